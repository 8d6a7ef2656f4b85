"""What a stranger gives wrongly is one sentence: what was given, what is allowed, what to do."""

import contextlib
import dataclasses
import functools
import math
from typing import Any

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.errors import BackendError, CodesignError, DomainError, FileFormatError
from codesign.pose import as_poses, look_at, se3_exp
from codesign.render import Camera, Film, MitsubaScene, MovingScene, TexturedPlane, light
from codesign.render.charts import emissive_mesh
from codesign.types import Rays
from scenes import textures, worlds
from tests import refusals
from tests.numbers import D, f64
from tests.render import test_own_lens
from tests.render.solids import area

SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]])
FACES = np.array([[0, 1, 2], [2, 1, 3]])
PLANE = TexturedPlane([[0.7, 0.3]], [0.4], [0.2])
ABOVE = look_at((0.1, -0.2, 2.0), (0.0, 0.1, 0.0), down=(0, -1, 0))
POSES = ABOVE.repeat(2, 1, 1)
STILL = torch.eye(4, dtype=D).repeat(3, 1, 1)
PINHOLE = lens.Pinhole(8.0)
CAMERA = Camera(PINHOLE, 6, 4, 0.5, 2)
NARROW = Camera(lens.load("cooke-triplet").scaled(0.1), 32, 24, 0.1, 4)
THIN = Camera(lens.ThinLens(10.0, 2.0).focus_at(1.0), 48, 40, 0.02, 256)
SHEET = {"type": "rectangle"}
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}


def mesh(vertices=SQUARE, faces=FACES, radiance: Any = (5.0, 5.0)):
    radiance = radiance if isinstance(radiance, dict) else np.array(radiance)
    return emissive_mesh(backend.mitsuba(), vertices, faces, radiance)


def with_vertex(value):
    vertices = SQUARE.copy()
    vertices[3, 1] = value
    return vertices


def moving(poses: Any, scene: Any = PLANE):
    return MovingScene(PLANE, {"card": (scene, poses)})


def flat(level):
    return worlds.wall(np.full((8, 8), level, dtype=np.float32))


class Brighter(MitsubaScene):
    """Twice the radiance, whose distances would tell of the plain scene."""

    def radiance(self, arr, origin, direction):
        return 2 * super().radiance(arr, origin, direction)


# ---- scenes


def placed_nowhere():
    frame = backend.mitsuba().ScalarTransform4f().translate([math.nan, 0, 0])
    return MitsubaScene({"ball": {"type": "sphere", "to_world": frame, "emitter": area(1.0)}})


def unpainted():
    named = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "face_colour"}}
    return MitsubaScene({"painted": mesh(radiance=named)})


def unlit():
    """Shapes that Mitsuba joins, as they look alike."""
    dull = {"type": "cube", "bsdf": {"type": "diffuse"}}
    return MitsubaScene(
        {"lamp": {"type": "cube", "emitter": area(3.0)}, "table": dull, "chair": dull}
    )


def loaded():
    """A scene of Mitsuba, not yet one of ours."""
    return backend.mitsuba().load_dict({"type": "scene", "wall": SHEET})


def test_a_mesh_of_ones_own_is_looked_at_before_mitsuba_uses_it():
    mi = backend.mitsuba()
    bare = mi.Mesh("own", 4, 2)
    parameters = mi.traverse(bare)
    parameters["vertex_positions"] = mi.Float(with_vertex(math.nan).astype(np.float32).reshape(-1))
    parameters["faces"] = mi.UInt32(FACES.astype(np.uint32).reshape(-1))
    parameters.update()
    with pytest.raises(DomainError, match="mesh 'mine': 1 of 4 vertices are NaN"):
        MitsubaScene({"mine": bare}, emissive=False)


