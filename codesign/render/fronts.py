"""Which side of a surface is its front. Mitsuba goes by the normals that a shape stores, and a mirrored ``to_world``
turns its faces inside out, but not those normals."""

from typing import Any

import numpy as np


def is_mirrored(matrix: Any) -> bool:
    """Whether a to_world [4, 4] turns left into right."""
    return bool(np.linalg.det(np.asarray(matrix)[:3, :3]) < 0)


def front_faces(shape: Any, parameters: Any) -> np.ndarray:
    """Faces [F, 3] of a Mitsuba mesh, wound so that their normals point to the side that shines."""
    faces = np.array(parameters["faces"], dtype=np.int64).reshape(-1, 3)
    turned = np.full(len(faces), shape.has_flipped_normals()) ^ _against_normals(shape, parameters, faces)
    return np.where(turned[:, None], faces[:, ::-1], faces)


def are_geometric(mi: Any, shape: Any) -> bool:
    """Whether the geometric normal of a Mitsuba shape points to the side that shines, everywhere."""
    parameters = mi.traverse(shape)
    if shape.shape_type() == int(mi.ShapeType.Rectangle):
        return not is_mirrored(np.array(parameters["to_world"].matrix, dtype=float).reshape(4, 4))
    if not shape.is_mesh() or "faces" not in parameters:
        return True
    faces = np.array(parameters["faces"], dtype=np.int64).reshape(-1, 3)
    return not _against_normals(shape, parameters, faces).any()


def _against_normals(shape, parameters, faces):
    """Whether each face is wound against the normals of its vertices: [F] bool."""
    if not shape.has_vertex_normals():
        return np.zeros(len(faces), dtype=bool)
    corners, normals = (
        np.array(parameters[key], dtype=np.float64).reshape(-1, 3)[faces]
        for key in ("vertex_positions", "vertex_normals")
    )
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return (across * normals.sum(1)).sum(1) < 0
