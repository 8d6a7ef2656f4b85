"""Does a scene list every curve where radiance jumps, and each once? Asked of the picture, not of the geometry.

Lines are laid across the film, each through one point of the pupil; where radiance differs between neighbouring rays
the larger difference is halved again and again, until what is left is a jump or a slope. Every jump must lie on
exactly one listed curve. What is neither makes the gradient of the boundary term wrong, and is refused.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.pose import apply, inverse
from codesign.render.camera import Camera
from codesign.render.curve_points import IN_FRONT_M, piece_rad
from codesign.render.film import coarse_pixels
from codesign.render.moving import parts, says_distance
from codesign.render.sampling import film_pupil_pattern
from codesign.render.wavefront import HIDDEN, look

LINES = 16  # each way across the film
RAYS_PER_PX = 3
HALVINGS = 14
CONTRAST = 0.02  # of a frame's range: what is less is no jump worth the name
NEAR_PX = 0.5  # between a jump and the chord of a piece that may hold it
ON_PX = 0.05  # between a jump and the curve it lies on
SAME_RAD = 3e-5  # between curves that are one, at float32's precision
MEETING = 20  # times that from their ends, curves that run together are one listed twice
STEPS = 24  # of the search along a piece
WRONG = 0.05  # share of all jumps up to which a view is taken as listed
# another view needs no look of its own as long as the camera has moved by less than this share of the distance to what
# it sees, and turned by less than this share of half its field
MOVED = 0.2
WIDER = 1.2
TURNED = 0.5


@dataclass(frozen=True)
class Listing:
    """Of the jumps in a view, weighted by their size: the share on no listed curve, the share on several, and the
    largest of these jumps in world axes (or the axes of the static part); crossings: how many jumps were found."""

    unlisted: float
    doubled: float
    place_m: tuple[float, float, float] | None
    crossings: int


def listing(
    camera: Camera, scene: Any, curves: Sequence[Sequence[Any]], cameras: Tensor, lines: int = LINES
) -> Listing:
    """Whether the jumps of one view lie on the listed curves. cameras: [parts, 4, 4], the camera in the axes of every
    part; curves: of every part; lines: each way across the film, at most."""
    with torch.no_grad():
        x, q, size, distance, furthest = _crossings(camera, scene, cameras, lines)
        if not len(x):
            return Listing(0.0, 0.0, None, 0)
        rays = camera.rays_through(x, q)
        origin, direction = rays.origin_m.double(), rays.direction.double()
        count, along = _on_curves(camera, curves, cameras, origin, direction, distance, furthest)
    total = float(size.sum())
    none, many = count == 0, along > 1
    place = None
    if bool((none | many).any()):
        worst = int((size * (none | many)).argmax())
        at = origin[worst] + direction[worst] * distance[worst].clamp_max(1e6)
        x, y, z = apply(cameras[0], at[None])[0].tolist()
        place = (x, y, z)
    return Listing(float(size[none].sum()) / total, float(size[many].sum()) / total, place, len(size))


def check_listed(camera: Camera, scene: Any, curves: Sequence[Sequence[Any]], cameras: Tensor) -> None:
    """Raise DomainError when a frame of a sequence shows jumps of radiance that the scene does not list, or lists
    twice. Views near one that was found right are not looked at again. cameras: [parts, F, 4, 4]."""
    known = _known_views(parts(scene), camera.film)
    field = _half_field_rad(camera)
    pupil_m = getattr(camera.lens, "entrance_pupil_diameter_mm", 0.0) * 1e-3
    for frame in range(cameras.shape[1]):
        view = cameras[:, frame]
        if any(old.covers(view, field, pupil_m) for old in known):
            continue
        found = listing(camera, scene, curves, view)
        if max(found.unlisted, found.doubled) > WRONG:  # a few crossings say little: look closer
            found = listing(camera, scene, curves, view, 8 * LINES)
        for share, what in (
            (found.unlisted, "lie on no edge or outline that the scene lists"),
            (found.doubled, "lie on several of its edges at once"),
        ):
            if share > WRONG:
                at = ", ".join(f"{v:.3g}" for v in found.place_m or ())
                raise DomainError(
                    f"gradient 'boundary': {share:.0%} of the jumps of radiance in frame {frame} {what}, the largest near "
                    f"({at}) m: parts of a moving scene that touch, textures with hard texels, or shapes that are not "
                    "known; move them apart, smooth the texture, or use 'difference'."
                )
        known.append(_View(view.clone(), reach_m(camera, scene, view), field, pupil_m))


def _known_views(own, film):
    """The views of these parts on such a film that were found right: a list, kept by the first part where it can
    keep anything, with the other parts, so that none of them makes way for another of its name."""
    kept = getattr(own[0], "__dict__", {}).setdefault("_listed", {})
    return kept.setdefault((tuple(map(id, own)), film), (own, []))[1]


@dataclass(frozen=True)
class _View:
    """A view that was found right: the camera [parts, 4, 4], the distance of what it showed, half its field and the
    diameter of its pupil."""

    cameras: Tensor
    reach_m: float
    field_rad: float
    pupil_m: float

    def covers(self, cameras, field_rad, pupil_m):
        """Whether the camera is near where it was, seen from every part, through a lens that shows little more."""
        moved = (cameras[:, :3, 3] - self.cameras[:, :3, 3]).norm(dim=1)
        straight = (cameras[:, :3, 2] * self.cameras[:, :3, 2]).sum(1)
        near = (moved < MOVED * self.reach_m).all() and (straight > math.cos(TURNED * self.field_rad)).all()
        return bool(near) and field_rad <= WIDER * self.field_rad and pupil_m <= WIDER * self.pupil_m


def _half_field_rad(camera):
    film = camera.film
    return math.atan(max(film.sensor_width_px, film.sensor_height_px) / 2 * abs(camera.slope_per_px()))


def reach_m(camera: Camera, scene: Any, cameras: Tensor | Sequence[Tensor]) -> float:
    """Median distance of what a view shows, 1 where it shows nothing or a scene that does not say. cameras: the camera
    [4, 4] or [1, 4, 4] in the axes of every part."""
    if not all(says_distance(type(part)) for part in parts(scene)):
        return 1.0
    pixels = coarse_pixels(camera.film, 8)
    rays = camera.rays_through(pixels, torch.zeros_like(pixels))
    poses = torch.stack([pose.double().reshape(1, 4, 4) for pose in cameras])
    _, distance = look(
        scene, poses.expand(-1, len(pixels), 4, 4), rays.origin_m.double(), rays.direction.double()
    )
    met = distance[distance.isfinite()]
    return float(met.median()) if len(met) else 1.0


def _crossings(camera, scene, cameras, most):
    """Jumps along lines: film position [n, 2] px, pupil point [n, 2], size of the jump [n], and distances [n] m of the
    nearer and the further of its sides."""
    film = camera.film
    generator = torch.Generator().manual_seed(most)
    _, pupils = film_pupil_pattern(64, most)
    low, high, pupil = [], [], []
    for left, top in film.windows_px or ((0, 0),):
        for axis, (along, across) in enumerate(
            ((film.width_px, film.height_px), (film.height_px, film.width_px))
        ):
            lines = min(most, 4 * across)
            shift = torch.rand(lines, generator=generator, dtype=torch.float64)
            level = (torch.arange(lines) + shift) / lines * across - 0.5
            cells = along * RAYS_PER_PX
            edges = torch.arange(cells + 1, dtype=torch.float64) / RAYS_PER_PX - 0.5
            at = torch.stack([edges.expand(lines, -1), level[:, None].expand(-1, cells + 1)], -1)
            at = (at if axis == 0 else at.flip(-1)) + torch.tensor([left, top], dtype=torch.float64)
            low.append(at[:, :-1].reshape(-1, 2))
            high.append(at[:, 1:].reshape(-1, 2))
            turn = torch.randint(64, (lines,), generator=generator)
            pupil.append(pupils[turn].repeat_interleave(cells, 0))
    low, high, pupil = torch.cat(low), torch.cat(high), torch.cat(pupil)

    def light(at, q):
        rays = camera.rays_through(at, q)
        passes = rays.weight > 0
        seen = look(
            scene, cameras[:, None].expand(-1, len(at), 4, 4), rays.origin_m.double(), rays.direction.double()
        )
        return *seen, passes

    (first, near, begins), (second, far, ends) = light(low, pupil), light(high, pupil)
    lit = torch.cat([first, second])
    least = CONTRAST * float(lit.amax() - lit.amin())
    rows = torch.nonzero(((first - second).abs() > least) & begins & ends)[:, 0]
    low, high, pupil, first, second, near, far = (
        v[rows] for v in (low, high, pupil, first, second, near, far)
    )
    for _ in range(HALVINGS):
        if not len(low):
            break
        middle = (low + high) / 2
        between, depth, _ = light(middle, pupil)
        left = (between - first).abs() > (second - between).abs()
        low, high = torch.where(left[:, None], low, middle), torch.where(left[:, None], middle, high)
        first, second = torch.where(left, first, between), torch.where(left, between, second)
        near, far = torch.where(left, near, depth), torch.where(left, depth, far)
    size = (second - first).abs()
    jump = torch.nonzero(size > least)[:, 0]
    return (
        ((low + high) / 2)[jump],
        pupil[jump],
        size[jump],
        torch.minimum(near, far)[jump],
        torch.maximum(near, far)[jump],
    )


def _on_curves(camera, curves, cameras, origin, direction, distance, furthest):
    """On how many listed curves the edge lies that each ray [n, 3] of the camera meets at a distance [n], behind which
    the light comes from ``furthest`` [n], and on how many of them away from their ends, where curves may meet without
    being one."""
    slope_per_px = camera.slope_per_px()
    aperture_m = getattr(camera.lens, "entrance_pupil_diameter_mm", 0.0) * 1e-3 / 2
    found = []
    names = 0
    for pose, of_part in zip(cameras, curves, strict=True):
        back = inverse(pose)
        eye = pose[:3, 3]
        o = apply(pose, origin)
        d = direction @ pose[:3, :3].T
        for curve in of_part:
            index, bounds = curve.pieces(eye, piece_rad(slope_per_px), aperture_m)
            if not index.numel():
                continue
            ends = torch.stack([apply(back, curve.points(index, bounds[:, i], eye)) for i in (0, 1)])
            front = torch.nonzero((ends[..., 2] > IN_FRONT_M).all(0))[:, 0]
            ray, piece = _close(ends[:, front], origin, direction, NEAR_PX * slope_per_px)
            piece = front[piece]
            away, reach, apart = _angle(curve, index[piece], bounds[piece], o[ray], d[ray])
            within = curve.aside_rad(index[piece], eye).clamp_min(ON_PX * slope_per_px)
            rows = (away < within) & (reach < distance[ray] * (1 + HIDDEN))
            rows &= curve.counts(index[piece], o[ray])
            beside = curve.covered(
                index[piece], o[ray]
            )  # by surfaces on both sides: not where one is far behind
            rows &= ~beside | (furthest[ray] < reach * (1 + HIDDEN))
            found.append((ray[rows], away[rows], apart[rows], names + index[piece][rows]))
            names += int(index.max()) + 1
    if not found:
        return torch.zeros(2, len(origin), dtype=torch.long)
    ray, away, apart, name = (torch.cat(column) for column in zip(*found, strict=True))
    least = torch.full((len(origin),), torch.inf, dtype=torch.float64).scatter_reduce(0, ray, away, "amin")
    same = away < least[ray] + SAME_RAD

    def count(rows):
        pairs = torch.unique(torch.stack([ray[rows], name[rows]]), dim=1)  # pieces of one curve are one
        return torch.bincount(pairs[0], minlength=len(origin))

    return torch.stack([count(same), count(same & (apart > MEETING * SAME_RAD))])


def _close(ends, origin, direction, near):
    """Pairs (ray, piece) whose angle is at most ``near`` and a tenth of the piece's length: ends [2, pieces, 3]."""
    a, b = ends
    rays, pieces = [], []
    for block in torch.arange(len(origin)).split(256):
        o, d = origin[block, None], direction[block, None]
        depth = ((a - o) * d).sum(2).clamp_min(1e-6)
        # in the plane across the ray, scaled to angles at the depth of the piece's start
        p = ((a - o) - ((a - o) * d).sum(2, keepdim=True) * d) / depth[..., None]
        then = ((b - o) * d).sum(2).clamp_min(1e-6)
        r = ((b - o) - ((b - o) * d).sum(2, keepdim=True) * d) / then[..., None]
        v = r - p
        t = (-(p * v).sum(2) / v.square().sum(2).clamp_min(1e-30)).clamp(0, 1)
        away = (p + t[..., None] * v).norm(dim=2)
        ray, piece = torch.nonzero(away < near + 0.1 * v.norm(dim=2), as_tuple=True)
        rays.append(block[ray])
        pieces.append(piece)
    return torch.cat(rays), torch.cat(pieces)


def _angle(curve, index, bounds, origin, direction):
    """Least angle [n] between rays and pieces of curves, the distance [n] m there, and the angle [n] from there to the
    nearer end of the piece; by golden sections along the piece."""
    low, high = bounds.unbind(1)

    def away(s):
        y = curve.points(index, s, origin) - origin
        reach = (y * direction).sum(1).clamp_min(1e-9)
        return torch.linalg.cross(y, direction).norm(dim=1) / reach, reach

    share = 0.6180339887498949
    a, b = high - share * (high - low), low + share * (high - low)
    (at_a, _), (at_b, _) = away(a), away(b)
    for _ in range(STEPS):
        lower = at_a < at_b
        low, high = torch.where(lower, low, a), torch.where(lower, b, high)
        a, b = high - share * (high - low), low + share * (high - low)
        (at_a, _), (at_b, reach) = away(a), away(b)
    here = curve.points(index, (a + b) / 2, origin)
    ends = torch.stack([(curve.points(index, s, origin) - here).norm(dim=1) for s in bounds.unbind(1)])
    return torch.minimum(at_a, at_b), reach, ends.amin(0) / reach
