"""Worlds from mesh files: what a camera reads back of them against the numbers that were
written."""

import base64
import json
from functools import partial
from typing import Any

import numpy as np
import PIL.Image
import pytest
import torch

from codesign import lens, render
from codesign.errors import FileFormatError
from codesign.pose import look_at, se3_exp
from scenes import build, mesh_files, textures, worlds
from tests import refusals
from tests.numbers import D, f64
from tests.scenes.solids import across, area_m2, volume_m3

PICTURE = np.array([[0, 64], [128, 255]], dtype=np.uint8)  # first row at the top; no two alike
CAMERA = render.Camera(lens.Pinhole(8.0), 32, 32, 0.2, samples_per_pixel=4)


def radiance_of(code):
    """Of an 8-bit sRGB value, by IEC 61966-2-1."""
    value = code / 255
    linear = value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
    return 2 + 253 * linear


def seen(scene, point, eye=(0.0, -2.5, 0.0)):
    """Radiance of one ray from the eye to a point."""
    from codesign.backend import arrays

    arr = arrays("cpu", torch.float32)
    origin = f64([eye])
    direction = torch.nn.functional.normalize(f64([point]) - origin, dim=1)
    ray = [
        arr.Array3(*[arr.Float(v.float()) for v in part.unbind(1)]) for part in (origin, direction)
    ]
    return float(scene.radiance(arr, *ray).numpy()[0])


def write_obj(folder, vertices, faces, name="q.obj", kd="1 1 1", picture="p.png"):
    """A square or another mesh with texture coordinates 0, 0; 1, 0; 1, 1; 0, 1 at its first four
    corners."""
    PIL.Image.fromarray(PICTURE).save(folder / "p.png")
    map_kd = f"map_Kd {picture}\n" if picture else ""
    (folder / "q.mtl").write_text(f"newmtl m\nKd {kd}\n{map_kd}")
    (folder / name).write_text(
        "mtllib q.mtl\n"
        + "".join(f"v {x} {y} {z}\n" for x, y, z in vertices)
        + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl m\n"
        + "".join("f " + " ".join(f"{i}/{i}" for i in face) + "\n" for face in faces)
    )
    return folder / name


UPRIGHT = [(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)]  # z up, facing -y
SQUARE = [(1, 2, 3, 4)]
# texel centres
CORNERS = {(-0.5, 0, 0.5): 0, (0.5, 0, 0.5): 64, (-0.5, 0, -0.5): 128, (0.5, 0, -0.5): 255}


def write_gltf(folder, kind, sampler=None, uv=((0, 1), (1, 1), (1, 0), (0, 0)), **changes):
    """The upright square in glTF's axes (y up, towards +z), v down, with a node that moves it 0.5 m
    up."""
    blob = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], dtype="<f4").tobytes()
    blob += (
        np.array(uv, dtype="<f4").tobytes() + np.array([0, 1, 2, 0, 2, 3], dtype="<u2").tobytes()
    )
    PIL.Image.fromarray(PICTURE).save(folder / "p.png")
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"translation": [0, 0.5, 0], "children": [1]}, {"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
                ]
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "baseColorFactor": [0.5, 0.5, 0.5, 1],
                }
            }
        ],
        "textures": [{"source": 0, **({} if sampler is None else {"sampler": 0})}],
        "samplers": [sampler or {}],
        "images": [{"uri": "p.png"}],
        "buffers": [
            {"byteLength": len(blob), "uri": "data:;base64," + base64.b64encode(blob).decode()}
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 32},
            {"buffer": 0, "byteOffset": 80, "byteLength": 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        **changes,
    }
    path = folder / f"q.{kind}"
    if kind == "gltf":
        path.write_text(json.dumps(tree))
        return path
    del tree["buffers"][0]["uri"]
    picture = (folder / "p.png").read_bytes()
    tree["images"] = [{"bufferView": 3, "mimeType": "image/png"}]
    tree["bufferViews"].append({"buffer": 0, "byteOffset": 92, "byteLength": len(picture)})
    blob += picture
    tree["buffers"][0]["byteLength"] = len(blob)
    chunks = b""
    for tag, data, pad in ((b"JSON", json.dumps(tree).encode(), b" "), (b"BIN\0", blob, b"\0")):
        data += pad * (-len(data) % 4)
        chunks += len(data).to_bytes(4, "little") + tag + data
    path.write_bytes(
        b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks
    )
    return path


