"""Worlds from Mitsuba scenes: the same picture as Mitsuba's own sensor, units and axes, and what is
refused."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.errors import DomainError, FileFormatError, GradientError
from codesign.pose import look_at
from codesign.render import Camera, light
from codesign.render.charts import emissive_mesh
from scenes import trial_load, worlds
from tests import refusals
from tests.numbers import close, f64

XML = """<scene version="3.0.0">
    <default name="bright" value="2"/>
    <integrator type="path"><integer name="max_depth" value="4"/></integrator>
    <sensor type="perspective">
        <float name="fov" value="50"/>
        <transform name="to_world"><lookat origin="1.5, 2, 4" target="0.2, 0.5, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/></film>
    </sensor>
    <shape type="rectangle">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>
        <bsdf type="twosided"><bsdf type="roughplastic"/></bsdf>
    </shape>
    <shape type="sphere">
        <point name="center" x="0" y="0.6" z="0"/><float name="radius" value="0.5"/>
        <bsdf type="principled"><rgb name="base_color" value="0.8, 0.3, 0.2"/></bsdf>
    </shape>
    <emitter type="constant"><rgb name="radiance" value="$bright"/></emitter>
    <emitter type="point"><point name="position" x="2" y="3" z="1"/><rgb name="intensity" value="20"/></emitter>
