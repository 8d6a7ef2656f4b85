"""Faces of different radiance in one plane, one over the other: rounding decides which of them a ray meets."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.render.outline.curves import Curve, cut, pieces_of


@dataclass(frozen=True)
class Overlaps(Curve):
    """A line start, end [n, 3] across every overlap; normal: [n, 3] of both faces; names: of their shapes [n]. No
    radiance can be read there: where it is asked how, the scene is refused."""

    start: Tensor
    end: Tensor
    normal: Tensor
    names: tuple[tuple[str, str], ...]

    def pieces(self, viewpoint, angle, within_m=0.0):
        """As for Segments; none of faces that turn away, which are black."""
        kept = torch.nonzero(((viewpoint - self.start) * self.normal).sum(1) > 0)[:, 0]
        return cut(kept, pieces_of(self.start[kept] - viewpoint, self.end[kept] - viewpoint, angle))

    def points(self, index, s, viewpoint):
        """As for Segments."""
        return self.start[index] + s[:, None] * (self.end - self.start)[index]

    def aside_rad(self, index, viewpoint):
        """Raise DomainError: an overlap may be in view."""
        if not index.numel():
            return torch.zeros(0, dtype=torch.float64)
        first, second = self.names[int(index[0])]
        at = ", ".join(f"{v:.3g}" for v in self.start[index[0]].tolist())
        raise DomainError(
            f"faces of shapes '{first}' and '{second}' lie in one plane near ({at}) m, one over the other, and rounding "
            "decides which is seen; move one of them by a millimetre."
        )


def overlaps(
    first: np.ndarray, second: np.ndarray, normal: np.ndarray, apart_m: float
) -> tuple[np.ndarray, ...]:
    """Of triangles [n, 3, 3] in one plane each, with normals [n, 3]: the rows of those that overlap by more than
    ``apart_m``, and the middle [m, 3] and a far end [m, 3] of what they share."""
    origin = first[:, :1]
    u = first[:, 1] - first[:, 0]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    axes = np.stack([u, np.cross(normal, u)], 2)
    p, q = ((corners - origin) @ axes for corners in (first, second))
    depth = np.full(len(p), np.inf)
    for corners in (p, q):
        for k in range(3):
            along = corners[:, (k + 1) % 3] - corners[:, k]
            across = np.stack([-along[:, 1], along[:, 0]], 1) / np.linalg.norm(along, axis=1, keepdims=True)
            a, b = ((v * across[:, None]).sum(2) for v in (p, q))
            depth = np.minimum(depth, np.minimum(a.max(1), b.max(1)) - np.maximum(a.min(1), b.min(1)))
    rows = np.nonzero(depth > apart_m)[0]
    p, q, axes, origin = p[rows], q[rows], axes[rows], origin[rows]
    points = [p, q]
    shared = [_within(p, q), _within(q, p)]
    for i in range(3):
        for j in range(3):
            at, meet = _meeting(p[:, i], p[:, (i + 1) % 3], q[:, j], q[:, (j + 1) % 3])
            points.append(at[:, None])
            shared.append(meet[:, None])
    points = np.concatenate(points, 1)
    shared = np.concatenate(shared, 1)
    middle = (points * shared[..., None]).sum(1) / np.maximum(shared.sum(1), 1)[:, None]
    away = np.where(shared, np.linalg.norm(points - middle[:, None], axis=2), -1.0)
    end = points[np.arange(len(rows)), away.argmax(1)] if len(rows) else middle
    return rows, *(origin[:, 0] + (axes @ v[..., None])[..., 0] for v in (middle, end))


def _turn(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _within(points, corners):
    """Whether points [n, 3, 2] lie in triangles [n, 3, 2]."""
    sides = np.stack(
        [
            _turn((corners[:, (k + 1) % 3] - corners[:, k])[:, None], points - corners[:, k][:, None])
            for k in range(3)
        ]
    )
    return (sides >= 0).all(0) | (sides <= 0).all(0)


def _meeting(a, b, c, d):
    """Where segments a to b and c to d [n, 2] meet, and whether they do."""
    size = _turn(b - a, d - c)
    safe = np.where(np.abs(size) > 1e-300, size, 1.0)
    s = _turn(c - a, d - c) / safe
    t = _turn(c - a, b - a) / safe
    return a + s[:, None] * (b - a), (size != 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
