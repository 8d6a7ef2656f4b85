"""Robot bodies and other triangle meshes from files, of one colour or of their own. Metres."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from codesign.errors import DomainError
from scenes import mesh_files

# share of light from everywhere, and where the rest comes from
SKY = 0.6
SUN = (0.3, -0.5, 0.81)


@dataclass(frozen=True)
class Body:
    """Triangles in the world: vertices_m [V, 3], faces [F, 3].

    uv: [V, 2] where its paint is laid out by texture coordinates (v up). tint: what the paint's level is times
    where it has none: one number, [F], or [V] where ``smooth``.
    """

    vertices_m: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    tint: Any = 1.0
    smooth: bool = False

    def placed(self, x=0.0, y=0.0, bottom_m=0.0, turn_deg=0.0):
        """The body turned about z, its bounding box centred over (x, y) and resting on ``bottom_m``."""
        angle = np.radians(turn_deg)
        turned = self.vertices_m @ np.array(
            [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        low = turned.min(0)
        high = turned.max(0)
        middle = [(low[0] + high[0]) / 2 - x, (low[1] + high[1]) / 2 - y, low[2] - bottom_m]
        return replace(self, vertices_m=turned - middle)


def read(path: str | Path, scale: float = 1.0) -> Body:
    """The shapes of a mesh file (scenes.mesh_files.KINDS) as one Body, its coordinates times ``scale`` (0.001 for
    a file in millimetres); its colours are left.

    Raises: FileFormatError when the file is missing, of another kind, empty or damaged; DomainError for a
      scale that is not positive.
    """
    if not 0 < scale < float("inf"):
        raise DomainError(f"mesh {path}: scale = {scale} must be positive and finite.")
    parts = mesh_files.read(path, materials=False)
    before = np.cumsum([0, *(len(part.vertices_m) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, before, strict=False)]
    return Body(scale * np.concatenate([part.vertices_m for part in parts]), np.concatenate(faces))


def skylight(body: Body) -> np.ndarray:
    """Share of full light from a plain sky with a soft sun: what stands for shading where nothing is lit. [F] on
    each face, or [V] by the mean normal at each vertex of a ``smooth`` body."""
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
