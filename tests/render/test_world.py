"""Mitsuba worlds: constants come back, pictures stand upright, static cameras see static frames."""

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.pose import look_at
from codesign.render import Camera
from codesign.render.charts import emissive_mesh
from scenes import textures, worlds
from tests.numbers import D, close

# top left, top right; bottom left, bottom right
CORNERS = np.array([[10.0, 60.0], [120.0, 200.0]], dtype=np.float32)


def quadrants(size=64):
    return np.kron(CORNERS, np.ones((size // 2, size // 2), dtype=np.float32))


def corners_seen(scene, pose, spread_px=10):
    """Radiance a little away from the image's middle, as [[top left, top right],
    [bottom left, bottom right]]."""
    camera = Camera(lens.Pinhole(8.0), 64, 64, 0.05, 1)
    image = render.frames(camera, scene, pose[None])[0]
    at = [32 - spread_px, 31 + spread_px]
    return image[at][:, at].numpy()


@pytest.mark.parametrize(
    ("scene", "eye", "down"),
    [
        (
            lambda: worlds.wall(quadrants(512), texel_m=16 / 512, half_width_m=8.0),
            (0, -2, 0),
            (0, 0, -1),
        ),
        # for one who faces north
        (
            lambda: worlds.ground(quadrants(512), texel_m=24 / 512, half_width_m=12.0),
            (0, 0, 2),
            (0, -1, 0),
        ),
    ],
)
def test_a_picture_is_upright_and_not_mirrored(scene, eye, down):
    """The picture once over the whole wall, or the whole ground."""
    found = corners_seen(scene(), look_at(eye, (0, 0, 0), down=down))
    np.testing.assert_allclose(found, CORNERS, rtol=1e-6)


@pytest.mark.parametrize(
    ("wall", "target"), [(0, (0, 2, 1.3)), (1, (0, -2, 1.3)), (2, (2, 0, 1.3)), (3, (-2, 0, 1.3))]
)
def test_pictures_in_the_room_are_upright_and_each_on_its_wall(wall, target):
    level = 60.0
    pictures = [np.full((64, 64), level, dtype=np.float32)] * 6
    pictures[wall] = quadrants()
    scene = worlds.room(photos=pictures, objects=False)
    np.testing.assert_allclose(
        corners_seen(scene, look_at((0, 0, 1.3), target)), CORNERS, rtol=1e-6
    )
    behind = [-c for c in target[:2]]
    np.testing.assert_allclose(
        corners_seen(scene, look_at((0, 0, 1.3), (*behind, 1.3))), level, rtol=1e-6
    )


def test_the_room_has_no_holes_at_its_seams():
    scene = worlds.room(photos=[np.full((8, 8), 60.0, dtype=np.float32)] * 6, objects=False)
    camera = Camera(lens.Pinhole(3.0), 96, 96, 0.06, 4)
    views = [look_at((0.3, 0.2, 1.0), corner) for corner in ((2, 2, 0), (-2, 2, 2.6), (2, -2, 1.3))]
    image = render.frames(camera, scene, torch.stack(views))
    close(image, torch.full_like(image, 60.0), rtol=1e-5)


@pytest.mark.bits
def test_a_static_camera_sees_equal_frames_and_the_seed_decides_the_samples():
    scene, geo = worlds.room(), lens.load("cooke-triplet").scaled(0.1)
    pose = look_at((0.5, -1.2, 1.4), (0, 1, 0.8))[None]
    first, again, other = (
        render.frames(Camera(geo, 24, 16, 0.1, 8, seed), scene, poses)
        for seed, poses in ((1, pose), (1, pose.repeat(5, 1, 1)), (2, pose))
    )
    assert torch.equal(first.expand_as(again), again)
    assert not torch.equal(first, other)


def test_ten_kilometres_away_single_precision_still_renders():
    """A wall at 10 km with texels of 10 m: pixel means and flow of a scene 5000 times closer and
    finer."""
    texture = textures.speckle(0, 64, finest_px=6.0)
    camera = Camera(lens.Pinhole(50.0), 16, 12, 0.1, 4)
    near, far = (
        (
            worlds.wall(texture, *size),
            torch.stack([look_at((x, -d, 0), (x, 0, 0)) for x in (0.0, d / 1e3)]),
        )
        for d, *size in ((2.0, 0.002, 0.064), (1e4, 10.0, 320.0))
    )
    # positions on the wall round to 1e-4 texels, contrasts per texel are below 5
    frames, truth = (render.frames(camera, *seen) for seen in (far, near))
    close(frames, truth, rtol=1e-3)
    flow, valid = render.true_flow(camera, *far)
    assert valid.all()
    close(flow[0, 0], torch.full((12, 16), -0.5, dtype=D), rtol=1e-6)


# ---- textures


def test_a_photograph_is_linearised_as_srgb(tmp_path):
    import imageio.v3 as imageio

    values = np.array([[0, 10, 188, 255]], dtype=np.uint8).repeat(2, 0)
    imageio.imwrite(tmp_path / "gray.png", values)
    # IEC 61966-2-1 by hand: 10/255 is on the straight part, 188 is linear 0.5029
    linear = np.array([0.0, 10 / 255 / 12.92, 0.502886, 1.0])
    np.testing.assert_allclose(
        textures.photo(tmp_path / "gray.png")[0], 2 + 253 * linear, rtol=2e-6
    )
    colour = np.zeros((2, 2, 3), dtype=np.uint8)
    colour[..., 1] = 255
    imageio.imwrite(tmp_path / "green.png", colour)
    # luminance is a sum of linear light
    np.testing.assert_allclose(textures.photo(tmp_path / "green.png"), 2 + 253 * 0.7152, rtol=2e-6)


@pytest.mark.parametrize(
    ("size_px", "shape"), [(4, (2, 4)), (9, (4, 9)), (10, (5, 10)), (12, (6, 12))]
)
def test_a_large_picture_is_averaged_not_cut(tmp_path, size_px, shape):
    """Every texel repeated as often as the new picture has rows (columns), and means of as many as
    the old one has: averages over areas without a fraction of a texel."""
    import imageio.v3 as imageio

    values = np.random.default_rng(3).integers(0, 256, (6, 12), dtype=np.uint8)
    imageio.imwrite(tmp_path / "noise.png", values)
    coded = values / 255
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    fine = linear.repeat(shape[0], 0).repeat(shape[1], 1)
    expected = fine.reshape(shape[0], 6, shape[1], 12).mean((1, 3))
    found = textures.photo(tmp_path / "noise.png", size_px)
    assert found.shape == shape
    np.testing.assert_allclose(found, 2 + 253 * expected, rtol=1e-6)  # float32
    if shape[0] * 2 == shape[1]:  # equal scales: light is kept as well
        assert found.mean(dtype=np.float64) == pytest.approx(2 + 253 * linear.mean(), rel=1e-6)


def test_a_tall_picture_keeps_its_proportions(tmp_path):
    import imageio.v3 as imageio

    imageio.imwrite(tmp_path / "tall.png", np.full((40, 7), 60000, dtype=np.uint16))
    found = textures.photo(tmp_path / "tall.png", 20)
    assert found.shape == (20, 4)  # 3.5 columns, rounded
    np.testing.assert_allclose(found, 2 + 253 * ((60000 / 65535 + 0.055) / 1.055) ** 2.4, rtol=2e-6)
    assert textures.photo(tmp_path / "tall.png").shape == (40, 7), "a small one stays as it is"


def test_speckle_keeps_its_band_and_contrast():
    field = np.log(
        textures.speckle(5, 256, finest_px=4.0, coarsest_px=32.0, contrast=0.3).astype(np.float64)
        / 60
    )
    assert field.std() == pytest.approx(0.3, rel=1e-5)
    power = np.abs(np.fft.fft2(field)) ** 2
    radius = np.hypot(np.fft.fftfreq(256)[:, None], np.fft.fftfreq(256))
    inside = (radius >= 1 / 32) & (radius <= 1 / 4)
    assert power[inside].sum() / power.sum() > 1 - 1e-9  # float32 rounding of the radiance
    low = power[(radius >= 1 / 32) & (radius < 1 / 16)].sum()
    # equal power per octave; some 300 random modes
    assert low / power[(radius >= 1 / 8) & (radius <= 1 / 4)].sum() == pytest.approx(1, abs=0.25)


def test_faded_pictures_end_in_the_level():
    faded = textures.faded_to(quadrants(), 60.0)
    for border in (faded[:2], faded[-2:], faded[:, :2], faded[:, -2:]):
        assert (border == 60).all()
    np.testing.assert_array_equal(faded[12:-12, 12:-12], quadrants()[12:-12, 12:-12])


@pytest.mark.parametrize("at", ["vertex", "face"])
def test_an_attribute_of_three_colours_shows_its_luminance(at):
    """Of a square that fills the picture; by the weights of Rec. 709."""
    mi = backend.mitsuba()
    radiance = {"type": "mesh_attribute", "name": f"{at}_radiance"}
    options = mi.Properties()
    options["mesh_emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    square = mi.Mesh("square", 4, 2, props=options)
    parameters = mi.traverse(square)
    parameters["vertex_positions"] = [-1, 0, -1, 1, 0, -1, 1, 0, 1, -1, 0, 1]
    parameters["faces"] = [0, 1, 2, 0, 2, 3]
    parameters.update()
    square.add_attribute(f"{at}_radiance", 3, [10, 20, 30] * (4 if at == "vertex" else 2))
    camera = render.Camera(lens.Pinhole(4.0), 6, 6, 0.5, 4)
    found = render.frames(
        camera, render.MitsubaScene({"square": square}), look_at((0, -2, 0), (0, 0, 0))[None]
    )
    close(found, torch.full((1, 6, 6), 0.2126 * 10 + 0.7152 * 20 + 0.0722 * 30), rtol=1e-3)


def test_a_picture_named_as_an_attribute_and_an_attribute_within_a_picture_show(tmp_path):
    """Mitsuba's own evaluation has them, not the short way of plain attributes."""
    mi = backend.mitsuba()
    camera = render.Camera(lens.Pinhole(4.0), 6, 6, 0.5, 4)
    facing = mi.ScalarTransform4f().translate([0, 0, 3]).rotate([0, 1, 0], 180)
    squares = {"type": "checkerboard", "color0": 5.0, "color1": 9.0}
    named = {"type": "mesh_attribute", "name": "face_squares"}
    within = {"type": "checkerboard", "color0": {"type": "mesh_attribute", "name": "face_radiance"}}
    plain = emissive_mesh(
        mi, np.array([[-1.0, -1, 3], [1, -1, 3], [1, 1, 3]]), np.array([[0, 2, 1]]), np.array([7.0])
    )
    picture = {"type": "rectangle", "to_world": facing, "face_squares": squares}
    picture["emitter"] = {"type": "area", "radiance": named}
    plain.write_ply(str(mesh := tmp_path / "mesh.ply"))
    mixed = {"type": "ply", "filename": str(mesh)}
    mixed["emitter"] = {"type": "area", "radiance": within | {"color1": 7.0}}
    for shape, seen in ((picture, {5.0, 9.0}), (mixed, {7.0})):
        image = render.frames(camera, render.MitsubaScene({"shape": shape}), torch.eye(4)[None])
        assert seen <= set(image.flatten().tolist())
