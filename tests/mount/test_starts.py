"""Starts are spread over what is allowed, and what is hopeless is told before a search."""

import math

import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.mount import Body, CableSide, Clearance, Housing, LookAhead, Mount, judge, starts
from scenes import robots

D = torch.float64


@pytest.fixture(scope="module")
def rover():
    return Body.of(robots.from_urdf(robots.ROVER).parts, without=["camera_link"])


@pytest.fixture(scope="module")
def camera():
    return render.Camera(lens.Pinhole(3.4), 24, 16, 0.2, 1)


def rover_mount(**more):
    return Mount((0.15, 0.0, 0.45), (0.15, 0.1, 0.15), pitch_rad=0.4, **more)


def test_numbers_give_their_poses_back(generator):
    mount = rover_mount()
    numbers = torch.randn(40, 6, generator=generator, dtype=D)
    mount.unit[:] = torch.rand(6, generator=generator, dtype=D) + 0.5
    # the pose of numbers up to 3 lies within tanh 4.5 of the wall: its inverse loses cosh^2 4.5 = 2000 times
    # eps
    torch.testing.assert_close(mount.numbers_at(mount(numbers)), numbers, rtol=0, atol=1e-11)


def test_starts_fill_box_and_directions_evenly():
    mount = rover_mount()
    poses = mount(starts(mount, 256, reach_rad=1.2, roll_rad=0.5, seed=3)).detach()
    offset = (poses[:, :3, 3] - mount.nominal_m) / mount.half_range_m
    # the mean cosine of a cap of angle a is (1 + cos a) / 2, and its height is spread evenly
    cosine = poses[:, :3, 2] @ mount.start_attitude[:, 2]
    assert float(cosine.min()) >= math.cos(1.2) - 1e-12
    for column, low, high in (*((offset[:, k], -0.9, 0.9) for k in range(3)), (cosine, math.cos(1.2), 1.0)):
        placed = np.sort(((column - low) / (high - low)).numpy())
        # one of the scrambled points in each interval of 1 / 256: exactly even
        assert np.floor(256 * placed.clip(0, 1 - 1e-12)).tolist() == list(range(256))
    again = mount(starts(mount, 256, reach_rad=1.2, roll_rad=0.5, seed=3)).detach()
    other = mount(starts(mount, 256, reach_rad=1.2, roll_rad=0.5, seed=4)).detach()
    assert torch.equal(again, poses)
    assert not torch.equal(other, poses)


def test_starts_without_roll_keep_their_rows_level_to_the_start():
    mount = Mount((0.0, 0.0, 1.0), (0.1, 0.1, 0.1))
    poses = mount(starts(mount, 64, reach_rad=0.3)).detach()
    # a tilt by b leaves the image's x axis within b^2 / 2 of the body's right-hand side up and down
    assert float(poses[:, 2, 0].abs().max()) <= 0.3**2 / 2 + 1e-9


def test_starts_keep_what_is_required(rover, camera):
    mount = rover_mount()
    wanted = [
        Clearance(rover, Housing(0.03), margin_m=0.01),
        CableSide((0, 0, 1), 0.6),
        LookAhead(3.0, share=0.2),
    ]
    poses = mount(starts(mount, 12, wanted, camera, reach_rad=math.pi, roll_rad=math.pi)).detach()
    for pose in poses:
        assert all(verdict.kept for verdict in judge(wanted, pose, camera))


def test_global_random_numbers_stay_as_they_are():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    starts(rover_mount(), 4)
    assert torch.equal(torch.rand(3), expected)
