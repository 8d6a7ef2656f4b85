"""Points, segments and rays against triangles [F, 3, 3], exactly and without gradient; float64,
many against many."""

import math

import torch
from torch import Tensor

PAIRS = 1 << 17  # of a point and a triangle looked at together


def closest_points(points: Tensor, triangles: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest point of a set of triangles.

    Args:
      points: [N, 3].
      triangles: [F, 3, 3], F >= 1; ones without area count as their edges.
    Returns: closest [N, 3], and the triangle that it lies on [N]. Gradient: none.
    Source: Ericson, Real-Time Collision Detection, 2005, 5.1.5: inside the prism over a triangle
      its plane is nearest, elsewhere one of its edges.
    """
    chunks = points.detach().split(max(1, PAIRS // len(triangles)))
    found = [_closest(chunk, triangles.detach()) for chunk in chunks]
    return torch.cat([at for at, _ in found]), torch.cat([face for _, face in found])


def _closest(points, triangles):
    edge = triangles.roll(-1, 1) - triangles  # of corner k to k + 1
    normal = torch.linalg.cross(edge[:, 0], edge[:, 1])
    from_corner = points[:, None, None] - triangles  # [N, F, 3, 3]
    along = (from_corner * edge).sum(-1) / edge.square().sum(-1).clamp_min(1e-300)
    on_edge = triangles + along.clamp(0, 1)[..., None] * edge
    squared = (points[:, None, None] - on_edge).square().sum(-1)
    near, which = squared.min(-1)
    best = on_edge.gather(2, which[..., None, None].expand(*which.shape, 1, 3))[:, :, 0]
    # over the inside of the triangle the foot on its plane is nearer
    inward = torch.linalg.cross(normal[:, None].expand_as(edge), edge)
    above = ((from_corner * inward).sum(-1) >= 0).all(-1) & (normal.square().sum(-1) > 0)
    height = (from_corner[:, :, 0] * normal).sum(-1) / normal.square().sum(-1).clamp_min(1e-300)
    foot = points[:, None] - height[..., None] * normal
    squared = torch.where(above, height.square() * normal.square().sum(-1), near)
    face = squared.argmin(1)
    at = torch.arange(len(points), device=points.device)
    return torch.where(above[at, face, None], foot[at, face], best[at, face]), face


def winding_numbers(points: Tensor, triangles: Tensor) -> Tensor:
    """How often triangles wind around points: 1 inside a closed surface that faces outward, 0
    outside of it.

    Args:
      points: [N, 3].
      triangles: [F, 3, 3].
    Returns: [N]. Gradient: none.
    Source: solid angle of a triangle of van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30,
      1983; as a test of what is inside Jacobson, Kavan and Sorkine-Hornung, SIGGRAPH 2013.
    """
    found = []
    for chunk in points.detach().split(max(1, PAIRS // len(triangles))):
        a, b, c = (triangles.detach()[:, k] - chunk[:, None] for k in range(3))
        x, y, z = (torch.linalg.vector_norm(side, dim=-1) for side in (a, b, c))
        volume = (a * torch.linalg.cross(b, c)).sum(-1)
        flat = x * y * z + (a * b).sum(-1) * z + (b * c).sum(-1) * x + (c * a).sum(-1) * y
        found.append(2 * torch.atan2(volume, flat).sum(1) / (4 * math.pi))
    return torch.cat(found)


def first_crossings(origin: Tensor, direction: Tensor, triangles: Tensor) -> Tensor:
    """Where lines first cross triangles ahead of their origin, in lengths of their direction.

    Args:
      origin, direction: [N, 3].
      triangles: [F, 3, 3].
    Returns: [N], infinite where there is no crossing. Gradient: none.
    Source: Moeller and Trumbore, J. Graphics Tools 2, 1997.
    """
    first = triangles.detach()[:, 0]
    side = triangles.detach()[:, 1] - first
    other = triangles.detach()[:, 2] - first
    found = []
    size = max(1, PAIRS // len(triangles))
    for o, d in zip(origin.detach().split(size), direction.detach().split(size), strict=True):
        d = d[:, None].expand(len(d), len(first), 3)
        across = torch.linalg.cross(d, other.expand_as(d))
        scale = (side * across).sum(-1)
        meets = scale != 0
        scale = torch.where(meets, scale, 1.0)
        offset = o[:, None] - first
        u = (offset * across).sum(-1) / scale
        turned = torch.linalg.cross(offset, side.expand_as(offset))
        v = (d * turned).sum(-1) / scale
        length = (other * turned).sum(-1) / scale
        meets = meets & (u >= 0) & (v >= 0) & (u + v <= 1) & (length >= 0)
        found.append(torch.where(meets, length, torch.inf).amin(1))
    return torch.cat(found)


def nearest_to_edges(start: Tensor, end: Tensor, triangles: Tensor) -> Tensor:
    """Where along segments their distance to the edges of triangles is smallest.

    Args:
      start, end: [N, 3].
      triangles: [F, 3, 3].
    Returns: [N] in 0..1. Gradient: none. Source: Ericson, 2005, 5.1.9.
    """
    corner = triangles.detach().reshape(-1, 3)
    edge = (triangles.roll(-1, 1) - triangles).detach().reshape(-1, 3)
    long = edge.square().sum(-1).clamp_min(1e-300)
    found = []
    size = max(1, PAIRS // len(corner))
    for p, q in zip(start.detach().split(size), end.detach().split(size), strict=True):
        axis = (q - p)[:, None]
        squared = axis.square().sum(-1).clamp_min(1e-300)
        gap = p[:, None] - corner
        ahead = (axis * gap).sum(-1)
        beside = (edge * gap).sum(-1)
        both = (axis * edge).sum(-1)
        spread = squared * long - both.square()
        # nearest points of the two lines, then each kept on its segment (of parallel lines any
        # point serves)
        t = ((both * beside - ahead * long) / torch.where(spread > 0, spread, 1.0)).clamp(0, 1)
        t = torch.where(spread > 1e-14 * squared * long, t, 0.0)
        s = ((both * t + beside) / long).clamp(0, 1)
        t = ((both * s - ahead) / squared).clamp(0, 1)
        away = gap + t[..., None] * axis - s[..., None] * edge
        best = away.square().sum(-1).argmin(1)
        found.append(t.gather(1, best[:, None])[:, 0])
    return torch.cat(found)