def test_the_corners_of_a_picture_on_an_obj_are_read_back(tmp_path):
    scene = worlds.from_mesh(write_obj(tmp_path, UPRIGHT, SQUARE, kd="0.25 0.5 0.75"))
    factor = 0.2126 * 0.25 + 0.7152 * 0.5 + 0.0722 * 0.75  # BT.709, of linear values
    for point, code in CORNERS.items():
        # a 32-bit float ray falls within 1e-6 of the texel's middle
        assert seen(scene, point) == pytest.approx(2 + factor * (radiance_of(code) - 2), rel=1e-5)
    # from behind the sheet too
    assert seen(scene, (0.5, 0, -0.5), (0, 2.5, 0)) == pytest.approx(2 + factor * 253, rel=1e-5)


@pytest.mark.parametrize("kind", ["gltf", "glb"])
def test_the_corners_of_a_picture_on_a_gltf_are_read_back(tmp_path, kind):
    scene = worlds.from_mesh(write_gltf(tmp_path, kind))
    for (x, y, z), code in CORNERS.items():
        at = (x, y, z + 0.5)  # the node's translation, y up in the file
        assert seen(scene, at) == pytest.approx(2 + 0.5 * (radiance_of(code) - 2), rel=1e-5)


@pytest.mark.parametrize(("wrap", "expected"), [(None, 0), (10497, 0), (33071, 64), (33648, 64)])
def test_a_picture_goes_on_as_its_sampler_says(tmp_path, wrap, expected):
    sampler = None if wrap is None else {"wrapS": wrap, "wrapT": wrap}
    twice = ((0, 1), (2, 1), (2, 0), (0, 0))  # two pictures side by side
    scene = worlds.from_mesh(write_gltf(tmp_path, "gltf", sampler, twice))
    # u = 1.25, the middle of the second picture's first column, in the upper row
    assert seen(scene, (0.25, 0, 1.0)) == pytest.approx(
        2 + 0.5 * (radiance_of(expected) - 2), rel=1e-4
    )


def test_axes_and_units(tmp_path):
    path = write_obj(tmp_path, [(0, 0, 0), (1, 0, 0), (1, 2, 0), (0, 2, 3)], SQUARE)
    given = {up: mesh_files.read(path, 0.01, up)[0].vertices_m for up in "xyz"}
    np.testing.assert_allclose(given["z"][3], [0, 0.02, 0.03])
    # y up, z towards the viewer, who is at -y
    np.testing.assert_allclose(given["y"][3], [0, -0.03, 0.02])
    np.testing.assert_allclose(given["x"][1], [0, 0, 0.01])
    for axes in mesh_files.AXES.values():
        assert np.linalg.det(axes) == 1  # turned, never mirrored


