"""What users bring into worlds: pictures in linear light against Mitsuba's reader, and one sentence
for what has no meaning."""

import os

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.errors import FileFormatError
from codesign.pose import look_at
from codesign.render.charts import emissive_mesh
from scenes import build, rgbe, textures, worlds
from tests import refusals
from tests.hostile import seeds_scenes
from tests.processes import python

HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 4\n"
FLAT = HEAD + bytes([9, 8, 7, 130] * 3 + [5, 6, 7, 120])
EVEN = np.ones((4, 4))


@pytest.mark.parametrize("name", ["new.hdr", "flat.hdr", "sky.exr"])
def test_pictures_in_linear_light_hold_what_mitsuba_reads(tmp_path, name):
    made = {"new.hdr": seeds_scenes.hdr(), "flat.hdr": FLAT, "sky.exr": seeds_scenes.exr()}
    (tmp_path / name).write_bytes(made[name])
    with backend.threads(least=2):
        theirs = np.array(backend.mitsuba().Bitmap(str(tmp_path / name)))[..., :3]
    np.testing.assert_array_equal(
        rgbe.read(tmp_path / name).astype(np.float32), theirs.astype(np.float32)
    )


ONE_CORE = """import os, sys
os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
from scenes import foreign, textures
print(textures.environment(sys.argv[1]).shape)
foreign.from_mitsuba({"sky": {"type": "envmap", "filename": sys.argv[1]}, "ball": {"type": "sphere"}})
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="a process is kept on one core")
def test_pictures_of_openexr_are_read_on_one_core(tmp_path):
    (tmp_path / "sky.exr").write_bytes(seeds_scenes.exr())
    done = python("-c", ONE_CORE, str(tmp_path / "sky.exr"))
    assert (done.returncode, done.stdout) == (0, "(6, 12)\n"), done.stderr


WHOLE = seeds_scenes.hdr()
DAMAGED = {
    "cut short": WHOLE[:-1],
    "another value": WHOLE[:-30] + b"\xff" + WHOLE[-29:],
    "another header": WHOLE[:60] + b"\3" + WHOLE[61:],
    "runs of the older kind": HEAD + bytes([9, 8, 7, 130, 1, 1, 1, 2, 5, 6, 7, 120]),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_hdr_ends_in_a_sentence(tmp_path, damage):
    (tmp_path / "sky.hdr").write_bytes(DAMAGED[damage])
    with pytest.raises(FileFormatError, match="cannot be read"):
        textures.environment(tmp_path / "sky.hdr")


@refusals.table(__file__, "pictures and sizes")
def test_what_has_no_meaning_ends_in_a_sentence(row):
    row.holds(globals() | {"build": build, "worlds": worlds})


def test_an_array_of_bytes_says_how_it_is_coded(tmp_path):
    import imageio.v3 as imageio

    pixels = np.full((8, 8), 188, dtype=np.uint8)
    imageio.imwrite(tmp_path / "grey.png", pixels)
    np.testing.assert_allclose(
        textures.picture(pixels, encoding="srgb"),
        textures.picture(tmp_path / "grey.png"),
        rtol=1e-6,
    )
    imageio.imwrite(tmp_path / "float.tiff", pixels / np.float32(255))
    with pytest.raises(FileFormatError, match="numbers of 32 bits, whose white is not known"):
        textures.picture(tmp_path / "float.tiff")
    for whole in (np.uint8, np.int32, np.int64):
        assert textures.picture(pixels.astype(whole), encoding="linear").max() == 188


def test_colours_of_a_needle_a_kilometre_long_are_those_between_its_corners():
    mi = backend.mitsuba()
    vertices = np.array([[0, 0, -0.1], [0, 0, 0.1], [0, 1000.0, 0]])
    source = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_radiance"}}
    needle = emissive_mesh(mi, vertices, np.array([[0, 1, 2]]), source)
    needle.add_attribute("vertex_radiance", 1, np.float32(50 + vertices[:, 1] / 10))
    scene = render.MitsubaScene({"needle": needle}).two_sided()
    camera = render.Camera(lens.Pinhole(100.0), 5, 5, 0.1, 1)
    for y in (5.0, 200.0, 700.0):  # radiance is 50 + y / 10 there
        pose = look_at((3.0, y, 0.0), (0.0, y, 0.0))[None].requires_grad_()
        frame = render.frames(camera, scene, pose)
        assert float(frame[0, 2, 2].detach()) == pytest.approx(50 + y / 10, abs=0.01)
        (slope,) = torch.autograd.grad(frame[0, 2, 2], pose)
        assert float(slope[0, 1, 3]) == pytest.approx(0.1, rel=1e-3)
