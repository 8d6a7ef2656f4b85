"""Mesh files as parts: triangles with their colours, in metres and z up. .obj with its .mtl, .ply,
.stl, .dae, .gltf and .glb, read by trimesh.

Files are data: nothing in them is run, nothing is fetched over a network, and other files that they
name (materials, pictures, buffers) are read from their own folder, or from the folder given as
``root``, alone. A part that a file cannot give whole is refused in a sentence.
"""

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from codesign.errors import DomainError, FileFormatError
from codesign.optional import optional
from codesign.reading import open_regular, read_bytes, reading
from scenes import gltf, obj, textures
from scenes.mesh_folder import MOST_BYTES, Folder

trimesh = optional("trimesh", "worlds", "reading meshes")
collada = optional("collada", "worlds", "reading .dae")

KINDS = (".obj", ".ply", ".stl", ".dae", ".gltf", ".glb")
MOST_FACES = 4_000_000  # some 10 s to read; their silhouettes take minutes and GiB
UNCOLOURED = 0.5  # linear luminance of what says none
FOLDED = 0.999  # cosine of what lies upon each other
# what trimesh would read as something else
MISREAD = {
    ".obj": (
        rb"^f(?=[ \t])[^\n]*?[ \t/](-\d+|0+)(?=[ \t/\r\n]|$)",
        "a face with index {}; indices must count from 1, so export it anew",
    ),
    ".ply": (
        rb"^property[ \t]+(ushort|uint16)[ \t]+(?:red|green|blue)\b",
        "colours of the type {}; export them as uchar, or as float from 0 to 1",
    ),
}
# rows: the axes x, y, z here in terms of the file's; x_up and y_up as COLLADA 1.4 names right, up
# and in
AXES = {
    "x": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}


@dataclass(frozen=True)
class Part:
    """Triangles of one material.

    name: of the mesh in its file. vertices_m: [V, 3]; faces: [F, 3]. colour: linear luminance 0..1
    (white is 1) as a picture [H, W] (first row at the top, looked up at ``uv`` [V, 2], v up), as
    one number per face [F] where ``uv`` is None, or per vertex [V] where ``smooth``. wrap: how the
    picture goes on beside the unit square.
    coloured: whether the file says a colour.
    """

    name: str
    vertices_m: np.ndarray
    faces: np.ndarray
    colour: np.ndarray
    uv: np.ndarray | None = None
    smooth: bool = False
    wrap: str = "repeat"
    coloured: bool = True


def read(
    path: str | Path,
    unit_m: float | None = None,
    up: str | None = None,
    *,
    root: str | Path | None = None,
    materials: bool = True,
) -> list[Part]:
    """Every mesh of a file, at its place in the file's scene.

    Args:
      path: .obj, .ply, .stl, .dae, .gltf or .glb.
      unit_m: metres per unit of the file. None: what a .dae says, 1 otherwise (glTF is in metres by
        its standard; .obj, .ply and .stl do not say).
      up: axis of the file that points up, "x", "y" or "z". None: what a .dae says, "y" for glTF by
        its standard, "z" for .obj, .ply and .stl, which do not say.
      root: folder that the files it names must lie in; None is its own.
      materials: whether materials and colours are read; otherwise all is of one colour and no other
        file is asked for but buffers.
    Returns: parts, in the order of the file's scene; faces without area are left out, points and
      lines too.
    Raises: FileFormatError for a file that is missing, of another kind, too large, empty or
      damaged, that names files which are missing or elsewhere, or uses what is not read here;
      DomainError for a unit or an axis that cannot be.
    """
    path = Path(path)
    kind = _checked_kind(path, unit_m, up)
    folder = Folder(path, root)
    if kind == ".dae":
        said = _dae_says(path)
        unit_m, up = said[0] if unit_m is None else unit_m, up or said[1]
    axes = (unit_m or 1.0) * AXES[up or ("y" if kind in (".gltf", ".glb") else "z")]
    surfaces = None
    if kind in (".gltf", ".glb"):
        data, surfaces = gltf.opened(path, folder, materials)
    else:
        data = read_bytes(path, MOST_BYTES)
    told = _faces_told(kind, data)
    _check_count(path, told)
    if kind in MISREAD:
        pattern, sentence = MISREAD[kind]
        if wrong := re.search(pattern, data, re.MULTILINE):
            raise FileFormatError(f"mesh '{path}' has {sentence.format(wrong[1].decode())}.")
    scene = _loaded(path, data, folder, ".gltf" if surfaces is not None else kind, materials)
    if materials:
        folder.check()
    cut = kind == ".dae" and b"<poly" in data
    parts = list(_parts(path, scene, told, cut, axes, surfaces if materials else None, materials))
    if not parts:
        raise FileFormatError(
            f"mesh '{path}' has no faces that can be read: it is cut short, damaged, or holds points and lines alone; "
            "export it anew, with triangles."
        )
    return parts