def dae(folder, unit, up):
    """A tetrahedron of 1, 1 and 2 units, red 0.5."""
    path = folder / "t.dae"
    path.write_text(f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified>
<unit name="u" meter="{unit}"/><up_axis>{up}</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="c"><lambert><diffuse><color>1 0 0 1</color></diffuse>
</lambert></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0 1 0 0 0 1 0 0 0 2</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4" material="s"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="w"><node><instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="s" target="#m"/></technique_common></bind_material></instance_geometry></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#w"/></scene></COLLADA>""")
    return path


def test_a_dae_says_its_unit_and_its_axis(tmp_path):
    [part] = mesh_files.read(dae(tmp_path, 0.01, "Z_UP"))
    np.testing.assert_allclose(part.vertices_m.max(0), [0.01, 0.01, 0.02])
    np.testing.assert_allclose(part.colour, 0.2126, rtol=1e-6)  # red of BT.709
    assert len(part.vertices_m) == 4  # one vertex for each place
    [part] = mesh_files.read(dae(tmp_path, 1, "Y_UP"))
    np.testing.assert_allclose(
        [part.vertices_m.min(0), part.vertices_m.max(0)], [[0, -2, 0], [1, 0, 1]]
    )
    [part] = mesh_files.read(tmp_path / "t.dae", 2.0, "z")
    np.testing.assert_allclose(part.vertices_m.max(0), [2, 2, 4])


def write_ply(path, **colours):
    import trimesh

    mesh = trimesh.Trimesh(UPRIGHT, [(0, 1, 2), (0, 2, 3)], process=False, **colours)
    mesh.export(path, encoding="ascii")
    return path


def grey(*levels):
    return [[level] * 3 for level in levels]


def test_colours_of_faces_and_vertices_are_shown_in_the_light_of_a_plain_sky(tmp_path):
    # the upright square faces -y: its sky share, by the constants of scenes.bodies
    share = 0.6 * 0.6 + 0.4 * 0.5 / np.sqrt(0.3**2 + 0.5**2 + 0.81**2)
    path = write_ply(tmp_path / "f.ply", face_colors=grey(200, 40))
    scene = worlds.from_mesh(path)
    assert seen(scene, (0.5, 0, -0.5)) == pytest.approx(share * radiance_of(200), rel=1e-5)
    assert seen(scene, (-0.5, 0, 0.5)) == pytest.approx(share * radiance_of(40), rel=1e-5)
    scene = worlds.from_mesh(write_ply(tmp_path / "v.ply", vertex_colors=grey(255, 0, 0, 0)))
    # barycentric: a quarter along the diagonal from the bright corner
    expected = 0.75 * radiance_of(255) + 0.25 * radiance_of(0)
    assert seen(scene, (-0.5, 0, -0.5)) == pytest.approx(share * expected, rel=1e-4)
    scene = worlds.from_mesh(path, radiance=100.0)
    assert seen(scene, (0.5, 0, -0.5)) == pytest.approx(share * 100, rel=1e-5)


def test_colours_of_16_bits_are_read_to_their_last_bit(tmp_path):
    levels = np.array([13107, 655, 65535, 40000], dtype="<u2")
    pure, truth = 65535 * np.eye(4, dtype="<u2"), [0.2126 / 2, 0.7152 / 4, 0.0722]
    tint = [{"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.25, 1, 1]}}]
    point, colour = (
        {"bufferView": view, "componentType": kind, "count": 3, "type": shape}
        for view, kind, shape in ((0, 5126, "VEC3"), (1, 5123, "VEC4"))
    )
    white = levels.repeat(4), {}, levels[:3] / 65535
    for values, material, found in (white, (pure, {"material": 0}, truth)):
        path = write_gltf(
            tmp_path,
            "gltf",
            uv=values.view("<f4").reshape(4, 2),  # where texture coordinates were
            meshes=[{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, **material}]}],
            materials=tint,
            accessors=[point, colour],
        )
        [part] = mesh_files.read(path)
        assert part.colour == pytest.approx(found, rel=1e-12)


def test_a_picture_is_tinted_colour_by_colour(tmp_path):
    base = {"baseColorFactor": [1, 0.05, 0.05, 1], "baseColorTexture": {"index": 0}}
    obj = write_obj(tmp_path, UPRIGHT, SQUARE, kd="1 0.05 0.05")
    other = write_gltf(tmp_path, "gltf", materials=[{"pbrMetallicRoughness": base}])
    PIL.Image.new("RGB", (2, 2), (200, 30, 30)).save(tmp_path / "p.png")
    # 200 and 30 of sRGB are 0.577580 and 0.012983 of light, by IEC 61966-2-1
    truth = 0.2126 * 0.577580 + 0.05 * (0.7152 + 0.0722) * 0.012983
    for path in (obj, other):
        assert mesh_files.read(path)[0].colour == pytest.approx(np.full((2, 2), truth), rel=1e-5)


def test_a_diffuse_colour_of_the_older_extension_is_the_base_colour(tmp_path):
    older = {"diffuseTexture": {"index": 0}, "diffuseFactor": [0.5, 0.5, 0.5, 1]}
    given = [{"extensions": {"KHR_materials_pbrSpecularGlossiness": older}}]
    [part] = mesh_files.read(write_gltf(tmp_path, "gltf", materials=given))
    assert 2 + 253 * 2 * part.colour == pytest.approx(np.vectorize(radiance_of)(PICTURE))


def test_every_file_of_materials_of_an_obj_is_read(tmp_path):
    for name in "12":
        (tmp_path / f"{name}.mtl").write_text(f"newmtl m{name}\nKd 0.{name} 0.{name} 0.{name}\n")
    path = tmp_path / "t.obj"
    path.write_text(
        "mtllib 1.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m2\nf 1 2 3\nmtllib 2.mtl\nusemtl m1\nf 3 2 1\n"
    )
    assert sorted(part.colour[0] for part in mesh_files.read(path)) == pytest.approx([0.1, 0.2])


OUTLINES = {  # the same polygon from each of its corners
    "L": [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)],
    "T": [(0, 0), (1, 0), (1, 2), (2, 2), (2, 3), (-1, 3), (-1, 2), (0, 2)],
    "arrow": [(0, 0), (2, 1), (0, 2), (1, 1)],
    "house": [(0, 0), (1, 0), (2, 0), (2, 2), (1, 3), (0, 2)],  # a corner on a line
}


