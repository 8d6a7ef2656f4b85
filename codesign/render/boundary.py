"""The part of a frame's gradient that automatic differentiation misses: silhouettes and edges that move
across the film.

With pupil point q fixed, the film is cut by curves where radiance jumps. When such a curve moves by v along
its normal n, a pixel gains (L- - L+) v per length of curve, L- and L+ the radiances before and behind it
along n. The term is estimated by points on the curves, and enters as w (x(y, q) . n), whose value is taken
out again and whose gradient is that of the film position x of the world point y: through the lens, the pose of
the camera and that of the object, whatever they depend on. Sources: Li et al., Differentiable Monte Carlo ray
tracing through edge sampling, SIGGRAPH Asia 2018 (the term); Reynolds' transport theorem.
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.pose import apply, inverse
from codesign.render.camera import Camera
from codesign.render.curve_points import IN_FRONT_M, CurvePoints, curve_points
from codesign.render.moving import cameras_in_parts, in_one_row, parts
from codesign.render.rays import coloured_rays
from codesign.render.unlisted import check_listed
from codesign.render.wavefront import HIDDEN, look

# px, of the film position for the derivative of a ray; the change up to which its root is taken as found, since the
# next would be of its square
STEP_PX = 1e-3
FOUND_PX = 1e-4
TURNS = 6
SLIPPED = 5e-3  # a ray that goes on by this share of the distance has missed the faces beside the edge
# for the question whether there are jumps at all: points per pixel of curve, and share of the light
GLANCE_PER_PX = 0.3
CONTRAST = 1e-3
_AHEAD = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@dataclass(frozen=True)
class Jumps:
    """Seen points of curves with a jump of radiance, in the axes of their part: world [n, 3], frame and part [n],
    film position [n, 2] px, pupil [n, 2], colour [n], pixel [n] of the sequence, weight [n], contrast [n] of the two
    radiances, and the motion along the curve's normal on the film per miss of the ray in space, [n, 2] px/m."""

    world_m: Tensor
    frame: Tensor
    part: Tensor
    film_px: Tensor
    pupil: Tensor
    colour: Tensor
    pixel: Tensor
    weight: Tensor
    contrast: Tensor
    per_miss: Tensor

    def __getitem__(self, rows: Any) -> "Jumps":
        return Jumps(*(getattr(self, field.name)[rows] for field in fields(self)))


def boundary_term(camera: Camera, scene: Any, T_world_cam: Tensor, per_px: float = 2.5) -> Tensor:
    """Zero-valued image [..., T, *film.shape] whose gradient is that of moving silhouettes and edges.

    Args: camera, scene, T_world_cam as for ``frames``; every part of the scene with ``outline()`` and
      ``radiance_and_distance``. per_px: samples per pixel length of curve.
    Gradient: lens, poses, and poses of moving objects, each of which is rigid.
    Raises: DomainError for a scene that does not know its curves.
    """
    shape = (*T_world_cam.shape[:-2], *camera.film.shape)
    frames_each = T_world_cam.shape[-3]
    scene, T_world_cam = in_one_row(scene, T_world_cam)
    cameras = torch.stack([pose.double() for pose in cameras_in_parts(scene, T_world_cam)])
    found = _seen(camera, scene, cameras.detach(), frames_each, per_px)
    if found is None or found.frame.numel() == 0:
        return torch.zeros(shape, dtype=scene.dtype)
    back = inverse(cameras)[found.part, found.frame]
    y = apply(back, found.world_m[:, None])[:, 0]
    origin, direction, _ = coloured_rays(camera, found.film_px, found.pupil, found.colour)
    ahead = (y[:, 2:] - origin[:, 2:]) / direction[:, 2:]
    # zero; how it changes tells how the film position must
    miss = origin[:, :2] + direction[:, :2] * ahead - y[:, :2]
    along = -(miss * found.per_miss).sum(1)
    image = torch.zeros(math.prod(shape), dtype=torch.float64).index_add(
        0, found.pixel, found.weight * (along - along.detach())
    )
    return image.reshape(shape).to(scene.dtype)


