"""The part of a frame's gradient that automatic differentiation misses: silhouettes and edges that move
across the film.

With pupil point q fixed, the film is cut by curves where radiance jumps. When such a curve moves by v along
its normal n, a pixel gains (L- - L+) v per length of curve, L- and L+ the radiances before and behind it
along n. The term is estimated by points on the curves, and enters as w (x(y, q) . n), whose value is taken
out again and whose gradient is that of the film position x of the world point y: through the lens and the
pose, whatever they depend on. Sources: Li et al., Differentiable Monte Carlo ray tracing through edge
sampling, SIGGRAPH Asia 2018 (the term); Reynolds' transport theorem.
"""

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from codesign.backend import arrays
from codesign.errors import DomainError
from codesign.pose import apply, inverse
from codesign.render.camera import Camera
from codesign.render.sampling import film_pupil_pattern

# where the two radiances are read, either side of a curve; a float32 ray is good to a hundredth of that
ASIDE_RAD = 1e-5
WIDER = 1.15  # a lens with this much distortion still finds the points at the film's edge
# a point is hidden when something beside it is nearer by this share; a curved surface falls away by less
HIDDEN = 5e-3
# of a piece, for its tangent on the film; of the pupil, for the motion at one point of it
STEP = 1e-4
PUPIL_STEP = 1e-3
_AHEAD = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@dataclass(frozen=True)
class CurvePoints:
    """Sampled points of curves: world [n, 3], pupil point [n, 2], frame [n], the same curve a little further
    on [n, 3], and how many such steps each point stands for [n]."""

    world_m: Tensor
    ahead_m: Tensor
    share: Tensor
    pupil: Tensor
    frame: Tensor


def boundary_term(camera: Camera, scene: Any, T_world_cam: Tensor, per_px: float = 2.5) -> Tensor:
    """Zero-valued image [..., T, *film.shape] whose gradient is that of moving silhouettes and edges.

    Args: camera, scene, T_world_cam as for ``frames``; scene with ``outline()`` and
      ``radiance_and_distance``. per_px: samples per pixel length of curve.
    Gradient: lens and poses. The curves' own world points do not move (rigid scenes).
    Raises: DomainError for cameras with a spectrum or aimed pupils, whose boundary is not implemented.
    """
    if camera.aim or camera.spectrum is not None or camera.falloff:
        raise DomainError(
            "gradient 'boundary' is there for cameras without aim, spectrum and falloff; drop these, or use "
            "'difference'."
        )
    if not hasattr(camera.lens, "film_points"):
        raise DomainError(
            f"gradient 'boundary' needs a lens that says where points of space meet the film, but a "
            f"{type(camera.lens).__name__} has no film_points; write it as GeoLens has it, or use 'interior'."
        )
    shape = (*T_world_cam.shape[:-2], *camera.film.shape)
    frames_each = T_world_cam.shape[-3]
    T_world_cam = T_world_cam.reshape(-1, 4, 4)
    with torch.no_grad():
        px_per_slope = 1 / camera.slope_per_px()
        found = _jumps(
            camera,
            scene,
            T_world_cam.double(),
            _sample(camera, scene, T_world_cam, frames_each, per_px, px_per_slope),
            ASIDE_RAD * px_per_slope,
        )
    if found is None or found.frame.numel() == 0:
        return torch.zeros(shape, dtype=scene.dtype)
    back = inverse(T_world_cam.double())[found.frame]
    y = apply(back, found.world_m[:, None])[:, 0]
    rays = camera.rays_through(found.film_px, found.pupil)
    ahead = (y[:, 2:] - rays.origin_m[:, 2:]) / rays.direction[:, 2:]
    miss = (
        rays.origin_m[:, :2] + rays.direction[:, :2] * ahead - y[:, :2]
    )  # zero; how it changes tells how the film position must
    along = -(miss * found.per_miss).sum(1)
    image = torch.zeros(math.prod(shape), dtype=torch.float64).index_add(
        0, found.pixel, found.weight * (along - along.detach())
    )
    return image.reshape(shape).to(scene.dtype)


@dataclass(frozen=True)
class Jumps:
    """Seen points of curves with a jump of radiance: world [n, 3], frame [n], film position [n, 2] px, pupil
    [n, 2], pixel [n] of the sequence, weight [n], and the motion along the curve's normal on the film per
    miss of the ray in space, [n, 2] px/m."""

    world_m: Tensor
    frame: Tensor
    film_px: Tensor
    pupil: Tensor
    pixel: Tensor
    weight: Tensor
    per_miss: Tensor

    def __getitem__(self, rows):
        return Jumps(*(getattr(self, f.name)[rows] for f in fields(self)))