def test_slivers_have_no_albedo_at_their_vertices():
    """Triangles of length 1: 1/300 high they pass, 1/400 high they are refused."""
    mi = backend.mitsuba()
    for high, refused in ((1 / 300, False), (1 / 400, True)):
        albedo = {"type": "mesh_attribute", "name": "vertex_albedo"}
        options = mi.Properties()
        options["mesh_bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": albedo})
        own = mi.Mesh("own", 3, 1, props=options)
        own.add_attribute("vertex_albedo", 3, [0.5] * 9)
        parameters = mi.traverse(own)
        parameters["vertex_positions"] = mi.Float([0, 0, 0, 1, 0, 0, 1, high, 0])
        parameters["faces"] = mi.UInt32([0, 1, 2])
        parameters.update()
        sentence = "mesh 'mine': 1 of its faces are more than 316 times as long as wide"
        with pytest.raises(DomainError, match=sentence) if refused else contextlib.nullcontext():
            MitsubaScene({"mine": own}, emissive=False)


def test_files_are_looked_at_before_they_end_the_process(tmp_path):
    """A triangle in a file of its own."""
    (tmp_path / "part.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0\n3 0 1 9999999\n"
    )
    with pytest.raises(
        DomainError, match="mesh 'part': its faces name vertices 0 to 9999999, but it has 3"
    ):
        MitsubaScene(
            {"part": {"type": "ply", "filename": str(tmp_path / "part.ply"), "emitter": area(1.0)}}
        )
    (tmp_path / "broken.png").write_bytes(b"not a picture")
    with pytest.raises(FileFormatError, match=r"broken\.png cannot be read"):
        textures.photo(tmp_path / "broken.png")


@pytest.mark.parametrize("value", [-2.0, math.nan, math.inf])
def test_radiance_is_finite_and_at_least_0_wherever_it_stands(value):
    bitmap = backend.mitsuba().Bitmap(np.full((4, 8, 3), value, dtype=np.float32))
    rgb = {"type": "rgb", "value": value}
    for light_of in (
        rgb,
        {"type": "bitmap", "bitmap": bitmap, "raw": True},
        {"type": "checkerboard", "color1": rgb},
    ):
        with pytest.raises(DomainError, match=r"radiance of 'wrong': .* negative, NaN or infinite"):
            MitsubaScene(
                {"wrong": {"type": "cube", "emitter": {"type": "area", "radiance": light_of}}}
            )
    for entry in (
        {"type": "constant", "radiance": rgb},
        {"type": "point", "intensity": rgb},
        {"type": "envmap", "bitmap": bitmap},
    ):
        with pytest.raises(DomainError, match=r"radiance of 'wrong': .* negative, NaN or infinite"):
            MitsubaScene({"wrong": entry})
    with pytest.raises(DomainError, match="radiance of 'wrong': face_radiance holds 1 values"):
        MitsubaScene({"wrong": mesh(radiance=(1.0, value))})


def test_black_shapes_are_there_where_black_is_meant():
    black = render.frames(
        CAMERA, MitsubaScene({"wall": {**SHEET, "bsdf": GREY, "emitter": area(0.0)}}), POSES
    )
    assert torch.equal(black, torch.zeros_like(black))


def test_devices_may_be_those_of_torch():
    assert backend.device_name(torch.device("cpu")) == "cpu"
    assert {backend.device_name(name) for name in ("cuda", "cuda:0", torch.device("cuda", 0))} == {
        "cuda"
    }
    if not torch.cuda.is_available():
        with pytest.raises(BackendError, match="torch sees no CUDA device"):
            MitsubaScene({}, "cuda:0")


# ---- poses


def test_numpy_arrays_and_lists_are_poses_too():
    for tell in (
        lambda poses: render.frames(CAMERA, PLANE, poses),
        lambda poses: render.true_flow(CAMERA, PLANE, poses)[0],
        lambda poses: torch.cat(list(render.frame_chunks(CAMERA, PLANE, poses, 1))),
        lambda poses: render.camera_velocity(poses, [0.0, 1.0])[0],
        lambda poses: render.view(CAMERA, PLANE, poses, 1).points_world_m,
        lambda poses: render.psf_frames(CAMERA, PLANE, poses),
    ):
        for given in (
            POSES.numpy(),
            POSES.tolist(),
            list(POSES),
            [POSES[0].numpy(), POSES[1].numpy()],
        ):
            assert torch.equal(tell(given), tell(POSES))
    assert as_poses(np.eye(4, dtype=np.float32)).dtype == torch.float64


