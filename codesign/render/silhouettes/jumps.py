"""Radiances on both sides of points on curves, where the camera's own rays see these, and whether
they are seen.

A point is hidden when the rays that pass it on either side meet something before it. They pass
aside, where a slanting surface lies nearer than at the curve itself: where that is in doubt a
second pair of rays, twice as far aside, tells how the surface goes on, and it is taken back to the
curve along a straight line. What is left is rounding of float32. Faces narrower than radiance is
read beside their edges (slivers) are read along their normal: rays from the camera would pass over
them, and both their edges would tell of one jump.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from codesign.pose import apply, inverse
from codesign.render.camera import Camera, images
from codesign.render.rows import Rows
from codesign.render.silhouettes.curve_points import (
    FOUND_PX,
    IN_FRONT_M,
    NEARBY,
    STEP_PX,
    CurvePoints,
)
from codesign.render.wavefront import look

DOUBTFUL = 0.05  # share of the distance by which a slanting surface may come nearer beside its edge
ROUNDING = 2.0**-21  # of float32 distances, four units in the last place
SAFETY = 2.0
# share of the contrast of a sliver by which what is seen beyond it may differ from what is before
# it
SAME = 0.05
NARROW = 4.0  # times as wide as radiance is read to the side: wider faces are met
WITHIN = 0.1  # share of the way from an edge to the corner beyond it at which a face is read
FLOAT32 = 2.0**-20  # of coordinates, by which a reading keeps clear of edge and face
THIN = 1e-9


@dataclass(frozen=True)
class Jumps(Rows):
    """Points of curves on the film. row: [n], number of the given point. world [n, 3], frame and
    part [n], in the axes of the part; film position [n, 2] px, pupil [n, 2], colour [n], pixel [n]
    of the sequence; normal [n, 2] of the curve on the film; before, behind [n]: radiances along it;
    seen [n] bool; weight [n] of the jump; per_miss: the motion along the normal per miss of the ray
    in space, [n, 2] px/m; aside_px [n]: how far to the sides radiances are read."""

    row: Tensor
    world_m: Tensor
    frame: Tensor
    part: Tensor
    film_px: Tensor
    pupil: Tensor
    colour: Tensor
    pixel: Tensor
    normal: Tensor
    before: Tensor
    behind: Tensor
    seen: Tensor
    weight: Tensor
    per_miss: Tensor
    aside_px: Tensor

    @property
    def contrast(self) -> Tensor:
        """[n], of the two radiances."""
        return (self.before - self.behind).abs() / torch.maximum(
            self.before, self.behind
        ).clamp_min(1e-30)


def jumps(camera: Camera, scene: Any, cameras: Tensor, points: CurvePoints) -> Jumps | None:
    """The points that fall on the film, with their jumps of radiance, of weight 0 where they are
    hidden; None for none.
    cameras: [parts, F, 4, 4]."""
    back = inverse(cameras)[points.part, points.frame]
    y, on = apply(back, torch.stack([points.world_m, points.ahead_m], 1)).unbind(1)
    row = torch.nonzero((y[:, 2] > IN_FRONT_M) & (on[:, 2] > IN_FRONT_M))[:, 0]
    if not row.numel():
        return None
    points, y, on = points[row], y[row], on[row]
    seen_at = images(camera, y, points.pupil, points.colour, points.near_px, STEP_PX, FOUND_PX)
    x, per_px, slope = seen_at.at_px, seen_at.m_per_px, seen_at.slope
    pixel = _pixels(camera.film, x, points.window)
    moved = (on - y)[:, :2] - slope * (on - y)[:, 2:]
    fine = (seen_at.step_px < FOUND_PX) & (pixel >= 0)
    per_m = torch.linalg.inv(torch.where(fine[:, None, None], per_px, torch.eye(2, dtype=y.dtype)))
    tangent = (per_m @ moved[..., None])[..., 0]
    length = tangent.norm(dim=1)
    rows = torch.nonzero(fine & (length > 0))[:, 0]
    if not rows.numel():
        return None
    points = points[rows]
    row, y, on, x, per_px, slope, per_m, tangent, length, pixel = (
        v[rows] for v in (row, y, on, x, per_px, slope, per_m, tangent, length, pixel)
    )
    normal = torch.stack([-tangent[:, 1], tangent[:, 0]], 1) / length[:, None]
    aside_px = points.aside_rad / _rad_per_px(y, per_px, slope, normal)
    before, behind, seen = _sides(
        camera, scene, cameras, points, y, on, x, aside_px[:, None] * normal
    )
    return Jumps(
        row,
        points.world_m,
        points.frame,
        points.part,
        x,
        points.pupil,
        points.colour,
        pixel + points.frame * math.prod(camera.film.shape),
        normal,
        before,
        behind,
        seen,
        (before - behind) * length * points.share * seen,
        (normal[:, None] @ per_m)[:, 0],
        aside_px,
    )


def _sides(camera, scene, cameras, points, y, on, x, aside):
    """Radiances [n] before and behind points y [n, 3] of curves, which go on to ``on`` [n, 3], at
    film positions x [n, 2], ``aside`` [n, 2] px to either side, and whether the points are seen
    [n]."""
    q, colour = (v.repeat(2, *[1] * (v.ndim - 1)) for v in (points.pupil, points.colour))
    rays = camera.coloured_rays(torch.cat([x - aside, x + aside]), q, colour)
    light = camera.light(rays, colour).detach()
    origin, direction, weight = (
        v.unflatten(0, (2, -1)) for v in (rays.origin_m, rays.direction, light)
    )
    reach = (y - origin[0]).norm(dim=1)

    def read(rows, share, start=0.0):
        """At a share [n] of the way aside, from where the share ``start`` of the distance is left
        behind."""
        o, d = (
            v[:, rows].mean(0) + share[:, None] * (v - v.mean(0))[:, rows]
            for v in (origin, direction)
        )
        skipped = start * reach[rows]
        o = o + skipped[:, None] * d
        frame = points.frame[rows].repeat(2)
        light, distance = look(scene, cameras, frame, o.flatten(0, 1), d.flatten(0, 1))
        return weight[:, rows] * light.reshape(2, -1), distance.reshape(2, -1) + skipped

    light, distance = read(torch.arange(len(y)), torch.ones_like(reach))
    # what nothing hides from afar is read again from nearby, where float32 tells finer things apart
    rows = torch.nonzero(distance.amax(0) > reach * (1 - DOUBTFUL))[:, 0]
    finer = points.near_rad / points.aside_rad
    light[:, rows], distance[:, rows] = read(rows, finer[rows], 1 - NEARBY)
    rounding = ROUNDING * (NEARBY * reach + points.world_m.norm(dim=1))
    nearest = distance.clone()
    rows = rows[((distance.amax(0) < reach) & (distance.amax(0) > reach * (1 - DOUBTFUL)))[rows]]
    if rows.numel():
        change = read(rows, 2 * finer[rows], 1 - NEARBY)[1] - distance[:, rows]
        change = torch.where(change.abs() < DOUBTFUL * reach[rows], change, 0.0)
        nearest[:, rows] -= change
        steepness = change.abs().amax(0) / (points.near_rad * reach)[rows]
        rounding[rows] *= 1 + steepness
    seen = nearest.amax(0) > reach - rounding
    side, row, own = sliver_radiance(scene, cameras, points, y, on, origin.mean(0), direction)
    # what is narrower than a reading as a whole is left alone: nearly the same is seen on both its
    # sides
    differ = (light[0, row] - light[1, row]).abs() > SAME * (own - light[side, row]).abs()
    side, row, own = side[differ], row[differ], own[differ]
    light[side, row] = weight[side, row] * own
    distance[side, row] = torch.minimum(distance[side, row], reach[row])
    # between two faces that are seen a ray may slip through, and tells of what lies behind them
    within = reach * (1 + SAFETY * points.near_rad * points.face_slope) + rounding
    return *light, seen & (distance.amax(0) <= within)


def _rad_per_px(y, per_px, slope, normal):
    """Angle [n] that a ray to y [n, 3] turns by per pixel along ``normal`` [n, 2] on the film."""
    ray = torch.cat([slope, torch.ones_like(slope[:, :1])], 1)
    moved = (per_px @ normal[..., None])[..., 0]
    moved = torch.cat([moved, torch.zeros_like(moved[:, :1])], 1)
    return torch.linalg.cross(moved, ray).norm(dim=1) / (y[:, 2] * ray.square().sum(1))


def _pixels(film, x, window):
    """Flat number of the pixel of the given windows [n] that holds each position [n, 2], -1
    outside."""
    column, row = (x - film.corners_px[window] + 0.5).floor().unbind(1)
    inside = (column >= 0) & (column < film.width_px) & (row >= 0) & (row < film.height_px)
    number = window * (film.width_px * film.height_px) + row * film.width_px + column
    return torch.where(inside, number, -1.0).long()


def sliver_radiance(
    scene: object,
    cameras: Tensor,
    points: CurvePoints,
    y: Tensor,
    on: Tensor,
    origin: Tensor,
    sides: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """(side [k], row [k], radiance [k]) where the face that is seen beside a straight edge is a
    sliver: read along its normal, since radiance is the same in all directions.

    Args:
      cameras: [parts, F, 4, 4].
      y, on: [n, 3], the points and the same curves a little further on, in camera axes.
      origin: [n, 3] of the rays to the points.
      sides: [2, n, 3], directions of the rays before and behind them.
    """
    known = torch.nonzero(points.apex_m.isfinite().all(2).any(1))[:, 0]
    points, y, on, origin, sides = (
        points[known],
        y[known],
        on[known],
        origin[known],
        sides[:, known],
    )
    back = inverse(cameras)[points.part, points.frame]
    apex = apply(back, points.apex_m)
    ahead = normalize(y - origin, dim=1)
    edge = on - y
    across = normalize(torch.linalg.cross(edge, ahead), dim=1)
    across = across * ((sides[1] - sides[0]) * across).sum(1, keepdim=True).sign()
    away = apex - origin[:, None]
    width = (away * across[:, None]).sum(2) / (away * ahead[:, None]).sum(2)
    normal = torch.linalg.cross(edge[:, None].expand_as(apex), apex - y[:, None])
    facing = (normal * ahead[:, None]).sum(2)
    # per angle
    nearer = -(normal * across[:, None]).sum(2) / torch.where(facing.abs() > 0, facing, THIN)
    sign = torch.tensor([-1.0, 1.0], dtype=y.dtype)[:, None, None]
    there = width * sign > 0
    face = torch.where(there, nearer * sign, torch.inf).argmin(2)
    side, row = torch.nonzero(there.any(2)).unbind(1)
    face = face[side, row]
    low = width[row, face].abs() < NARROW * points.aside_rad[row]
    side, row, face = (v[low] for v in (side, row, face))
    if not row.numel():
        return side, row, y.new_zeros(0)
    way = apex[row, face] - y[row]
    least = FLOAT32 * (points.world_m[row].norm(dim=1) + (y - origin)[row].norm(dim=1))
    up = normalize(normal[row, face], dim=1) * -facing[row, face].sign()[:, None]
    share = (least / way.norm(dim=1).clamp_min(THIN)).clamp(WITHIN, 0.5)
    height = torch.maximum(least, 1e-3 * way.norm(dim=1))
    start = y[row] + share[:, None] * way + height[:, None] * up
    light, distance = look(scene, cameras, points.frame[row], start, -up)
    met = torch.nonzero((distance - height).abs() < least)[:, 0]
    return side[met], known[row[met]], light[met]