@pytest.mark.parametrize("kind", ["obj", "ply", "dae"])
@pytest.mark.parametrize("name", OUTLINES)
def test_polygons_have_their_area_or_are_refused(tmp_path, name, kind):
    """By the shoelace formula, whichever corner comes first; a fan of triangles is right where every
    corner lies in sight of the first."""
    outline = np.array(OUTLINES[name], dtype=float)
    x, y = outline.T
    area = abs((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) / 2
    refused = 0
    for turn in range(len(outline)):
        path = polygon(tmp_path, np.roll(outline, turn, 0), kind)
        try:
            [part] = mesh_files.read(path, 1.0, "z")
        except FileFormatError:
            with pytest.raises(FileFormatError, match="points inwards; give triangles"):
                mesh_files.read(path, 1.0, "z")
            refused += 1
            continue
        assert area_m2(part) == pytest.approx(area, rel=1e-6)
    assert 0 < refused < len(outline) if name != "house" else refused == 0


def ply(lines, *names):
    """Text of a file with one face over all vertices; lines: their numbers, by these names."""
    numbers = "".join(f"property float {name}\n" for name in names)
    face = " ".join(map(str, [len(lines), *range(len(lines))]))
    return (
        f"ply\nformat ascii 1.0\nelement vertex {len(lines)}\n{numbers}element face 1\n"
        "property list uchar int vertex_indices\nend_header\n" + "\n".join([*lines, face, ""])
    )


def polygon(folder, outline, kind):
    """A file with one face, as modelling programs write them."""
    count = len(outline)
    if kind == "obj":
        text = "".join(f"v {x} {y} 0\n" for x, y in outline)
        text += f"f {' '.join(str(i + 1) for i in range(count))}\n"
    elif kind == "ply":
        text = ply([f"{x} {y} 0" for x, y in outline], "x", "y", "z")
    else:
        text = (
            '<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
            "<asset/><library_geometries><geometry id='g'><mesh><source id='s'><float_array id='a' "
            f"count='{3 * count}'>{' '.join(f'{x} {y} 0' for x, y in outline)}</float_array><technique_common>"
            f"<accessor source='#a' count='{count}' stride='3'><param name='X' type='float'/><param name='Y' "
            "type='float'/><param name='Z' type='float'/></accessor></technique_common></source><vertices id='v'>"
            "<input semantic='POSITION' source='#s'/></vertices><polylist count='1'><input semantic='VERTEX' "
            f"source='#v' offset='0'/><vcount>{count}</vcount><p>{' '.join(map(str, range(count)))}</p></polylist>"
            "</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id='w'><node id='n'>"
            "<instance_geometry url='#g'/></node></visual_scene></library_visual_scenes><scene>"
            "<instance_visual_scene url='#w'/></scene></COLLADA>"
        )
    (folder / f"one.{kind}").write_text(text)
    return folder / f"one.{kind}"


@pytest.mark.parametrize(
    ("library", "used", "found"),
    [
        ("newmtl m\nKd 0.3 0.3 0.3 # paint", "m", 0.3),
        ("newmtl m\n  kd 0.3", "m", 0.3),  # one number stands for three
        ("newmtl Material #25\nKd 0.3 0.3 0.3", "Material #25", 0.3),
        ("newmtl m\nKd 0,3 0,3 0,3", "m", "'Kd 0,3 0,3 0,3' is not three numbers"),
        ("newmtl red\nKd 0.3 0.3 0.3", "Red", "uses the material 'Red', which its library"),
    ],
)
def test_colours_of_materials_are_read_or_refused(tmp_path, library, used, found):
    (tmp_path / "q.mtl").write_text(library + "\n")
    path = tmp_path / "q.obj"
    path.write_text(f"mtllib q.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl {used}\nf 1 2 3\n")
    if isinstance(found, str):
        with pytest.raises(FileFormatError, match=found):
            mesh_files.read(path)
    else:
        [part] = mesh_files.read(path)
        assert part.colour == pytest.approx([found])


@pytest.mark.parametrize(
    ("kind", "colours", "found"),
    [
        ("obj", ["0.5 0.5 0.5"] * 3, 0.5),
        ("obj", ["128 128 128"] * 3, "reach 128; export them from 0 to 1"),
        ("obj", ["1 1 1", "", "1 1 1"], "2 of its 3 vertices have a colour"),
        ("ply", ["0.5 0.5 0.5"] * 3, 0.5),
        ("ply", ["128 128 128"] * 3, "reach 128, where 1 is the most"),
    ],
)
def test_colours_of_vertices_are_read_or_refused(tmp_path, kind, colours, found):
    places = ["0 0 0", "1 0 0", "0 1 0"]
    lines = [f"{place} {colour}" for place, colour in zip(places, colours, strict=True)]
    if kind == "obj":
        text = "".join(f"v {line}\n" for line in lines) + "f 1 2 3\n"
    else:
        text = ply(lines, "x", "y", "z", "red", "green", "blue")
    (tmp_path / f"c.{kind}").write_text(text)
    if isinstance(found, str):
        with pytest.raises(FileFormatError, match=found):
            mesh_files.read(tmp_path / f"c.{kind}")
    else:
        [part] = mesh_files.read(tmp_path / f"c.{kind}")
        # of sRGB, in 8 bits
        assert 2 + 253 * part.colour == pytest.approx([radiance_of(255 * found)] * 3, rel=0.01)


def test_a_mesh_on_bones_is_refused(tmp_path):
    nodes = [{"mesh": 0, "skin": 0, "translation": [9, 0, 0]}, {"translation": [3, 0, 0]}]
    with pytest.raises(FileFormatError, match="meshes on bones"):
        mesh_files.read(write_gltf(tmp_path, "gltf", nodes=nodes, skins=[{"joints": [1]}]))


def cube(folder, kind, size=0.5):
    """A cube whose three lower coordinates are 0, facing outwards, written by hand as .obj or by
    trimesh."""
    import trimesh

    mesh = trimesh.creation.box(extents=[size] * 3)
    mesh.apply_translation([size / 2] * 3)
    mesh.export(folder / f"c.{kind}")
    return folder / f"c.{kind}"


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "dae", "glb"])
def test_volume_and_area_of_a_cube_in_every_format(tmp_path, kind):
    up = "z" if kind in ("dae", "glb") else None
    [part] = mesh_files.read(cube(tmp_path, kind), 0.1, up)
    assert volume_m3(part) == pytest.approx(0.05**3, rel=1e-6)
    assert area_m2(part) == pytest.approx(6 * 0.05**2, rel=1e-6)


