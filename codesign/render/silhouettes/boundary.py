"""The part of a frame's gradient that automatic differentiation misses: silhouettes and edges that
move across the film.

With pupil point q fixed, the film is cut by curves where radiance jumps. When such a curve moves by
v along its normal n, a pixel gains (L- - L+) v per length of curve, L- and L+ the radiances before
and behind it along n. The term is estimated by points on the curves, and enters as w (x(y, q) . n),
whose value is taken out again and whose gradient is that of the film position x of the world point
y: through the lens, the pose of the camera and that of the object, whatever they depend on.
Sources: Li et al., Differentiable Monte Carlo ray tracing through edge sampling, SIGGRAPH Asia 2018
(the term); Reynolds' transport theorem.
"""

import math

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.pose import apply, inverse
from codesign.render.camera import Camera
from codesign.render.moving import Views, parts
from codesign.render.silhouettes.curve_points import FieldOfView, curve_points
from codesign.render.silhouettes.jumps import jumps
from codesign.render.silhouettes.occlusion_check import check_listed

# for the question whether there are jumps at all: points per pixel of curve, and share of the light
GLANCE_PER_PX = 0.3
CONTRAST = 1e-3


def boundary_term(camera: Camera, views: Views, per_px: float = 2.5) -> Tensor:
    """Zero-valued image [..., T, *film.shape] whose gradient is that of moving silhouettes and
    edges.

    Args:
      camera: as for ``frames``.
      views: of a scene, every part of which has ``outline()`` and ``radiance_and_distance``.
      per_px: samples per pixel length of curve.
    Gradient: lens, poses, and poses of moving objects, each of which is rigid.
    Raises: DomainError for a scene that does not know its curves.
    """
    shape = (*views.batch, *camera.film.shape)
    dtype = views.scene.dtype
    found = _seen(camera, views.detach(), per_px)
    if found is None or found.frame.numel() == 0:
        return torch.zeros(shape, dtype=dtype)
    back = inverse(views.cameras)[found.part, found.frame]
    y = apply(back, found.world_m[:, None])[:, 0]
    rays = camera.coloured_rays(found.film_px, found.pupil, found.colour)
    ahead = (y[:, 2:] - rays.origin_m[:, 2:]) / rays.direction[:, 2:]
    # zero; how it changes tells how the film position must
    miss = rays.origin_m[:, :2] + rays.direction[:, :2] * ahead - y[:, :2]
    along = -(miss * found.per_miss).sum(1)
    image = torch.zeros(math.prod(shape), dtype=torch.float64).index_add(
        0, found.pixel, found.weight * (along - along.detach())
    )
    return image.reshape(shape).to(dtype)


def radiance_jumps(camera: Camera, views: Views) -> bool:
    """Whether any frame shows an edge or outline at which radiance jumps by more than CONTRAST of
    what is seen there; looked at by few points. Raises: as ``boundary_term``."""
    found = _seen(camera, views.detach(), GLANCE_PER_PX)
    return found is not None and bool((found.contrast > CONTRAST).any())


@torch.no_grad()
def _seen(camera, views, per_px):
    """Jumps at points on the curves of all parts, of views that are certified; None for none."""
    scene, cameras = views.scene, views.cameras
    curves = [_curves(part) for part in parts(scene)]
    field = FieldOfView(camera)
    check_listed(camera, field, scene, curves, cameras)
    points = curve_points(camera, field, curves, cameras, views.batch[-1], per_px)
    found = None if points is None else jumps(camera, scene, cameras, points)
    return None if found is None else found[torch.nonzero(found.weight)[:, 0]]


def _curves(scene):
    if not hasattr(scene, "outline"):
        raise DomainError(
            f"gradient 'boundary' needs a scene that lists the curves where its radiance jumps, but a "
            f"{type(scene).__name__} has no outline(); give it one as MitsubaScene has it (an empty list "
            "where nothing jumps), or use 'difference'."
        )
    return list(scene.outline())
