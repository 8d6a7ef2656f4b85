"""Triangles of a mesh: their normals, and which of them share an edge."""

import numpy as np


def across(corners: np.ndarray) -> np.ndarray:
    """Normals [F, 3] of triangles [F, 3, 3], as long as twice their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def normals_of(corners: np.ndarray) -> np.ndarray:
    """Normals [F, 3] of length one of triangles [F, 3, 3]; 0 of those without area."""
    normal = across(corners)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def edge_pairs(place: np.ndarray) -> tuple[np.ndarray, ...]:
    """Edges of faces whose corners lie at places [F, 3], in order of their lower and their higher
    place.

    Returns: one, other: [E] sides of faces that lie there, numbered 3 face + corner at which a side
      begins; the same where not just two do. count: [E] how many do. rises: [3 F] whether a side
      runs to a higher place.
    """
    first = place.reshape(-1)
    second = np.roll(place, -1, axis=1).reshape(-1)
    key = np.minimum(first, second) * (place.max(initial=0) + 1) + np.maximum(first, second)
    order = np.argsort(key, kind="stable")
    begins = np.nonzero(np.diff(key[order], prepend=-1))[0]
    count = np.diff(begins, append=len(order))
    one = order[begins]
    other = np.where(count == 2, order[np.minimum(begins + 1, len(order) - 1)], one)
    return one, other, count, first < second
