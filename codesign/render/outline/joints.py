"""Curves that coincide count once: seams of walls, edges that overlap in part, a tube's end and its lid."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from codesign.render.outline.edges import ROUNDING, Edges, joined, welded
from codesign.render.outline.pairs import touching

SAME_PLACE_M = 1e-4  # curves nearer than this are one; they are read from farther aside by as much
SHORT = 4  # edges shorter than this many such distances are left as they are


def tolerance(points: np.ndarray) -> float:
    """Distance, metres, below which curves of a scene with points [N, 3] are one: SAME_PLACE_M, less where the
    scene is smaller than a metre, more where its coordinates are rounded so coarsely."""
    size = float(np.ptp(points, axis=0).max(initial=0))
    return max(SAME_PLACE_M * min(size, 1.0), ROUNDING * float(np.abs(points).max(initial=0)))


def edges_once(parts: list[Edges], apart_m: float) -> Edges:
    """Edges of several shapes, each stretch of a line once, however many edges overlap there.

    Edges are cut where an end of another lies on them; what then has the same ends is one, and counts from
    every side.
    """
    parts = [part for part in parts if len(part)]
    edges = joined(parts)
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
    _, first, which, count = np.unique(both, return_index=True, return_inverse=True, return_counts=True)
    middle = (cut.start + cut.end) / 2
    apart = np.maximum(_from_line(middle, cut[first][which]), off)
    width = np.zeros(len(first))
    np.maximum.at(width, which, apart)
    width = np.where(count > 1, np.maximum(width, cut.width_m[first]), cut.width_m[first])
    merged = cut[first]
    normals = np.where((count > 1)[:, None, None], 0.0, merged.normals)
    apexes = np.where((count > 1)[:, None, None], np.nan, merged.apexes)
    merged = replace(merged, normals=normals, width_m=width, apexes=apexes)
    return joined([edges[~chosen], merged])


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
    tree = cKDTree(points)
    middle = (edges.start + edges.end) / 2
    half = edges.length_m / 2
    nearest, _ = tree.query(middle)
    doubtful = np.nonzero(nearest < half - apart_m)[0]
    near = tree.query_ball_point(middle[doubtful], half[doubtful])
    which = np.repeat(doubtful, [len(found) for found in near])
    point = (
        points[np.concatenate([np.array(found, dtype=np.int64) for found in near])]
        if len(which)
        else points[:0]
    )
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
        replace(cut, start=cut.start + share[:, None] * along, end=cut.start + until[:, None] * along),
        widest[which],
    )


def _from_line(points, edges):
    """Distances [n] of points [n, 3] from the lines of edges [n]."""
    along = (edges.end - edges.start) / np.maximum(edges.length_m, 1e-300)[:, None]
    return np.linalg.norm(np.cross(points - edges.start, along), axis=1)


def rims_once(
    centre: np.ndarray, u: np.ndarray, v: np.ndarray, axis: np.ndarray, width_m: np.ndarray, apart_m: float
) -> tuple[np.ndarray, ...]:
    """Rims centre + cos u + sin v with the ``axis`` of their cylinders, [C, 3] each, that are not one curve with an earlier
    one, whose axis is then that of either; and ``width_m`` [C], grown by how far apart those lie that are."""
    # the same however u and v are turned
    shape = np.einsum("ni,nj->nij", u, u) + np.einsum("ni,nj->nij", v, v)
    radius = np.sqrt(np.trace(shape, axis1=1, axis2=2) / 2)
    kept = np.ones(len(centre), dtype=bool)
    axis = axis.copy()
    width = width_m.copy()
    pairs = cKDTree(centre).query_pairs(apart_m, output_type="ndarray")
    for i, j in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        apart = np.linalg.norm(centre[i] - centre[j]) + np.linalg.norm(shape[i] - shape[j]) / radius[i]
        if kept[i] and kept[j] and apart < apart_m:
            kept[j] = False
            axis[i] = axis[i] if axis[i].any() else axis[j]
            width[i] = max(width[i], width[j] + apart)
    return centre[kept], u[kept], v[kept], axis[kept], width[kept]
