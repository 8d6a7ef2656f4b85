"""Surfaces whose light is baked: where their texels lie (charts from texture coordinates to points
and normals), their sides, whether they shine, their pictures; and meshes that glow."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from codesign import backend
from codesign.errors import DomainError, ShapeError
from codesign.exclusive import exclusive
from codesign.render.atlas import Atlas, Nodes, atlas_of, cells_of, nodes_of
from codesign.render.mitsuba_shapes import checked_mesh, front_faces, is_mirrored, matrix_of
from codesign.render.triangles import across
from codesign.render.world import MitsubaScene

# texels of a finished texture per light-map texel along each side, unless its picture is coarser
# than that
FINE = 10
# of a texel: meshes whose pieces are smaller on the average have their light at vertices
FINE_MESH = 0.5
MAX_FACES = 400_000  # of a mesh that is cut into cells
LAMBERTIAN = ("DiffuseReflection", "FrontSide", "BackSide", "SpatiallyVarying")


@dataclass(frozen=True)
class Chart:
    """A map from the unit square to a surface: ``at`` takes u, v [N] (v up) and gives points
    [N, 3], normals [N, 3], on the surface [N]. size: its extent along u and v, in the scene's unit.
    matrix, kind, flip: of the Mitsuba shape that it is; atlas: the layout of a mesh, whose texture
    coordinates are its own;
    uv_per_unit: lengths of that mesh's former ones on its surface."""

    size: tuple[float, float]
    at: Callable[[Any, Any], tuple[Any, Any, Any]]
    kind: str = ""
    matrix: Any = None
    flip: float = 1.0
    atlas: Atlas | None = None
    uv_per_unit: float = 0.0


def chart_of(mi: Any, shape: Any, texel: float, detail: float | None) -> Chart | Nodes:
    """The chart of a Mitsuba shape, or nodes for a mesh that is finer than its texels.

    Args:
      texel: of light.
      detail: of the pictures on it, None where there are none.
    Raises: DomainError for a shape that has no chart here.
    """
    parameters = mi.traverse(shape)
    for kind in ("Rectangle", "Disk", "Sphere", "Cylinder"):
        if shape.shape_type() == int(getattr(mi.ShapeType, kind)):
            return _chart(kind, *_unmirrored(mi, shape, matrix_of(parameters)))
    if not shape.is_mesh() or "faces" not in parameters:
        raise DomainError(
            f"bake: shape '{shape.id()}', a {shape.class_name()}, has no texture chart here; use meshes, "
            "rectangles, cubes, spheres, disks and cylinders (copies instead of instances), or PathScene."
        )
    vertices, _, uv = mesh_arrays(parameters)
    faces = front_faces(shape, parameters)
    area = _areas(vertices[faces])
    faces = faces[area > 0]
    if not len(faces):
        raise DomainError(f"bake: mesh '{shape.id()}' has no faces with an area; leave it out.")
    piece = np.sqrt(2 * area.sum() / len(faces))  # of two triangles
    if (piece < FINE_MESH * texel and (detail is None or piece < detail)) or len(faces) > MAX_FACES:
        return nodes_of(vertices, faces)
    covered = _areas(np.pad(uv[faces], ((0, 0), (0, 0), (0, 1)))).sum() if uv is not None else 0.0
    atlas = atlas_of(cells_of(vertices, faces), texel)
    size = (texel * atlas.texels[1], texel * atlas.texels[0])
    return Chart(size, atlas.at, atlas=atlas, uv_per_unit=float(np.sqrt(covered / area.sum())))


def _areas(corners):
    return np.linalg.norm(across(corners), axis=1) / 2


def placed(
    mi: Any,
    chart: Chart | Nodes,
    to_world: np.ndarray,
    light: list[np.ndarray],
) -> tuple[Any, Any]:
    """The shape moved by a similarity [4, 4], with its light as emission: textures [H, W] of a
    Chart, values [N] of Nodes, of its front and, where there are two, of its back. Returns the
    shape and the emitter of its back or None."""
    if isinstance(chart, Nodes):
        back = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_back"}}
        shape = emissive_mesh(
            mi, _to_world(to_world, chart.vertices), chart.faces, light[0], attribute="vertex_front"
        )
        if len(light) > 1:
            shape.add_attribute("vertex_back", 1, np.ascontiguousarray(light[1], dtype=np.float32))
    else:
        front, back = (emitter(mi, part) for part in (light[0], light[-1]))
        if chart.atlas is not None:
            vertices, faces, uv = chart.atlas.mesh()
            shape = emissive_mesh(mi, _to_world(to_world, vertices), faces, front, uv)
        else:
            frame = mi.ScalarTransform4f(to_world @ chart.matrix)
            flipped = chart.flip < 0
            shape = mi.load_dict(
                {"type": chart.kind, "to_world": frame, "flip_normals": flipped, "emitter": front}
            )
    return shape, mi.load_dict(back) if len(light) > 1 else None


