"""Straight edges of triangle meshes that may part two radiances; and what coincides counts once:
seams of walls, edges that overlap in part, a tube's end and its lid."""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from codesign.render.rows import Rows
from codesign.render.triangles import across, edge_pairs

# vertices of a mesh nearer than this share of its size, or than rounding, are one
SAME_POINT = 1e-6
ROUNDING = 2.0**-21  # of float32 coordinates, four units in the last place
# share of the largest by which what radiance is looked up by may differ across an edge
SAME_VALUE = 1e-6
# cosine of the angle of two faces: above the first an edge is none, below the second it may part
# two radiances
FLAT = 1 - 1e-6
SHARP = 0.98
SAME_PLACE_M = 1e-4  # curves nearer than this are one; they are read from farther aside by as much
SHORT = 4  # edges shorter than this many such distances are left as they are
BITS = 10  # of each coordinate in the order along a space-filling curve


@dataclass(frozen=True)
class Edges(Rows):
    """start, end: [E, 3]. normals: [E, 2, 3] of the two faces, the side that shines. always: [E],
    True where an edge counts from every side. free: [E], True where not just two faces of one mesh
    meet. width_m: [E], how far apart edges lie that count as this one. apexes: [E, 2, 3], third
    corners of the two faces, NaN for none and where more than two meet."""

    start: np.ndarray
    end: np.ndarray
    normals: np.ndarray
    always: np.ndarray
    free: np.ndarray
    width_m: np.ndarray
    apexes: np.ndarray

    def __len__(self):
        return len(self.start)

    @property
    def length_m(self):
        """Lengths [E], metres."""
        return np.linalg.norm(self.end - self.start, axis=1)


def segments(start: np.ndarray, end: np.ndarray) -> Edges:
    """Edges from start to end [E, 3] that count from every side and belong to no mesh."""
    count = len(start)
    yes = np.ones(count, dtype=bool)
    return Edges(
        start,
        end,
        np.zeros((count, 2, 3)),
        yes,
        yes,
        np.zeros(count),
        np.full((count, 2, 3), np.nan),
    )


def mesh_edges(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray | None = None) -> Edges:
    """Edges of a mesh of vertices [V, 3] and faces [F, 3] that may part two radiances.

    Args:
      values: [F, 3, k] by which radiance is looked up at the corners of every face; None for one
    radiance. Vertices at one place are one. An edge of two faces counts from every side where they
    are creased sharply or their values differ along it, as a silhouette where they are creased at
    all; an edge of one face, or of three and more, counts always, and so does one between faces
    wound against each other, of which one is black. Faces without area are left out.
    """
    place = welded(vertices, np.ptp(vertices, axis=0).max(initial=0) * SAME_POINT)
    at = place[faces]
    corners = vertices[faces]
    normals = across(corners)
    area = np.linalg.norm(normals, axis=1)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1, initial=0)
    flat = np.abs(vertices).max(initial=0) * ROUNDING
    whole = np.nonzero(
        (at[:, 0] != at[:, 1])
        & (at[:, 1] != at[:, 2])
        & (at[:, 2] != at[:, 0])
        & (area > longest * min(flat, 1e-3 * longest.max(initial=0)))
    )[0]
    normals = normals[whole] / area[whole, None]
    one, other, count, forward = edge_pairs(at[whole])
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
    """Whether the values [F, 3, k] of two faces differ at an end of their common edge: corner
    numbers ``one`` and ``other`` [E] of its beginning in either face, ``forward`` [3 F] whether
    that is its lower end."""
    begin = values.reshape(-1, values.shape[2])
    end = np.roll(values, -1, axis=1).reshape(-1, values.shape[2])
    low = np.where(forward[:, None], begin, end)
    high = np.where(forward[:, None], end, begin)
    apart = np.maximum(np.abs(low[one] - low[other]), np.abs(high[one] - high[other])).max(
        1, initial=0
    )
    return apart > SAME_VALUE * np.abs(values).max(initial=0)


def welded(points: np.ndarray, apart_m: float) -> np.ndarray:
    """Numbers [N] of places: points [N, 3] nearer than ``apart_m``, or than float32 rounding, share
    one."""
    order, number = _equal(points)
    unique = points[order[np.nonzero(np.diff(number, prepend=-1))[0]]]
    place = np.empty(len(points), dtype=np.int64)
    place[order] = number
    apart_m = max(float(apart_m), float(np.abs(points).max(initial=0)) * ROUNDING)
    pairs = scipy.spatial.cKDTree(unique, balanced_tree=False).query_pairs(
        apart_m, output_type="ndarray"
    )
    if not len(pairs):
        return place
    size = len(unique)
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(size, size)
    )
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1][place]