def test_a_mirrored_node_keeps_its_outside_outside(tmp_path):
    nodes = [{"scale": [-1, 1, 1], "children": [1]}, {"mesh": 0}]
    [part] = mesh_files.read(write_gltf(tmp_path, "gltf", nodes=nodes))
    normal = across(part.vertices_m[part.faces])
    assert (normal[:, 1] < 0).all()  # towards the viewer, as before


@pytest.mark.parametrize("inside", [False, True])
def test_the_boundary_gradient_of_a_loaded_mesh_is_that_of_differences(tmp_path, inside):
    """Of outlines; and, inside a cube whose normals point outwards, as rooms are often exported, of
    creases."""
    if inside:
        scene = worlds.from_mesh(cube(tmp_path, "ply", 2.0))
        ends = ((2, 1, 1), (1, 2, 1), (1, 1, 2))
        assert len({round(seen(scene, end, (1, 1, 1)), 3) for end in ends}) == 3
        turned = se3_exp(torch.tensor([0, 0, 0, 0, 0, 0.3]).double())
        pose = look_at((0.7, 0.8, 0.9), (2.0, 1.7, 1.9)) @ turned
    else:
        scene = worlds.from_mesh(cube(tmp_path, "obj"), background=30.0)
        pose = look_at((0.6, -1.4, 0.7), (0.25, 0.25, 0.25))
    camera = render.Camera(lens.Pinhole(4.0 if inside else 8.0), 24, 24, 0.3, samples_per_pixel=256)
    weight = torch.linspace(0.2, 1.4, 24, dtype=D)[:, None] * torch.linspace(1.3, 0.1, 24)

    def loss(twist, gradient: Any = "interior"):
        image = render.frames(camera, scene, (pose @ se3_exp(twist))[None], gradient=gradient)[0]
        return (image * weight).mean()

    def gradient(kind):
        twist = torch.zeros(6, dtype=D, requires_grad=True)
        [found] = torch.autograd.grad(loss(twist, kind), twist)
        return found

    step = 0.01 * torch.eye(6).double()
    with torch.no_grad():
        expected = torch.stack([loss(e) - loss(-e) for e in step]) / 0.02
    # 256 samples per pixel over some 60 px of outline or creases: a few per cent of noise; leaving
    # it out loses nearly all, since faces of one radiance have no gradient inside
    assert (gradient("boundary") - expected).norm() / expected.norm() < 0.05
    assert gradient("interior").norm() < 0.01 * expected.norm()


