"""What a mount has to keep: distance to the robot, a free way for its cable, a view ahead.

Each requirement has a ``slack`` in metres or radians with a gradient to the mount (and to the lens
where it looks through it), and an ``exact`` one that is at least 0 where it is kept; they have the
same sign but where a count of pixels decides. ``penalty`` makes one smooth number of the slacks, to
add to an objective; ``judge`` says yes or no.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import torch
from torch import Tensor

from codesign.checks import check_finite, check_kind, check_number, check_positive
from codesign.errors import DomainError, ShapeError
from codesign.mount.body import Body, Housing
from codesign.render import Camera, MitsubaScene, frames
from codesign.render.charts import glowing
from codesign.render.film import some_pixels
from codesign.render.moving import views_of
from codesign.render.truth import hits_of
from codesign.types import ChiefRayCamera

DARK = -1.0  # sine of where a pixel without light looks
CAMERA_PIXELS = 4096  # of a film, spread over it, that a look ahead looks at


class Requirement(Protocol):
    """name: what is required. unit: of the slack. step: slack from which on nothing pushes."""

    @property
    def name(self) -> str: ...

    @property
    def unit(self) -> str: ...

    @property
    def step(self) -> float: ...

    def slack(self, T_body_cam: Tensor, camera: Any) -> Tensor:
        """[..., K] of mounts [..., 4, 4], with gradient."""
        ...

    def exact(self, T_body_cam: Tensor, camera: Any) -> Tensor:
        """[..., K]: the requirement is kept where none is negative."""
        ...


@dataclass(frozen=True)
class Clearance:
    """The housing stays ``margin_m`` away from the robot.

    Args:
      body: in the axes of the mount.
      housing: of the camera.
      margin_m: >= 0.
      step: metres beyond the margin within which ``penalty`` pushes.
    """

    body: Body
    housing: Housing
    margin_m: float = 0.0
    step: float = 0.01
    name: str = "clearance"
    unit: str = "m"

    def __post_init__(self):
        check_number(self.margin_m, "clearance: margin_m", 0.0)
        check_positive(self.step, "clearance: step")
        check_kind(self.body, Body, "clearance: the body")

    def slack(self, T_body_cam: Tensor, camera: ChiefRayCamera) -> Tensor:
        """[..., solids] m of clearance beyond the margin. Gradient: mount."""
        return self.body.clearances_m(T_body_cam, self.housing) - self.margin_m

    exact = slack


@dataclass(frozen=True)
class CableSide:
    """The back of the housing, where the cable leaves, does not point into a cone.

    Args:
      forbidden: direction in body axes, of any length.
      half_angle_rad: of the cone, above 0 and below pi.
    """

    forbidden: tuple[float, float, float]
    half_angle_rad: float
    step: float = 0.1
    name: str = "cable side"
    unit: str = "rad"

    def __post_init__(self):
        check_number(self.half_angle_rad, "cable side: half_angle_rad", above=0.0, below=math.pi)
        _direction(self.forbidden, "cable side: forbidden")
        check_positive(self.step, "cable side: step")

    def slack(self, T_body_cam: Tensor, camera: ChiefRayCamera) -> Tensor:
        """[..., 1]: (cos a - cos b) / sin a with a the half angle and b the angle between back and
        axis; near the rim of the cone that is b - a in radians, and it is smooth everywhere.
        Gradient: mount."""
        return (math.cos(self.half_angle_rad) - self._cosine(T_body_cam)) / math.sin(
            self.half_angle_rad
        )

    def exact(self, T_body_cam: Tensor, camera: ChiefRayCamera) -> Tensor:
        """[..., 1]: b - a, radians."""
        return self._cosine(T_body_cam).clamp(-1, 1).acos() - self.half_angle_rad

    def _cosine(self, T_body_cam):
        axis = _direction(self.forbidden, "cable side: forbidden").to(T_body_cam)
        return -(T_body_cam[..., :3, 2] * axis).sum(-1, keepdim=True)


@dataclass(frozen=True)
class LookAhead:
    """A share of the film (of its windows, where it has some) sees farther than ``distance_m``.

    A pixel sees beyond the distance when its chief ray goes ahead and meets the ground, if at all,
    beyond the line across at that distance.

    Args:
      distance_m: from the body's origin, forward, > 0.
      share: of the film's pixels, above 0, at most 1.
      ground_z_m: height of the ground in body axes (0 for a body whose origin is on the ground, as
        base_footprint of REP 105).
      smooth: share of the pixels over which the slack at the wanted rank is averaged.
    Raises: DomainError for numbers out of range.
    """

    distance_m: float
    share: float
    ground_z_m: float = 0.0
    smooth: float = 0.02
    step: float = 0.05
    name: str = "look-ahead"
    unit: str = "rad"

    def __post_init__(self):
        check_positive(self.distance_m, "look-ahead: distance_m")
        check_positive(self.step, "look-ahead: step")
        for label in ("share", "smooth"):
            check_number(getattr(self, label), f"look-ahead: {label}", above=0.0, most=1.0)

    def slack(self, T_body_cam: Tensor, camera: ChiefRayCamera) -> Tensor:
        """[..., 1]: the mean of ``angles`` at the ranks around the one that ``exact`` looks at, so
        that a row of pixels decides and not its last one. Gradient: mount, and the lens behind the
        chief rays."""
        angles = self.angles(T_body_cam, camera)
        rank = torch.arange(angles.shape[-1]).to(angles)
        reach = max(1.0, self.smooth * len(rank))
        weight = (1 - (rank - self._rank(angles)).abs() / reach).clamp_min(0)
        found = angles.sort(-1, descending=True).values
        # pixels without light are no part of the edge between those that have some
        dark = (found == DARK) & (found[..., self._rank(angles)][..., None] != DARK)
        weight = torch.where(dark, 0.0, weight)
        return (found * weight).sum(-1, keepdim=True) / weight.sum(-1, keepdim=True)

    def exact(self, T_body_cam: Tensor, camera: ChiefRayCamera) -> Tensor:
        """[..., 1]: the angle that just ``share`` of the pixels reach."""
        angles = self.angles(T_body_cam, camera)
        rank = self._rank(angles)
        return angles.sort(-1, descending=True).values[..., rank : rank + 1]

    def _rank(self, angles):
        return max(math.ceil(self.share * angles.shape[-1] - 1e-9) - 1, 0)

    def angles(self, T_body_cam: Tensor, camera: ChiefRayCamera) -> Tensor:
        """By how much each pixel [..., P] looks beyond the distance: the sine of the angle between
        its ray and the plane through the line at that distance and the camera, or the vertical
        plane across, whichever is smaller; of a camera beyond that line, the latter."""
        if not hasattr(camera, "chief_rays"):
            raise DomainError(
                "look-ahead: it looks through the camera; give one with chief rays, as render.Camera."
            )
        pixels = camera.film.pixels()[some_pixels(camera.film, CAMERA_PIXELS)]
        rays = camera.chief_rays(pixels)
        pose = T_body_cam.double()
        direction = rays.direction.double() @ pose[..., :3, :3].mT
        forward = direction[..., 0]
        origin = pose[..., None, :3, 3] + rays.origin_m.double() @ pose[..., :3, :3].mT
        before = (self.distance_m - origin[..., 0]).clamp_min(0)
        height = origin[..., 2] - self.ground_z_m
        line_m = torch.hypot(height, before).clamp_min(1e-9)
        over = (height * forward + before * direction[..., 2]) / line_m
        # what gets no light sees nothing
        return torch.where(rays.weight > 0, torch.minimum(over, forward), DARK)


def penalty(
    requirements: Sequence[Requirement],
    T_body_cam: Tensor,
    camera: ChiefRayCamera,
) -> Tensor:
    """What to add to an objective so that a search keeps to its requirements: sum of
    max(0, 1 - slack / step)^2.

    Args:
      T_body_cam: [..., 4, 4].
    Returns: [...], 0 where every slack is at least its step, 1 where one of them is 0.
    Gradient: mount, lens; continuous wherever the slack's is.
    """
    total = T_body_cam.new_zeros(T_body_cam.shape[:-2], dtype=torch.float64)
    for each in requirements:
        total = total + (1 - each.slack(T_body_cam, camera) / each.step).clamp_min(0).square().sum(
            -1
        )
    return total


@dataclass(frozen=True)
class Verdict:
    """slack: the smallest, in ``unit``. kept: whether it is at least 0."""

    name: str
    slack: float
    unit: str
    kept: bool

    def __str__(self):
        said, left = ("kept with", " to spare") if self.kept else ("missed by", "")
        return f"{self.name}: {said} {abs(self.slack):.3g} {self.unit}{left}"


@torch.no_grad()
def judge(
    requirements: Sequence[Requirement],
    T_body_cam: Tensor,
    camera: ChiefRayCamera,
) -> list[Verdict]:
    """The hard answer for one mount [4, 4], one Verdict for each requirement."""
    if T_body_cam.shape != (4, 4):
        raise ShapeError(
            f"judge: one mount [4, 4] is judged at a time, got {tuple(T_body_cam.shape)}."
        )
    found = []
    for each in requirements:
        slack = float(each.exact(T_body_cam, camera).min())
        found.append(Verdict(each.name, slack, each.unit, slack >= 0))
    return found


@torch.no_grad()
def first_missed(
    requirements: Sequence[Requirement],
    T_body_cam: Tensor,
    camera: Any,
) -> Requirement | None:
    """The first requirement that one mount [4, 4] does not keep, by the hard answer; None where all
    are kept."""
    for each in requirements:
        if float(each.exact(T_body_cam, camera).min()) < 0:
            return each
    return None


def _direction(vector, name):
    given = check_finite(torch.as_tensor(vector, dtype=torch.float64), name, "give finite numbers")
    if given.shape != (3,) or not float(given.norm()) > 0:
        raise DomainError(f"{name} is {vector}; three numbers that are not all 0 are needed.")
    return given / given.norm()


@dataclass(frozen=True)
class OwnBody:
    """The body covers at most ``largest_share`` of the film (of its windows, where it has some), one of the requirements of a mount
    (see codesign.mount).

    The slack's gradient is that of a rendered picture in which the body glows and nothing else
    does, with the motion of its silhouettes: it is 0 where nothing of the body is in view. The
    exact answer counts chief rays.

    >>> from codesign import lens, render
    >>> from codesign.mount import Body, Mount, OwnBody
    >>> sheet = Body([([(2, -9, 0), (2, 9, 0), (2, 9, 9), (2, -9, 9)], [(0, 1, 2), (0, 2, 3)])])
    >>> camera = render.Camera(lens.Pinhole(8.0), 16, 16, 0.1, 4)
    >>> level = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))().detach()  # the sheet fills the upper half
    >>> round(float(OwnBody(sheet, 0.7).slack(level, camera)), 3)
    0.2

    Args:
      body: in the axes of the mount.
      largest_share: 0 to 1.
      step: share below it from which on nothing pushes.
      per_px: points of silhouettes per pixel length, for the gradient (before a rover, in 16 x 12
        pixels, it is good to 2 %).
    Raises: DomainError for shares out of range.
    """

    body: Body
    largest_share: float
    step: float = 0.02
    per_px: float = 10.0
    name: str = "own body in view"
    unit: str = "of the film"

    def __post_init__(self):
        check_number(self.largest_share, "own body: largest_share", 0.0, 1.0)
        check_positive(self.step, "own body: step")
        check_kind(self.body, Body, "own body: the body", "see Body.of")

    @cached_property
    def scene(self) -> MitsubaScene:
        """The body with radiance 1 on both sides of every face, before nothing."""
        return glowing(self.body.triangles)

    def slack(self, T_body_cam: Tensor, camera: Camera) -> Tensor:
        """[..., 1] share of the film that may still be covered. Gradient: mount and lens."""
        return self.largest_share - self.covered(T_body_cam, camera).mean(-1, keepdim=True)

    def covered(self, T_body_cam: Tensor, camera: Camera) -> Tensor:
        """[..., windows] share of every window of the film that the body covers. Gradient: mount
        and lens."""
        poses = T_body_cam.reshape(-1, 4, 4)
        camera = camera.in_one_colour()  # by falloff a dark corner would be free
        rays = camera.rays()
        moves = any(each.requires_grad for each in (poses, rays.direction, rays.weight))
        # of which the pictures are the same
        way = "boundary" if moves and torch.is_grad_enabled() else "interior"
        found = frames(camera, self.scene, poses, way, self.per_px, rays=rays).double()
        return found.flatten(-2).mean(-1).reshape(*T_body_cam.shape[:-2], -1)

    @torch.no_grad()
    def exact(self, T_body_cam: Tensor, camera: Camera) -> Tensor:
        """[..., 1]: the same, of the pixels whose chief ray meets the body."""
        return self.largest_share - self.met(T_body_cam, camera).mean(-1, keepdim=True)

    @torch.no_grad()
    def met(self, T_body_cam: Tensor, camera: Camera, every_px: int = 1) -> Tensor:
        """[..., windows] share of the pixels of every window of the film, or of every so many in
        both directions, whose chief ray meets the body. No gradient."""
        size = camera.film.shape[-2:]
        first = min(every_px, *size) // 2
        pixels = camera.film.pixels().reshape(-1, *size, 2)[:, first::every_px, first::every_px]
        rays = camera.chief_rays(pixels.reshape(-1, 2))
        hits = hits_of(rays, self.scene, views_of(self.scene, T_body_cam.reshape(-1, 4, 4)).cameras)
        return (hits.part >= 0).double().reshape(*T_body_cam.shape[:-2], len(pixels), -1).mean(-1)