def _checked_kind(path, unit_m, up):
    if unit_m is not None and not 0 < unit_m < float("inf"):
        raise DomainError(
            f"mesh {path}: unit_m = {unit_m} must be positive and finite, such as 0.001 for mm."
        )
    if up is not None and up not in AXES:
        raise DomainError(f"mesh {path}: up = '{up}' is no axis; give 'x', 'y' or 'z'.")
    if not path.is_file():
        raise FileFormatError(
            f"mesh '{path}' is not a file; give the path of one ending in {', '.join(KINDS)}."
        )
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise FileFormatError(
            f"mesh '{path}' ends in '{kind}'; {', '.join(KINDS)} are read, so convert it, in Blender for instance."
        )
    size = path.stat().st_size
    if size == 0:
        raise FileFormatError(f"mesh '{path}' is empty; export it anew.")
    if size > MOST_BYTES:
        raise FileFormatError(
            f"mesh '{path}' has {size / 2**30:.1f} GiB, more than {MOST_BYTES / 2**30:.0f}; decimate it, in Blender "
            "for instance."
        )
    return kind


def _dae_says(path):
    """Metres per unit and the axis that is up, of a COLLADA file."""
    with (
        open_regular(path, MOST_BYTES) as file,
        reading(f"mesh '{path}'", "export it anew as DAE"),
    ):
        asset = collada.Collada(file, ignore=[collada.DaeError]).assetInfo
    return asset.unitmeter or 1.0, (asset.upaxis or "Y_UP")[0].lower()


def _faces_told(kind, data):
    """Number of faces that a file announces, before it is parsed; 0 where it would have to be."""
    if kind == ".stl" and data[:5] != b"solid":
        return (len(data) - 84) // 50
    if kind == ".ply":
        said = re.search(rb"element\s+face\s+(\d+)", data[:10_000])
        return int(said[1]) if said else 0
    return data.count(b"\nf ") if kind == ".obj" else 0


def _check_count(path, count):
    if count > MOST_FACES:
        raise FileFormatError(
            f"mesh '{path}' has {count:,} faces, more than {MOST_FACES:,}; decimate it, in Blender for instance."
        )


def _loaded(path, data, folder, kind, materials):
    options: dict = {"process": False, "validate": False}
    if kind in (".obj", ".gltf"):
        options["skip_materials"] = not materials
    elif kind == ".ply":
        options["skip_texture"] = not materials
    elif kind == ".dae":
        options["ignore_broken"] = False
    try:
        with (
            reading(f"mesh '{path}'", f"export it anew as {path.suffix[1:].upper()}"),
            warnings.catch_warnings(),
        ):
            if kind == ".obj" and materials:
                obj.check_colours(data)
                data = obj.with_one_library(data, folder)
            # numpy reads numbers as far as it can, and only warns
            warnings.filterwarnings("error", message=".*could not be read to its end")
            return trimesh.load_scene(
                trimesh.util.wrap_as_stream(data), file_type=kind[1:], resolver=folder, **options
            )
    except FileFormatError:
        folder.check()  # what a file names says more than what trimesh made of its absence
        raise


def _parts(path, scene, told, cut, axes, surfaces, materials) -> Iterator[Part]:
    count = sum(
        len(getattr(scene.geometry[scene.graph[n][1]], "faces", ()))
        for n in scene.graph.nodes_geometry
    )
    _check_count(path, count)
    if 0 < count < told:
        raise FileFormatError(
            f"mesh '{path}' has {told} faces, of which {told - count} cannot be read; export it anew."
        )
    cut = cut or 0 < told < count  # polygons, into fans of triangles
    for node in scene.graph.nodes_geometry:
        frame, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue  # points and lines, which have no surface
        frame = np.asarray(frame, dtype=np.float64)
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.faces)
        where = f"mesh '{path}', '{name}'"
        wrong = ""
        if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
            wrong = f"vertices have {vertices.shape[1]} coordinates"
        elif not np.isfinite(vertices).all() or not np.isfinite(frame).all():
            wrong = "vertices are not all finite"
        elif faces.min() < 0 or faces.max() >= len(vertices):
            wrong = f"a face asks for vertex {faces.max()} of {len(vertices)}"
        elif cut and _folded(vertices, faces):
            wrong = "a face of several corners has one that points inwards; give triangles"
        elif materials and (most := _brightest(mesh)) > 1:
            wrong = f"colours of its vertices reach {most:g}, where 1 is the most"
        if wrong:
            raise FileFormatError(f"{where}: {wrong}; export it anew.")
        turn = axes @ frame[:3, :3]
        vertices = vertices @ turn.T + axes @ frame[:3, 3]
        if np.linalg.det(turn) < 0:  # a mirrored instance: keep its outside outside
            faces = faces[:, ::-1]
        first, second, third = vertices[faces].swapaxes(0, 1)
        whole = (np.cross(second - first, third - first) ** 2).sum(1) > 0
        if whole.any():
            visual = mesh.visual if materials else None
            yield _merged(_coloured(where, str(name), vertices, faces, whole, visual, surfaces))


