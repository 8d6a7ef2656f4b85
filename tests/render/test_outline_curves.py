"""Curves as seen from a point: tangency, both lines of a cylinder from end to end, and how far beside the true
outline Mitsuba's float32 rays find it."""

import numpy as np
import pytest
import torch

from codesign import backend
from codesign.errors import DomainError
from codesign.render.charts import emissive_mesh
from codesign.render.silhouettes.curves import DEEPEST, EPS, PARTS, Circles, Cylinders, Segments, Spheres

F64 = torch.float64
EYE = torch.tensor([0.3, -2.0, 0.4], dtype=F64)


def tube(start=(0.0, 0.0, -1.0), end=(0.2, 0.1, 1.0), radius=0.1):
    start, end = (torch.tensor([v], dtype=F64) for v in (start, end))
    return Cylinders.of(start, end, torch.tensor([radius], dtype=F64))


def test_outlines_of_spheres_are_tangent_to_the_view():
    s = torch.linspace(0, 1, 21, dtype=F64)
    ball = Spheres(torch.tensor([[0.1, 0.2, 0.3]], dtype=F64), torch.tensor([0.5], dtype=F64))
    y = ball.points(torch.zeros(21, dtype=torch.long), s, EYE.expand(21, 3))
    outward = y - ball.centre
    torch.testing.assert_close(outward.norm(dim=1), torch.full((21,), 0.5, dtype=F64))
    torch.testing.assert_close((outward * (y - EYE)).sum(1), torch.zeros(21, dtype=F64), rtol=0, atol=1e-12)


def test_outlines_of_cylinders_are_two_tangent_lines_from_end_to_end():
    """Ends of pieces included: each line runs through its parts without a jump, and its ends lie over those of
    the axis."""
    pole = tube()
    index, bounds = pole.pieces(EYE, 0.01)
    axis = torch.nn.functional.normalize((pole.end[-1] - pole.start[0])[None], dim=1)[0]
    sides = []
    for side in (1.0, -1.0):
        mine = pole.side[index] == side
        ends = torch.stack([pole.points(index[mine], bounds[mine, k], EYE) for k in (0, 1)], 1)
        torch.testing.assert_close(ends[1:, 0], ends[:-1, 1], rtol=0, atol=1e-12)
        outward = ends.reshape(-1, 3) - pole.start[0]
        outward = outward - (outward @ axis)[:, None] * axis
        torch.testing.assert_close(outward.norm(dim=1), torch.full((len(outward),), 0.1, dtype=F64))
        across = (outward * (ends.reshape(-1, 3) - EYE)).sum(1)
        torch.testing.assert_close(across, torch.zeros_like(across), rtol=0, atol=1e-12)
        for end, centre in ((ends[0, 0], pole.start[0]), (ends[-1, 1], pole.end[-1])):
            assert float((end - centre) @ axis) == pytest.approx(0, abs=1e-12)
        sides.append(outward[0])
    assert float(torch.linalg.cross(sides[0], sides[1]).norm()) > 1e-4  # two lines
    assert len(index) >= 2 * PARTS


@pytest.mark.parametrize("eye", [(0.05, 0.02, 0.3), (0.0, 0.05, -7.0)])
def test_from_within_its_radius_a_cylinder_has_no_tangent(eye):
    """Inside the tube, and before its open end."""
    pole = tube((0.0, 0.0, -1.0), (0.0, 0.0, 1.0))
    assert pole.pieces(torch.tensor(eye, dtype=F64), 0.01)[0].numel() == 0
    ball = Spheres(torch.zeros(1, 3, dtype=F64), torch.tensor([0.5], dtype=F64))
    assert ball.pieces(torch.tensor([0.1, 0.2, 0.3], dtype=F64), 0.01)[0].numel() == 0


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
@pytest.mark.parametrize(
    ("ratio", "offset_m"), [(5, 0), (20, 100), (250, 1), (600, 0), (600, 100), (2000, 1)]
)
def test_float32_rays_find_the_edge_within_the_reading_angle(kind, ratio, offset_m):
    """By bisection for 96 views: the law is 2^-23 d / r, a reading at twice that lies outside the error, and
    inside the shape."""
    rng = np.random.default_rng(7)
    worst = 0.0
    for _ in range(3):
        shape, curve, eyes, along, aside, true = _views(kind, ratio, offset_m, rng, 32)
        low, high = np.full(len(eyes), 0.2) * true, 2 * true
        for _ in range(26):
            middle = (low + high) / 2
            hit = _hits(shape, eyes, np.cos(middle)[:, None] * along + np.sin(middle)[:, None] * aside)
            low, high = np.where(hit, middle, low), np.where(hit, high, middle)
        error = np.abs(low - true)
        reading = torch.stack([curve.aside_rad(torch.zeros(1).long(), torch.tensor(eye)) for eye in eyes])
        reading = reading[:, 0].numpy()
        assert (error < reading).all()
        assert (reading <= DEEPEST * true * (1 + 1e-9)).all()
        worst = max(worst, error.max())
    coordinates = 2 * offset_m / (ratio * 0.1)
    assert (
        0.2 * EPS * ratio < worst < EPS * (1.2 * ratio + 2 * coordinates)
    )  # so the law is neither 0 nor loose


