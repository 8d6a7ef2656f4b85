"""glTF 2.0 as trimesh reads it, with what trimesh leaves out: exact factors, how pictures go on,
and which extensions a file needs.

Source: Khronos Group, glTF 2.0 Specification, 2021.
"""

import base64
import io
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL.Image

from codesign.errors import FileFormatError
from codesign.reading import read_bytes, reading
from scenes import textures
from scenes.mesh_folder import MOST_BYTES, Folder
from scenes.trees import unreached

MAGIC = b"glTF"
WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
REPEAT = 10497  # where no sampler says
FLOAT = 5126
FAN = 6  # mode of a primitive
FLOATING = {"POSITION", "TEXCOORD_0"}
READ = FLOATING | {"COLOR_0", "indices"}
SHORTEST = 1e-3  # of a quaternion, whose length is 1
OWN_BUFFER = "codesign:the binary chunk"
# extensions that change neither shape nor base colour
LIGHT_ONLY = ("KHR_materials_", "KHR_lights_", "KHR_xmp")
DIFFUSE = "KHR_materials_pbrSpecularGlossiness"  # but this one, in which it is called diffuse
# which change what is seen even where not required
UNREAD = ("EXT_mesh_gpu_instancing", "KHR_texture_transform")


@dataclass(frozen=True)
class Surface:
    """Base colour: linear ``factor`` [3], and the luminance of it times the picture [H, W] (first
    row at the top) where there is one."""

    factor: np.ndarray
    picture: np.ndarray | None = None
    wrap: str = "repeat"


