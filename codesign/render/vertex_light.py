"""Radiance that a mesh has at its vertices, between them. Mitsuba weighs corners in float32 by the square of a face's
area, which is noise on faces more than a thousand times as long as wide; here that is float64."""

import re
from typing import Any


def vertex_attribute(surface: Any) -> str | None:
    """Name of the attribute at vertices that an emitter or material of Mitsuba shows, None where it shows none."""
    found = re.search(r'MeshAttribute\[\s*name = "(vertex_\w+)"', str(surface))
    return found[1] if found else None


def interpolated(mi: Any, shape: Any, name: str, si: Any) -> Any:
    """An attribute at vertices of a mesh where it is met (drjit arrays), between the values of the corners. Gradient: to
    the place."""
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