def _sample(camera, scene, T_world_cam, frames_each, per_px, px_per_slope):
    """Points on all curves that may fall on the film, about ``per_px`` per pixel length, stratified along
    each frame's curves; every trajectory, of ``frames_each`` frames, draws the same numbers."""
    film = camera.film
    parts = []
    centre = T_world_cam[:, :3, 3].double()
    aperture_m = getattr(camera.lens, "entrance_pupil_diameter_mm", 0.0) * 1e-3 / 2
    _, pupils = film_pupil_pattern(4096, camera.seed)
    generator = torch.Generator()
    for frame, eye in enumerate(centre):
        if frame % frames_each == 0:
            generator.manual_seed(camera.seed)
        back = inverse(T_world_cam[frame : frame + 1].double())[0]
        for curve in scene.outline():
            index, bounds = curve.pieces(eye, 8 / px_per_slope)
            if index.numel() == 0:
                continue
            ends = [_flat(back, curve.points(index, bounds[:, i], eye), px_per_slope) for i in (0, 1)]
            middle = (ends[0][0] + ends[1][0]) / 2
            half = torch.tensor([film.sensor_width_px, film.sensor_height_px], dtype=torch.float64) / 2
            reach = WIDER * half + 1 + (ends[1][0] - ends[0][0]).abs()
            ahead = ends[0][1] & ends[1][1] & (middle.abs() < reach).all(1)
            index = index[ahead]
            bounds = bounds[ahead]
            length = (ends[1][0] - ends[0][0])[ahead].norm(dim=1)
            if not index.numel():
                continue
            piece, inside, fraction = _places(length, per_px, generator)
            flat = (
                ends[0][0][ahead][piece] + inside[:, None] * (ends[1][0] - ends[0][0])[ahead][piece]
            ).abs()
            near = torch.nonzero((flat < WIDER * half + 1).all(1))[:, 0]
            piece = piece[near]
            inside = inside[near]
            fraction = fraction[near]
            if not piece.numel():
                continue
            count = piece.numel()
            wide = (bounds[:, 1] - bounds[:, 0])[piece]
            s = bounds[piece, 0] + inside * wide
            pupil = (
                pupils[(torch.arange(count) + torch.randint(4096, (1,), generator=generator)) % 4096]
                if aperture_m
                else torch.zeros(count, 2, dtype=torch.float64)
            )
            view = apply(
                T_world_cam[frame].double(),
                torch.cat([pupil * aperture_m, torch.zeros(count, 1, dtype=torch.float64)], 1),
            )
            step = STEP * wide
            y = curve.points(index[piece], s, view)
            on = curve.points(index[piece], s + step, view)
            parts.append(CurvePoints(y, on, fraction / STEP, pupil, torch.full((count,), frame)))
    if not parts:
        empty = torch.zeros(0, 3, dtype=torch.float64)
        return CurvePoints(empty, empty, empty[:, 0], empty[:, :2], torch.zeros(0, dtype=torch.long))
    return CurvePoints(
        *(
            torch.cat([getattr(p, name) for p in parts])
            for name in ("world_m", "ahead_m", "share", "pupil", "frame")
        )
    )


def _places(length, per_px, generator):
    """Where points lie on pieces of the given lengths [m] px: piece [n], position within it [n] 0..1, and
    share of the piece each stands for [n].

    A piece longer than the spacing of points is cut into equal parts with a point in each, so that what is
    constant along it is summed exactly; shorter ones are thinned together, evenly along their total length.
    """
    long = torch.nonzero(length * per_px >= 1)[:, 0]
    count = (length[long] * per_px).ceil().long()
    which = torch.repeat_interleave(torch.arange(long.numel()), count)
    k = torch.arange(which.numel()) - (count.cumsum(0) - count)[which]
    inside = (k + torch.rand(k.numel(), generator=generator, dtype=torch.float64)) / count[which]
    short = torch.nonzero(length * per_px < 1)[:, 0]
    total = length[short].cumsum(0)
    few = int(torch.ceil(total[-1] * per_px)) if short.numel() else 0
    if few == 0:
        return long[which], inside, 1 / count[which].double()
    at = (torch.arange(few) + torch.rand(1, generator=generator, dtype=torch.float64)) / few * total[-1]
    piece = torch.searchsorted(total, at).clamp_max(short.numel() - 1)
    size = length[short[piece]].clamp_min(1e-12)
    within = (1 - (total[piece] - at) / size).clamp(0, 1)
    return (
        torch.cat([long[which], short[piece]]),
        torch.cat([inside, within]),
        torch.cat([1 / count[which].double(), total[-1] / few / size]),
    )


def _flat(back, world_m, px_per_slope):
    """Rough film position [n, 2] px from the axis, and whether the point lies in front of the camera."""
    y = apply(back, world_m)
    front = y[:, 2] > 1e-3
    return y[:, :2] / torch.where(front, y[:, 2], 1.0)[:, None] * px_per_slope, front