def emitter(mi, texture):
    """Area emitter of a texture [H, W] whose first row is v = 0."""
    return {
        "type": "area",
        "radiance": {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(texture, dtype=np.float32)[..., None]),
            "raw": True,
            "wrap_mode": "clamp",
        },
    }


@exclusive
def emissive_mesh(mi, vertices, faces, light, uv=None, bsdf=None, attribute="face_radiance"):
    """A Mitsuba mesh of flat faces: ``light`` is an emitter dictionary, an array of radiance, [F]
    per face or, for an ``attribute`` that begins with vertex_, [V] per vertex, or None; ``bsdf`` a
    dictionary or None.
    Raises: DomainError and ShapeError for a mesh that cannot be."""
    vertices, faces = checked_mesh("mesh", vertices, faces)
    per = "vertex" if attribute.startswith("vertex_") else "face"
    for label, values, count in (
        (
            f"radiance per {per}",
            None if isinstance(light, dict) else light,
            len(vertices if per == "vertex" else faces),
        ),
        ("texture coordinates", uv, len(vertices)),
    ):
        if values is not None and len(values) != count:  # Mitsuba would read beyond their end
            raise ShapeError(
                f"mesh: {len(values)} values of {label} for {count}; give one for each."
            )
    properties = mi.Properties()
    if light is not None:
        source = (
            light
            if isinstance(light, dict)
            else {"type": "area", "radiance": {"type": "mesh_attribute", "name": attribute}}
        )
        properties["mesh_emitter"] = mi.load_dict(source)
    if bsdf is not None:
        properties["mesh_bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(
        "mesh", len(vertices), len(faces), props=properties, has_vertex_texcoords=uv is not None
    )
    if light is not None and not isinstance(light, dict):
        mesh.add_attribute(attribute, 1, np.asarray(light, dtype=np.float32).reshape(-1))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(
        np.ascontiguousarray(vertices, dtype=np.float32).reshape(-1)
    )
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, dtype=np.uint32).reshape(-1))
    if uv is not None:
        parameters["vertex_texcoords"] = mi.Float(
            np.ascontiguousarray(uv, dtype=np.float32).reshape(-1)
        )
    parameters.update()
    return mesh


def mesh_arrays(parameters):
    """Vertices [V, 3] float64, faces [F, 3] and texture coordinates [V, 2] of a mesh, None where it
    has none."""
    vertices = np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
    uv = (
        np.array(parameters["vertex_texcoords"], dtype=np.float64)
        if "vertex_texcoords" in parameters
        else np.empty(0)
    )
    return (
        vertices,
        np.array(parameters["faces"]).reshape(-1, 3),
        uv.reshape(-1, 2) if uv.size else None,
    )


def _to_world(matrix, local):
    return local @ matrix[:3, :3].T + matrix[:3, 3]


def _unmirrored(mi, shape, matrix):
    """A to_world [4, 4] of the same surface that does not mirror, and whether its normals are then
    flipped (-1)."""
    flip = -1.0 if shape.has_flipped_normals() else 1.0
    if is_mirrored(matrix):
        matrix = matrix @ np.diag([1.0, -1, 1, 1])
        # Mitsuba counts the mirror as a flip of a cylinder's normals, but leaves them outside
        flip *= -1 if shape.shape_type() == int(mi.ShapeType.Cylinder) else 1
    return matrix, flip


def _chart(kind, matrix, flip):
    """Chart of a shape of Mitsuba with its texture coordinates, from that of one of unit size."""
    x, y, z = (float(length) for length in np.linalg.norm(matrix[:3, :3], axis=0))
    local_of, size = {
        "Rectangle": (_rectangle, (2 * x, 2 * y)),
        "Disk": (_disk, (x, 2 * np.pi * x)),
        "Sphere": (_sphere, (2 * np.pi * x, np.pi * x)),
        "Cylinder": (_cylinder, (2 * np.pi * x, z)),
    }[kind]
    up = np.cross(matrix[:3, 0], matrix[:3, 1])
    up *= flip / np.linalg.norm(up)

    def at(u, v):
        local, out = local_of(u, v)
        points = _to_world(matrix, local)
        normals = (
            np.broadcast_to(up, points.shape) if out is None else flip * out @ matrix[:3, :3].T / x
        )
        return points, normals, np.ones(len(points), dtype=bool)

    return Chart(size, at, kind.lower(), matrix, flip)