def _views(kind, ratio, offset_m, rng, count):
    """A shape of radius 0.1 m seen across from ``ratio`` radii: Mitsuba scene, curve, eyes, directions to the
    middle and aside, and the true angle of its outline."""
    mi = backend.mitsuba()
    T = mi.ScalarTransform4f
    centre = rng.standard_normal(3)
    centre *= offset_m / np.linalg.norm(centre)
    axis = _units(rng, 1)[0]
    where = T().translate(list(centre)) @ T().look_at([0, 0, 0], list(axis), list(_units(rng, 1)[0]))
    shape = {"type": kind, "to_world": where @ T().scale([0.1, 0.1, 0.1])}
    if kind == "cylinder":
        shape["to_world"] = where @ T().translate([0, 0, -1]) @ T().scale([0.1, 0.1, 2.0])
    scene = mi.load_dict({"type": "scene", "shape": shape})
    matrix = np.array(mi.traverse(scene.shapes()[0])["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    radius = np.linalg.norm(matrix[:3, 0])
    axis = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    start = matrix[:3, 3]
    out = _units(rng, count)
    if kind == "cylinder":
        start = start + 1.0 * axis
        out -= (out @ axis)[:, None] * axis
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        curve = Cylinders(
            *(torch.tensor((start + s * axis)[None]) for s in (-1.0, 1.0)),
            torch.tensor([radius]),
            torch.ones(1),
        )
    else:
        curve = Spheres(torch.tensor(start[None]), torch.tensor([radius]))
    eyes = np.float32(start + ratio * radius * out).astype(np.float64)
    along = start - eyes
    if kind == "cylinder":
        along -= (along @ axis)[:, None] * axis
    distance = np.linalg.norm(along, axis=1)
    along /= distance[:, None]
    aside = np.cross(along, axis if kind == "cylinder" else _units(rng, count))
    return (
        scene,
        curve,
        eyes,
        along,
        aside / np.linalg.norm(aside, axis=1, keepdims=True),
        np.arcsin(radius / distance),
    )


def _units(rng, count):
    v = rng.standard_normal((count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def _hits(scene, origin, direction):
    mi = backend.mitsuba()

    def column(v):
        return [mi.Float(np.ascontiguousarray(c, dtype=np.float32)) for c in v.T]

    return np.array(scene.ray_test(mi.Ray3f(mi.Point3f(*column(origin)), mi.Vector3f(*column(direction)))))


@pytest.mark.parametrize("ratio", [2500.0, 1e4])
def test_what_float32_rays_cannot_find_is_refused(ratio):
    eye = torch.tensor([ratio * 1e-3, 0.0, 0.0], dtype=F64)
    ball = Spheres(torch.zeros(1, 3, dtype=F64), torch.tensor([1e-3], dtype=F64))
    pole = tube((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), 1e-3)
    for curve in (ball, pole):
        index, _ = curve.pieces(eye, 0.01)  # listed, since nothing says yet that it is seen
        with pytest.raises(DomainError, match=r"of radius 0.001 m near .* too far for float32 rays"):
            curve.aside_rad(index, eye)


@pytest.mark.parametrize(
    ("offset_m", "distance_m", "size_m"), [(0, 1, 0.1), (3, 1, 1), (0, 0.1, 3), (100, 1, 1)]
)
def test_float32_rays_find_straight_edges_within_the_reading_angle(offset_m, distance_m, size_m):
    """By bisection, from viewpoints that float32 does not hold, at points anywhere on an edge of a triangle."""
    mi = backend.mitsuba()
    rng = np.random.default_rng(4)
    always = torch.ones(1, dtype=torch.bool)
    for _ in range(4):
        corners = np.float32(offset_m * _units(rng, 1) + size_m * _units(rng, 3)).astype(np.float64)
        mesh = emissive_mesh(mi, corners, np.array([[0, 1, 2]]), np.ones(1))
        scene = mi.load_dict({"type": "scene", "triangle": mesh})
        start, end = torch.tensor(corners[:1]), torch.tensor(corners[1:2])
        none = torch.zeros(1, 2, 3, dtype=F64)
        curve = Segments(start, end, none, always, torch.zeros(1, dtype=F64), none)
        place = corners[0] + rng.uniform(0.1, 0.9, (64, 1)) * (corners[1] - corners[0])
        eyes = place + distance_m * _units(rng, 64)
        along = (place - eyes) / distance_m
        aside = np.cross(along, corners[1] - corners[0])
        aside *= (np.sign(((corners[2] - eyes) * aside).sum(1)) / np.linalg.norm(aside, axis=1))[:, None]
        low, high = np.full(64, -1e-3), np.full(64, 1e-3)
        fair = _hits(scene, eyes, along + 1e-3 * aside) & ~_hits(scene, eyes, along - 1e-3 * aside)
        for _ in range(26):
            middle = (low + high) / 2
            hit = _hits(scene, eyes, along + middle[:, None] * aside)
            low, high = np.where(hit, low, middle), np.where(hit, middle, high)
        reading = [float(curve.aside_rad(torch.zeros(1).long(), torch.tensor(eye))) for eye in eyes]
        assert fair.mean() > 0.5
        assert (np.abs(low) < np.array(reading))[fair].all()


@pytest.mark.parametrize("eye", [(0.3, 0.4, 0.9), (3.0, 0.4, 1e-3), (0.5, 0.2, 1e-4), (0.0, 0.0, 2.0)])
def test_no_piece_of_a_rim_turns_back(eye):
    """A piece that went out and came back would look short: seen from the viewpoint, no piece bends by more than a
    quarter turn, however nearly edge-on, and together they are the whole rim."""
    rim = Circles(
        *(torch.tensor([v], dtype=F64) for v in ((0.1, 0.0, 0.0), (0.2, 0.1, 0.0), (-0.15, 0.3, 0.0))),
        torch.zeros(1, 3, dtype=F64),
        torch.zeros(1),
    )
    eye = torch.tensor(eye, dtype=F64)
    index, bounds = rim.pieces(eye, 0.01)
    assert float((bounds[:, 1] - bounds[:, 0]).sum()) == pytest.approx(1, abs=1e-12)
    s = bounds[:, :1] + torch.linspace(0, 1, 41, dtype=F64) * (bounds[:, 1:] - bounds[:, :1])
    y = rim.points(index[:, None].expand(s.shape).reshape(-1), s.reshape(-1), eye).reshape(*s.shape, 3)
    seen = torch.nn.functional.normalize(y - eye, dim=2)
    length = (seen[:, 1:] - seen[:, :-1]).norm(dim=2).sum(1)
    assert float(((seen[:, -1] - seen[:, 0]).norm(dim=1) / length).min()) > 0.7


@pytest.mark.parametrize(
    "towards", [(0.2, 1.5, 0.2), (0.0, 1.0, 0.0), (1.0, 1.0, 1.0), (0.0, 0.0, -1.0), (-2.0, 0.3, 0.3)]
)
def test_a_place_on_a_sphere_has_one_name_from_all_points_of_a_pupil(towards, generator):
    """A pupil of 2 mm before a ball of 0.3 m: the same parameters are the same places, to some millimetres."""
    eye = torch.tensor([0.3, -0.2, 0.1], dtype=F64)
    ball = Spheres((eye + torch.tensor(towards, dtype=F64))[None], torch.tensor([0.3], dtype=F64))
    index, s = ball.pieces(eye, 0.1)
    middle = s.mean(1)
    seen = ball.points(index, middle, eye)
    for _ in range(20):
        aside = 2e-3 * (torch.rand(len(index), 3, generator=generator, dtype=F64) - 0.5)
        assert float((ball.points(index, middle, eye + aside) - seen).norm(dim=1).max()) < 4e-3
