"""What the shapes of Mitsuba do not tell by themselves: which side is the front, radiance between
vertices, numbers, the box around them; and scenes that cannot be, refused where they are built,
before Mitsuba renders them wrong or black, or ends the process.

Mitsuba takes the front from the normals that a shape stores, and a mirrored ``to_world`` turns its
faces inside out, but not those normals. At vertices it weighs corners in float32 by the square of a
face's area, which is noise on faces more than a thousand times as long as wide; here that is
float64.
"""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from codesign.errors import DomainError, ShapeError
from codesign.render.triangles import across

# Mitsuba itself follows their faces to vertices that are not there
FILES_UNCHECKED = ("ply", "serialized")
RADIANCE = ("value", "data", "scale")  # last part of the names of what an emitter shines with
REPEAT = "radiance.to_uv"  # of an emitter's picture
# of a mesh, beside the attributes its user has given it
OWN = ("positions", "normals", "texcoords")
# from the origin of texture coordinates: beyond, float32 knows a texel to a quarter at best
MOST_TEXELS = 2.0**22
# squared sine of the angle at a face's corner, below which Mitsuba's weights of corners are noise
THINNEST = 1e-5
NAMED = 3  # shapes that a sentence names
ROOM = 1e-3  # of a box's diagonal, around it


def checked_mesh(name: str, vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3] of a mesh as arrays; ShapeError and DomainError, by its
    name, for a mesh without faces, vertices that are not finite and faces of vertices that are not
    there."""
    vertices = np.asarray(vertices)
    faces = np.asarray(faces)
    for label, array in (("vertices", vertices), ("faces", faces)):
        if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
            raise ShapeError(
                f"mesh '{name}': its {label} are {array.shape}; give at least one, [N, 3]."
            )
    finite = np.isfinite(vertices).all(1)
    if not finite.all():
        raise DomainError(
            f"mesh '{name}': {int((~finite).sum())} of {len(finite)} vertices are NaN or infinite (first "
            f"number {int(np.argmin(finite))}); repair or remove them."
        )
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(vertices):
        raise DomainError(
            f"mesh '{name}': its faces name vertices {low} to {high}, but it has {len(vertices)}, counted "
            "from 0; repair the faces."
        )
    return vertices, faces


def check_description(mi: Any, description: Any) -> None:
    """Raise DomainError or ShapeError for a description that is none, or that holds a mesh which
    would end the process when Mitsuba builds the scene."""
    if not isinstance(description, Mapping):
        raise DomainError(
            "a scene is described by a dictionary of shapes as Mitsuba has it, got a "
            f"{type(description).__name__}; give one, or ask worlds.from_mitsuba for a file."
        )
    for name, entry in description.items():
        if isinstance(entry, Mapping) and entry.get("type") in FILES_UNCHECKED:
            try:
                shape = mi.load_dict({**_file_of(entry), "face_normals": True})
            # what cannot be read at all is told where the scene is built
            except (
                RuntimeError,
                TypeError,
                ValueError,
            ):
                continue
            _check_shape(mi, name, shape)
        elif isinstance(entry, mi.Mesh):
            _check_shape(mi, name, entry)


def check_scene(mi: Any, scene: Any, emissive: bool) -> None:
    """Raise DomainError or ShapeError when a shape of a built scene is not finite, has no faces,
    or, where it must be ``emissive``, has no emitter; or when an emitter's radiance is negative or
    not finite."""
    black = []
    for number, shape in enumerate(scene.shapes()):
        name = shape.id() or f"number {number}"
        _check_shape(mi, name, shape)
        if not shape.is_emitter():
            black.append(name)
    if emissive and black:
        more = f" and {len(black) - NAMED} more" if len(black) > NAMED else ""
        raise DomainError(
            f"shape {', '.join(map(repr, black[:NAMED]))}{more} has no emitter, so it would be black: give "
            "it one of type 'area' (of radiance 0 where black is meant), or let light.bake or "
            "light.PathScene work out its light."
        )
    for emitter in scene.emitters():
        shape = emitter.get_shape()
        parameters = mi.traverse(emitter)
        values = (
            (key, parameters[key]) for key, _ in parameters if key.rsplit(".", 1)[-1] in RADIANCE
        )
        _check_radiance(emitter.id() if shape is None else shape.id(), values)
        if shape is not None:
            _check_attributes(mi, shape, emitter)


def _check_attributes(mi, shape, emitter):
    for name in re.findall(r'MeshAttribute\[\s*name = "(\w+)"', str(emitter)):
        if not bool(shape.has_attribute(name)[0]):
            raise DomainError(
                f"radiance of '{shape.id()}': the mesh has no attribute '{name}', so it would be black; add "
                "it (mesh.add_attribute), or name one that is there."
            )
        numbers = mi.traverse(shape)
        if name not in numbers:  # a picture
            continue
        held = shape.face_count() if name.startswith("face") else shape.vertex_count()
        size = len(numbers[name]) / max(held, 1)
        if size not in (1, 3):
            raise DomainError(
                f"radiance of '{shape.id()}': attribute '{name}' has {size:g} numbers each; one, or three "
                "(a colour), are needed."
            )


def _file_of(entry):
    return {
        key: value for key, value in entry.items() if key in ("type", "filename", "shape_index")
    }


def _check_shape(mi, name, shape):
    parameters = mi.traverse(shape)
    _check_lookup(name, parameters)
    if shape.is_mesh() and "vertex_positions" in parameters:
        vertices, faces = checked_mesh(
            name,
            *(np.array(parameters[key]).reshape(-1, 3) for key in ("vertex_positions", "faces")),
        )
        if re.search(r'MeshAttribute\[\s*name = "vertex_', str(shape.bsdf())):
            _check_thick(name, vertices[faces])
        attributes = (
            key
            for key, _ in parameters
            if key.startswith(("vertex_", "face_")) and not key.endswith(OWN)
        )
        _check_radiance(name, ((key, parameters[key]) for key in attributes))
        return
    box = shape.bbox()
    if not np.isfinite(np.array([box.min, box.max], dtype=float)).all():
        raise DomainError(
            f"shape '{name}': its place or size is NaN or infinite; repair its to_world."
        )


def _check_lookup(name, parameters):
    """Texture coordinates times texels stay below what float32 can tell apart."""
    uv = (
        np.array(parameters["vertex_texcoords"]) if "vertex_texcoords" in parameters else np.ones(1)
    )
    for key in [key for key, _ in parameters if key.endswith(".data")]:
        size = max(np.shape(parameters[key]))
        to_uv = key.removesuffix("data") + "to_uv"
        scale = (
            np.abs(np.array(parameters[to_uv].matrix, dtype=float)).max()
            if to_uv in parameters
            else 1.0
        )
        reach = float(np.abs(uv).max(initial=0)) * scale * size
        if not reach <= MOST_TEXELS:
            raise DomainError(
                f"shape '{name}': its texture coordinates reach {reach:.3g} texels away from 0, where "
                f"float32 no longer tells texels apart (at most {MOST_TEXELS:.0f}); repeat the picture less "
                "often, or make its texels larger."
            )


def _check_thick(name, corners):
    u, v = corners[:, 1].astype(float) - corners[:, 0], corners[:, 2].astype(float) - corners[:, 0]
    uu, vv, uv = (u * u).sum(1), (v * v).sum(1), (u * v).sum(1)
    area = uu * vv - uv * uv
    thin = int(((area > 0) & (area < THINNEST * uu * vv)).sum())
    if thin:
        raise DomainError(
            f"mesh '{name}': {thin} of its faces are more than {THINNEST**-0.5:.0f} times as long as wide, "
            "on which Mitsuba cannot tell albedo at vertices; remove them, or show the mesh at the level "
            "'emissive'."
        )


def _check_radiance(name, values):
    for key, value in values:
        array = np.array(value, dtype=np.float32)
        if array.size and not (array.min() >= 0 and array.max() < np.inf):
            wrong = array[~(np.isfinite(array) & (array >= 0))]
            raise DomainError(
                f"radiance of '{name}': {key} holds {wrong.size} values that are negative, NaN or infinite "
                f"(first {wrong.flat[0]:.3g}); make every one finite and at least 0."
            )


def is_mirrored(matrix: Any) -> bool:
    """Whether a to_world [4, 4] turns left into right."""
    return bool(np.linalg.det(np.asarray(matrix)[:3, :3]) < 0)


def matrix_of(parameters: Any) -> np.ndarray:
    """The to_world [4, 4] of a Mitsuba shape."""
    return np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)


def front_faces(shape: Any, parameters: Any) -> np.ndarray:
    """Faces [F, 3] of a Mitsuba mesh, wound so that their normals point to the side that shines."""
    faces = np.array(parameters["faces"], dtype=np.int64).reshape(-1, 3)
    turned = np.full(len(faces), shape.has_flipped_normals()) ^ _against_normals(
        shape, parameters, faces
    )
    return np.where(turned[:, None], faces[:, ::-1], faces)


def are_geometric(mi: Any, shape: Any) -> bool:
    """Whether the geometric normal of a Mitsuba shape points to the side that shines,
    everywhere."""
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


def attribute_of(mi: Any, shape: Any, emitter: Any) -> str | None:
    """Name of the attribute at vertices or faces of a mesh that its emitter shows, as it is and
    without anything else; None where it shows none."""
    found = re.search(r'radiance = MeshAttribute\[\s*name = "((?:vertex|face)_\w+)"', str(emitter))
    return found[1] if found and shape.is_mesh() and found[1] in mi.traverse(shape) else None


def attribute_at(mi: Any, shape: Any, name: str, si: Any) -> Any:
    """An attribute of a mesh where it is met (drjit arrays): of the face, or between the values at
    its corners; of three colours their luminance. Mitsuba itself would ask all shapes of all scenes
    that there are.
    Gradient: to the place."""
    import drjit as dr

    parameters = mi.traverse(shape)
    values = parameters[name]
    on_faces = name.startswith("face")
    held = dr.width(parameters["faces" if on_faces else "vertex_positions"]) // 3
    colours = dr.width(values) // held

    def read(index):
        told = [dr.gather(mi.Float, values, colours * index + k) for k in range(colours)]
        return told[0] if colours == 1 else mi.luminance(mi.Color3f(told))

    if on_faces:
        return read(si.prim_index)
    corner = [dr.gather(mi.UInt32, parameters["faces"], 3 * si.prim_index + k) for k in range(3)]
    at = [
        mi.Point3d(dr.gather(mi.Point3f, parameters["vertex_positions"], vertex))
        for vertex in corner
    ]
    value = [read(vertex) for vertex in corner]
    u = at[1] - at[0]
    v = at[2] - at[0]
    towards = mi.Point3d(si.p) - at[0]
    uu, vv, uv = dr.squared_norm(u), dr.squared_norm(v), dr.dot(u, v)
    area = uu * vv - uv * uv
    along_u, along_v = dr.dot(u, towards), dr.dot(v, towards)
    share_u = dr.clip((vv * along_u - uv * along_v) / area, 0, 1)
    share_v = dr.clip((uu * along_v - uv * along_u) / area, 0, 1 - share_u)
    return (
        value[0]
        + mi.Float(share_u) * (value[1] - value[0])
        + mi.Float(share_v) * (value[2] - value[0])
    )


def repeats(mi: Any, scene: Any) -> dict[Any, Any]:
    """Emitter -> how often its picture is repeated (an opaque drjit transform), where it has one
    picture that is."""
    import drjit as dr

    found = {}
    for emitter in scene.emitters():
        parameters = mi.traverse(emitter)
        if REPEAT in parameters:
            found[emitter] = mi.AffineTransform3f(parameters[REPEAT].matrix)
    dr.make_opaque(found)
    return found


def eval_repeated(mi: Any, emitter: Any, si: Any, repeat: Any) -> Any:
    """What an emitter shows (drjit arrays), its repeat taken from memory. Mitsuba writes it into
    the kernel, so that every other world would need a new one, of as many pieces as it has
    pictures."""
    if repeat is None:
        return emitter.eval(si)
    parameters = mi.traverse(emitter)
    own, uv = parameters[REPEAT], mi.Point2f(si.uv)
    try:
        # not told to the emitter (``update``), whose other numbers stand
        parameters[REPEAT] = mi.ScalarAffineTransform3f()
        si.uv = repeat @ uv
        return emitter.eval(si)
    finally:
        parameters[REPEAT], si.uv = own, uv


def shape_numbers(mi: Any, scene: Any) -> Any:
    """Numbers of the shapes of a Mitsuba scene in its own list, behind what their pointers hold
    (drjit array)."""
    import drjit as dr

    held = [int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) for shape in scene.shapes()]
    table = [0] * (1 + max(held, default=0))
    for number, place in enumerate(held):
        table[place] = number
    return mi.UInt32(table)


def box_around(mi: Any, scene: Any) -> Any:
    """Box (drjit arrays) with room for rounding around all shapes of a Mitsuba scene; None under a
    sky, where rays start inside."""
    import drjit as dr

    box = scene.bbox()
    if scene.environment() is not None or not box.valid():
        return None
    room = ROOM * float(dr.norm(box.extents()))
    low, high = mi.Point3f(box.min - room), mi.Point3f(box.max + room)
    # another scene needs no new kernel
    dr.make_opaque(low, high)
    return mi.BoundingBox3f(low, high)
