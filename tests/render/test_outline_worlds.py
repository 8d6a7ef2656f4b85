"""Worlds whose gradient was once wrong without a word: thin poles near and far, a mesh with one
radiance per face, an edge of a floor against two walls. Against closed forms and differences with
common random numbers."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign import backend, lens, pose, render
from codesign.errors import DomainError
from codesign.render import MitsubaScene
from codesign.render.charts import emissive_mesh
from codesign.render.silhouettes import occlusion_check
from codesign.render.silhouettes.curve_points import CurvePoints
from codesign.render.silhouettes.jumps import jumps
from scenes.silhouettes import smooth
from studies.gradient_flow.silhouettes import PITCH_MM, SIZE_PX, STEPS, Task
from tests.hostile import judge
from tests.hostile.outline_cases import icosphere
from tests.numbers import D, f64, rand64, randn64
from tests.render.solids import area

SCALE = f64(STEPS["pose"])


def picture(seed, cycles=6):
    bitmap = backend.mitsuba().Bitmap(smooth(seed, cycles=cycles))
    radiance = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat"}
    return {"type": "area", "radiance": radiance}


def wall():
    place = backend.mitsuba().ScalarTransform4f().translate([0, 2.5, 0.5]).scale([4, 0.1, 4])
    return {"type": "cube", "to_world": place, "emitter": picture(1)}


SKY = {"type": "constant", "radiance": {"type": "rgb", "value": 60.0}}
AHEAD = pose.look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def judged(turn_rad, pitch_mm, nearest_m, **shapes):
    """By differences with common random numbers, through a pinhole of 11 mm that looks along y."""
    turned = AHEAD @ pose.se3_exp(f64([0, 0, 0, 0, 0, turn_rad]))
    scene = MitsubaScene(shapes)
    case = judge.Case(scene, lens.Pinhole(11.0), turned, pitch_mm, 28, nearest_m, 1)
    return judge.judge(case, effort=judge.Effort(seeds=(6,), per_px=16.0))


def loss_of_a_pole(task, start, end, radius, radiance, twist):
    """The task's loss for a bright pole that crosses the picture from top to bottom, before black:
    along every line across the picture the pole lies between two planes through the eye; the
    weights are constant within a pixel."""
    T = (task.pose @ pose.se3_exp(f64(twist)[None]))[0].numpy()
    eye = T[:3, 3]
    axis = (end - start) / np.linalg.norm(end - start)
    towards = eye - start
    towards = towards - (towards @ axis) * axis
    distance = np.linalg.norm(towards)
    out = towards / distance
    share = radius / distance
    middle = (SIZE_PX - 1) / 2
    rows = (np.arange(SIZE_PX * 64) + 0.5) / 64 - 0.5
    slope = (rows - middle) * PITCH_MM / 11.0
    borders = []
    for side in (1, -1):
        normal = T[:3, :3].T @ (share * out + side * math.sqrt(1 - share**2) * np.cross(axis, out))
        borders.append(-(normal[1] * slope + normal[2]) / normal[0] * 11.0 / PITCH_MM + middle)
    edges = np.arange(SIZE_PX + 1) - 0.5
    wide = np.sign(borders[1] - borders[0])
    assert (wide == wide[0]).all()  # the two lines do not cross in the picture
    total = 0.0
    for number, weights in enumerate(task.weight.double().numpy()):
        sums = np.concatenate([[0.0], np.cumsum(weights)])
        first, last = (np.interp(b[64 * number : 64 * number + 64], edges, sums) for b in borders)
        total += (last - first).mean()
    return radiance * wide[0] * total / SIZE_PX**2


@pytest.mark.parametrize("ratio", [20, 250, 1000])
def test_poles_however_thin_and_far(ratio):
    start = np.float32([-0.5, 0.3, -2.0]).astype(np.float64)
    end = np.float32([0.3, 0.4, 4.0]).astype(np.float64)
    radius = 1.5 / ratio
    pole = {
        "type": "cylinder",
        "p0": start.tolist(),
        "p1": end.tolist(),
        "radius": radius,
        "emitter": area(100),
    }
    task = Task(MitsubaScene({"pole": pole}), "pinhole")
    step = 1e-5
    truth = [
        (
            loss_of_a_pole(task, start, end, radius, 100.0, t)
            - loss_of_a_pole(task, start, end, radius, 100.0, -t)
        )
        / (2 * step)
        for t in step * np.eye(6)
    ]
    truth = f64(truth) * SCALE
    # two lines a fraction of a pixel apart, sampled apart: a single estimate is noisy
    whole = (
        torch.stack([task.gradient("pose", 1, seed, "boundary", 32.0) for seed in range(16)])
        * SCALE
    )
    noise = float(whole.std(0).norm() / 4 / truth.norm())
    assert (whole.mean(0) - truth).norm() / truth.norm() < 0.01 + 2 * noise
    assert noise < 0.04


def test_the_outline_of_a_fine_mesh_through_a_wide_pupil():
    """An aperture of 5 mm sees the outline of a ball of 20,480 faces move over edges next to it."""
    vertices, faces = icosphere(5)
    ball = emissive_mesh(
        backend.mitsuba(), 0.3 * vertices + [0, 0.1, 0.9], faces, np.full(len(faces), 200.0)
    )
    task = Task(MitsubaScene({"wall": wall(), "ball": ball}), "thin")
    truth = torch.stack([task.differences("pose", 256, seed) for seed in (11, 12)]) * SCALE
    noise = float((truth[0] - truth[1]).norm() / 2 / truth.mean(0).norm())
    plain, whole = (
        task.gradient("pose", 256, 13, way, 16.0) * SCALE for way in ("interior", "boundary")
    )
    assert (plain - truth.mean(0)).norm() / truth.mean(0).norm() > 0.3
    assert (whole - truth.mean(0)).norm() / truth.mean(0).norm() < 0.03 + 2 * noise
    assert noise < 0.04


def test_lines_without_width_between_faces_are_no_jumps():
    """Rays along the middle row of the film meet edges of a mesh exactly, and may slip through."""
    vertices, faces = icosphere(4)
    ball = emissive_mesh(backend.mitsuba(), 0.5 * vertices + [0, 2, 0], faces, area(200))
    camera = render.Camera(lens.Pinhole(11.0), 32, 32, 0.3575, 4)
    frames = render.frames(
        camera, MitsubaScene({"ball": ball, "sky": SKY}), AHEAD[None], gradient="boundary"
    )
    assert not bool(frames.isnan().any())


@pytest.mark.parametrize("ratio", [5, 100])
def test_a_dark_ball_through_a_mesh_however_far(ratio):
    """A mesh of 320 faces with a black ball of half its radius before its centre, the film narrower
    the further it is. The ball's outline lies just within the mesh and the curve along which the
    two meet just behind the ball, both nearer to what is seen than rays pass beside them."""
    radius, distance = 0.3, 0.3 * ratio
    vertices, faces = icosphere(2)
    ball = {
        "type": "sphere",
        "center": [0.06, distance - 0.24, 0.03],
        "radius": 0.15,
        "emitter": area(0),
    }
    mesh = emissive_mesh(backend.mitsuba(), radius * vertices + [0, distance, 0], faces, area(200))
    found = judged(
        0.3, 22 * radius / distance / 12, distance - radius, mesh=mesh, ball=ball, sky=SKY
    )
    assert found.error < 0.05 + 2 * found.noise
    assert found.noise < 0.05


@pytest.mark.parametrize(
    ("twist", "nearer"),
    [((-6.0, 0, 0, 0, 0, 0), 1), ((0, 0, 0, 0, -0.23, 0), 1), ((-0.3, 0, 0, 0, 0, 0), 20)],
    ids=["6 m aside", "13 degrees of turning", "0.3 m aside of what is near"],
)
def test_a_view_is_looked_at_though_another_was_right(twist, nearer, monkeypatch):
    """A wall at 100 m that alone is seen at first, and a ball that moves through a cube 10 m ahead,
    aside, or as much smaller and nearer. A camera that moves by a thousandth of that is not looked
    through again."""
    T = backend.mitsuba().ScalarTransform4f
    far = T().translate([0, 0, 100.0]).rotate([1, 0, 0], 180).scale(80.0)
    aside = T().scale(1 / nearer).translate([-7.2, 0, 10.0]).rotate([1, 1, 0], 40).scale(0.8)
    static = {
        "wall": {"type": "rectangle", "to_world": far, "emitter": picture(2)},
        "cube": {"type": "cube", "to_world": aside, "emitter": area(200)},
    }
    ball = MitsubaScene({"ball": {"type": "sphere", "radius": 0.55 / nearer, "emitter": area(20)}})
    place = torch.eye(4, dtype=D)[None].clone()
    place[0, :3, 3] = torch.tensor([-6.6, 0.1, 9.3]) / nearer
    world = render.MovingScene(MitsubaScene(static), {"ball": (ball, place)})
    camera = render.Camera(lens.Pinhole(11.0), 32, 32, 0.35, 4)
    looks = []
    listings = occlusion_check.listings
    monkeypatch.setattr(
        occlusion_check, "listings", lambda *given: looks.append(given) or listings(*given)
    )
    for share in (0.0, 1e-3):
        small = pose.se3_exp(share * f64([twist]))
        render.frames(camera, world, small, gradient="boundary")
    assert len(looks) == 1
    other = pose.se3_exp(f64([twist]))
    with pytest.raises(DomainError, match="of the jumps of radiance in frame 0"):
        render.frames(camera, world, other, gradient="boundary")


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "disk", "cube"])
def test_no_surface_is_nearer_than_it_is_said(kind, generator):
    """Against points spread over the shape, from outside and within."""
    centre = f64([0.3, -0.2, 0.5])
    place = (
        backend.mitsuba()
        .ScalarTransform4f()
        .translate(centre.tolist())
        .rotate([0.6, 0.8, 0], 50)
        .scale(0.4)
    )
    scene = MitsubaScene({"thing": {"type": kind, "to_world": place, "emitter": area(1)}})
    at = randn64(generator, 40_000, 2, 3)
    direction = torch.nn.functional.normalize(centre + 0.4 * at[:, 1] - at[:, 0], dim=1)
    point, _, valid = scene.hit(at[:, 0], direction)
    for eye in torch.cat([2 * at[:20, 0], 0.1 * at[20:40, 0] + centre]):
        nearest = float((point[valid] - eye).norm(dim=1).min())
        assert scene.nearest_m(eye) <= nearest * (1 + 1e-5)
        if kind in ("sphere", "cube"):
            assert scene.nearest_m(eye) > nearest - 0.06


def test_an_edge_that_is_seen_end_on_is_no_line_in_the_picture():
    """Of an edge along the optical axis and one across it only the second jumps, upwards at its own
    place."""
    world = f64([[0.0, 0, 5], [0.3, 0.1, 5]])
    ahead = world + f64([[0.0, 0, 0.01], [0, 0.01, 0]])
    one, none = torch.ones(2, dtype=D), torch.zeros(2, dtype=torch.long)
    faces = 1e-4 * one, 1e-4 * one, torch.inf * one, torch.full((2, 2, 3), torch.nan, dtype=D)
    at_px = f64([[16.0, 12.0]] * 2)
    points = CurvePoints(
        world, ahead, one, *faces, at_px, torch.zeros(2, 2, dtype=D), none, none, none, none
    )
    camera = render.Camera(lens.Pinhole(8.0), 33, 25, 0.05)
    scene = render.TexturedPlane([[0.7, 0.3]], [0.4], [0.2])
    found = jumps(camera, scene, torch.eye(4, dtype=D)[None, None], points)
    assert found is not None
    assert found.row.tolist() == [1]
    place = [16 + 0.3 / 5 * 8 / 0.05, 12 + 0.1 / 5 * 8 / 0.05]
    torch.testing.assert_close(found.film_px, f64([place]))
    torch.testing.assert_close(found.normal, f64([[-1.0, 0.0]]))


@pytest.mark.parametrize("eye_m", [0.0, 9.0])
def test_rays_that_meet_a_chord_are_near_its_piece_wherever_the_eye_is(eye_m, generator):
    """Chords 0.2 m long 1 m before the eye, and rays from it to points all along them."""
    eye = f64([0.0, 0.0, eye_m])
    start = rand64(generator, 40, 3) * 0.4 + eye + torch.tensor([0.0, 0.0, 1.0])
    along = 0.2 * torch.nn.functional.normalize(randn64(generator, 40, 3), dim=1)
    curve = SimpleNamespace(points=lambda index, s, eye: start[index] + s[:, None] * along[index])
    piece = torch.arange(40).repeat(9)
    to = (
        curve.points(piece, torch.linspace(0.02, 0.98, 9, dtype=D).repeat_interleave(40), eye) - eye
    )
    distance = to.norm(dim=1)
    bounds = f64([[0.0, 1.0]]).expand(40, 2)
    rays = eye.expand_as(to), to / distance[:, None], distance
    near = occlusion_check._near(curve, torch.arange(40), bounds, eye, *rays, 1e-6)
    assert set(enumerate(piece.tolist())) <= set(zip(*(v.tolist() for v in near), strict=True))
