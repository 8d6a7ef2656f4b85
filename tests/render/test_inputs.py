"""What a stranger gives wrongly is one sentence: what was given, what is allowed, what to do."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.errors import BackendError, CodesignError, DomainError, ShapeError
from codesign.pose import as_poses, look_at
from codesign.render import Camera, Film, MitsubaScene, light
from codesign.render.charts import emissive_mesh
from scenes import worlds

SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]])
FACES = np.array([[0, 1, 2], [2, 1, 3]])
PLANE = render.TexturedPlane([[0.7, 0.3]], [0.4], [0.2])
POSES = look_at((0.1, -0.2, 2.0), (0.0, 0.1, 0.0), down=(0, -1, 0)).repeat(2, 1, 1)
PINHOLE = lens.Pinhole(8.0)
CAMERA = Camera(PINHOLE, 6, 4, 0.5, 2)
# any argument may be given to these
make: Any = Camera
show: Any = render
lit: Any = light


def area(value):
    return {"type": "area", "radiance": {"type": "rgb", "value": value}}


def picture(value):
    bitmap = backend.mitsuba().Bitmap(np.full((2, 2, 1), value, dtype=np.float32))
    return {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}


def mesh(vertices=SQUARE, faces=FACES, radiance=(5.0, 5.0)):
    return emissive_mesh(backend.mitsuba(), vertices, faces, np.array(radiance))


def cube(**surface):
    return {"type": "cube", **surface}


# ---- meshes


def with_vertex(value):
    vertices = SQUARE.copy()
    vertices[3, 1] = value
    return vertices


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_vertex_that_is_not_finite_is_refused_with_its_number(value):
    with pytest.raises(DomainError, match=r"1 of 4 vertices are NaN or infinite \(first number 3\)"):
        mesh(with_vertex(value))


def test_a_mesh_of_ones_own_is_looked_at_before_mitsuba_uses_it():
    mi = backend.mitsuba()
    bare = mi.Mesh("own", 4, 2)
    parameters = mi.traverse(bare)
    parameters["vertex_positions"] = mi.Float(with_vertex(math.nan).astype(np.float32).reshape(-1))
    parameters["faces"] = mi.UInt32(FACES.astype(np.uint32).reshape(-1))
    parameters.update()
    with pytest.raises(DomainError, match="mesh 'mine': 1 of 4 vertices are NaN"):
        MitsubaScene({"mine": bare}, emissive=False)


@pytest.mark.parametrize("faces", [[[0, 1, 4]], [[0, 1, -1]], [[0, 1, 10**9]]])
def test_faces_of_vertices_that_are_not_there_are_refused(faces):
    with pytest.raises(DomainError, match="but it has 4, counted from 0; repair the faces"):
        mesh(faces=np.array(faces), radiance=[1.0])


def test_a_file_whose_faces_leave_its_vertices_is_refused_before_it_ends_the_process(tmp_path):
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path = tmp_path / "broken.ply"
    path.write_text(header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 9999999\n")
    with pytest.raises(DomainError, match="mesh 'part': its faces name vertices 0 to 9999999, but it has 3"):
        MitsubaScene({"part": {"type": "ply", "filename": str(path), "emitter": area(1.0)}})
    path.write_text(header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    assert MitsubaScene({"part": {"type": "ply", "filename": str(path), "emitter": area(1.0)}}).scene


def test_a_mesh_without_faces_and_values_of_another_length_are_refused():
    with pytest.raises(ShapeError, match=r"its faces are \(0, 3\); give at least one"):
        mesh(faces=np.zeros((0, 3), dtype=int), radiance=[])
    with pytest.raises(ShapeError, match="3 values of radiance per face for 2"):
        mesh(radiance=[1.0, 2.0, 3.0])
    with pytest.raises(ShapeError, match="1 values of texture coordinates for 4"):
        emissive_mesh(backend.mitsuba(), SQUARE, FACES, area(1.0), uv=np.zeros((1, 2)))


def test_a_shape_placed_nowhere_is_refused():
    frame = backend.mitsuba().ScalarTransform4f().translate([math.nan, 0, 0])
    with pytest.raises(DomainError, match="shape 'ball': its place or size is NaN or infinite"):
        MitsubaScene({"ball": {"type": "sphere", "to_world": frame, "emitter": area(1.0)}})


# ---- light


@pytest.mark.parametrize("value", [-2.0, math.nan, math.inf])
def test_radiance_is_finite_and_at_least_0_wherever_it_stands(value):
    mi = backend.mitsuba()
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), value, dtype=np.float32))}
    checks = {"type": "checkerboard", "color1": {"type": "rgb", "value": value}}
    for entry in (
        cube(emitter=area(value)),
        cube(emitter=picture(value)),
        cube(emitter={"type": "area", "radiance": checks}),
        {"type": "constant", "radiance": {"type": "rgb", "value": value}},
        {"type": "point", "intensity": {"type": "rgb", "value": value}},
        sky,
    ):
        with pytest.raises(DomainError, match=r"radiance of 'wrong': .* negative, NaN or infinite"):
            MitsubaScene({"wrong": entry})
    with pytest.raises(DomainError, match="radiance of 'wrong': face_radiance holds 1 values"):
        MitsubaScene({"wrong": mesh(radiance=(1.0, value))})


def test_a_mesh_that_names_an_attribute_it_lacks_is_refused():
    named = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "face_colour"}}
    with pytest.raises(DomainError, match="'painted': the mesh has no attribute 'face_colour'"):
        MitsubaScene({"painted": emissive_mesh(backend.mitsuba(), SQUARE, FACES, named)})


def test_a_shape_without_emitter_is_refused_by_its_name_though_mitsuba_joins_meshes():
    grey = {"type": "diffuse"}
    shapes = {"lamp": cube(emitter=area(3.0)), "table": cube(bsdf=grey), "chair": cube(bsdf=grey)}
    with pytest.raises(DomainError, match=r"shape '(table|chair)', '(table|chair)' has no emitter"):
        MitsubaScene(shapes)
    with pytest.raises(DomainError, match="and 2 more has no emitter"):
        MitsubaScene({f"leg {k}": cube(bsdf=grey) for k in range(5)})


def test_black_shapes_are_there_where_black_is_meant_or_light_is_worked_out():
    wall = {
        "type": "rectangle",
        "to_world": backend.mitsuba().ScalarTransform4f().scale(4.0),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
    }
    black = render.frames(CAMERA, MitsubaScene({"wall": {**wall, "emitter": area(0.0)}}), POSES)
    assert torch.equal(black, torch.zeros_like(black))
    lit = {"wall": wall, "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 8.0}}}
    for scene in (light.PathScene(lit, samples=256), light.bake(lit, texel_m=1.0, samples=64)):
        # a white furnace: albedo times the sky's radiance; at least 4096 paths of a standard deviation of about
        # 1, five standard errors
        assert float(render.frames(CAMERA, scene, POSES).mean()) == pytest.approx(0.5 * 8.0, abs=5 / 64)


# ---- devices


@pytest.mark.parametrize("device", ["gpu", "CPU", "cuda:1", "mps", "", None])
def test_an_unknown_device_is_refused_wherever_one_is_taken(device):
    for build in (
        lambda: MitsubaScene({}, device),
        lambda: light.PathScene({}, device),
        lambda: light.bake({}, device),
        lambda: worlds.room(device=device),
        lambda: worlds.outdoor(device=device),
        lambda: backend.arrays(device),
        lambda: backend.variant(device),
    ):
        with pytest.raises(DomainError, match="is not known here; choose 'cpu' or 'cuda'"):
            build()


def test_devices_may_be_those_of_torch():
    assert backend.device_name(torch.device("cpu")) == "cpu"
    assert {backend.device_name(name) for name in ("cuda", "cuda:0", torch.device("cuda", 0))} == {"cuda"}
    if not torch.cuda.is_available():
        with pytest.raises(BackendError, match="torch sees no CUDA device"):
            MitsubaScene({}, "cuda:0")


# ---- poses


def test_numpy_arrays_and_lists_are_poses_too():
    expected = render.frames(CAMERA, PLANE, POSES)
    for given in (POSES.numpy(), POSES.tolist(), list(POSES), [POSES[0].numpy(), POSES[1].numpy()]):
        assert torch.equal(render.frames(CAMERA, PLANE, given), expected)
        assert torch.equal(
            render.true_flow(CAMERA, PLANE, given)[0], render.true_flow(CAMERA, PLANE, POSES)[0]
        )
        assert torch.equal(torch.cat(list(render.frame_chunks(CAMERA, PLANE, given, 1))), expected)
        assert torch.equal(render.camera_velocity(given, [0.0, 1.0])[0], torch.zeros(1, 6).double())
        assert render.view(CAMERA, PLANE, given, 1).valid.all()
        assert render.psf_frames(CAMERA, PLANE, given).shape == expected.shape
    assert as_poses(np.eye(4, dtype=np.float32)).dtype == torch.float64


def test_a_list_of_tensors_keeps_their_gradient():
    poses = [POSES[k].clone().requires_grad_() for k in range(2)]
    whole = POSES.clone().requires_grad_()
    weight = torch.linspace(-1, 1, 48).reshape(2, 4, 6)
    parts = torch.autograd.grad((render.frames(CAMERA, PLANE, poses) * weight).sum(), poses)
    (expected,) = torch.autograd.grad((render.frames(CAMERA, PLANE, whole) * weight).sum(), whole)
    assert float(expected.abs().max()) > 0
    assert torch.equal(torch.stack(parts), expected)


@pytest.mark.parametrize(
    ("poses", "kind", "sentence"),
    [
        (POSES.half(), DomainError, "poses are torch.float16; give float32 or float64"),
        (POSES.to(torch.int64), DomainError, "poses are torch.int64"),
        (POSES.to(torch.complex128), DomainError, "poses are torch.complex128"),
        (POSES.numpy().astype(complex), DomainError, "poses are a ndarray that holds no real numbers"),
        ([[1.0, 2.0], [3.0]], DomainError, "poses are a list that holds no real numbers"),
        (None, DomainError, "poses are a NoneType that holds no real numbers"),
        ("turntable", DomainError, "poses are a str"),
        ((pose for pose in POSES), DomainError, "poses are a generator"),
        ([POSES[0], POSES[0, :3]], ShapeError, r"a list of tensors \[\(3, 4\), \(4, 4\)\]"),
        (POSES[0], ShapeError, r"got \(4, 4\); for one pose give pose\[None\]"),
        (POSES[:, :3], ShapeError, r"got \(2, 3, 4\)"),
        (POSES[:0], ShapeError, r"T >= 1"),
        ([], ShapeError, r"T >= 1"),
        (torch.tensor(1.0), ShapeError, r"got \(\)"),
        (POSES * torch.tensor([1, 1, -1, 1.0]), DomainError, "determinant -1"),
        (POSES * 1.1, DomainError, "not rigid"),
        (POSES.numpy() * math.nan, DomainError, "32 of 32 values are NaN"),
        (POSES.to("meta"), DomainError, "poses are on meta, the rays of the camera on cpu"),
    ],
)
def test_poses_that_are_none_are_refused(poses, kind, sentence):
    with pytest.raises(kind, match=sentence):
        render.frames(CAMERA, PLANE, poses)


# ---- scenes and cameras


@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        (
            {"ball": {"type": "sphere"}},
            r"the scene is a dict, .* render.MitsubaScene\(description\) builds one",
        ),
        (None, "the scene is a NoneType, .* give a MitsubaScene"),
        ("room", "the scene is a str"),
        (np.ones((4, 4)), "the scene is a ndarray"),
        ((PLANE for _ in range(2)), "the scene is a generator, .* or a list of them"),
        (render.TexturedPlane, r"make one, as by TexturedPlane\(...\)"),
    ],
)
def test_what_is_no_scene_is_refused(scene, sentence):
    for call in (
        lambda: render.frames(CAMERA, scene, POSES),
        lambda: render.true_flow(CAMERA, scene, POSES),
        lambda: render.check_view(CAMERA, scene, POSES),
        lambda: render.MovingScene(PLANE, {"thing": (scene, POSES)}),
    ):
        with pytest.raises(DomainError, match=sentence):
            call()


def test_a_mitsuba_scene_is_not_yet_one_of_ours():
    mi = backend.mitsuba()
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle"}})
    with pytest.raises(DomainError, match=r"the scene is a Scene, .* worlds.from_mitsuba\(scene\)"):
        render.frames(CAMERA, scene, POSES)
    with pytest.raises(DomainError, match="'wall' has no emitter"):
        MitsubaScene(scene)
    with pytest.raises(DomainError, match=r"got a str; .* worlds.from_mitsuba"):
        show.MitsubaScene("scene.xml")


def test_a_film_beyond_memory_is_refused_before_anything_is_allocated():
    with pytest.raises(
        DomainError, match=r"6.4e\+11 rays per frame, at least 5.25e\+04 GiB; this machine has"
    ):
        Camera(lens.Pinhole(8.0), 200_000, 200_000, 0.001)
    window = Film(200_000, 200_000, 8, 8, 0.001, ((99_996, 99_996),))
    assert Camera(lens.Pinhole(8.0), 8, 8, 0.001, 1, film=window).rays().weight.numel() == 64


def test_more_frames_than_memory_holds_are_refused(monkeypatch):
    monkeypatch.setattr("codesign.render.wavefront.memory_bytes", lambda: 48 * 100 * 8 - 1)
    render.frames(CAMERA, PLANE, POSES[:1].expand(99, 4, 4))  # 48 rays each, float64
    with pytest.raises(DomainError, match=r"4.8e\+03 rays .* render fewer frames at a time"):
        render.frames(CAMERA, PLANE, POSES[:1].expand(100, 4, 4))


@pytest.mark.parametrize("per_px", [0, -1, math.nan, math.inf, "2", None])
def test_samples_per_length_of_silhouette_are_positive_and_finite(per_px):
    with pytest.raises(DomainError, match="per_px = "):
        render.frames(CAMERA, worlds.blank_room(), POSES, gradient="boundary", per_px=per_px)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: make(None, 8, 8, 0.1), "a NoneType has no camera_rays"),
        (lambda: make(lens.Pinhole, 8, 8, 0.1), "so it is no lens"),
        (lambda: make(PINHOLE, "8", 8, 0.1), "sensor_width_px = '8' is no number"),
        (lambda: make(PINHOLE, 8, 8, "0.1"), "pixel_pitch_mm = '0.1' is no number"),
        (lambda: make(PINHOLE, 8, 8, 0.1, 1.5), "samples_per_pixel = 1.5 must be a whole number"),
        (lambda: make(PINHOLE, 8, 8, 0.1, math.inf), "samples_per_pixel = inf must be a whole number"),
        (lambda: make(PINHOLE, 8, 8, 0.1, 1, math.nan), "seed = nan must be a whole number"),
        (lambda: make(PINHOLE, 8, 8, 0.1, 1, 2**70), "seed = .* must be a whole number between"),
        (lambda: make(PINHOLE, 8, 8, 0.1, film=3), "a int is no film; give a render.Film"),
        (lambda: make(PINHOLE, 8, 8, 0.1, spectrum="d"), "a str is no spectrum; give a lens.Spectrum"),
        (
            lambda: make(PINHOLE, 8, 8, 0.1, film=show.Film(9, 9, 8, 8, 0.1, ((0,),))),
            r"window \(0,\) is no pair",
        ),
        (lambda: show.frames(PINHOLE, PLANE, POSES), "the camera is a Pinhole; give a render.Camera"),
        (lambda: show.frames(CAMERA, PLANE, POSES, rays=3), "a int was given as rays"),
        (lambda: show.view(CAMERA, PLANE, POSES, "0"), "frame = '0' is no number"),
        (lambda: show.check_view(CAMERA, PLANE, POSES, 0), "every_px = 0 must be a whole number"),
        (lambda: show.shade(CAMERA.rays(), PLANE, POSES, "2"), "samples_per_pixel = '2' is no number"),
        (lambda: show.frame_chunks(CAMERA, PLANE, POSES, "1"), "frames_per_chunk = '1' is no number"),
        (
            lambda: show.project(CAMERA, torch.ones(3, 2)),
            r"points to project are \[..., N, 3\], got \(3, 2\)",
        ),
        (lambda: show.MovingScene(PLANE, {"a": PLANE}), "objects are a dictionary"),
        (lambda: show.MovingScene(PLANE, [(PLANE, POSES)]), "objects are a dictionary"),
        (lambda: show.TexturedPlane("a", [1.0], [0.0]), "frequency_per_m holds no numbers"),
        (lambda: show.TexturedPlane([[1, 1]], [1.0], [0.0], mean="x"), "mean = 'x' is no number"),
        (lambda: lit.PathScene({}, samples="2"), "samples per ray = '2' is no number"),
        (lambda: lit.PathScene({}, max_depth=None), "max_depth = None is no number"),
        (lambda: lit.PathScene({}, seed=2**40), "seed = .* must be a whole number between"),
    ],
)
def test_other_things_given_wrongly(call, sentence):
    with pytest.raises(CodesignError, match=sentence):
        call()
