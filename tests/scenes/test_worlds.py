"""Worlds: what they promise about gaps, levels, seeds and the negative control; meshes and skies
from files."""

import itertools

import numpy as np
import PIL.Image
import pytest
import torch

from codesign import backend, lens, render
from codesign.errors import DomainError, FileFormatError
from codesign.pose import look_at, se3_exp
from codesign.render import Camera
from codesign.render.charts import chart_of
from scenes import bodies, build, textures, worlds
from tests.scenes.solids import volume_m3

CAMERA = Camera(lens.Pinhole(8.0), 32, 24, 0.2, 4)
BUILT = ("room", "blank-room", "corridor", "outdoor", "tabletop", "dark-room")


def described(name, **options):
    """The world itself, before a light level makes a scene of it."""
    return worlds.WORLDS[name](light=lambda world, device: world, **options)


@pytest.mark.parametrize("name", worlds.WORLDS)
def test_every_world_shows_something_in_range_from_its_viewpoint(name):
    image = render.frames(CAMERA, worlds.WORLDS[name](), look_at(*worlds.VIEWS[name])[None])
    assert 0 < image.min() <= image.max() <= 255.001
    if name != "blank-room":
        assert image.log().std() > 0.15  # there is contrast


@pytest.mark.parametrize(
    "level",
    [
        build.emissive,
        lambda world, device: build.baked(world, device, samples=64, max_depth=16, texel_m=0.4),
    ],
)
def test_the_blank_room_shows_one_radiance_whatever_moves(level):
    start = look_at(*worlds.VIEWS["blank-room"])
    scene = worlds.blank_room(40.0, light=level)
    image = render.frames(CAMERA, scene, start @ se3_exp(0.2 * torch.eye(6, dtype=torch.float64)))
    # emissive: rounding. Baked: 64 paths of a furnace per texel, relative spread 0.5: 6 %, of which
    # a log threshold of 0.2 sees nothing
    assert (image / 40 - 1).abs().max() < (1e-5 if level is build.emissive else 0.15)


