"""Which side of a surface is seen, under transforms that mirror: as Mitsuba's own integrator has
it."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from codesign import backend, lens, render
from codesign.pose import look_at
from codesign.render import Camera, light
from codesign.render.placed import Placement, SidedScene
from codesign.render.silhouettes.shapes import read
from scenes import worlds
from tests.numbers import close
from tests.scenes.solids import across

CAMERA = Camera(lens.Pinhole(4.0), 24, 24, 0.1, 4)
# axes of one length, as Mitsuba asks for
EQUAL = {"sphere": [0, 1, 2], "cylinder": [0, 1], "disk": [0, 1]}
KINDS = ("rectangle", "disk", "sphere", "cylinder", "cube", "ply", "obj")


def shape(mi, folder, kind, seed, **more) -> dict[str, Any]:
    """A shape at a random place, mirrored in half of the cases, flipped in half of them."""
    random = np.random.default_rng(seed)
    scale = random.uniform(0.5, 1.0, 3)
    scale[EQUAL.get(kind, [])] = scale[0]
    scale[random.integers(3)] *= random.choice([-1, -1, 1])
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix() * scale
    entry = {
        "type": kind,
        "to_world": mi.ScalarTransform4f(T),
        "flip_normals": bool(random.integers(2)),
    }
    if kind in ("ply", "obj"):
        import trimesh

        file = folder / f"ball.{kind}"
        # .ply comes with its normals, and Mitsuba works out those of an .obj
        trimesh.creation.icosphere(2).export(
            file, **({"vertex_normal": True} if kind == "ply" else {})
        )
        entry["filename"] = str(file)
    return {**entry, **more}


def seen(scene, seed):
    at = np.random.default_rng(seed).normal(size=3)
    pose = look_at(tuple(3 * at / np.linalg.norm(at)), (0.0, 0.1, 0.0))
    return render.frames(CAMERA, scene, pose[None])[0].double()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_what_glows_shows_the_side_that_mitsuba_shows(tmp_path, kind, seed):
    mi = backend.mitsuba()
    glowing = {"a": shape(mi, tmp_path, kind, seed, emitter={"type": "area", "radiance": 100.0})}
    ours, theirs = (
        seen(scene, seed)
        for scene in (render.MitsubaScene(glowing), light.PathScene(glowing, max_depth=1))
    )
    # Mitsuba stores the normals of vertices to 1 %, by which a face seen nearly edge-on is lit or
    # not
    assert (ours - theirs).abs().mean() < 0.02 * 100
    found = read(mi, mi.load_dict({"type": "scene", **glowing}).shapes()[0])
    if kind not in EQUAL:  # faces of the outline point to where the light goes
        corners = found.vertices[found.faces]
        normal = across(corners)
        ahead = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        rays = [
            mi.Float(np.float32(v))
            for v in np.concatenate([corners.mean(1) + 0.01 * ahead, -ahead], 1).T
        ]
        light_there = light.PathScene(glowing, max_depth=1).radiance(
            mi, mi.Point3f(*rays[:3]), mi.Vector3f(*rays[3:])
        )
        assert np.array(light_there) == pytest.approx(100)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_baked_light_shows_the_side_that_mitsuba_shows(tmp_path, kind, two_sided, seed):
    mi = backend.mitsuba()
    white = {"type": "diffuse", "reflectance": 0.5}
    material = {"type": "twosided", "material": white} if two_sided else white
    lit = {
        "type": "scene",
        "a": shape(mi, tmp_path, kind, seed, bsdf=material),
        "sky": {"type": "constant", "radiance": 1.0},
        "i": {"type": "path", "max_depth": 6},
    }
    scene = mi.load_dict(lit)
    ours, theirs = (
        seen(worlds.from_mitsuba(scene, level, up="z", samples=64, texel_m=0.2), seed)
        for level in ("baked", "path")
    )
    assert (ours - theirs).abs().mean() < 0.03
    close(ours.mean(), theirs.mean(), rtol=0.02)


def test_a_back_shows_its_own_picture_however_often_the_front_repeats_its():
    """Seen from behind; the truth is a wall whose front has no picture."""
    mi = backend.mitsuba()
    random = np.random.default_rng(3)

    def wall(radiance):
        return {"type": "rectangle", "emitter": {"type": "area", "radiance": radiance}}

    def picture(times):
        bitmap = mi.Bitmap(random.uniform(10, 200, (16, 16, 1)).astype(np.float32))
        to_uv = mi.ScalarTransform3f().scale([times, times])
        return {"type": "bitmap", "bitmap": bitmap, "raw": True, "to_uv": to_uv}

    back = mi.load_dict(wall(picture(3.0)))
    as_it_is = Placement(torch.eye(3, dtype=torch.float64))
    behind = look_at((0.2, 0.1, -2.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))[None]
    plain, repeated = (
        render.frames(
            CAMERA, SidedScene({"wall": wall(front)}, {"wall": back.emitter()}, as_it_is), behind
        )
        for front in ({"type": "rgb", "value": 50.0}, picture(2.0))
    )
    assert plain.std() > 10
    close(repeated, plain, rtol=1e-5)
