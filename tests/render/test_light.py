"""Light levels: closed forms of radiative transfer, baked light against path tracing, and the
choice between levels."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.pose import look_at
from codesign.render import Camera, MitsubaScene, light
from codesign.render.atlas import cells_of
from codesign.render.charts import chart_of, emissive_mesh
from codesign.types import Rays
from scenes import textures, worlds
from scenes.build import sky
from tests.numbers import D, close
from tests.render.solids import area


def grey(albedo, radiance=0.0) -> Any:
    """A Lambertian surface that also glows."""
    glow = {"emitter": area(radiance)} if radiance else {}
    return {"bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}, **glow}


def square(centre, normal, side=1.0, up=(0, 1, 0), **surface: Any):
    target = [c + n for c, n in zip(centre, normal, strict=True)]
    frame = (
        backend.mitsuba()
        .ScalarTransform4f()
        .look_at(origin=list(centre), target=target, up=list(up))
    )
    return {"type": "rectangle", "to_world": frame.scale([side / 2, side / 2, 1]), **surface}


def sun(irradiance, *direction):
    light = {"type": "rgb", "value": irradiance}
    return {"type": "directional", "direction": list(direction), "irradiance": light}


def radiance_at(scene, points, normals, lift_m=0.005):
    """Radiance of surface points [N, 3], looked at along their normals."""
    points, normals = (torch.as_tensor(np.array(v), dtype=D) for v in (points, normals))
    rays = Rays(points + lift_m * normals, -normals, torch.ones(len(points), dtype=D))
    return render.shade(rays, scene, torch.eye(4, dtype=D)[None], 1)[0].double()


def grid(n=32):
    """Centres of n x n cells of the unit square about the origin of z = 0."""
    at = (np.arange(n) + 0.5) / n - 0.5
    return np.stack([*(v.reshape(-1) for v in np.meshgrid(at, at)), np.zeros(n * n)], 1)


# ---- closed forms


@pytest.mark.parametrize("albedo", [0.8])
def test_a_white_furnace_has_emission_over_one_minus_albedo(albedo):
    faces = {
        f"face-{axis}{sign + 1}": square(
            sign * np.eye(3)[axis],
            -sign * np.eye(3)[axis],
            2.0,
            np.eye(3)[axis - 2],
            **grey(albedo, 20.0),
        )
        for axis in range(3)
        for sign in (-1, 1)
    }
    truth = 20 / (1 - albedo)
    camera = Camera(lens.Pinhole(4.0), 16, 12, 0.3, 4)
    for scene, relative in (
        (light.PathScene(faces, samples=128, max_depth=-1), 1e-3),
        (light.bake(faces, texel_m=0.25, samples=512, max_depth=64), 2e-3),
    ):
        image = render.frames(camera, scene, look_at((0.1, 0.2, 0.3), (0, 1, 0))[None]).double()
        # a path's light has a relative spread of about 0.5; 100,000 paths and some 60 texels of 512
        # paths: 0.0002 and 0.003 / 5 at 1 sigma
        assert float(image.mean()) == pytest.approx(truth, rel=5 * relative / 2)
        assert (image / truth - 1).abs().max() < 0.25


PARALLEL = (
    2
    / math.pi
    * (
        math.log(2 / math.sqrt(3))
        + 2 * math.sqrt(2) * math.atan(1 / math.sqrt(2))
        - 2 * math.atan(1)
    )
)
PERPENDICULAR = (
    2 * math.atan(1) - math.sqrt(2) * math.atan(1 / math.sqrt(2)) + 0.25 * math.log(0.75)
) / math.pi


@pytest.mark.parametrize(
    ("centre", "normal", "up", "form_factor"),
    [
        ((0, 0, 1), (0, 0, -1), (0, 1, 0), PARALLEL),
        ((0.5, 0, 0.5), (-1, 0, 0), (0, 1, 0), PERPENDICULAR),
    ],
)
def test_squares_exchange_light_by_their_form_factor(centre, normal, up, form_factor):
    # Source: Howell, A catalog of radiation transfer configuration factors, C-11 and C-14 (unit
    # squares, distance 1; with a common edge)
    scene = {
        "source": square(centre, normal, 1.0, up, **grey(0.0, 100.0)),
        "receiver": square((0, 0, 0), (0, 0, 1), **grey(0.5)),
    }
    truth = 0.5 * 100 * form_factor  # mean irradiance is pi L F for equal areas
    # direct light has a relative spread below 1: 65,536 paths; near the common edge it is largest,
    # and texels of 5 cm sum it exactly
    baked = light.bake(scene, samples=256, texel_m=1 / 32)
    for made, points in ((light.PathScene(scene, samples=64), grid()), (baked, grid(64))):
        found = radiance_at(made, points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), 1e-4)
        assert float(found.mean()) == pytest.approx(truth, rel=0.02)


# ---- baked against path traced


def tetrahedron(mi, uv):
    vertices = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.4, 0], [0, 0, 0.4]]) + [-0.9, 0.4, 0.02]
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    places = None
    if uv:
        corners = np.array([[0.02, 0.02], [0.47, 0.02], [0.02, 0.47]])
        places = np.concatenate([corners + [x, y] for y in (0, 0.5) for x in (0, 0.5)])
        vertices, faces = vertices[faces.reshape(-1)] + [0, -0.6, 0], np.arange(12).reshape(4, 3)
    return emissive_mesh(mi, vertices, faces, None, places, bsdf=grey(0.6)["bsdf"])


@pytest.fixture(scope="module")
def still_life():
    mi = backend.mitsuba()
    T = mi.ScalarTransform4f
    picture = mi.Bitmap(
        textures.softened(textures.speckle(1, 64, finest_px=16.0), 2.0)[..., None] / 300
    )
    patterned: Any = grey(0.0)
    patterned["bsdf"]["reflectance"] = {"type": "bitmap", "bitmap": picture, "raw": True}
    cube = T().translate([0.7, 0.2, 0.201]).rotate([0, 0, 1], 25).scale([0.2, 0.15, 0.2])
    start, end = [0.3, -0.5, 0.01], [0.3, -0.5, 0.6]
    return {
        "floor": square((0, 0, 0), (0, 0, 1), 3.0, **patterned),
        "cube": {"type": "cube", "to_world": cube, **patterned},
        "ball": {"type": "sphere", "center": [0, 0.3, 0.302], "radius": 0.3, **grey(0.7)},
        "tube": {"type": "cylinder", "p0": start, "p1": end, "radius": 0.06, **grey(0.4)},
        "cap": {"type": "disk", "to_world": T().translate(end).scale(0.06), **grey(0.4)},
        "bare": tetrahedron(mi, uv=False),
        "unwrapped": tetrahedron(mi, uv=True),
        "lamp": square((0.5, -1.2, 2.0), (-0.3, 0.5, -1), 0.5, **grey(0.2, 800.0)),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 60.0}},
        "sun": sun(150.0, 0.2, 0.3, -1),
    }


VIEW = look_at((0.6, -2.2, 1.3), (0, 0, 0.2))[None]


def wide(samples):
    return Camera(lens.Pinhole(6.0), 48, 36, 0.12, samples)


@pytest.fixture(scope="module")
def baked_still_life(still_life):
    return light.bake(still_life, texel_m=0.04, samples=256)


@pytest.mark.parametrize(
    "name", ["floor", "ball", "tube", "cap", "lamp", "cube", "bare", "unwrapped"]
)
def test_baked_light_is_path_traced_light_on_every_kind_of_shape(
    still_life, baked_still_life, name
):
    """Face by face of meshes, whatever texture coordinates they have."""
    mi = backend.mitsuba()
    reference = light.PathScene(still_life, samples=256)
    made = isinstance(still_life[name], dict)
    shape = mi.load_dict(still_life[name]) if made else still_life[name]
    many = name in ("cube", "bare", "unwrapped")
    u, v = np.random.default_rng(0).random((2, 4096 if many else 512))
    points, normals, inside = chart_of(mi, shape, 0.04, None).at(u, v)
    for face in np.unique(normals[inside].round(3), axis=0) if many else [None]:
        there = inside if face is None else inside & (np.abs(normals - face).max(1) < 0.01)
        ours, theirs = (
            radiance_at(scene, points[there], normals[there], 5e-4)
            for scene in (baked_still_life, reference)
        )
        # 131,072 paths per face, 16 to 6000 texels of 256 paths: below 0.5 %; 50 texels of a mesh's
        # face: below 1 %, and light that falls off within a texel towards the floor is smeared.
        # Over the floor there is next to no light
        least, share = (5.0, 0.01) if made else (0.5 / 0.03, 0.03)
        assert abs((ours - theirs).mean()) < share * max(float(theirs.mean()), least)


def test_faces_of_two_triangles_stay_whole_where_they_are_baked():
    """A cube has twelve edges: no diagonal of a face parts two pieces of its texture."""
    (edges,) = light.bake({"cube": {"type": "cube", **grey(0.5, 1.0)}}, samples=1).outline()
    assert len(edges.start) == 12


def test_of_faces_in_a_strip_those_with_the_longest_edge_are_one_cell():
    """Three triangles in a row: the middle one makes a parallelogram with either neighbour."""
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [4, 0, 0]])
    for faces in itertools.permutations([[0, 1, 3], [1, 2, 3], [1, 4, 2]]):
        cells = cells_of(corners, np.array(faces))
        assert cells.area().tolist() == [2.0, 1.0]
        # the rectangle, whose diagonal is longer than the edge between the other two
        assert np.linalg.norm(cells.along_u + cells.along_v, axis=1)[0] == pytest.approx(
            math.sqrt(5)
        )


def test_the_sky_is_the_same_at_every_level():
    scene = {"sky": sky(backend.mitsuba(), textures.sky(3, 64))}
    camera = Camera(lens.Pinhole(3.0), 24, 18, 0.2, 4)
    poses = torch.stack(
        [look_at((0, 0, 1), at) for at in ((1, 0, 1.2), (0, 1, 2.0), (-1, -1, 0.6))]
    )
    plain, traced = (
        render.frames(camera, made, poses)
        for made in (MitsubaScene(scene), light.PathScene(scene, samples=1))
    )
    close(plain, traced, rtol=1e-4, atol=1e-3)
    assert plain.std() > 5  # and it is not plain


@pytest.mark.bits
def test_equal_seeds_give_equal_frames_and_others_do_not(still_life):
    scene = light.PathScene(still_life, samples=2)
    camera = Camera(lens.Pinhole(6.0), 8, 6, 0.6, 2)
    first, again, other = (
        render.frames(camera, made, VIEW) for made in (scene, scene, scene.with_seed(1))
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


# ---- measuring and choosing


def flat_wall(level):
    return worlds.wall(np.full((8, 8), level, dtype=np.float32))


CAMERA = Camera(lens.Pinhole(8.0), 8, 6, 0.1, 2)
POSES = look_at((0.1, -2, 0.1), (0, 0, 0)).repeat(2, 1, 1)


def test_a_level_that_is_a_tenth_brighter_is_wrong_by_a_tenth_and_by_nothing_after_gain():
    error = light.level_error(flat_wall(55.0), flat_wall(50.0), CAMERA, POSES)
    for part in (error.mean, error.percentile_95, error.maximum, error.rms):
        close(part, torch.full((2,), 0.1, dtype=D), rtol=1e-5)
    assert error.rms_after_gain.max() < 1e-6
    assert error.noise.max() == 0


def test_noise_of_the_reference_is_not_taken_for_error(still_life):
    truth = light.PathScene(still_life, samples=512, seed=9)
    error = light.level_error(truth, light.PathScene(still_life, samples=8), wide(2), VIEW)
    assert error.noise > 0.01
    # the products of independent errors average to nothing: over 1728 pixels their mean is below 5
    # / sqrt(1728) of the noise's square, plus the truth's own
    assert error.rms < error.noise * (5 * 2 / 1728**0.5 + 16 / 512) ** 0.5


def test_the_cheapest_level_within_the_tolerance_is_chosen_and_says_why():
    levels = {"plain": flat_wall(55.0), "exact": flat_wall(50.0)}
    loose, strict = (light.choose(levels, CAMERA, POSES, tolerance) for tolerance in (0.2, 0.01))
    assert strict.name == "exact"
    assert "no cheaper level stays within 0.01" in strict.reason
    assert "plain 0.1" in strict.reason
    assert loose.name == min(levels, key=lambda name: loose.cpu_s[name])
    assert (
        light.choose(levels, CAMERA, POSES, 0.01, after_gain=True)
        .errors["plain"]
        .rms_after_gain.max()
        < 0.01
    )