def _folded(vertices, faces):
    """Whether two triangles with an edge in common lie upon each other: a fan over a polygon with a
    corner that points inwards does."""
    first, second, third = vertices[faces].swapaxes(0, 1)
    normal = np.cross(second - first, third - first)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    start, end, apex = (np.roll(faces, -shift, 1).reshape(-1) for shift in range(3))
    along, back = start * len(vertices) + end, end * len(vertices) + start
    order = np.argsort(along)
    place = np.minimum(np.searchsorted(along, back, sorter=order), len(along) - 1)
    other = order[place]
    for _ in range(2):  # corners on a line give triangles without area: their neighbours' normal
        flat = ~normal.any(1).repeat(3) & (along[other] == back)
        normal[np.flatnonzero(flat) // 3] = normal[other[flat] // 3]
    cosine = (normal.repeat(3, 0) * normal[other // 3]).sum(1)
    return bool(((along[other] == back) & (cosine < -FOLDED) & (apex != apex[other])).any())


def _brightest(mesh):
    """Of colours that a .ply gives as fractions."""
    raw = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    names = (raw.dtype.names or ()) if isinstance(raw, np.ndarray) else raw  # binary, or text
    given = [np.asarray(raw[name]) for name in ("red", "green", "blue") if name in names]
    return max((float(one.max()) for one in given if one.dtype.kind == "f" and one.size), default=0)


def _coloured(where, name, vertices, faces, whole, visual, surfaces):
    """The part of those faces that are ``whole``, with its colour."""
    faces = faces[whole]
    plain = np.full(len(faces), UNCOLOURED)
    kind = None if visual is None else visual.kind
    if kind == "face":
        colours = visual.face_colors
        if len(colours) != len(whole):
            raise FileFormatError(
                f"{where}: it has colours of {len(colours)} faces, which are {len(whole)} triangles; export triangles."
            )
        return Part(name, vertices, faces, _from_srgb(colours[whole]))
    if kind == "vertex":
        return Part(name, vertices, faces, _from_srgb(visual.vertex_colors), smooth=True)
    if kind != "texture":
        return Part(name, vertices, faces, plain, coloured=False)
    surface = surfaces[visual.material.name] if surfaces else _surface(visual.material)
    tint = visual.vertex_attributes.get("color") if surfaces is not None else None
    if tint is not None:
        scale = np.iinfo(tint.dtype).max if tint.dtype.kind == "u" else 1.0
        tint = tint[:, :3].astype(np.float64) / scale
    if surface.picture is None:
        if tint is None:
            return Part(name, vertices, faces, plain * 0 + surface.factor @ textures.LUMINANCE)
        shade = (surface.factor * tint) @ textures.LUMINANCE
        return Part(name, vertices, faces, shade, smooth=True)
    uv = visual.uv
    if uv is None or len(uv) != len(vertices) or not np.isfinite(uv).all():
        raise FileFormatError(
            f"{where}: it has a picture but no texture coordinates for every vertex; unwrap it, or give radiance= and no "
            "picture is read."
        )
    if tint is not None and not np.allclose(tint, 1, atol=0.01):
        raise FileFormatError(
            f"{where}: its picture is tinted by vertex colours, which is not read; bake them into the picture."
        )
    uv = np.asarray(uv, dtype=np.float64)
    return Part(name, vertices, faces, surface.picture, uv, wrap=surface.wrap)


def _from_srgb(colours):
    """Linear luminance [N] of colours [N, 4] of 8 bits."""
    return textures.linear(colours[:, None, :3])[:, 0]


def _surface(material: Any) -> gltf.Surface:
    """Of an .obj, .ply or .dae: a picture in sRGB times a linear factor."""
    picture = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    # as the .mtl has it, before it is rounded to 8 bits
    said = getattr(material, "kwargs", {}).get("kd")
    if said is None:
        rounded = getattr(material, "baseColorFactor", None)
        said = None if rounded is None else np.asarray(rounded, dtype=np.float64)[:3] / 255
    elif np.size(said) != 3:
        said = np.full(3, np.ravel(said)[0])
    if said is None:
        said = np.full(3, UNCOLOURED if picture is None else 1.0)
    factor = np.asarray(said, dtype=np.float64)
    stored = None if picture is None else textures.stored_values(picture)
    return gltf.Surface(factor, None if stored is None else gltf.luminance(stored, factor))


def _merged(part):
    """The part with vertices of one place, colour and texture coordinate as one, where faces share
    none: an edge between faces that do not share its vertices would count as a seam."""
    if len(part.vertices_m) < 3 * len(part.faces):
        return part
    columns = [part.vertices_m]
    columns += [part.uv] if part.uv is not None else []
    columns += [part.colour[:, None]] if part.smooth else []
    rows = np.ascontiguousarray(np.concatenate(columns, 1)) + 0.0  # no negative zeros
    records = rows.view([("", rows.dtype)] * rows.shape[1]).reshape(-1)
    _, first, index = np.unique(records, return_index=True, return_inverse=True)
    return replace(
        part,
        vertices_m=part.vertices_m[first],
        faces=index.reshape(-1)[part.faces],
        colour=part.colour[first] if part.smooth else part.colour,
        uv=None if part.uv is None else part.uv[first],
    )