def _equal(points):
    """An order of points [N, 3] with equal ones side by side, and their numbers [N] in it: sorted
    by a mixture of their coordinates, since sorting rows takes ten times as long. Should two places
    have one mixture, equal points may get several numbers."""
    mixed = points[:, 0] + np.pi * points[:, 1] + np.e * points[:, 2]
    order = np.argsort(mixed)
    ordered = points[order]
    return order, np.cumsum(np.append(False, (ordered[1:] != ordered[:-1]).any(1)))[: len(points)]


def tolerance(points: np.ndarray) -> float:
    """Distance, metres, below which curves of a scene with points [N, 3] are one: SAME_PLACE_M,
    less where the scene is smaller than a metre, more where its coordinates are rounded so
    coarsely."""
    size = float(np.ptp(points, axis=0).max(initial=0))
    return max(SAME_PLACE_M * min(size, 1.0), ROUNDING * float(np.abs(points).max(initial=0)))


def edges_once(parts: list[Edges], apart_m: float) -> Edges:
    """Edges of several shapes, each stretch of a line once, however many edges overlap there.

    Edges are cut where an end of another lies on them; what then has the same ends is one, and
    counts from every side.
    """
    parts = [part for part in parts if len(part)]
    edges = Edges.joined(parts)
    chosen = (
        edges.always
        & (edges.length_m > SHORT * apart_m)
        & (edges.free | _beside_others(parts, edges, apart_m))
    )
    rows = np.nonzero(chosen)[0]
    if len(rows) < 2:
        return edges
    cut, off = _cut_at_ends(edges[rows], apart_m)
    place = welded(np.concatenate([cut.start, cut.end]), apart_m).reshape(2, -1)
    whole = place[0] != place[1]
    cut = cut[whole]
    off = off[whole]
    place = np.sort(place[:, whole], axis=0)
    both = place[0] * (place.max(initial=0) + 1) + place[1]
    _, first, which, count = np.unique(
        both, return_index=True, return_inverse=True, return_counts=True
    )
    middle = (cut.start + cut.end) / 2
    apart = np.maximum(_from_line(middle, cut[first][which]), off)
    width = np.zeros(len(first))
    np.maximum.at(width, which, apart)
    width = np.where(count > 1, np.maximum(width, cut.width_m[first]), cut.width_m[first])
    merged = cut[first]
    normals = np.where((count > 1)[:, None, None], 0.0, merged.normals)
    apexes = np.where((count > 1)[:, None, None], np.nan, merged.apexes)
    merged = replace(merged, normals=normals, width_m=width, apexes=apexes)
    return Edges.joined([edges[~chosen], merged])


def _beside_others(parts, edges, apart_m):
    """Edges [E] whose boxes touch those of another shape's edges."""
    shape = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    pairs = touching(np.stack([edges.start, edges.end], 1), 2 * apart_m)
    found = np.zeros(len(edges), dtype=bool)
    found[pairs[shape[pairs[:, 0]] != shape[pairs[:, 1]]]] = True
    return found


def _cut_at_ends(edges, apart_m):
    """Edges cut where ends of others lie on them, and how far off [E] these lay."""
    points = np.concatenate([edges.start, edges.end])
    points = points[np.unique(welded(points, 0.0), return_index=True)[1]]
    tree = scipy.spatial.cKDTree(points)
    middle = (edges.start + edges.end) / 2
    half = edges.length_m / 2
    nearest, _ = tree.query(middle)
    doubtful = np.nonzero(nearest < half - apart_m)[0]
    which, near = within_reach(tree, middle[doubtful], half[doubtful])
    which, point = doubtful[which], points[near]
    along = (edges.end - edges.start)[which] / (2 * half[which])[:, None]
    at = ((point - edges.start[which]) * along).sum(1)
    off = np.linalg.norm(point - edges.start[which] - at[:, None] * along, axis=1)
    inside = (off < apart_m) & (at > apart_m) & (at < 2 * half[which] - apart_m)
    which = np.concatenate([np.arange(len(edges)), which[inside]])
    share = np.concatenate([np.zeros(len(edges)), at[inside] / (2 * half[which[len(edges) :]])])
    off = np.concatenate([np.zeros(len(edges)), off[inside]])
    order = np.lexsort((share, which))
    which = which[order]
    share = share[order]
    until = np.where(np.append(which[1:] == which[:-1], False), np.append(share[1:], 1.0), 1.0)
    cut = edges[which]
    along = cut.end - cut.start
    widest = np.zeros(len(edges))
    np.maximum.at(widest, which, off[order])
    return (
        replace(
            cut, start=cut.start + share[:, None] * along, end=cut.start + until[:, None] * along
        ),
        widest[which],
    )