</scene>"""
PICTURE = '<texture type="bitmap" name="base_color"><string name="filename" value="{}"/></texture>'


def described(mi, bright=2.0) -> dict[str, Any]:
    """The scene of XML as a dictionary."""
    T = mi.ScalarTransform4f()
    plastic = {"type": "twosided", "bsdf": {"type": "roughplastic"}}
    red = {"type": "principled", "base_color": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": {
            "type": "perspective",
            "fov": 50,
            "to_world": T.look_at(origin=[1.5, 2, 4], target=[0.2, 0.5, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 24, "height": 16},
        },
        "floor": {
            "type": "rectangle",
            "to_world": T.scale(2).rotate([1, 0, 0], -90),
            "bsdf": plastic,
        },
        "ball": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.5, "bsdf": red},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": bright}},
        "lamp": {
            "type": "point",
            "position": [2, 3, 1],
            "intensity": {"type": "rgb", "value": 20.0},
        },
    }


BALL = {"ball": {"type": "sphere"}}


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "scene.xml"
    file.write_text(XML)
    return file


def seen(world, view, samples=4, **options):
    return render.frames(view.camera(samples, **options), world, view.T_world_cam[None])[0].double()


def test_a_file_a_dictionary_and_a_loaded_scene_are_one_world(path):
    mi = backend.mitsuba()
    view = worlds.view_of(path)
    images = [
        seen(worlds.from_mitsuba(source, "path", samples=2, **more), view)
        for source, more in (
            (path, {"bright": "3"}),
            (str(path), {"bright": 3}),
            (described(mi, 3.0), {}),
            (mi.load_dict(described(mi, 3.0)), {}),
        )
    ]
    # the file's turn by 90 degrees is rounded otherwise than the dictionary's
    for other in images[1:]:
        close(images[0], other, rtol=1e-4, atol=1e-5)
    assert not torch.equal(images[0], seen(worlds.from_mitsuba(path, "path", samples=2), view))


@pytest.mark.parametrize(("unit_m", "up"), [(0.01, "y"), (1.0, "z"), (0.25, "z")])
def test_units_and_the_up_axis_change_where_the_camera_stands_and_not_what_it_sees(
    path, unit_m, up
):
    view = worlds.view_of(path, unit_m=unit_m, up=up)
    plain = worlds.view_of(path, up="z")
    eye = [1.5, 2, 4] if up == "z" else [1.5, -4, 2]
    torch.testing.assert_close(view.T_world_cam[:3, 3], unit_m * f64(eye))
    world = worlds.from_mitsuba(path, "path", unit_m=unit_m, up=up, gain=3.0, samples=2)
    close(
        seen(world, view),
        3 * seen(worlds.from_mitsuba(path, "path", up="z", samples=2), plain),
        rtol=0.02,
    )
    point, normal, valid = world.hit(
        unit_m * torch.tensor([[0.0, -1.0, 1.5] if up == "z" else [0.0, -1.5, -1.0]]).double(),
        torch.tensor([[0.0, 1.0, 0.0] if up == "z" else [0.0, 0.0, 1.0]]).double(),
    )
    assert valid  # the floor at height 0, from below
    assert float(point.norm()) == pytest.approx(1.5 * unit_m, rel=1e-5)
    assert abs(float(normal[0, 1 if up == "z" else 2])) == pytest.approx(1)


def test_a_room_in_centimetres_is_told(path):
    with pytest.warns(UserWarning, match=r"scene.xml' is 400 m wide; .* give unit_m=0.01"):
        worlds.from_mitsuba(path, "path", unit_m=100.0)


@refusals.table(__file__, "files that Mitsuba cannot load")
def test_a_file_that_mitsuba_cannot_load_is_one_sentence_with_its_path(row, path):
    def changed(old, new):
        path.write_text(XML.replace(old, new, 1))
        worlds.from_mitsuba(path)

    told = row.holds(globals() | {"changed": changed})
    assert str(path) in told
    assert ".cpp" not in told


ROW = b"\x02\x02\x00\x09"  # of nine pixels, run by run; 136 is a run of eight
HDR = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 9\n" + ROW
BARE = '<texture type="bitmap" name="base_color"></texture>'


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("", "names no file"),
        ("run.hdr", "a run is longer than its row"),
        ("other.png", "a run is longer than its row"),
    ],
)
def test_a_picture_that_would_end_the_process_is_a_sentence(path, name, sentence):
    bitmap = {"type": "bitmap"}
    if name:
        path.with_name(name).write_bytes(HDR + b"\x88\x01" * 8)
        bitmap["filename"] = str(path.with_name(name))
    texture = PICTURE.format(name) if name else BARE
    path.write_text(XML.replace('<rgb name="base_color" value="0.8, 0.3, 0.2"/>', texture))
    painted = {"type": "rectangle", "paint": {"type": "diffuse", "reflectance": bitmap}}
    for source in (path, {"a": painted, "sky": {"type": "constant"}}):
        with pytest.raises(FileFormatError, match=sentence):
            worlds.from_mitsuba(source, "path")


@pytest.mark.parametrize(
    ("trial", "sentence"),
    [
        ("import os; os.abort()", "Mitsuba itself ends"),
        ("import time; time.sleep(60)", "within 1 s"),
    ],
)
def test_whatever_ends_mitsuba_ends_a_trial(path, monkeypatch, trial, sentence):
    monkeypatch.setattr(trial_load, "TRIAL", trial)
    monkeypatch.setattr(trial_load, "LONGEST_S", 1.0)
    with pytest.raises(FileFormatError, match=rf"scene\.xml.*{sentence}"):
        worlds.view_of(path)


@refusals.table(__file__, "scenes")
def test_what_is_no_scene_is_refused(row, path, tmp_path):
    (tmp_path / "one.xml").write_text('<shape version="3.0.0" type="sphere"/>')
    (tmp_path / "a.obj").write_text("")

    def viewed(**sensor):
        return worlds.view_of({**BALL, "sensor": sensor})

    row.holds(globals() | {"path": path, "tmp": tmp_path, "viewed": viewed})


def test_a_scene_of_another_variant_is_refused_with_what_to_do():
    mi = backend.mitsuba()
    mi.set_variant("scalar_rgb")
    try:
        scene = mi.load_dict(
            {"type": "scene", "ball": {"type": "sphere"}, "sky": {"type": "constant"}}
        )
    finally:
        mi.set_variant(backend.variant())
    for source in (scene, {"ball": scene.shapes()[0]}):
        with pytest.raises(DomainError, match=r"scalar_rgb.*mi.set_variant\('llvm_ad_mono'\)"):
            worlds.from_mitsuba(source)


def test_paths_have_no_gradient(path):
    poses = look_at((1.5, -4, 2), (0, 0, 0))[None].requires_grad_()
    camera = Camera(lens.Pinhole(8.0), 4, 4, 1.0, 1)
    world = worlds.from_mitsuba(path, "path", samples=1)
    with pytest.raises(GradientError, match="no gradient"):
        render.frames(camera, world, poses).sum().backward()
    with pytest.raises(GradientError, match="no outline"):
        world.outline()


# ---- baked


def grid(mi, n, bsdf):
    """A unit square of n x n cells in z = 0 as a mesh whose texture coordinates all lie on each
    other."""
    at = np.linspace(-0.5, 0.5, n + 1)
    vertices = np.stack([*(v.reshape(-1) for v in np.meshgrid(at, at)), np.zeros((n + 1) ** 2)], 1)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1)
    faces = np.concatenate(
        [
            corner[:, None] + [0, 1, n + 2],
            corner[:, None] + [0, n + 2, n + 1],
        ]
    )
    return emissive_mesh(mi, vertices, faces, None, vertices[:, :2] % 1, bsdf=bsdf)


@pytest.mark.parametrize("cells", [1, 4, 64])
def test_a_mesh_of_any_fineness_shows_the_falloff_of_a_lamp(cells):
    mi = backend.mitsuba()
    intensity, height, albedo = 5.0, 0.8, 0.5
    # 64: finer than the texels, so light at vertices
    scene = {
        "mesh": grid(
            mi, cells, {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}
        ),
        "lamp": {
            "type": "point",
            "position": [0, 0, height],
            "intensity": {"type": "rgb", "value": intensity},
        },
    }
    world = worlds.from_mitsuba(scene, "baked", up="z", texel_m=0.04, samples=16)
    camera = Camera(lens.Pinhole(8.0), 24, 24, 0.25, 4)
    pose = look_at((0, 0, 1.0), (0, 0, 0), down=(0, -1, 0))
    image = render.frames(camera, world, pose[None])[0].double()
    pixel = (torch.arange(24) - 11.5) * 0.25 / 8
    square = pixel[:, None] ** 2 + pixel[None] ** 2
    truth = albedo / math.pi * intensity * height / (square + height**2) ** 1.5
    inside = (pixel[:, None].abs() < 0.47) & (pixel[None].abs() < 0.47)
    # 16 points per texel, over which light changes by less than 6 %: 0.4 %, and bilinear between
    # texels
    assert (image / truth - 1)[inside].abs().max() < 0.02


def test_a_baked_scene_in_centimetres_stands_where_its_paths_do(path):
    options = {"unit_m": 0.25, "up": "y", "gain": 3.0}
    view = worlds.view_of(path, unit_m=0.25)
    matte = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    mi = backend.mitsuba()
    scene = described(mi) | {
        "sky": {
            "type": "envmap",
            "bitmap": mi.Bitmap(
                np.float32(np.linspace(0.5, 3, 16 * 32).reshape(16, 32, 1)).repeat(3, 2)
            ),
        },
    }
    scene["floor"]["bsdf"] = scene["ball"]["bsdf"] = matte
    baked = worlds.from_mitsuba(scene, "baked", texel_m=0.03, **options)
    paths = worlds.from_mitsuba(scene, "path", samples=32, **options)
    error = light.level_error(baked, paths, view.camera(8), view.T_world_cam[None])
    # 64 paths per texel: 3 % of what the sky gives, and the edge of a shadow
    assert error.rms < 0.04
    origin = f64([[0.0, -0.2, 0.5]])
    down = f64([[0.0, 0.0, -1.0]])
    for one, other in zip(baked.hit(origin, down), paths.hit(origin, down), strict=True):
        close(one.double(), other.double(), rtol=1e-5, atol=1e-6)


def test_gloss_is_as_it_is_from_the_place_it_is_baked_towards():
    mi = backend.mitsuba()
    eye = (0.0, -1.5, 1.0)
    scene = {
        "floor": {
            "type": "rectangle",
            "bsdf": {
                "type": "roughplastic",
                "alpha": 0.3,
                "diffuse_reflectance": {"type": "rgb", "value": 0.1},
            },
        },
        "lamp": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f()
            .look_at(origin=[0, 1.5, 1], target=[0, 0, 0], up=[0, 0, 1])
            .scale(0.3),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 30.0}},
        },
    }
    camera = Camera(lens.Pinhole(8.0), 24, 16, 0.3, 4)
    pose = look_at(eye, (0, 0, 0))[None]
    paths = worlds.from_mitsuba(scene, "path", up="z", samples=64)
    mean, there = (
        light.level_error(
            worlds.from_mitsuba(scene, "baked", up="z", towards_m=place, texel_m=0.05),
            paths,
            camera,
            pose,
        )
        for place in (None, eye)
    )
    # 64 paths per texel; the highlight is as wide as many texels
    assert there.rms < 0.05
    assert mean.rms > 0.2


def test_emissive_shows_albedo_and_emission_and_auto_takes_it_where_all_is_emission():
    mi = backend.mitsuba()
    camera = Camera(lens.Pinhole(8.0), 4, 4, 0.2, 1)
    pose = look_at((0.1, 0.2, 2), (0.1, 0.2, 0), down=(0, -1, 0))[None]
    lit = {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": 7.0}}}
    dark = {"bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.25}}}
    for surface, level, value in (
        (dark, "emissive", 0.25),
        (lit, "auto", 7.0),
        (lit | dark, "emissive", 7.0),
    ):
        world = worlds.from_mitsuba({"sheet": {"type": "rectangle", **surface}}, level, up="z")
        image = render.frames(camera, world, pose)
        close(image, torch.full_like(image, value), rtol=1e-5)
    bitmap = mi.Bitmap(np.float32([[[1.0], [2.0]], [[3.0], [4.0]]]))
    picture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}
    world = worlds.from_mitsuba(
        {"sheet": {"type": "rectangle", "emitter": {"type": "area", "radiance": picture}}}, up="z"
    )
    point = look_at((0.5, 0.5, 2), (0.5, 0.5, 0), down=(0, -1, 0))[None]
    assert float(render.frames(camera, world, point).mean()) == pytest.approx(4.0, rel=1e-3)


EVEN_SKY = {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": 2.0}}}


def from_above(world, x, y):
    """Mean of a picture of 4 x 4 px around a place."""
    camera = Camera(lens.Pinhole(8.0), 4, 4, 0.2, 1)
    pose = look_at((x, y, 2), (x, y, 0), down=(0, -1, 0))
    return float(render.frames(camera, world, pose[None]).mean())


@pytest.mark.parametrize("bsdf", ["conductor", "thindielectric", "mask"])
def test_mirrors_glass_and_masks_name_the_level_to_choose_and_may_be_matte(bsdf):
    coated = {"type": bsdf} | ({"b": {"type": "diffuse"}} if bsdf == "mask" else {})
    scene = {"sheet": {"type": "rectangle", "bsdf": coated}} | EVEN_SKY
    with pytest.raises(
        DomainError, match=r"shape 'sheet', a .*; use the level 'path', or matte=True"
    ):
        worlds.from_mitsuba(scene, up="z")
    world = worlds.from_mitsuba(scene, up="z", matte=True, texel_m=0.5, samples=256)
    # an even sky of 2 is 2 in a perfect mirror and through glass; a mask shows half of it and half
    # of albedo 0.5
    low, high = (1.4, 1.6) if bsdf == "mask" else (1.99, 2.01)
    assert low < from_above(world, 0.0, 0.0) < high


def test_instances_are_named_with_the_level_that_shows_them():
    copies = {
        "group": {"type": "shapegroup", "one": {"type": "rectangle"}},
        "copy": {"type": "instance", "of": {"type": "ref", "id": "group"}},
        **EVEN_SKY,
    }
    with pytest.raises(
        DomainError, match=r"shape 'copy', a Instance, has no texture chart here; .* PathScene"
    ):
        worlds.from_mitsuba(copies, up="z")
    world = worlds.from_mitsuba(copies, "path", up="z", samples=256)
    # albedo 0.5, 16 x 4096 paths
    assert from_above(world, 0.1, 0.2) == pytest.approx(0.5 * 2, rel=0.02)