def radiance_jumps(camera: Camera, scene: Any, T_world_cam: Tensor) -> bool:
    """Whether any frame [..., T, 4, 4] shows an edge or outline at which radiance jumps by more than CONTRAST of what
    is seen there; looked at by few points. Raises: as ``boundary_term``."""
    frames_each = T_world_cam.shape[-3]
    scene, T_world_cam = in_one_row(scene, T_world_cam)
    cameras = torch.stack([pose.detach().double() for pose in cameras_in_parts(scene, T_world_cam)])
    found = _seen(camera, scene, cameras, frames_each, GLANCE_PER_PX)
    return found is not None and bool((found.contrast > CONTRAST).any())


@torch.no_grad()
def _seen(camera, scene, cameras, frames_each, per_px):
    """Jumps at points on the curves of all parts, of views that are certified; None for none."""
    curves = [_curves(part) for part in parts(scene)]
    check_listed(camera, scene, curves, cameras)
    points = curve_points(camera, curves, cameras, frames_each, per_px)
    return None if points is None else jumps(camera, scene, cameras, points)


def _curves(scene):
    if not hasattr(scene, "outline"):
        raise DomainError(
            f"gradient 'boundary' needs a scene that lists the curves where its radiance jumps, but a "
            f"{type(scene).__name__} has no outline(); give it one as MitsubaScene has it (an empty list where nothing "
            "jumps), or use 'difference'."
        )
    return list(scene.outline())


def jumps(camera: Camera, scene: Any, cameras: Tensor, points: CurvePoints) -> Jumps | None:
    """The points that are seen, with their jumps of radiance; None for none. cameras: [parts, F, 4, 4]."""
    back = inverse(cameras)[points.part, points.frame]
    y, on = apply(back, torch.stack([points.world_m, points.ahead_m], 1)).unbind(1)
    rows = torch.nonzero((y[:, 2] > IN_FRONT_M) & (on[:, 2] > IN_FRONT_M))[:, 0]
    if not rows.numel():
        return None
    points, y, on = points[rows], y[rows], on[rows]
    x, per_px, slope, passes = _on_film(camera, y, points)
    pixel = _pixels(camera.film, x, points.window)
    moved = (on - y)[:, :2] - slope * (on - y)[:, 2:]
    fine = passes & (pixel >= 0)
    per_m = torch.linalg.inv(torch.where(fine[:, None, None], per_px, torch.eye(2, dtype=y.dtype)))
    tangent = (per_m @ moved[..., None])[..., 0]
    length = tangent.norm(dim=1)
    rows = torch.nonzero(fine & (length > 0))[:, 0]
    if not rows.numel():
        return None
    points = points[rows]
    y, x, per_px, slope, per_m, tangent, length, pixel = (
        v[rows] for v in (y, x, per_px, slope, per_m, tangent, length, pixel)
    )
    normal = torch.stack([-tangent[:, 1], tangent[:, 0]], 1) / length[:, None]
    aside = (points.aside_rad / _rad_per_px(y, per_px, slope, normal))[:, None] * normal
    q, colour = (v.repeat(2, *[1] * (v.ndim - 1)) for v in (points.pupil, points.colour))
    origin, direction, weight = coloured_rays(camera, torch.cat([x - aside, x + aside]), q, colour)
    light, distance = (
        v.reshape(2, -1) for v in look(scene, cameras[:, points.frame.repeat(2)], origin, direction)
    )
    before, behind = weight.detach().reshape(2, -1) * light
    reach = (y - origin[: len(y)]).norm(dim=1)
    # of a face nearly edge-on the near side may be much nearer; between two faces that are seen a ray may slip through
    seen = distance.amax(0) > reach * (1 - HIDDEN)
    seen &= ~points.covered | (distance.amax(0) < reach * (1 + SLIPPED))
    jump = (before - behind) * length * points.share * seen
    found = Jumps(
        points.world_m,
        points.frame,
        points.part,
        x,
        points.pupil,
        points.colour,
        pixel + points.frame * math.prod(camera.film.shape),
        jump,
        (before - behind).abs() / torch.maximum(before, behind).clamp_min(1e-30),
        (normal[:, None] @ per_m)[:, 0],
    )
    return found[torch.nonzero(jump != 0)[:, 0]]


