"""Triangles and lights that several tests are made of."""

import numpy as np

# a cube of side 2 about the origin, its faces wound outwards
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
CUBE = np.array([face for a, b, c, d in SIDES for face in ((a, b, c), (a, c, d))])


def squares(n, m, around=False):
    """Two faces for each square between vertices in n rows of m, numbered row by row; the last
    column goes on in the first."""
    row, column = (v.reshape(-1) for v in np.mgrid[: n - 1, : m - (not around)])
    a, b = row * m + column, row * m + (column + 1) % m
    return np.stack([a, b, b + m, a, b + m, a + m], 1).reshape(-1, 3)


def area(value):
    """Area emitter of one radiance."""
    return {"type": "area", "radiance": {"type": "rgb", "value": float(value)}}