def within_reach(
    tree: "scipy.spatial.cKDTree",
    points: np.ndarray,
    reach: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs [n], [n] of the number of a point and of what in a tree is nearer to it than its
    reach."""
    near = tree.query_ball_point(points, reach)
    numbers = [np.zeros(0, dtype=np.int64), *(np.array(found, dtype=np.int64) for found in near)]
    return np.repeat(np.arange(len(points)), [len(found) for found in near]), np.concatenate(
        numbers
    )


def _from_line(points, edges):
    """Distances [n] of points [n, 3] from the lines of edges [n]."""
    along = (edges.end - edges.start) / np.maximum(edges.length_m, 1e-300)[:, None]
    return np.linalg.norm(np.cross(points - edges.start, along), axis=1)


def rims_once(
    centre: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    axis: np.ndarray,
    width_m: np.ndarray,
    apart_m: float,
) -> tuple[np.ndarray, ...]:
    """Rims centre + cos u + sin v with the ``axis`` of their cylinders, [C, 3] each, that are not
    one curve with an earlier one, whose axis is then that of either; and ``width_m`` [C], grown by
    how far apart those lie that are."""
    # the same however u and v are turned
    shape = np.einsum("ni,nj->nij", u, u) + np.einsum("ni,nj->nij", v, v)
    radius = np.sqrt(np.trace(shape, axis1=1, axis2=2) / 2)
    kept = np.ones(len(centre), dtype=bool)
    axis = axis.copy()
    width = width_m.copy()
    pairs = scipy.spatial.cKDTree(centre).query_pairs(apart_m, output_type="ndarray")
    for i, j in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        apart = (
            np.linalg.norm(centre[i] - centre[j]) + np.linalg.norm(shape[i] - shape[j]) / radius[i]
        )
        if kept[i] and kept[j] and apart < apart_m:
            kept[j] = False
            axis[i] = axis[i] if axis[i].any() else axis[j]
            width[i] = max(width[i], width[j] + apart)
    return centre[kept], u[kept], v[kept], axis[kept], width[kept]


def touching(corners: np.ndarray, margin_m: float) -> np.ndarray:
    """Pairs [n, 2], first below second, of triangles or edges, by their corners [N, k, 3], whose
    boxes come nearer than ``margin_m``."""
    count = len(corners)
    if count < 2:
        return np.zeros((0, 2), dtype=np.int64)
    order = np.argsort(_along_curve(corners.mean(1)))
    size = 1 << (count - 1).bit_length()
    low = np.full((3, size), np.inf)
    high = np.full((3, size), -np.inf)
    low[:, :count] = corners[order].min(1).T - margin_m / 2
    high[:, :count] = corners[order].max(1).T + margin_m / 2
    levels = [(low, high)]
    while levels[-1][0].shape[1] > 1:
        low, high = levels[-1]
        levels.append(
            (np.minimum(low[:, ::2], low[:, 1::2]), np.maximum(high[:, ::2], high[:, 1::2]))
        )
    a = b = np.zeros(1, dtype=np.int32)
    for low, high in reversed(levels[:-1]):
        apart = np.nonzero(a != b)[0]
        a, b = (
            np.concatenate([2 * a, 2 * a, 2 * a + 1, 2 * a[apart] + 1]),
            np.concatenate([2 * b, 2 * b + 1, 2 * b + 1, 2 * b[apart]]),
        )
        for axis in range(3):
            near = np.nonzero((low[axis][a] <= high[axis][b]) & (low[axis][b] <= high[axis][a]))[0]
            a = a[near]
            b = b[near]
    different = a != b
    return np.sort(order[np.stack([a[different], b[different]], 1)], axis=1)


def _along_curve(points):
    """Morton codes [N] of points [N, 3]: neighbours in space are near in their order."""
    low = points.min(0)
    cells = (
        (points - low) / max(float((points.max(0) - low).max()), 1e-300) * (2**BITS - 1)
    ).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code
