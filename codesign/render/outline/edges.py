"""Straight edges of triangle meshes that may part two radiances."""

from dataclasses import dataclass, fields

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

SAME_POINT = 1e-6  # vertices of a mesh nearer than this share of its size, or than rounding, are one
ROUNDING = 2.0**-21  # of float32 coordinates, four units in the last place
SAME_VALUE = 1e-6  # share of the largest by which what radiance is looked up by may differ across an edge
# cosine of the angle of two faces: above the first an edge is none, below the second it may part two
# radiances
FLAT = 1 - 1e-6
SHARP = 0.98


@dataclass(frozen=True)
class Edges:
    """start, end: [E, 3]. normals: [E, 2, 3] of the two faces, the side that shines. always: [E], True where an
    edge counts from every side. free: [E], True where not just two faces of one mesh meet. width_m: [E], how far
    apart edges lie that count as this one. apexes: [E, 2, 3], third corners of the two faces, NaN for
    none and where more than two meet."""

    start: np.ndarray
    end: np.ndarray
    normals: np.ndarray
    always: np.ndarray
    free: np.ndarray
    width_m: np.ndarray
    apexes: np.ndarray

    def __getitem__(self, rows):
        return Edges(*(getattr(self, f.name)[rows] for f in fields(self)))

    def __len__(self):
        return len(self.start)

    @property
    def length_m(self):
        """Lengths [E], metres."""
        return np.linalg.norm(self.end - self.start, axis=1)


def joined(parts: list[Edges]) -> Edges:
    """All edges of a list that is not empty, one after the other."""
    return Edges(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Edges)))


def segments(start: np.ndarray, end: np.ndarray) -> Edges:
    """Edges from start to end [E, 3] that count from every side and belong to no mesh."""
    count = len(start)
    yes = np.ones(count, dtype=bool)
    return Edges(
        start, end, np.zeros((count, 2, 3)), yes, yes, np.zeros(count), np.full((count, 2, 3), np.nan)
    )


def mesh_edges(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray | None = None) -> Edges:
    """Edges of a mesh of vertices [V, 3] and faces [F, 3] that may part two radiances.

    Args: values: [F, 3, k] by which radiance is looked up at the corners of every face; None for one radiance.
    Vertices at one place are one. An edge of two faces counts from every side where they are creased sharply
    or their values differ along it, as a silhouette where they are creased at all; an edge of one face, or of
    three and more, counts always, and so does one between faces wound against each other, of which one is black.
    Faces without area are left out.
    """
    place = welded(vertices, np.ptp(vertices, axis=0).max(initial=0) * SAME_POINT)
    at = place[faces]
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1, initial=0)
    flat = np.abs(vertices).max(initial=0) * ROUNDING
    whole = np.nonzero(
        (at[:, 0] != at[:, 1])
        & (at[:, 1] != at[:, 2])
        & (at[:, 2] != at[:, 0])
        & (area > longest * min(flat, 1e-3 * longest.max(initial=0)))
    )[0]
    normals = across[whole] / area[whole, None]
    at = at[whole]
    first = at.reshape(-1)
    second = np.roll(at, -1, axis=1).reshape(-1)
    forward = first < second
    key = np.minimum(first, second) * (place.max(initial=0) + 1) + np.maximum(first, second)
    order = np.argsort(key, kind="stable")
    begins = np.nonzero(np.diff(key[order], prepend=-1))[0]
    count = np.diff(begins, append=len(order))
    one = order[begins]
    other = np.where(count == 2, order[np.minimum(begins + 1, len(order) - 1)], one)
    free = count != 2
    n = np.stack([normals[one // 3], normals[other // 3]], 1)
    cosine = (n[:, 0] * n[:, 1]).sum(1)
    always = free | (cosine < SHARP) | (forward[one] == forward[other])
    if values is not None:
        always |= _differ(values[whole], one, other, forward)
    n[free] = 0  # whose face turns away still hides what is behind
    kept = np.nonzero(always | (cosine < FLAT))[0]
    start = vertices[faces[whole].reshape(-1)[one[kept]]]
    end = vertices[np.roll(faces[whole], -1, axis=1).reshape(-1)[one[kept]]]
    third = vertices[np.roll(faces[whole], -2, axis=1).reshape(-1)]
    apexes = np.stack([third[one], third[other]], 1)
    apexes[count != 2, 1] = np.nan
    apexes[count > 2] = np.nan
    return Edges(start, end, n[kept], always[kept], free[kept], np.zeros(len(kept)), apexes[kept])


def _differ(values, one, other, forward):
    """Whether the values [F, 3, k] of two faces differ at an end of their common edge: corner numbers ``one``
    and ``other`` [E] of its beginning in either face, ``forward`` [3 F] whether that is its lower end."""
    begin = values.reshape(-1, values.shape[2])
    end = np.roll(values, -1, axis=1).reshape(-1, values.shape[2])
    low = np.where(forward[:, None], begin, end)
    high = np.where(forward[:, None], end, begin)
    apart = np.maximum(np.abs(low[one] - low[other]), np.abs(high[one] - high[other])).max(1, initial=0)
    return apart > SAME_VALUE * np.abs(values).max(initial=0)


def welded(points: np.ndarray, apart_m: float) -> np.ndarray:
    """Numbers [N] of places: points [N, 3] nearer than ``apart_m``, or than float32 rounding, share one."""
    order, number = _equal(points)
    unique = points[order[np.nonzero(np.diff(number, prepend=-1))[0]]]
    place = np.empty(len(points), dtype=np.int64)
    place[order] = number
    apart_m = max(float(apart_m), float(np.abs(points).max(initial=0)) * ROUNDING)
    pairs = cKDTree(unique, balanced_tree=False).query_pairs(apart_m, output_type="ndarray")
    if not len(pairs):
        return place
    size = len(unique)
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    return connected_components(graph, directed=False)[1][place]


def _equal(points):
    """An order of points [N, 3] with equal ones side by side, and their numbers [N] in it: sorted by a mixture of
    their coordinates, since sorting rows takes ten times as long. Should two places have one mixture, equal points
    may get several numbers."""
    mixed = points[:, 0] + np.pi * points[:, 1] + np.e * points[:, 2]
    order = np.argsort(mixed)
    ordered = points[order]
    return order, np.cumsum(np.append(False, (ordered[1:] != ordered[:-1]).any(1)))[: len(points)]