def test_lit_levels_of_a_mesh_agree_on_a_white_furnace(tmp_path):
    """Under an even sky a convex body of albedo a sends a times the sky's radiance, whichever way
    it is computed."""
    path = write_ply(tmp_path / "f.ply", face_colors=grey(255, 188))
    levels = (partial(build.path, samples=30000), partial(build.baked, samples=8000, texel_m=0.5))
    for level in levels:
        scene = worlds.from_mesh(path, light=level, background=100.0)
        for point, code in (((0.5, 0, -0.5), 255), ((-0.5, 0, 0.5), 188)):
            # half the energy of a path is noise of choosing light or surface: 0.5 / sqrt(30000) =
            # 0.3 %
            assert seen(scene, point) == pytest.approx(
                100 * 0.95 * radiance_of(code) / 255, rel=0.01
            )
    under_the_sun = worlds.from_mesh(path, light="path")
    assert (
        seen(under_the_sun, (0.5, 0, -0.5)) > seen(under_the_sun, (0.5, 0, -0.5), (0, 2.5, 0)) > 10
    )


@refusals.table(__file__, "mesh files")
def test_files_that_are_no_whole_meshes_are_refused(row, tmp_path):
    def read(name, content):
        if content is not None:
            (tmp_path / name).write_bytes(
                content if isinstance(content, bytes) else content.encode()
            )
        return mesh_files.read(tmp_path / name)

    assert row.call.split("'")[1] in row.holds({"read": read}), "it names the file"