def _jumps(camera, scene, T_world_cam, points, aside):
    """Jumps at the points that are seen, or None; radiances are read ``aside`` px from the curves."""
    film = camera.film
    back = inverse(T_world_cam)[points.frame]
    y, on = apply(back, torch.stack([points.world_m, points.ahead_m], 1)).unbind(1)
    front = (y[:, 2] > 1e-3) & (on[:, 2] > 1e-3)
    if not bool(front.any()):
        return None
    y = torch.where(front[:, None], y, _AHEAD)
    on = torch.where(front[:, None], on, _AHEAD)
    x, q, tangent, passes = _on_film(camera, y, on, points.pupil)
    usable = front & passes
    length = tangent.norm(dim=1)
    pixel = _pixels(film, x)
    rows = torch.nonzero(usable & (pixel >= 0) & (length > 0))[:, 0]
    if rows.numel() == 0:
        return None
    x = x[rows]
    q = q[rows]
    y = y[rows]
    on = on[rows]
    tangent = tangent[rows]
    length = length[rows]
    frame = points.frame[rows]
    share = points.share[rows]
    normal = torch.stack([-tangent[:, 1], tangent[:, 0]], 1) / length[:, None]
    rays = camera.rays_through(torch.cat([x - aside * normal, x + aside * normal]), q.repeat(2, 1))
    origin = rays.origin_m.reshape(2, -1, 3)
    direction = rays.direction.reshape(2, -1, 3)
    weight = rays.weight.reshape(2, -1)
    pose = T_world_cam[frame]
    world = [(pose[:, :3, :3] @ part[..., None])[..., 0] for part in (origin, direction)]
    start = (world[0] + pose[:, :3, 3]).reshape(-1, 3)
    along = world[1].reshape(-1, 3)
    light, distance = (v.reshape(2, -1) for v in _look(scene, start, along))
    reach = (y - origin[0]).norm(dim=1)
    jump = (
        (weight[0] * light[0] - weight[1] * light[1])
        * length
        * share
        * (distance.amin(0) > reach * (1 - HIDDEN))
    )
    # where the ray meets the depth of the point, per film position across the curve and along it
    here = origin + direction * ((y[:, 2:] - origin[..., 2:]) / direction[..., 2:])
    middle = (direction[0] + direction[1]) / 2
    across = (here[1] - here[0])[:, :2] / (2 * aside)
    moved = (on - y)[:, :2] - middle[:, :2] / middle[:, 2:] * (on - y)[:, 2:]
    jacobian = torch.stack([across, moved / length[:, None]], -1)  # [n, space, (normal, tangent)]
    fine = (torch.linalg.det(jacobian).abs() > 1e-16) & (jump != 0)
    per_miss = torch.linalg.inv(torch.where(fine[:, None, None], jacobian, torch.eye(2, dtype=y.dtype)))[:, 0]
    pixel = pixel[rows] + frame * math.prod(film.shape)
    return Jumps(points.world_m[rows], frame, x, q, pixel, jump, per_miss)[torch.nonzero(fine)[:, 0]]


def _look(scene, origin, direction):
    """Radiance [n] and distance [n] along world rays [n, 3], float64 without gradient."""
    import drjit as dr

    arr = arrays(origin.device.type, scene.dtype)
    o, d = (
        arr.Array3(*[arr.Float(c.to(scene.dtype).contiguous()) for c in part.unbind(1)])
        for part in (origin, direction)
    )
    light, distance = scene.radiance_and_distance(arr, o, d)
    dr.eval(light, distance)
    return [torch.as_tensor(v.numpy()).double() for v in (arr.Float(light), arr.Float(distance))]


def _on_film(camera, y, on, pupil):
    """Points y [n, 3] in camera axes seen through points of the exit pupil: film position [n, 2] px, the
    pupil point reached [n, 2] (the one asked for but for the square of the pupil's aberration), the tangent
    [n, 2] px towards ``on`` [n, 3] at one pupil point, and whether light passes [n]."""
    film = camera.film
    step = PUPIL_STEP * torch.eye(2, dtype=y.dtype)

    def trace(points, aims):
        x, q, passes = camera.lens.film_points(1e3 * torch.cat(points), torch.cat(aims))
        return (
            (x / film.pixel_pitch_mm + film.middle_px).reshape(len(points), -1, 2),
            q.reshape(len(points), -1, 2),
            passes.reshape(len(points), -1).all(0),
        )

    x, q, passes = trace([y, y, y], [pupil, pupil + step[0], pupil + step[1]])
    by_aim_x, by_aim_q = (torch.stack([v[1] - v[0], v[2] - v[0]], -1) / PUPIL_STEP for v in (x, q))
    passes &= torch.linalg.det(by_aim_q).abs() > 1e-6
    back = torch.linalg.inv(torch.where(passes[:, None, None], by_aim_q, step / PUPIL_STEP))
    aim = pupil + (back @ (pupil - q[0])[..., None])[..., 0]
    x, q, also = trace([y, on], [aim, aim])
    return x[0], q[0], x[1] - x[0] - (by_aim_x @ (back @ (q[1] - q[0])[..., None]))[..., 0], passes & also


def _pixels(film, x):
    """Flat number of the pixel of the (first) window that holds each position, -1 outside."""
    found = torch.full(x.shape[:1], -1)
    size = film.width_px * film.height_px
    for number, (left, top) in reversed(list(enumerate(film.windows_px or ((0, 0),)))):
        column = (x[:, 0] - left + 0.5).floor()
        row = (x[:, 1] - top + 0.5).floor()
        inside = (column >= 0) & (column < film.width_px) & (row >= 0) & (row < film.height_px)
        found = torch.where(inside, (number * size + row * film.width_px + column).long(), found)
    return found
