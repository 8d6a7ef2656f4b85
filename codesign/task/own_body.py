"""How much of the picture the robot's own body covers, as a requirement of a mount."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from codesign.errors import DomainError, as_number
from codesign.place import Body
from codesign.place.requirements import check_positive
from codesign.render import Camera, MitsubaScene, frames
from codesign.render.charts import glowing
from codesign.render.moving import views_of
from codesign.render.truth import hits_of


@dataclass(frozen=True)
class OwnBody:
    """The body covers at most ``largest_share`` of the picture, one of the requirements of a mount (see codesign.place).

    The slack's gradient is that of a rendered picture in which the body glows and nothing else does, with the motion of
    its silhouettes: it is 0 where nothing of the body is in view. The exact answer counts chief rays.

    >>> from codesign import lens, place, render, task
    >>> sheet = place.Body([([(2, -9, 0), (2, 9, 0), (2, 9, 9), (2, -9, 9)], [(0, 1, 2), (0, 2, 3)])])
    >>> camera = render.Camera(lens.Pinhole(8.0), 16, 16, 0.1, 4)
    >>> level = place.Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))().detach()  # the sheet fills the upper half
    >>> round(float(task.OwnBody(sheet, 0.7).slack(level, camera)), 3)
    0.2

    Args: body: in the axes of the mount. largest_share: 0 to 1. step: share below it from which on nothing pushes. per_px: points of
      silhouettes per pixel length, for the gradient (before a rover, in 16 x 12 pixels, it is good to 2 %).
    Raises: DomainError for shares out of range.
    """

    body: Body
    largest_share: float
    step: float = 0.02
    per_px: float = 10.0
    name: str = "own body in view"
    unit: str = "of the picture"

    def __post_init__(self):
        if not 0 <= as_number(self.largest_share, "largest_share") <= 1:
            raise DomainError(
                f"own body: largest_share is {self.largest_share}; a share from 0 to 1 is needed."
            )
        check_positive(self.step, "own body: step")

    @cached_property
    def scene(self) -> MitsubaScene:
        """The body with radiance 1 on both sides of every face, before nothing."""
        return glowing(self.body.triangles)

    def slack(self, T_body_cam: Tensor, camera: Camera) -> Tensor:
        """[..., 1] share of the picture that may still be covered. Gradient: mount and lens."""
        return self.largest_share - self.covered(T_body_cam, camera).mean(-1, keepdim=True)

    def covered(self, T_body_cam: Tensor, camera: Camera) -> Tensor:
        """[..., windows] share of every window of the film that the body covers. Gradient: mount and lens."""
        way = "boundary" if torch.is_grad_enabled() else "interior"  # of which the pictures are the same
        found = frames(camera, self.scene, T_body_cam.reshape(-1, 4, 4), way, self.per_px).double()
        return found.flatten(-2).mean(-1).reshape(*T_body_cam.shape[:-2], -1)

    @torch.no_grad()
    def exact(self, T_body_cam: Tensor, camera: Camera) -> Tensor:
        """[..., 1]: the same, of the pixels whose chief ray meets the body."""
        rays = camera.chief_rays(camera.film.pixels())
        hits = hits_of(rays, self.scene, views_of(self.scene, T_body_cam.reshape(-1, 4, 4)).cameras)
        covered = (hits.part >= 0).double().mean(-1).reshape(*T_body_cam.shape[:-2], 1)
        return self.largest_share - covered
