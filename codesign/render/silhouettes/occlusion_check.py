"""Does a scene list every curve where radiance jumps, and each once? Asked of the picture, not of
the geometry.

Lines are laid across the film, each through one point of the pupil; where radiance differs between
neighbouring rays the larger difference is halved again and again, until what is left is a jump or a
slope. The listed curves that cross the line there are read as the boundary term reads them, and
their jumps together must be the one that was found. What differs makes the gradient of that term
wrong, and is refused.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import scipy
import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.pose import apply
from codesign.render.camera import Camera, lines
from codesign.render.film import coarse_pixels, film_pupil_pattern
from codesign.render.moving import parts, says_distance
from codesign.render.rows import Rows
from codesign.render.silhouettes.certified_views import MOST, Looked, looked_at, nearest_m
from codesign.render.silhouettes.curve_points import (
    CurvePoints,
    FieldOfView,
    known_beside,
    piece_rad,
)
from codesign.render.silhouettes.edges import within_reach
from codesign.render.silhouettes.jumps import SAFETY, jumps
from codesign.render.wavefront import look

LINES = 48  # each way across the film
LEAST_LINES = 16  # each way across every frame that is looked at in a sequence
FRAMES = 32  # looked at in one launch
RAYS_PER_PX = 3
HALVINGS = 14
CONTRAST = 0.02  # of a frame's range: what is less is no jump worth the name
FOUND_PX = 1e-3  # between a jump and the curve it lies on, beside what the curve is known to
# share of the distance by which a curve may lie before or behind what is seen beside it
DEPTH = 0.01
NEAR = 0.1  # of the length of a piece, between its chord and a ray that may meet it
NEAR_PX = 0.1  # the same, where pieces are short
BEYOND = 0.3  # of a piece, by which it is searched beyond its ends
STEP = 1e-4  # of a piece, for the direction of its curve
TURNS = 4  # of the search along a piece
GRAZING = 0.3  # sine of the angle between a line and a curve, at least
WRONG = 0.05  # share of all jumps up to which a view is taken as listed
DOUBTFUL = 0.005  # from which on a first look, of a few lines, is followed by a closer one


@dataclass(frozen=True)
class Listing:
    """Of the jumps in a view, weighted by their size: the share that is on no listed curve, the
    share that curves have beyond what is seen, and the place where most is amiss in world axes (or
    the axes of the static part); crossings: how many jumps were found."""

    unlisted: float
    doubled: float
    place_m: tuple[float, float, float] | None
    crossings: int


def listings(
    camera: Camera, scene: Any, curves: Sequence[Sequence[Any]], cameras: Tensor, lines: int = LINES
) -> list[Listing]:
    """Whether the jumps of views lie on the listed curves, one by one. cameras: [parts, F, 4, 4],
    the camera in the axes of every part; curves: of every part; lines: each way across the film, at
    most, in each of the views."""
    camera = camera.in_one_colour()
    with torch.no_grad():
        found = _crossings(camera, scene, cameras, lines)
        frame, change, listed, at = _listed(camera, scene, curves, cameras, found)
    amiss = (change - listed).abs()
    missing = torch.minimum(amiss, change.abs()) * (listed.abs() < change.abs())
    told = []
    for number, pose in enumerate(cameras[0]):
        rows = torch.nonzero(frame == number)[:, 0]
        total = float(change[rows].abs().sum()) or 1.0
        place = None
        if rows.numel() and float(amiss[rows].max()) > 0:
            worst = rows[amiss[rows].argmax()]
            x, y, z = apply(pose, at[worst][None])[0].tolist()
            place = (x, y, z)
        lacks, both = float(missing[rows].sum()), float(amiss[rows].sum())
        told.append(Listing(lacks / total, (both - lacks) / total, place, len(rows)))
    return told


def check_listed(
    camera: Camera, view: FieldOfView, scene: Any, curves: Sequence[Sequence[Any]], cameras: Tensor
) -> None:
    """Raise DomainError when a frame of a sequence shows jumps of radiance that the scene does not
    list, or lists twice. Looked at are frames that may show what was not looked at yet, by fewer
    lines where there are many. field: of the camera; cameras: [parts, F, 4, 4]."""
    known = looked_at(parts(scene), camera.film)
    for start in range(0, cameras.shape[1], FRAMES):
        views = cameras[:, start : start + FRAMES]
        left = torch.ones(views.shape[1], dtype=torch.bool)
        for each in known:
            left &= ~each.answers_for(views, view)
        fresh = {}
        while left.any():
            row = int(left.nonzero()[0])
            fresh[row] = Looked(views[:, row], nearest_m(parts(scene), views[:, row]), view)
            left &= ~fresh[row].answers_for(views, view)
            left[row] = False
        if fresh:
            _check_frames(camera, scene, curves, views, list(fresh), start)
            known.extend(fresh.values())
    del known[:-MOST]


def _check_frames(camera, scene, curves, cameras, rows, start):
    """Look at frames ``rows`` of cameras [parts, F, 4, 4], of which the first is frame
    ``start``."""
    lines = max(LEAST_LINES, LINES // len(rows))
    for row, found in zip(
        rows, listings(camera, scene, curves, cameras[:, rows], lines), strict=True
    ):
        if max(found.unlisted, found.doubled) > DOUBTFUL:  # a few crossings say little
            (found,) = listings(camera, scene, curves, cameras[:, row : row + 1], 8 * LINES)
        if max(found.unlisted, found.doubled) <= WRONG:
            continue
        share, what = max(
            (found.unlisted, "lie on no edge or outline that the scene lists"),
            (found.doubled, "lie on several of its edges at once"),
        )
        at = ", ".join(f"{v:.3g}" for v in found.place_m or ())
        raise DomainError(
            f"gradient 'boundary': {share:.0%} of the jumps of radiance in frame {start + row} {what}, the "
            f"largest near ({at}) m: parts of a moving scene that touch, textures with hard texels, or "
            "shapes that are not known; move them apart, smooth the texture, or use 'difference'."
        )


def reach_m(camera: Camera, scene: Any, cameras: Tensor) -> float:
    """Median distance of what a view shows, 1 where it shows nothing or a scene that does not say.
    cameras:
    the camera [parts, 1, 4, 4] in the axes of every part."""
    if not all(says_distance(type(part)) for part in parts(scene)):
        return 1.0
    pixels = coarse_pixels(camera.film, 8)
    rays = camera.rays_through(pixels, torch.zeros_like(pixels))
    first = torch.zeros_like(pixels[:, 0], dtype=torch.long)
    _, distance = look(scene, cameras, first, rays.origin_m.double(), rays.direction.double())
    met = distance[distance.isfinite()]
    return float(met.median()) if len(met) else 1.0


def _lines(film, most):
    """Points of lines across every window: film position [lines, points, 2] px for either way, with
    direction [2], pupil [lines, 2] and window [lines]."""
    generator = torch.Generator().manual_seed(most)
    _, pupils = film_pupil_pattern(64, most)
    for window, corner in enumerate(film.corners_px):
        for axis in (0, 1):
            along, across = (film.width_px, film.height_px)[:: 1 - 2 * axis]
            lines = min(most, 4 * across)
            shift = torch.rand(lines, generator=generator, dtype=torch.float64)
            level = (torch.arange(lines) + shift) / lines * across - 0.5
            edges = torch.arange(along * RAYS_PER_PX + 1, dtype=torch.float64) / RAYS_PER_PX - 0.5
            at = torch.stack([edges.expand(lines, -1), level[:, None].expand(-1, len(edges))], -1)
            at = (at if axis == 0 else at.flip(-1)) + corner
            turn = torch.randint(64, (lines,), generator=generator)
            yield (
                at,
                torch.eye(2, dtype=torch.float64)[axis],
                pupils[turn],
                torch.full((lines,), window),
            )


@dataclass(frozen=True)
class _Steps(Rows):
    """Neighbouring rays between which light changes: frame [n]; film position, light and distance
    of both [n, 2, 4]; direction of their line on the film and point of the pupil [n, 2]; window
    [n]."""

    frame: Tensor
    ends: Tensor
    along: Tensor
    pupil: Tensor
    window: Tensor

    @property
    def change(self):
        """Of light [n] from the first to the second."""
        return self.ends[:, 1, 2] - self.ends[:, 0, 2]

    @property
    def film_px(self):
        """Film position [n, 2] between them."""
        return self.ends[..., :2].mean(1)

    @property
    def distance(self):
        """Of the nearer side [n], metres."""
        return self.ends[..., 3].amin(1)


def _crossings(camera, scene, cameras, most):
    aperture = camera.aperture_m > 0
    frames = torch.arange(cameras.shape[1])
    seen = partial(_look, camera, scene, cameras)
    found = []
    lit = []
    for at, along, pupil, window in _lines(camera.film, most):
        pupil = pupil * aperture
        lines, points = at.shape[:2]
        at = at.reshape(-1, 2)
        rays = camera.rays_through(at, pupil.repeat_interleave(points, 0))
        every, same = frames.repeat_interleave(len(at)), len(frames)
        origin, direction = (v.repeat(same, 1) for v in (rays.origin_m, rays.direction))
        light, distance = look(scene, cameras, every, origin, direction)
        light = rays.weight.repeat(same) * light
        told = torch.cat([at.repeat(same, 1), light[:, None], distance[:, None]], 1)
        told = told.reshape(same, lines, points, 4)
        passes = (rays.weight > 0).reshape(lines, points)
        lit.append(told[..., 2].flatten(1))
        frame, line, cell = torch.nonzero(
            passes[:, 1:] & passes[:, :-1] & (told[..., 2].diff(dim=2) != 0)
        ).unbind(1)
        ends = torch.stack([told[frame, line, cell], told[frame, line, cell + 1]], 1)
        found.append(_Steps(frame, ends, along.expand(len(line), 2), pupil[line], window[line]))
    found = _Steps.joined(found)
    lit = torch.cat(lit, 1)
    least = CONTRAST * (lit.amax(1) - lit.amin(1))
    found = found[found.change.abs() > least[found.frame]]
    for _ in range(HALVINGS if len(found.frame) else 0):
        between = seen(found.frame, found.film_px, found.pupil)
        first, second = found.ends[..., 2].unbind(1)
        left = (between[:, 2] - first).abs() > (second - between[:, 2]).abs()
        kept = torch.stack([left, ~left], 1)[..., None]
        found = replace(found, ends=torch.where(kept, found.ends, between[:, None]))
    found = found[found.change.abs() > least[found.frame]]
    if not len(found.frame):
        return found
    # between faces that meet rays slip through a line without width
    aside = FOUND_PX * found.along
    sides = [
        seen(found.frame, found.film_px + sign * aside, found.pupil)[:, 2:3] for sign in (-1, 1)
    ]
    at, _, distance = found.ends.split([2, 1, 1], 2)
    found = replace(found, ends=torch.cat([at, torch.stack(sides, 1), distance], 2))
    return found[found.change.abs() > least[found.frame]]


def _listed(camera, scene, curves, cameras, found):
    """Of the steps that can be judged their frames [n] and changes of light [n]; the changes [n]
    along their lines that the listed curves have there, as the boundary term reads them; and their
    places [n, 3] in camera axes. A line along a curve tells little of it: there is one across."""
    seen = camera.rays_through(found.film_px, found.pupil)
    place_cam_m = seen.origin_m + seen.direction * found.distance.clamp_max(1e6)[:, None]
    total = torch.zeros_like(found.change)
    near = _near_curves(camera, curves, cameras, found, seen)
    read = None
    if near:
        read = jumps(camera, scene, cameras, CurvePoints.joined([points for _, points in near]))
    if read is None:
        return found.frame, found.change, total, place_cam_m
    read = read[torch.nonzero(read.seen)[:, 0]]
    ray = torch.cat([ray for ray, _ in near])[read.row]
    turned = (read.normal * found.along[ray]).sum(1)
    away = ((read.film_px - found.film_px[ray]) * read.normal).sum(1)
    met = torch.nonzero((away.abs() < SAFETY * read.aside_px + FOUND_PX) & (turned.abs() > 0))[:, 0]
    ray, turned, away, read = ray[met], turned[met], away[met], read[met]
    # rounding leaves slivers at edges: the change that counts is that around the nearest curve, as
    # far aside as it is read
    least = torch.full_like(total, torch.inf).scatter_reduce(0, ray, away.abs(), "amin")
    first = torch.nonzero(away.abs() == least[ray])[:, 0]
    nearest = torch.full_like(found.frame, -1).scatter_reduce(0, ray[first], first, "amax")
    place, half, slant = (
        torch.where(nearest >= 0, v[nearest], 1.0) if len(v) else torch.ones_like(total)
        for v in (away / turned, read.aside_px / turned.abs(), turned.abs())
    )
    within = (away / turned - place[ray]).abs() < half[ray]
    total = total.index_add(0, ray, (read.behind - read.before) * turned.sign() * within)
    rows = torch.nonzero((nearest >= 0) & (slant > GRAZING))[:, 0]
    steps = found[rows]
    before, behind = (
        _look(
            camera,
            scene,
            cameras,
            steps.frame,
            steps.film_px + far[rows, None] * steps.along,
            steps.pupil,
        )
        for far in (place - half, place + half)
    )
    change = found.change.index_put((rows,), behind[:, 2] - before[:, 2])
    kept = torch.nonzero((nearest < 0) | (slant > GRAZING))[:, 0]
    return found.frame[kept], change[kept], total[kept], place_cam_m[kept]


def _near_curves(camera, curves, cameras, found, seen):
    """Pairs of the numbers of steps [n] and of CurvePoints [n] on the curves that their rays
    ``seen`` pass by."""
    slope_per_px = camera.slope_per_px()
    from_axis = lines(seen)[0].norm(dim=1)
    near = []
    for part, of_part in enumerate(curves):
        pose = cameras[part][found.frame]
        o = apply(pose, seen.origin_m[:, None])[:, 0]
        d = (pose[:, :3, :3] @ seen.direction[..., None])[..., 0]
        for frame in torch.unique(found.frame).tolist():
            rows = torch.nonzero((found.frame == frame) & found.distance.isfinite())[:, 0]
            eye = cameras[part, frame, :3, 3]
            for curve in of_part:
                index, bounds = curve.pieces(eye, piece_rad(slope_per_px), float(from_axis.max()))
                rays = o[rows], d[rows], found.distance[rows]
                ray, piece = _near(curve, index, bounds, eye, *rays, NEAR_PX * abs(slope_per_px))
                if not ray.numel():
                    continue
                ray = rows[ray]
                index = index[piece]
                within, y, ahead = _place(curve, index, bounds[piece], o[ray], d[ray])
                count = curve.counts(index, y, o[ray]) & within
                ray, index, y, ahead = (v[count] for v in (ray, index, y, ahead))
                beside = known_beside(curve, index, y, o[ray])
                of_ray = (
                    found.film_px[ray],
                    found.pupil[ray],
                    torch.zeros_like(ray),
                    found.window[ray],
                    found.frame[ray],
                )
                each = torch.ones_like(y[:, 0])
                points = CurvePoints(y, ahead, each, *beside, *of_ray, torch.full_like(ray, part))
                near.append((ray, points))
    return near


def _look(camera, scene, cameras, frame, at, pupil):
    """Film position, light and distance [n, 4] of rays."""
    rays = camera.rays_through(at, pupil)
    light, distance = look(scene, cameras, frame, rays.origin_m, rays.direction)
    return torch.cat([at, (rays.weight * light)[:, None], distance[:, None]], 1)


def _near(curve, index, bounds, eye, origin, direction, distance, near_rad):
    """Pairs (ray, piece) of which the chord of the piece passes near where the ray [n, 3] meets
    something at a distance [n]."""
    if not index.numel():
        return index, index
    a, b = (curve.points(index, s, eye) for s in bounds.unbind(1))
    middle = (a + b) / 2
    half = (b - a).norm(dim=1) / 2
    share = float((half / (middle - eye).norm(dim=1).clamp_min(1e-9)).max()) + DEPTH
    at = origin + distance[:, None] * direction
    near = within_reach(
        scipy.spatial.cKDTree(middle.numpy()), at.numpy(), (distance * share * (1 + share)).numpy()
    )
    ray, piece = map(torch.tensor, near)
    # in the plane across the ray
    p, q = (_across(v[piece] - origin[ray], direction[ray]) for v in (a, b))
    v = q - p
    t = (-(p * v).sum(1) / v.square().sum(1).clamp_min(1e-30)).clamp(0, 1)
    away = (p + t[:, None] * v).norm(dim=1)
    rows = torch.nonzero(away < NEAR * v.norm(dim=1) + near_rad * distance[ray])[:, 0]
    return ray[rows], piece[rows]


def _place(curve, index, bounds, origin, direction):
    """Whether the point of a curve that is nearest to a ray lies on its piece [n], that point and
    one a little further on [n, 3]; by Newton's method along the piece and a little beyond it."""
    low, high = bounds.unbind(1)
    step = STEP * (high - low)
    s = (low + high) / 2
    for _ in range(TURNS):
        y, ahead = (curve.points(index, at, origin) for at in (s, s + step))
        p, v = _across(y - origin, direction), _across(ahead - y, direction)
        s = s - step * ((p * v).sum(1) / v.square().sum(1).clamp_min(1e-30))
        s = torch.minimum(
            torch.maximum(s, low - BEYOND * (high - low)), high + BEYOND * (high - low)
        )
    y, ahead = (curve.points(index, at, origin) for at in (s, s + step))
    return (s >= low) & (s < high), y, ahead


def _across(v, direction):
    return v - (v * direction).sum(1, keepdim=True) * direction