# points [N, 3] of shapes of unit size at texture coordinates [N] as Mitsuba has them, and normals,
# None where they are +z


def _rectangle(u, v):
    return np.stack([2 * u - 1, 2 * v - 1, 0 * u], -1), None


def _disk(u, v):
    turn = 2 * np.pi * v
    return np.stack([u * np.cos(turn), u * np.sin(turn), 0 * u], -1), None


def _sphere(u, v):
    phi = 2 * np.pi * u
    theta = np.pi * v
    out = np.stack([np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta)], -1)
    return out, out


def _cylinder(u, v):
    phi = 2 * np.pi * u
    out = np.stack([np.cos(phi), np.sin(phi), 0 * phi], -1)
    return out + np.stack([0 * v, 0 * v, v], -1), out


@dataclass(frozen=True)
class Surface:
    """name, shape: of the Mitsuba scene. chart: of its points. sides: 1, or 2 where it reflects
    from behind too.
    shiny: whether its radiance depends on the direction. texels_per_uv: rows and columns of its
    finest picture per unit of its texture coordinates, (0, 0) without pictures, infinite where
    patterns have no resolution."""

    name: str
    shape: Any
    chart: Chart | Nodes
    sides: int
    shiny: bool
    texels_per_uv: tuple[float, float]


def surfaces_of(mi: Any, scene: Any, texel: float, matte: bool) -> list[Surface]:
    """The surfaces of a Mitsuba scene whose light is kept in texels of this size, and pictures in
    finer ones.

    Raises: DomainError for surfaces that no texture can stand for: mirrors, glass and masks unless
      ``matte``, media, shapes without charts.
    """
    found = {}
    for shape in scene.shapes():
        name = shape.id() or shape.class_name()  # those of files need no id
        if name in found:
            name = next(other for k in itertools.count(2) if (other := f"{name}-{k}") not in found)
        found[name] = _surface(mi, name, shape, texel, matte)
    return list(found.values())


def _surface(mi, name, shape, texel, matte):
    bsdf = shape.bsdf()
    flags = 0 if bsdf is None else int(bsdf.flags())
    if shape.interior_medium() is not None or shape.exterior_medium() is not None:
        raise DomainError(
            f"bake: shape '{name}' holds a medium, which no texture shows; leave it out, or use paths."
        )

    def has(*names):
        return any(flags & int(getattr(mi.BSDFFlags, kind)) for kind in names)

    through = has("DeltaTransmission", "GlossyTransmission", "DiffuseTransmission", "Null")
    mirror = has("DeltaReflection") and not has("DiffuseReflection")
    if (through or mirror) and not matte:
        raise DomainError(
            f"bake: what one sees on shape '{name}', a {bsdf.class_name()}, lies behind it or before it and "
            "moves as one moves; use the level 'path', or matte=True to show it as a matte surface of its "
            "mean radiance."
        )
    shiny = bool(flags & ~sum(int(getattr(mi.BSDFFlags, kind)) for kind in LAMBERTIAN))
    pictures = _pictures(mi.traverse(shape))
    if not pictures and has("SpatiallyVarying"):
        pictures = [(np.inf, np.inf)]
    detail = texel / FINE if pictures else None
    chart = chart_of(mi, shape, texel, detail)
    finest = tuple(max((row[k] for row in pictures), default=0.0) for k in (0, 1))
    return Surface(name, shape, chart, 2 if has("BackSide") else 1, shiny, finest)


def _pictures(parameters):
    """Rows and columns per unit of texture coordinates of every bitmap of a shape."""
    found = []
    for key in list(parameters.keys()):
        if key.endswith(".data") and len(parameters[key].shape) == 3:
            rows, columns, _ = parameters[key].shape
            to_uv = parameters.get(key.removesuffix("data") + "to_uv")
            scale = (
                np.eye(3) if to_uv is None else np.array(to_uv.matrix, dtype=float).reshape(3, 3)
            )
            found.append(
                (rows * np.linalg.norm(scale[1, :2]), columns * np.linalg.norm(scale[0, :2]))
            )
    return found


def glowing(triangles_m: Tensor) -> MitsubaScene:
    """Scene of triangles [F, 3, 3] with radiance 1 on both sides, and 0 elsewhere. Raises:
    DomainError for a mesh that cannot be."""
    corners = triangles_m.detach().cpu().reshape(-1, 3).numpy()
    faces = np.arange(len(corners)).reshape(-1, 3)
    mesh = emissive_mesh(backend.mitsuba("cpu"), corners, faces, np.ones(len(faces)))
    return MitsubaScene({"body": mesh}).two_sided()
