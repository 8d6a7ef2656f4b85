"""Triangle meshes: out of boxes and cylinders, or from files, of one colour or of their own.
Metres, outward faces."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from codesign.doors import explain
from codesign.errors import DomainError
from scenes import mesh_files

# share of light from everywhere, and where the rest comes from
SKY = 0.6
SUN = (0.3, -0.5, 0.81)
# faces of a cylinder
AROUND = 32
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


@dataclass(frozen=True)
class Body:
    """Triangles in the world: vertices_m [V, 3], faces [F, 3].

    uv: [V, 2] where its paint is laid out by texture coordinates (v up). tint: what the paint's
    level is times where it has none: one number, [F], or [V] where ``smooth``.
    """

    vertices_m: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    tint: Any = 1.0
    smooth: bool = False

    def placed(self, x=0.0, y=0.0, bottom_m=0.0, turn_deg=0.0):
        """The body turned about z, its bounding box centred over (x, y) and resting on
        ``bottom_m``."""
        turned = self.vertices_m @ _about_z(turn_deg).T
        low, high = turned.min(0), turned.max(0)
        middle = [*(low + high)[:2] / 2, low[2]]
        return replace(self, vertices_m=turned - middle + [x, y, bottom_m])


def read(path: str | Path, scale: float = 1.0) -> Body:
    """The shapes of a mesh file (scenes.mesh_files.KINDS) as one Body, its coordinates times
    ``scale`` (0.001 for a file in millimetres); its colours are left.

    Raises: FileFormatError when the file is missing, of another kind, empty or damaged; DomainError
      for a scale that is not positive.
    """
    if not 0 < scale < float("inf"):
        raise DomainError(f"mesh {path}: scale = {scale} must be positive and finite.")
    parts = mesh_files.read(path, materials=False)
    before = np.cumsum([0, *(len(part.vertices_m) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, before, strict=False)]
    return Body(scale * np.concatenate([part.vertices_m for part in parts]), np.concatenate(faces))


def skylight(body: Body) -> np.ndarray:
    """Share of full light from a plain sky with a soft sun: what stands for shading where nothing
    is lit. [F] on each face, or [V] by the mean normal at each vertex of a ``smooth`` body."""
    corners = body.vertices_m[body.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if body.smooth:
        mean = np.zeros_like(body.vertices_m)
        for k in range(3):
            np.add.at(mean, body.faces[:, k], normal)
        normal = mean
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    sun = np.array(SUN) / np.linalg.norm(SUN)
    return SKY * (0.6 + 0.4 * normal[:, 2]) + (1 - SKY) * np.maximum(normal @ sun, 0)


def box(size_m: Sequence[float], centre_m: Sequence[float], turn_deg: float = 0.0) -> Body:
    """A box of three side lengths about a point, turned about the vertical.

    >>> box((2.0, 1.0, 0.5), (0.0, 0.0, 1.0)).vertices_m.max(0).tolist()
    [1.0, 0.5, 1.25]
    """
    corners = CORNERS * np.asarray(size_m, dtype=float) @ _about_z(turn_deg).T
    return Body(corners + np.asarray(centre_m, dtype=float), SIDES)


def _about_z(turn_deg):
    """Rotation [3, 3]."""
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def cylinder(radius_m: float, length_m: float, centre_m: Sequence[float], along: str = "z") -> Body:
    """A closed cylinder about a point, its axis along "x", "y" or "z"; AROUND flat sides inside the
    radius.

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


explain(globals())
