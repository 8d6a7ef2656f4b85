"""Radiance of faces that are narrower on the film than radiance is read beside their edges: rays from the camera would pass
over them, and both their edges would tell of one jump."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from codesign.pose import apply, inverse
from codesign.render.curve_points import CurvePoints
from codesign.render.wavefront import look

NARROW = 4.0  # times as wide as radiance is read to the side: wider faces are met
WITHIN = 0.1  # share of the way from an edge to the corner beyond it at which a face is read
FLOAT32 = 2.0**-20  # of coordinates, by which a reading keeps clear of edge and face
THIN = 1e-9


def of_slivers(
    scene: object, cameras: Tensor, points: CurvePoints, y: Tensor, on: Tensor, origin: Tensor, sides: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """(side [k], row [k], radiance [k]) where the face that is seen beside a straight edge is a sliver: read along its
    normal, since radiance is the same in all directions.

    Args: cameras: [parts, F, 4, 4]. y, on: [n, 3], the points and the same curves a little further on, in camera axes.
      origin: [n, 3] of the rays to the points; sides: [2, n, 3], directions of the rays before and behind them.
    """
    known = torch.nonzero(points.apex_m.isfinite().all(2).any(1))[:, 0]
    points, y, on, origin, sides = points[known], y[known], on[known], origin[known], sides[:, known]
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
    nearer = -(normal * across[:, None]).sum(2) / torch.where(facing.abs() > 0, facing, THIN)  # per angle
    none = torch.zeros(0, dtype=torch.long)
    found = [(none, none, none.double())]
    for side, sign in ((0, -1.0), (1, 1.0)):
        there = width * sign > 0
        seen = torch.where(there, nearer * sign, torch.inf).argmin(1)
        rows = torch.nonzero(there.any(1))[:, 0]
        face = seen[rows]
        reach = (y - origin)[rows].norm(dim=1)
        low = width[rows, face].abs() < NARROW * points.aside_rad[rows]
        rows, face, reach = rows[low], face[low], reach[low]
        if not rows.numel():
            continue
        way = apex[rows, face] - y[rows]
        least = FLOAT32 * (points.world_m[rows].norm(dim=1) + reach)
        up = normalize(normal[rows, face], dim=1) * -facing[rows, face].sign()[:, None]
        share = (least / way.norm(dim=1).clamp_min(THIN)).clamp(WITHIN, 0.5)
        height = torch.maximum(least, 1e-3 * way.norm(dim=1))
        start = y[rows] + share[:, None] * way + height[:, None] * up
        light, distance = look(scene, cameras, points.frame[rows], start, -up)
        met = torch.nonzero((distance - height).abs() < least)[:, 0]
        found.append((torch.full_like(met, side), known[rows[met]], light[met]))
    return tuple(torch.cat(column) for column in zip(*found, strict=True))
