"""Objectives in task units: the true flow has no angular error, also of moving objects; a miss has
the angle it has."""

import math

import pytest
import torch

from codesign import lens, pose, render
from codesign.errors import DomainError
from codesign.system.objectives import angular_error_mrad, edge_energy, edge_objective
from codesign.types import EventVolume, FlowField
from scenes import textures, trajectories, worlds

PITCH_MM = 0.05
EFL_MM = 8.0


@pytest.fixture(scope="module")
def wall():
    return worlds.wall(textures.speckle(1, size_px=64), texel_m=0.02)


def camera(film=None):
    size = (film.width_px, film.height_px) if film else (32, 32)
    return render.Camera(lens.Pinhole(EFL_MM), *size, PITCH_MM, 1, film=film)


def drives():
    t_s = torch.linspace(0, 0.05, 3, dtype=torch.float64)
    start = pose.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0))
    return torch.stack(
        [trajectories.translation(start, v, t_s) for v in ((0.6, 0.1, 0.0), (-0.3, 0.5, 0.2))]
    )


def field_of(flow_px, valid):
    return FlowField(flow_px, valid, 0.05)


def test_the_true_flow_has_no_error_and_a_pixel_of_miss_has_the_angle_of_a_pixel(wall):
    poses = drives()
    flow, valid = render.true_flow(camera(), wall, poses[:, [0, -1]])
    flow = flow[:, 0]
    exact = angular_error_mrad(field_of(flow, valid[:, 0]), camera(), wall, poses)
    assert exact.shape == (2,)
    assert float(exact.max()) < 2e-3  # a float32 hit, and 1e-6 rad instead of zero
    missed = flow + torch.tensor([1.0, 0.0])[:, None, None]
    found = angular_error_mrad(field_of(missed, valid[:, 0]), camera(), wall, poses, every_px=1)
    # a pixel is PITCH / EFL rad at the axis, and less by cos^2 along the radius towards the border
    pixel_mrad = 1e3 * PITCH_MM / EFL_MM
    border = math.cos(math.atan(16 * math.sqrt(2) * PITCH_MM / EFL_MM)) ** 2
    assert bool(((found < pixel_mrad) & (found > border * pixel_mrad)).all())


def test_windows_and_scenes_are_samples_in_order(wall):
    film = render.Film(64, 48, 16, 16, PITCH_MM, ((0, 0), (48, 32)))
    poses = drives()
    behind = camera(film)
    flow, valid = render.true_flow(behind, wall, poses[:, [0, -1]])
    samples = flow[:, 0].movedim(2, 1).flatten(0, 1)  # [trajectories x windows, 2, H, W]
    samples = samples + torch.tensor([0.0, 1.0, 2.0, 3.0])[:, None, None, None]
    valid = valid[:, 0].flatten(0, 1)
    found = angular_error_mrad(field_of(samples, valid), behind, wall, poses)
    assert bool((found.diff() > 0).all())
    twice = angular_error_mrad(field_of(samples, valid), behind, (wall, wall), poses[:, None])
    torch.testing.assert_close(twice, found)


def test_points_move_with_their_object(wall):
    t_s = torch.linspace(0, 0.05, 3, dtype=torch.float64)
    still = pose.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0)).expand(3, 4, 4)
    shift = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    shift[:, 0, 3] = 0.8 * t_s
    scene = render.MovingScene(worlds.blank_room(size_m=(8.0, 8.0, 8.0)), {"wall": (wall, shift)})
    poses = still
    flow, valid = render.true_flow(camera(), scene, poses, stride=2)
    assert float(flow[0].abs().max()) > 1.0  # the object moves by pixels
    error = angular_error_mrad(field_of(flow, valid), camera(), scene, poses)
    assert float(error) < 2e-3


def test_a_sample_that_sees_nothing_is_refused(wall):
    away = pose.look_at((0.0, -2.0, 0.0), (0.0, -4.0, 0.0)).expand(2, 4, 4)
    nothing = field_of(torch.zeros(1, 2, 32, 32), torch.ones(1, 32, 32, dtype=torch.bool))
    with pytest.raises(DomainError, match="sees no surface at any pixel"):
        angular_error_mrad(nothing, camera(), wall, away)


def test_edge_energy_of_a_step_is_that_of_the_sobel_filter():
    counts = torch.zeros(1, 2, 1, 8, 8)
    counts[:, 0, :, :, 4:] = 3.0  # a step of 3 events between columns 3 and 4
    volume = EventVolume(counts, torch.zeros(1), torch.ones(1))
    # normalised Sobel: half of the central difference, 3 / 2, at the two columns beside the step,
    # of eight columns
    assert float(edge_energy(volume)) == pytest.approx((1.5**2) * 2 / 8, rel=1e-6)
    activity = float(volume.counts.sum(1).mean())
    assert float(edge_objective(volume, 0.1)) == pytest.approx(0.1 * activity - 0.5625, rel=1e-6)
