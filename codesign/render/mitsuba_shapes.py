"""What the shapes of Mitsuba do not tell by themselves: which side is the front, radiance between vertices,
numbers, and the box around them.

Mitsuba takes the front from the normals that a shape stores, and a mirrored ``to_world`` turns its faces
inside out, but not those normals. At vertices it weighs corners in float32 by the square of a face's area,
which is noise on faces more than a thousand times as long as wide; here that is float64.
"""

import re
from typing import Any

import numpy as np

from codesign.render.triangles import across

ROOM = 1e-3  # of the diagonal


def is_mirrored(matrix: Any) -> bool:
    """Whether a to_world [4, 4] turns left into right."""
    return bool(np.linalg.det(np.asarray(matrix)[:3, :3]) < 0)


def matrix_of(parameters: Any) -> np.ndarray:
    """The to_world [4, 4] of a Mitsuba shape."""
    return np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)


def front_faces(shape: Any, parameters: Any) -> np.ndarray:
    """Faces [F, 3] of a Mitsuba mesh, wound so that their normals point to the side that shines."""
    faces = np.array(parameters["faces"], dtype=np.int64).reshape(-1, 3)
    turned = np.full(len(faces), shape.has_flipped_normals()) ^ _against_normals(shape, parameters, faces)
    return np.where(turned[:, None], faces[:, ::-1], faces)


def are_geometric(mi: Any, shape: Any) -> bool:
    """Whether the geometric normal of a Mitsuba shape points to the side that shines, everywhere."""
    parameters = mi.traverse(shape)
    if shape.shape_type() == int(mi.ShapeType.Rectangle):
        return not is_mirrored(matrix_of(parameters))
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
    return (across(corners) * normals.sum(1)).sum(1) < 0


def vertex_attribute(surface: Any) -> str | None:
    """Name of the attribute at vertices that an emitter or material of Mitsuba shows, None where it shows
    none."""
    found = re.search(r'MeshAttribute\[\s*name = "(vertex_\w+)"', str(surface))
    return found[1] if found else None


def interpolated(mi: Any, shape: Any, name: str, si: Any) -> Any:
    """An attribute at vertices of a mesh where it is met (drjit arrays), between the values of the corners.
    Gradient: to the place."""
    import drjit as dr

    parameters = mi.traverse(shape)
    corner = [dr.gather(mi.UInt32, parameters["faces"], 3 * si.prim_index + k) for k in range(3)]
    at = [mi.Point3d(dr.gather(mi.Point3f, parameters["vertex_positions"], vertex)) for vertex in corner]
    value = [dr.gather(mi.Float, parameters[name], vertex) for vertex in corner]
    u = at[1] - at[0]
    v = at[2] - at[0]
    towards = mi.Point3d(si.p) - at[0]
    uu, vv, uv = dr.squared_norm(u), dr.squared_norm(v), dr.dot(u, v)
    area = uu * vv - uv * uv
    along_u, along_v = dr.dot(u, towards), dr.dot(v, towards)
    share_u = dr.clip((vv * along_u - uv * along_v) / area, 0, 1)
    share_v = dr.clip((uu * along_v - uv * along_u) / area, 0, 1 - share_u)
    return value[0] + mi.Float(share_u) * (value[1] - value[0]) + mi.Float(share_v) * (value[2] - value[0])


def shape_numbers(mi: Any, scene: Any) -> Any:
    """Numbers of the shapes of a Mitsuba scene in its own list, behind what their pointers hold (drjit
    array)."""
    import drjit as dr

    held = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in scene.shapes()]
    table = [0] * (1 + max(held, default=0))
    for number, place in enumerate(held):
        table[place] = number
    return mi.UInt32(table)


def box_around(mi: Any, scene: Any) -> Any:
    """Box (drjit arrays) with room for rounding around all shapes of a Mitsuba scene; None under a sky, where
    rays start inside."""
    import drjit as dr

    box = scene.bbox()
    if scene.environment() is not None or not box.valid():
        return None
    room = ROOM * float(dr.norm(box.extents()))
    found = mi.BoundingBox3f(mi.Point3f(box.min - room), mi.Point3f(box.max + room))
    dr.make_opaque(found)  # another scene needs no new kernel
    return found
