"""Where shapes pass through each other, and a mesh through itself: segments along which two
triangles cross.

Round shapes stand as fine triangles here; their segments are carried onto the true curve in
``intersections``. Where faces of different radiance lie in one plane, one over the other, rounding
decides which is met: such views are refused.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.render.rows import Rows
from codesign.render.silhouettes.curves import Curve, cut_line, on_line
from codesign.render.silhouettes.edges import ROUNDING, touching, welded
from codesign.render.silhouettes.shapes import Ball, Disk, Mesh, Shape
from codesign.render.triangles import across, normals_of

AROUND = 96  # triangles around a round shape
BLOCK = 1_000_000  # pairs at a time


@dataclass(frozen=True)
class Triangles(Rows):
    """corners: [N, 3, 3]; place: [N, 3], equal for corners of one shape at one place; shape, face:
    [N], numbers."""

    corners: np.ndarray
    place: np.ndarray
    shape: np.ndarray
    face: np.ndarray


@dataclass(frozen=True)
class Crossings(Rows):
    """Segments start, end [n, 3] along which two triangles cross; normals: [n, 2, 3] of these;
    shapes: [n, 2], their numbers."""

    start: np.ndarray
    end: np.ndarray
    normals: np.ndarray
    shapes: np.ndarray


@dataclass(frozen=True)
class Overlaps(Curve):
    """A line start, end [n, 3] across every overlap; normal: [n, 3] of both faces; names: of their
    shapes [n]. No radiance can be read there: where it is asked how, the scene is refused."""

    start: Tensor
    end: Tensor
    normal: Tensor
    names: tuple[tuple[str, str], ...]

    def pieces(self, viewpoint, angle, within_m=0.0):
        """As for Segments; none of faces that turn away, which are black."""
        kept = torch.nonzero(((viewpoint - self.start) * self.normal).sum(1) > 0)[:, 0]
        return cut_line(self, kept, viewpoint, angle)

    def points(self, index, s, viewpoint):
        """As for Segments."""
        return on_line(self, index, s)

    def aside_rad(self, index, viewpoint):
        """Raise DomainError: an overlap may be in view."""
        if not index.numel():
            return torch.zeros(0, dtype=torch.float64)
        first, second = self.names[int(index[0])]
        at = ", ".join(f"{v:.3g}" for v in self.start[index[0]].tolist())
        raise DomainError(
            f"faces of shapes '{first}' and '{second}' lie in one plane near ({at}) m, one over the other, "
            "and rounding decides which is seen; move one of them by a millimetre."
        )


def find_crossings(shapes: list[Shape], apart_m: float = 0.0) -> tuple[Crossings, Overlaps | None]:
    """All segments along which the shapes cross each other, and meshes themselves; and where faces
    of different radiance lie in one plane and overlap by more than ``apart_m``."""
    triangles = _near_others(shapes)
    noise = ROUNDING * float(np.abs(triangles.corners).max(initial=0))
    pairs = touching(triangles.corners, noise)
    own = triangles.shape[pairs[:, 0]] == triangles.shape[pairs[:, 1]]
    mesh = np.array([isinstance(shape, Mesh) for shape in shapes])[triangles.shape[pairs[:, 0]]]
    pairs = pairs[~own | (mesh & ~_neighbours(triangles.place, pairs))]
    found = [
        _crossing(triangles, pairs[k : k + BLOCK], noise)
        for k in range(0, max(len(pairs), 1), BLOCK)
    ]
    return (
        Crossings.joined([part for part, _ in found]),
        _overlaps(shapes, triangles, np.concatenate([level for _, level in found]), apart_m),
    )


def _overlaps(shapes, triangles, pairs, apart_m):
    """Overlaps of pairs [n, 2] of triangles in one plane that face one way, or None."""
    one, other = (triangles[pairs[:, side]] for side in (0, 1))
    normal = normals_of(one.corners)
    rows, middle, end = overlaps(one.corners, other.corners, normal, apart_m)
    light = [
        [shapes[k].light_of(f) for k, f in zip(side.shape[rows], side.face[rows], strict=True)]
        for side in (one, other)
    ]
    kept = [k for k, (a, b) in enumerate(zip(*light, strict=True)) if a is None or a != b]
    if not kept:
        return None
    names = [
        (shapes[a].name, shapes[b].name)
        for a, b in zip(one.shape[rows], other.shape[rows], strict=True)
    ]
    return Overlaps(
        *(torch.tensor(v[kept]) for v in (middle, end, normal[rows])), tuple(names[k] for k in kept)
    )


def _neighbours(place, pairs):
    """Whether pairs [n, 2] of triangles with corners at places [N, 3] share one."""
    columns = [
        [np.ascontiguousarray(place[:, k])[pairs[:, side]] for k in range(3)] for side in (0, 1)
    ]
    shared = np.zeros(len(pairs), dtype=bool)
    for a in columns[0]:
        for b in columns[1]:
            shared |= a == b
    return shared


def _near_others(shapes):
    """Triangles of all shapes: of meshes all, since they may cross themselves; of others those
    within the box of another shape."""
    lows, highs = (np.stack([of(s.corners(), 0) for s in shapes]) for of in (np.min, np.max))
    parts = []
    for number, shape in enumerate(shapes):
        vertices, faces = tessellated(shape)
        corners = vertices[faces]
        kept = np.full(len(faces), isinstance(shape, Mesh))
        if not kept.all():
            low = corners.min(1)
            high = corners.max(1)
            beside = ((lows[number] <= highs) & (highs[number] >= lows)).all(1)
            beside[number] = False
            for other in np.nonzero(beside)[0]:
                kept |= ((low <= highs[other]) & (high >= lows[other])).all(1)
        kept &= across(corners).any(1)
        place = welded(vertices, 0.0)[faces] if kept.any() else faces
        parts.append(
            Triangles(
                corners[kept], place[kept], np.full(int(kept.sum()), number), np.nonzero(kept)[0]
            )
        )
    return Triangles.joined(parts)


def tessellated(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] of a shape; round ones lie half within and half beyond their
    triangles."""
    if isinstance(shape, Mesh):
        return shape.vertices, shape.faces
    turn = 2 * np.pi * np.arange(AROUND) / AROUND
    k = np.arange(AROUND)
    following = (k + 1) % AROUND
    wider = 1 + (np.pi / AROUND) ** 2 / 4  # between the circle and the polygon around it
    if isinstance(shape, Ball):
        rise = np.pi * np.arange(AROUND // 2 + 1) / (AROUND // 2)
        ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
        grid = np.sin(rise)[:, None, None] * ring + np.cos(rise)[:, None, None] * np.array(
            [0.0, 0.0, 1.0]
        )
        row = AROUND * np.arange(AROUND // 2)[:, None]
        lower = np.stack([row + k, row + AROUND + k, row + AROUND + following], -1).reshape(-1, 3)
        upper = np.stack([row + k, row + AROUND + following, row + following], -1).reshape(-1, 3)
        return shape.centre + wider * shape.radius * grid.reshape(-1, 3), np.concatenate(
            [lower, upper]
        )
    around = np.cos(turn)[:, None] * shape.u + np.sin(turn)[:, None] * shape.v
    if isinstance(shape, Disk):
        rim = shape.centre + (1 + (np.pi / AROUND) ** 2) * around
        return np.concatenate([rim, shape.centre[None]]), np.stack(
            [k, following, 0 * k + AROUND], 1
        )
    ring = wider * around
    sides = np.concatenate(
        [
            np.stack([k, following, AROUND + k], 1),
            np.stack([following, AROUND + following, AROUND + k], 1),
        ]
    )
    return np.concatenate([shape.start + ring, shape.end + ring]), sides


def _crossing(triangles, pairs, noise):
    """Crossings of pairs [n, 2] of triangles, and the pairs [m, 2] that lie in one plane and face
    one way. A corner on the other's plane counts as above it, so that an edge that lies in a face
    is found from one of its sides at most."""
    pair = [triangles[pairs[:, side]] for side in (0, 1)]
    normals = [normals_of(side.corners) for side in pair]
    height = [
        ((this.corners - other.corners[:, :1]) * n[:, None]).sum(2)
        for this, other, n in ((pair[0], pair[1], normals[1]), (pair[1], pair[0], normals[0]))
    ]
    level = ((normals[0] * normals[1]).sum(1) > 0) & (
        np.maximum(*(np.abs(h).max(1, initial=0) for h in height)) <= noise
    )
    cut = np.ones(len(pair[0].shape), dtype=bool)
    for h in height:
        cut &= (
            (h.min(1, initial=np.inf) < 0)
            & (h.max(1, initial=-np.inf) >= 0)
            & (np.abs(h).max(1, initial=0) > noise)
        )
    rows = np.nonzero(cut)[0]
    normals = [n[rows] for n in normals]
    along = np.cross(*normals)
    size = np.linalg.norm(along, axis=1)
    along /= np.maximum(size, 1e-300)[:, None]
    # [n, 2, 3] each
    ends = [_on_plane(side.corners[rows], h[rows]) for side, h in zip(pair, height, strict=True)]
    origin = ends[0][:, :1]
    at = [np.sort(((end - origin) * along[:, None]).sum(2), axis=1) for end in ends]
    first = np.maximum(at[0][:, 0], at[1][:, 0])
    last = np.minimum(at[0][:, 1], at[1][:, 1])
    real = np.nonzero((last - first > noise) & (size > 1e-9))[0]
    start, end = (origin[real, 0] + v[real, None] * along[real] for v in (first, last))
    numbers = np.stack([side.shape[rows][real] for side in pair], 1)
    return Crossings(start, end, np.stack([n[real] for n in normals], 1), numbers), pairs[level]


def _on_plane(corners, height):
    """The two points [n, 2, 3] where sides of triangles [n, 3, 3] meet a plane over which corners
    are ``height`` [n, 3]: one corner lies on one side, the two others on the other."""
    above = height >= 0
    lone = np.where(above.sum(1) == 1, above.argmax(1), (~above).argmax(1))[:, None]
    rows = np.arange(len(corners))[:, None]
    others = (lone + [1, 2]) % 3
    share = height[rows, lone] / (height[rows, lone] - height[rows, others])
    return corners[rows, lone] + share[..., None] * (corners[rows, others] - corners[rows, lone])


def overlaps(
    first: np.ndarray, second: np.ndarray, normal: np.ndarray, apart_m: float
) -> tuple[np.ndarray, ...]:
    """Of triangles [n, 3, 3] in one plane each, with normals [n, 3]: the rows of those that overlap
    by more than ``apart_m``, and the middle [m, 3] and a far end [m, 3] of what they share."""
    origin = first[:, :1]
    u = first[:, 1] - first[:, 0]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    axes = np.stack([u, np.cross(normal, u)], 2)
    p, q = ((corners - origin) @ axes for corners in (first, second))
    along = np.concatenate([np.roll(corners, -1, axis=1) - corners for corners in (p, q)], 1)
    across = np.stack([-along[..., 1], along[..., 0]], 2) / np.linalg.norm(
        along, axis=2, keepdims=True
    )
    a, b = ((corners[:, None] * across[:, :, None]).sum(3) for corners in (p, q))
    depth = (np.minimum(a.max(2), b.max(2)) - np.maximum(a.min(2), b.min(2))).min(1)
    rows = np.nonzero(depth > apart_m)[0]
    p, q, axes, origin = p[rows], q[rows], axes[rows], origin[rows]
    one, other = ((corners, np.roll(corners, -1, axis=1)) for corners in (p, q))
    at, meet = _meeting(*(v[:, :, None] for v in one), *(v[:, None] for v in other))
    points = np.concatenate([p, q, at.reshape(-1, 9, 2)], 1)
    shared = np.concatenate([_within(p, q), _within(q, p), meet.reshape(-1, 9)], 1)
    middle = (points * shared[..., None]).sum(1) / np.maximum(shared.sum(1), 1)[:, None]
    away = np.where(shared, np.linalg.norm(points - middle[:, None], axis=2), -1.0)
    end = points[np.arange(len(rows)), away.argmax(1)] if len(rows) else middle
    return rows, *(origin[:, 0] + (axes @ v[..., None])[..., 0] for v in (middle, end))


def _turn(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _within(points, corners):
    """Whether points [n, 3, 2] lie in triangles [n, 3, 2]."""
    along = np.roll(corners, -1, axis=1) - corners
    sides = _turn(along[:, None], points[:, :, None] - corners[:, None])
    return (sides >= 0).all(2) | (sides <= 0).all(2)


def _meeting(a, b, c, d):
    """Where segments a to b and c to d [..., 2] meet, and whether they do."""
    size = _turn(b - a, d - c)
    safe = np.where(np.abs(size) > 1e-300, size, 1.0)
    s = _turn(c - a, d - c) / safe
    t = _turn(c - a, b - a) / safe
    return a + s[..., None] * (b - a), (size != 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