def test_a_list_of_tensors_keeps_their_gradient():
    poses = [pose.clone().requires_grad_() for pose in POSES]
    weight = torch.arange(32.0, dtype=D).reshape(2, 4, 4)
    found = torch.autograd.grad((as_poses(poses) * weight).sum(), poses)
    assert torch.equal(torch.stack(found), weight)


SEVERAL = STILL.repeat(3, 1, 1, 1)


# ---- cameras, frames, truth


def film(*windows):
    return Camera(PINHOLE, 4, 4, 0.1, film=Film(10, 10, 4, 4, 0.1, windows))


def too_many():
    line = torch.zeros(1, 3).expand(2**31, 3)
    return render.shade(Rays(line, line, line[:, 0]), PLANE, POSES, 1)


def differences_to_an_object():
    asks = STILL.clone().requires_grad_(True)
    return render.frames(CAMERA, moving(asks), STILL, gradient="difference")


def test_more_frames_than_memory_holds_are_refused(monkeypatch):
    monkeypatch.setattr("codesign.render.wavefront.memory_bytes", lambda: 48 * 100 * 8 - 1)
    render.frames(CAMERA, PLANE, POSES[:1].expand(99, 4, 4))  # 48 rays each, float64
    with pytest.raises(DomainError, match=r"4.8e\+03 rays .* render fewer frames at a time"):
        render.frames(CAMERA, PLANE, POSES[:1].expand(100, 4, 4))
    window = Film(200_000, 200_000, 8, 8, 0.001, ((99_996, 99_996),))
    assert Camera(PINHOLE, 8, 8, 0.001, 1, film=window).rays().weight.numel() == 64


# ---- time


def jumping():
    def path(t):
        twist = torch.zeros(len(t), 6, dtype=D)
        twist[:, 0] = torch.where(t > 0.5, 0.5, 0.0)
        return ABOVE @ se3_exp(twist)

    return render.adaptive_times(CAMERA, PLANE, path, 0.0, 1.0, 0.5)


def half_a_turn():
    return se3_exp(f64([[0.0] * 6, [0, 0, 0, 0, 3.1, 0]]))


# ---- light and point spread functions

COPIES = {
    "group": {"type": "shapegroup", "one": SHEET},
    "a": {"type": "instance", "of": {"type": "ref", "id": "group"}},
}


def baked(**surface):
    return light.bake({"a": {**SHEET, **surface}})


def covered():
    """A sheet less than the height above it from which it would be looked at."""
    place = backend.mitsuba().ScalarTransform4f()
    sheets = {"a": place.scale(0.5), "b": place.translate([0, 0, 4.5e-5])}
    return light.bake(
        {n: {**SHEET, "to_world": at, "bsdf": GREY} for n, at in sheets.items()}, samples=1
    )


class Glow:
    """A scene that does not say how far away its light comes from."""

    dtype = D

    def radiance(self, arr, origin, direction):
        return arr.Float(1)


def hollow():
    front, back = lens.load("la1509").to_surfaces()
    ring = dataclasses.replace(front, inner_semi_aperture_mm=2.0)
    return Camera(lens.GeoLens([ring, back], 20.0), 48, 40, 0.001)


@functools.cache
def psf():
    return render.psf_map(THIN, nearest_m=1.0)


def changed_after_its_map():
    optics = lens.load("cooke-triplet").scaled(0.2).focus_at(2.0)
    camera = Camera(optics, 48, 40, 0.02)
    psf = render.psf_map(camera, nearest_m=1.0)
    with torch.no_grad():
        optics.curvature_per_mm *= 1.001
    return camera, PLANE, POSES, psf


def test_light_that_is_traced_has_no_gradient():
    efl = torch.tensor(6.0, dtype=D, requires_grad=True)
    lamp = light.PathScene({"lamp": {"type": "cube", "emitter": area(1.0)}}, samples=1)
    frames = render.frames(Camera(lens.Pinhole(efl), 4, 3, 0.6, 2), lamp, POSES[:1])
    assert frames.detach().max() > 0
    with pytest.raises(CodesignError, match="PathScene has no gradient"):
        frames.sum().backward()


@refusals.table(__file__)
def test_what_cannot_be_gets_a_sentence(row):
    row.holds(vars(test_own_lens) | globals())