def luminance(stored: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Linear luminance [H, W] of a picture's values in sRGB [H, W] or [H, W, 3], each colour times
    its linear factor [3]."""
    if stored.ndim < 3 or np.ptp(factor) == 0:
        return factor @ textures.LUMINANCE * textures.linear(stored)
    return textures.linear(stored, factor * textures.LUMINANCE)


def opened(path: Path, folder: Folder, materials: bool) -> tuple[bytes, dict[str, Surface]]:
    """A .gltf, or the same in a .glb, as text that trimesh reads with ``folder``, and its materials
    by the names that the text gives them: their numbers. Raises: FileFormatError for what is
    damaged or not read."""
    try:
        with reading(f"mesh '{path}'", "it is no whole glTF 2.0; export it anew"):
            tree = _tree(read_bytes(path, MOST_BYTES), folder)
            if str(tree["asset"]["version"]).split(".")[0] != "2":
                raise ValueError(f"version {tree['asset']['version']}")
            _made_readable(path, tree)
            _check_nodes(tree.get("nodes", []))
            surfaces = _surfaces(tree, folder) if materials else {}
    except FileFormatError:
        folder.check()
        raise
    tree.pop("images", None)
    for number, material in enumerate(tree.get("materials", [])):
        material["name"] = str(number)
    return json.dumps(tree).encode(), surfaces


def _tree(data, folder):
    """The header, as the standard lays it out; the binary chunk of a .glb goes to the folder."""
    if data[:4] != MAGIC:
        return json.loads(data.decode("utf-8"))
    at = 12
    chunks = []
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        if at + 8 + size > len(data):
            raise ValueError("it ends early")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 8 + size
    if not chunks or chunks[0][0] != b"JSON":
        raise ValueError("it has no header")
    tree = json.loads(chunks[0][1].decode("utf-8"))
    binary = [chunk for kind, chunk in chunks[1:] if kind == b"BIN\0"]
    if binary and tree.get("buffers") and "uri" not in tree["buffers"][0]:
        folder.given[OWN_BUFFER] = binary[0]
        tree["buffers"][0]["uri"] = OWN_BUFFER
    return tree


def _made_readable(path, tree):
    """Refuse what trimesh would leave out or read as something else. Coloured vertices without a
    material get the standard's own, white: without one trimesh cuts their colours to 8 bits."""
    found = {
        name for name in tree.get("extensionsRequired", []) if not name.startswith(LIGHT_ONLY)
    } | {name for name in tree.get("extensionsUsed", []) if name in UNREAD}
    materials, meshes = (tree.setdefault(key, []) for key in ("materials", "meshes"))
    for primitive in (each for mesh in meshes for each in mesh["primitives"]):
        if primitive.get("mode") == FAN:
            found.add("triangle fans")
        if "COLOR_0" in primitive["attributes"]:
            primitive.setdefault("material", len(materials))
        numbers = {**primitive["attributes"], **primitive}
        for name in READ & numbers.keys():
            accessor = tree["accessors"][numbers[name]]
            if "sparse" in accessor:
                found.add("sparse accessors")
            if name in FLOATING and accessor["componentType"] != FLOAT:
                found.add(f"{name} in whole numbers")
    materials.append({})
    nodes = tree.get("nodes", [])
    if any(any(each.get("weights", [])) for each in (*meshes, *nodes)):
        found.add("morph targets at work")
    if any({"mesh", "skin"} <= node.keys() for node in nodes):
        found.add("meshes on bones")
    if found:
        raise FileFormatError(
            f"mesh '{path}' needs {', '.join(sorted(found))}, which is not read here; export it without compression, "
            "quantisation, instancing, texture transforms, shape keys and armatures (apply them first), as plain triangles."
        )


def _check_nodes(nodes):
    """What trimesh would go round in, or read as something else."""
    pairs = [
        (parent, child) for parent, node in enumerate(nodes) for child in node.get("children", [])
    ]
    often = [child for child, count in Counter(child for _, child in pairs).items() if count > 1]
    looped = unreached(range(len(nodes)), pairs)
    if often or looped:
        raise ValueError(
            f"its nodes are no tree: node {[*often, *looped][0]} has two parents, or is below itself"
        )
    for number, node in enumerate(nodes):
        if not np.linalg.norm(node.get("rotation", [1.0])) > SHORTEST:
            raise ValueError(
                f"node {number} has the rotation {node['rotation']}, which is no quaternion"
            )


def _surfaces(tree, folder):
    pictures: dict[int, np.ndarray] = {}
    found = {}
    for number, material in enumerate(tree.get("materials", [])):
        older = material.get("extensions", {}).get(DIFFUSE, {})
        base = material.get("pbrMetallicRoughness") or {
            key.replace("diffuse", "baseColor"): value for key, value in older.items()
        }
        given = base.get("baseColorFactor", [1, 1, 1, 1])
        factor = np.asarray(given, dtype=np.float64)[:3].reshape(3)
        texture = base.get("baseColorTexture")
        if texture is None:
            found[str(number)] = Surface(factor)
            continue
        if texture.get("texCoord", 0) != 0:
            raise ValueError(
                "a base colour is laid out by TEXCOORD_1, and TEXCOORD_0 alone is read"
            )
        entry = tree["textures"][texture["index"]]
        if "source" not in entry:
            raise ValueError("a picture is neither PNG nor JPEG")
        source = entry["source"]
        if source not in pictures:
            pictures[source] = _picture(tree, tree["images"][source], folder)
        sampler = tree["samplers"][entry["sampler"]] if "sampler" in entry else {}
        wraps = {sampler.get(key, REPEAT) for key in ("wrapS", "wrapT")}
        if len(wraps) > 1:
            raise ValueError("a picture goes on in one way along u and in another along v")
        found[str(number)] = Surface(
            factor, luminance(pictures[source], factor), WRAPS[wraps.pop()]
        )
    return found


def _picture(tree, image, folder):
    if "bufferView" in image:
        view = tree["bufferViews"][image["bufferView"]]
        data = _bytes(tree["buffers"][view["buffer"]]["uri"], folder)
        data = data[view.get("byteOffset", 0) :][: view["byteLength"]]
    else:
        data = _bytes(image["uri"], folder)
    with PIL.Image.open(io.BytesIO(data)) as picture:
        return textures.stored_values(picture)


def _bytes(uri, folder):
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition("base64,")[2], validate=True)
    return folder.get(uri)
