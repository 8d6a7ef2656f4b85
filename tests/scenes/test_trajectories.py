"""Camera paths: what they promise about place, view, speed and period."""

import math

import pytest
import torch

from codesign.errors import DomainError
from codesign.pose import check_poses, look_at
from scenes import trajectories

D = torch.float64


@pytest.fixture
def start():
    return look_at((0.3, -2.0, 1.1), (0.0, 0.0, 1.0))


def test_times_are_uniform_from_zero():
    torch.testing.assert_close(trajectories.times(5, 200.0), torch.tensor([0.0, 0.005, 0.01, 0.015, 0.02], dtype=D), rtol=0, atol=1e-17)


@pytest.mark.parametrize(("count", "rate", "sentence"), [(1, 100.0, "at least 2 frames"), (5, 0.0, "rate_hz = 0.0"), (5, -3.0, "rate_hz = -3.0"), (5, math.nan, "rate_hz = nan")])
def test_too_few_frames_and_impossible_rates_are_refused(count, rate, sentence):
    with pytest.raises(DomainError, match=sentence):
        trajectories.times(count, rate)


def test_translation_has_its_speed_along_the_camera_axes(start):
    t = trajectories.times(11, 50.0)
    path = trajectories.translation(start, (0.5, -0.2, 0.1), t)
    check_poses(path)
    torch.testing.assert_close(path[:, :3, :3], start[:3, :3].expand(11, 3, 3), rtol=0, atol=1e-15)
    velocity = path[:, :3, 3].diff(dim=0) * 50.0
    expected = 0.5 * start[:3, 0] - 0.2 * start[:3, 1] + 0.1 * start[:3, 2]
    torch.testing.assert_close(velocity, expected.expand(10, 3), rtol=0, atol=1e-12)


def test_body_twist_keeps_its_velocity_in_the_camera_and_batches(start):
    t = trajectories.times(9, 100.0)
    twists = torch.tensor([[0.3, 0.0, 0.1, 0.0, 0.5, 0.2], [0.0, 0.1, 0.0, 0.3, 0.0, 0.0]], dtype=D)
    paths = trajectories.body_twist(start, twists, t)
    assert paths.shape == (2, 9, 4, 4)
    for path in paths:
        check_poses(path)
        steps = torch.linalg.inv(path[:-1]) @ path[1:]  # the same small motion from every pose to the next
        torch.testing.assert_close(steps, steps[:1].expand_as(steps), rtol=0, atol=1e-14)
    turn = torch.linalg.inv(paths[0, 0]) @ paths[0, -1]
    angle = math.acos((float(turn[:3, :3].trace()) - 1) / 2)
    assert angle == pytest.approx(0.08 * math.hypot(0.5, 0.2), rel=1e-9)


def test_an_orbit_keeps_its_distance_and_looks_at_the_centre():
    centre, radius, height, rate = (0.5, -0.2, 1.0), 2.0, 0.7, 3.0
    t = trajectories.times(25, 20.0)
    path = trajectories.orbit(centre, radius, height, rate, t, phase_rad=0.4)
    check_poses(path)
    away = torch.tensor(centre, dtype=D) - path[:, :3, 3]
    torch.testing.assert_close(away.norm(dim=1), torch.full((25,), math.hypot(radius, height), dtype=D), rtol=1e-14, atol=0)
    torch.testing.assert_close(path[:, :3, 2], away / away.norm(dim=1, keepdim=True), rtol=0, atol=1e-14)
    torch.testing.assert_close(path[:, 2, 3], torch.full((25,), 1.7, dtype=D), rtol=0, atol=1e-15)
    bearing = torch.atan2(-away[:, 1], -away[:, 0])
    steps = torch.remainder(bearing.diff(), 2 * math.pi)
    torch.testing.assert_close(steps, torch.full((24,), rate / 20, dtype=D), rtol=1e-12, atol=0)
    assert float(bearing[0]) == pytest.approx(0.4)


@pytest.mark.parametrize(("path", "axis"), [(trajectories.radial, 2), (trajectories.vertical, 1)])
def test_oscillations_have_their_amplitude_period_and_axis(path, axis, start):
    amplitude, frequency = 0.05, 4.0
    t = trajectories.times(1001, 1000.0)  # four periods, 250 frames each
    poses = path(start, amplitude, frequency, t)
    check_poses(poses)
    moved = (poses[:, :3, 3] - start[:3, 3]) @ start[:3, :3]  # along the camera's axes
    shift = moved[:, axis]
    assert float(shift.max()) == pytest.approx(amplitude, rel=1e-4)  # the crest lies within half a frame: cos(pi / 250)
    assert float(shift.min()) == pytest.approx(-amplitude, rel=1e-4)
    torch.testing.assert_close(shift[250:], shift[:-250], rtol=0, atol=1e-14)  # the period
    assert float(moved[:, [i for i in range(3) if i != axis]].abs().max()) <= 1e-15
    speed = float((shift[1] - shift[0]) * 1000)
    assert speed == pytest.approx(2 * math.pi * frequency * amplitude, rel=2e-4)  # steepest at the start


def test_an_axis_may_have_any_length_but_zero(start):
    t = trajectories.times(5, 100.0)
    long, short = (trajectories.oscillation(start, axis, 0.1, 3.0, t) for axis in ((3, 0, 4), (0.6, 0.0, 0.8)))
    torch.testing.assert_close(long, short, rtol=0, atol=1e-15)
    with pytest.raises(DomainError, match="axis"):
        trajectories.oscillation(start, (0, 0, 0), 0.1, 3.0, t)
