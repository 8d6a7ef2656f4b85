"""Robot bodies out of boxes and cylinders: triangle meshes that need no file. Metres, outward faces."""

from collections.abc import Sequence

import numpy as np

from scenes.bodies import Body

AROUND = 32  # faces of a cylinder
CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
# two triangles per side, counter-clockwise from outside
SIDES = np.array(
    [
        (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
        (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
    ]
)  # fmt: skip
# columns: where the axes x, y, z of an upright cylinder go; a rotation, so that faces stay outward
ALONG = {
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "y": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    "z": np.eye(3),
}


def box(size_m: Sequence[float], centre_m: Sequence[float], turn_deg: float = 0.0) -> Body:
    """A box of three side lengths about a point, turned about the vertical.

    >>> box((2.0, 1.0, 0.5), (0.0, 0.0, 1.0)).vertices_m.max(0).tolist()
    [1.0, 0.5, 1.25]
    """
    angle = np.radians(turn_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return Body(CORNERS * np.asarray(size_m, dtype=float) @ turn.T + np.asarray(centre_m, dtype=float), SIDES)


def cylinder(radius_m: float, length_m: float, centre_m: Sequence[float], along: str = "z") -> Body:
    """A closed cylinder about a point, its axis along "x", "y" or "z"; AROUND flat sides inside the radius.

    >>> wheel = cylinder(0.1, 0.04, (0.0, 0.0, 0.1), "y")
    >>> wheel.vertices_m.min(0).round(3).tolist()
    [-0.1, -0.02, 0.0]
    """
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    ring = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.zeros(AROUND)], 1)
    up = np.array([0.0, 0.0, length_m / 2])
    vertices = np.concatenate([ring - up, ring + up, [-up, up]])
    here = np.arange(AROUND)
    after = (here + 1) % AROUND
    low, high = 2 * AROUND, 2 * AROUND + 1
    faces = np.concatenate(
        [
            np.stack([here, after, AROUND + after], 1),
            np.stack([here, AROUND + after, AROUND + here], 1),
            np.stack([np.full(AROUND, low), after, here], 1),
            np.stack([np.full(AROUND, high), AROUND + here, AROUND + after], 1),
        ]
    )
    return Body(vertices @ ALONG[along].T + np.asarray(centre_m, dtype=float), faces)