def inside(kind, matrix, points, margin_m):
    """Whether points lie in a cube, sphere or cylinder grown by a margin."""
    local = (points - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T
    size = np.linalg.norm(matrix[:3, :3], axis=0)
    if kind == "cube":
        return (np.abs(local) * size < size + margin_m).all(1)
    if kind == "sphere":
        return np.linalg.norm(local, axis=1) * size[0] < size[0] + margin_m
    along = local[:, 2] * size[2]
    return (
        (np.linalg.norm(local[:, :2], axis=1) * size[0] < size[0] + margin_m)
        & (along > -margin_m)
        & (along < size[2] + margin_m)
    )


@pytest.mark.parametrize("name", BUILT)
def test_nothing_interpenetrates_and_gaps_are_a_millimetre(name):
    mi = backend.mitsuba()
    world = described(name)
    solid: dict = {}
    sheets = {}
    clouds = {}
    random = np.random.default_rng(0)
    for shape, (geometry, _) in world.shapes.items():
        matrix = np.array(geometry["to_world"].matrix, dtype=float).reshape(4, 4)
        kind = geometry["type"]
        if kind == "rectangle":
            sheets[shape] = matrix
        elif kind != "disk":  # the lid of a cylinder belongs to it
            solid[shape] = kind, matrix
            chart = chart_of(mi, mi.load_dict(geometry), 0.01, None)
            points, _, there = chart.at(*random.random((2, 1800 if kind == "cube" else 300)))
            clouds[shape] = points[there]
    boxes = {shape: (cloud.min(0), cloud.max(0)) for shape, cloud in clouds.items()}
    for one, other in itertools.permutations(solid, 2):
        if (boxes[one][0] > boxes[other][1] + 0.01).any() or (
            boxes[one][1] < boxes[other][0] - 0.01
        ).any():
            continue
        assert not inside(solid[other][0], solid[other][1], clouds[one], 0.9e-3).any(), (
            f"{one} in {other}"
        )
    for one, cloud in clouds.items():
        for sheet, matrix in sheets.items():
            local = (cloud - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T
            height = local[:, 2] * np.linalg.norm(matrix[:3, 2])
            assert (height > 0.9e-3).all(), f"{one} through {sheet}"


@pytest.mark.parametrize("name", ["outdoor", "tabletop", "dark-room"])
def test_the_seed_decides_where_things_are(name):
    places = [
        [
            np.array(geometry["to_world"].matrix).tolist()
            for geometry, _ in described(name, seed=seed).shapes.values()
        ]
        for seed in (1, 1, 2)
    ]
    assert places[0] == places[1]
    assert places[0] != places[2]


# ---- bodies


TWO = """o first
v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4
o second
v 4 0 0\nv 5 0 0\nv 4 1 0\nv 4 0 2\nf 5 7 6\nf 5 6 8\nf 5 8 7\nf 6 7 8
"""


def test_all_shapes_of_a_file_are_one_body_at_its_scale(tmp_path):
    (tmp_path / "two.obj").write_text(TWO)
    body = bodies.read(tmp_path / "two.obj", scale=0.5)
    # twice a sixth of 1 x 1 x 2, halved thrice
    assert volume_m3(body) == pytest.approx(2 * 2 / 6 / 8, rel=1e-6)
    placed = body.placed(3.0, -2.0, 0.1, 90.0).vertices_m
    np.testing.assert_allclose(
        [placed.min(0), placed.max(0)], [[2.75, -3.25, 0.1], [3.25, -0.75, 1.1]], atol=1e-7
    )
    with pytest.raises(DomainError, match="scale = 0"):
        bodies.read(tmp_path / "two.obj", 0)


def test_a_robot_stands_on_the_ground(shared):
    path = shared("data/robot_meshes/jackal/jackal-base.stl")
    size = np.ptp(bodies.read(path).vertices_m, axis=0)
    assert (size > 0.1).all()
    assert (size < 1.0).all()  # a robot of half a metre, in metres
    scene = worlds.outdoor(clutter=0, meshes=[(path, 0.0, 0.0, 30.0)])
    seen = render.view(CAMERA, scene, look_at((0.0, -1.2, 0.6), (0, 0, 0.1))[None], 0)
    height_m = seen.points_world_m[seen.valid][:, 2]
    assert 0.05 < height_m.max() < 0.5
    assert (height_m > 0.01).double().mean() > 0.05


def test_things_outdoors_keep_clear_of_a_body_of_any_size(tmp_path):
    """A plate of 4 m in the middle: balls of radius r lie beyond 2 m + r along x or y."""
    corners = ((-2, -2), (2, -2), (2, 2), (-2, 2))
    vertices = "".join(f"v {x} {y} 0\n" for x, y in corners) + "v 0 0 1\n"
    (tmp_path / "plate.obj").write_text(f"{vertices}f 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n")
    meshes = [(tmp_path / "plate.obj", 0.0, 0.0, 0.0)]
    world = worlds.outdoor(clutter=24, meshes=meshes, light=lambda world, device: world)
    balls = [np.array(world.shapes[f"ball-{k}"][0]["to_world"].matrix) for k in range(1, 25, 3)]
    for frame in balls:
        assert np.abs(frame[:2, 3]).max() > 2 + frame[0, 0]


# ---- skies


def test_a_photograph_stands_as_its_exif_says(tmp_path):
    """Orientation 6: its first row is the right-hand side of what is seen (EXIF 2.3, 4.6.4)."""
    stored = np.full((4, 6, 3), 30, np.uint8)
    stored[0] = 220
    exif = PIL.Image.Exif()
    exif[0x0112] = 6
    PIL.Image.fromarray(stored).save(tmp_path / "turned.png", exif=exif)
    seen = textures.photo(tmp_path / "turned.png")
    assert seen.shape == textures.file_size(tmp_path / "turned.png") == (6, 4)
    assert (seen[:, -1] > 100).all()
    assert (seen[:, :-1] < 100).all()


def test_a_texel_of_a_large_file_is_a_pixel_of_the_file(tmp_path):
    """Stripes of 256 px in a file that is made four times smaller."""
    stripes = np.tile(np.repeat(np.array([40, 200], np.uint8), 256), 4)[None].repeat(64, 0)
    PIL.Image.fromarray(stripes).save(tmp_path / "stripes.png")
    wall = worlds.wall(tmp_path / "stripes.png", texel_m=0.001, wrap="repeat")
    camera = Camera(lens.Pinhole(8.0), 256, 4, 0.03)  # 1.92 m of the wall
    row = render.frames(camera, wall, look_at((0, -2, 0), (0, 0, 0))[None])[0, 2]
    assert (row > 60).int().diff().abs().sum() == 7  # at every 0.256 m


def test_a_sky_from_a_file_has_its_mean_and_its_east_in_the_east(tmp_path):
    mi = backend.mitsuba()
    picture = np.full((32, 64, 3), 1.0, dtype=np.float32)
    picture[14:18, 15:18] = 50.0  # a lamp just about the horizon, a quarter of the way round: +x
    for kind in ("exr", "hdr"):
        with backend.threads(least=2):
            mi.Bitmap(picture).write(str(tmp_path / f"sky.{kind}"))
        values = textures.environment(tmp_path / f"sky.{kind}", mean=30.0)
        weight = np.cos((np.arange(32) + 0.5 - 16) * np.pi / 32)[:, None]
        assert float((values * weight).mean() / weight.mean()) == pytest.approx(30, rel=1e-5)
    scene = worlds.outdoor(clutter=0, environment=tmp_path / "sky.exr")
    views = [look_at((0, 0, 1), (x, y, 1)) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    brightest = render.frames(
        Camera(lens.Pinhole(8.0), 16, 12, 0.3, 4), scene, torch.stack(views)
    ).amax((1, 2))
    assert brightest.argmax() == 0
    assert brightest[0] > 20 * brightest[1:].max()


def test_real_environment_maps_are_read(shared):
    values = textures.environment(shared("data/hdri/city.hdr"), mean=50.0)
    assert values.shape == (512, 1024)
    assert values.max() > 255  # lamps stay bright


def test_skies_that_cannot_be_are_refused(tmp_path):
    with pytest.raises(FileFormatError, match="is not a file"):
        textures.environment(tmp_path / "nowhere.exr")
    for level, sentence in ((-1.0, "negative"), (0.0, "black")):
        picture = np.full((4, 8, 3), level, dtype=np.float32)
        with backend.threads(least=2):
            backend.mitsuba().Bitmap(picture).write(str(tmp_path / "sky.exr"))
        with pytest.raises(DomainError, match=sentence):
            textures.environment(tmp_path / "sky.exr")


def test_pictures_by_name_and_array():
    assert textures.picture("speckle-7").max() <= 255
    np.testing.assert_array_equal(textures.picture(np.eye(4)), np.eye(4, dtype=np.float32))
    with pytest.raises(DomainError, match="negative"):
        textures.picture(-np.eye(4))
    with pytest.raises(FileFormatError, match="neither a file"):
        worlds.room(photos=["nowhere.png"])


def test_sizes_that_cannot_be_are_refused_whatever_was_made_before():
    textures.photo("brick", 2)
    with pytest.raises(DomainError, match="whole number"):
        textures.photo("brick", 2.0)
    with pytest.raises(DomainError, match="size_px = 0"):
        textures.speckle(0, 0)