def _rad_per_px(y, per_px, slope, normal):
    """Angle [n] that a ray to y [n, 3] turns by per pixel along ``normal`` [n, 2] on the film."""
    ray = torch.cat([slope, torch.ones_like(slope[:, :1])], 1)
    moved = (per_px @ normal[..., None])[..., 0]
    moved = torch.cat([moved, torch.zeros_like(moved[:, :1])], 1)
    return torch.linalg.cross(moved, ray).norm(dim=1) / (y[:, 2] * ray.square().sum(1))


def _on_film(camera, y, points):
    """Where points y [n, 3] in camera axes are seen through points of the pupil: film position [n, 2] px, change of
    the place at that depth per pixel of it [n, 2, 2] m/px, slope of the ray there [n, 2], and whether light passes
    [n]. Newton's method on the rays of the camera, from where the lens says light of the point goes."""
    steps = STEP_PX * torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=y.dtype)
    x = _first_guess(camera, y, points)
    per_px = torch.eye(2, dtype=y.dtype).repeat(len(y), 1, 1)
    slope = torch.zeros_like(x)
    found = torch.zeros(len(y), dtype=torch.bool)
    rows = torch.arange(len(y))
    for _ in range(TURNS):
        at = (x[rows] + steps[:, None]).reshape(-1, 2)
        q, colour = points.pupil[rows].repeat(3, 1), points.colour[rows].repeat(3)
        origin, direction, light = coloured_rays(camera, at, q, colour)
        origin, direction = (v.reshape(3, -1, 3) for v in (origin, direction))
        passes = ((light.reshape(3, -1) > 0) & (direction[..., 2] > 1e-6)).all(0)
        slopes = direction[..., :2] / torch.where(passes[:, None], direction[..., 2:], 1.0)
        here = origin[..., :2] + slopes * (y[rows, 2:] - origin[..., 2:])
        change_per_px = torch.stack([here[1] - here[0], here[2] - here[0]], -1) / STEP_PX
        passes &= torch.linalg.det(change_per_px).abs() > 1e-12 * change_per_px.square().sum((1, 2))
        rows, change_per_px = rows[passes], change_per_px[passes]
        change = torch.linalg.solve(change_per_px, here[0, passes] - y[rows, :2])
        x[rows] -= change
        per_px[rows] = change_per_px
        slope[rows] = slopes[0, passes]
        near = change.abs().amax(1) < FOUND_PX
        found[rows] = near
        rows = rows[~near]
        if not rows.numel():
            break
    return x, per_px, slope, found


def _first_guess(camera, y, points):
    """Film position [n, 2] px of points y [n, 3]: as the lens sends light there, or else along the chief ray of the
    axis's scale."""
    film = camera.film
    if not hasattr(camera.lens, "film_points"):
        return film.middle_px + y[:, :2] / y[:, 2:] / camera.slope_per_px()
    if camera.spectrum is None:
        x, _, _ = camera.lens.film_points(1e3 * y, points.pupil)
        return x / film.pixel_pitch_mm + film.middle_px
    x = torch.zeros_like(y[:, :2])
    for number, wavelength in enumerate(camera.spectrum.wavelengths_um):
        rows = points.colour == number
        x[rows] = camera.lens.film_points(1e3 * y[rows], points.pupil[rows], wavelength)[0].to(x)
    return x / film.pixel_pitch_mm + film.middle_px


def _pixels(film, x, window):
    """Flat number of the pixel of the given windows [n] that holds each position [n, 2], -1 outside."""
    corner = torch.tensor(film.windows_px or ((0, 0),), dtype=x.dtype)[window]
    column, row = (x - corner + 0.5).floor().unbind(1)
    inside = (column >= 0) & (column < film.width_px) & (row >= 0) & (row < film.height_px)
    number = window * (film.width_px * film.height_px) + row * film.width_px + column
    return torch.where(inside, number, -1.0).long()