@pytest.mark.parametrize(
    ("picture", "sentence"),
    [
        ("lost.png", "'lost.png' is missing"),
        ("../secret.png", "lies outside"),
        ("/etc/passwd", "lies outside"),
        ("http://127.0.0.1:9/p.png", "lies on a network"),
        ("q.mtl.png", "is not a readable picture"),
    ],
)
def test_pictures_that_cannot_be_had_are_named(tmp_path, picture, sentence):
    PIL.Image.fromarray(PICTURE).save(tmp_path / "secret.png")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "q.mtl.png").write_text("no picture")
    path = write_obj(tmp_path / "in", UPRIGHT, SQUARE, picture=picture)
    with pytest.raises(FileFormatError, match=sentence) as told:
        worlds.from_mesh(path)
    assert str(path) in str(told.value)
    assert worlds.from_mesh(path, radiance=50.0).scene.shapes()  # nothing else is asked for
    changed = write_gltf(tmp_path / "in", "gltf", images=[{"uri": picture}])
    with pytest.raises(
        FileFormatError, match=sentence if "mtl" not in picture else "cannot be read"
    ):
        worlds.from_mesh(changed)


def test_a_wider_folder_is_named_by_root(tmp_path):
    PIL.Image.fromarray(PICTURE).save(tmp_path / "wall.png")
    (tmp_path / "meshes").mkdir()
    path = write_obj(tmp_path / "meshes", UPRIGHT, SQUARE, picture="../wall.png")
    assert seen(worlds.from_mesh(path, root=tmp_path), (0.5, 0, -0.5)) == pytest.approx(
        255, rel=1e-5
    )


@refusals.table(__file__, "glTF")
def test_gltf_that_would_be_read_in_part_is_refused(row, tmp_path):
    row.holds({"gltf": lambda **changes: mesh_files.read(write_gltf(tmp_path, "gltf", **changes))})


@refusals.table(__file__, "worlds of meshes")
def test_arguments_that_cannot_be_are_refused(row, tmp_path):
    path = write_obj(tmp_path, UPRIGHT, SQUARE)
    row.holds({"world": lambda **options: worlds.from_mesh(path, **options)})


def test_a_file_in_centimetres_gets_a_hint(tmp_path):
    wide = [(400 * x, y, 260 * z) for x, y, z in UPRIGHT]
    with pytest.warns(UserWarning, match=r"800 m wide.*unit_m=0.01"):
        worlds.from_mesh(write_obj(tmp_path, wide, SQUARE))


def test_pictures_are_textures_in_one_line(tmp_path):
    PIL.Image.fromarray(np.full((16, 16), 188, dtype=np.uint8)).save(tmp_path / "grey.png")
    scene = worlds.wall(tmp_path / "grey.png")
    assert seen(scene, (0.3, 0, 0.2)) == pytest.approx(radiance_of(188), rel=1e-5)
    # the format of Greg Ward's Radiance: mantissas of 8 bits with one exponent, 128 / 256 * 2^(e -
    # 128)
    row = bytes([128, 128, 128, 129]) * 2 + bytes([192, 192, 192, 130]) * 2
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n"
    (tmp_path / "a.hdr").write_bytes(header + row * 2)  # 1 1 3 3, twice
    # mean 80
    np.testing.assert_allclose(
        textures.photo(tmp_path / "a.hdr"), [[40.0, 40, 120, 120]] * 2, rtol=1e-5
    )


def test_real_robot_bodies_are_read(shared):
    [part] = mesh_files.read(shared("data/robot_meshes/jackal/jackal-wheel.stl"))
    assert len(part.vertices_m) < len(part.faces)  # merged: a closed surface has about half as many
    parts = mesh_files.read(shared("data/robot_meshes/crazyflie/cf2_assembly_with_props.dae"))
    size = np.ptp(np.concatenate([part.vertices_m for part in parts]), axis=0)
    assert 0.05 < size.max() < 0.3  # a quadrotor of a hand's width
