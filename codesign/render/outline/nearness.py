"""How near to a camera the nearest surface of a scene is, in view or not."""

from dataclasses import dataclass

import numpy as np

from codesign.render.outline.shapes import Ball, Disk, Mesh, Shape


@dataclass(frozen=True)
class Bodies:
    """Triangles corners [N, 3, 3] and distances [N] from them to the surface: 0, or the radius about a point or line."""

    corners: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, shapes: list[Shape]) -> "Bodies":
        """The triangles of meshes, squares around disks, middles of balls and axes of cylinders."""
        found = [(np.zeros((0, 3, 3)), 0.0), *(_body(shape) for shape in shapes)]
        return cls(
            np.concatenate([corners for corners, _ in found]).astype(np.float32),
            np.concatenate([np.full(len(corners), radius) for corners, radius in found]),
        )

    def nearest_m(self, eye: np.ndarray) -> float:
        """Distance from a point [3] below which there is no surface; infinite without any."""
        if not len(self.radius):
            return np.inf
        middle = self.corners.mean(1)
        reach = np.linalg.norm(self.corners - middle[:, None], axis=2).max(1)
        away = np.linalg.norm(middle - eye, axis=1)
        flat = self.radius == 0
        most = (away + reach)[flat].min(initial=np.inf)
        rows = ~flat | (away - reach <= most * (1 + 1e-5))
        apart = _distance(self.corners[rows].astype(np.float64) - eye)
        return float(np.abs(apart - self.radius[rows]).min())


def _body(shape):
    if isinstance(shape, Mesh):
        return shape.vertices[shape.faces], 0.0
    if isinstance(shape, Disk):
        square = np.array([[[-1, -1], [1, -1], [1, 1]], [[-1, -1], [1, 1], [-1, 1]]])
        return shape.centre + square @ np.stack([shape.u, shape.v]), 0.0
    ends = (shape.centre,) * 3 if isinstance(shape, Ball) else (shape.start, shape.start, shape.end)
    return np.stack(ends)[None], shape.radius


def _distance(corners):
    """Distance [n] of triangles [n, 3, 3], which may be lines or points, from the origin."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    above = np.abs((corners[:, 0] * normal).sum(1)) / np.maximum(size, 1e-300)
    within = size > 0
    nearest = np.full(len(corners), np.inf)
    for k in range(3):
        a = corners[:, k]
        along = corners[:, (k + 1) % 3] - a
        within &= (np.cross(along, -a) * normal).sum(1) >= 0
        share = -(a * along).sum(1) / np.maximum((along * along).sum(1), 1e-300)
        nearest = np.minimum(nearest, np.linalg.norm(a + share.clip(0, 1)[:, None] * along, axis=1))
    return np.where(within, above, nearest)
