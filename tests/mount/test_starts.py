"""Starts are spread over what is allowed, and what is hopeless is told before a search."""

import math

import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.errors import DomainError
from codesign.mount import Body, CableSide, Clearance, Housing, LookAhead, Mount, check_mount, judge, starts
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
    # the pose of numbers up to 3 lies within tanh 4.5 of the wall: its inverse loses cosh^2 4.5 = 2000 times eps
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


def test_a_natural_step_moves_the_image_alike_in_position_and_turn(rover, camera):
    """From a start far from the scene: a metre across counts f / depth pixels, a radian f pixels."""
    mount = Mount((0.0, 0.0, 0.4), (0.4, 0.4, 0.4))
    mount.numbers.detach().copy_(starts(mount, 1, reach_rad=0.0)[0])
    mount.variables(camera, 5.0)
    focal_px = 3.4 / 0.2
    slope = mount.half_range_m * (1 - torch.tanh(mount.unit * mount.numbers.detach())[:3].square()[:3])[:3]
    per_metre = 1 / (mount.unit[1:3] * slope[1:3])
    # y and z of the body are across the view
    torch.testing.assert_close(per_metre, torch.full((2,), focal_px / 5.0, dtype=D), rtol=1e-6, atol=0)
    # a turn about the camera's y axis moves a pixel at slope s by f (1 + s^2) in x, at least f
    assert focal_px <= float(1 / mount.unit[4]) <= 1.6 * focal_px


def test_a_good_mount_passes(rover, camera):
    check_mount(rover_mount(), [Clearance(rover, Housing(0.03)), LookAhead(2.0, share=0.2)], camera)


@pytest.mark.parametrize(
    ("box", "sentence"),
    [
        (((0.0, 0.0, 0.17), (0.05, 0.05, 0.02)), "has no room for the camera"),  # inside the chassis
        (((2.0, 0.0, 0.3), (0.1, 0.1, 0.1)), "1.62 m away from the robot"),  # wheel: hypot(1.62, 0.07, 0.1)
        (((200.0, 0.0, 450.0), (100.0, 100.0, 100.0)), "in metres"),  # in millimetres
    ],
)
def test_boxes_inside_and_outside_of_the_robot_get_a_sentence(rover, camera, box, sentence):
    with pytest.raises(DomainError, match=sentence):
        check_mount(Mount(*box), [Clearance(rover, Housing(0.03))], camera)


def test_a_start_that_keeps_too_little_is_told(rover, camera):
    mount = rover_mount(position_m=(0.09, 0.0, 0.5))  # on the mast
    with pytest.raises(DomainError, match=r"clearance: missed by 0.0\d+ m; look-ahead: missed by"):
        check_mount(mount, [Clearance(rover, Housing(0.03)), LookAhead(9.0, share=0.9)], camera)


def test_an_image_circle_smaller_than_the_sensor_is_told(rover):
    triplet = render.Camera(lens.load("cooke-triplet"), 60, 60, 2.0, 1)
    with pytest.raises(DomainError, match="image circle"):
        check_mount(rover_mount(), [Clearance(rover, Housing(0.03))], triplet)


def test_requirements_that_leave_nothing_are_named(rover, camera):
    wanted = [Clearance(rover, Housing(0.03)), CableSide((-1, 0, 0.4), 1.5)]
    with pytest.raises(DomainError, match=r"most, \d+%, fail first at 'cable side'"):
        starts(rover_mount(), 3, wanted, camera, reach_rad=0.2)
    with pytest.raises(DomainError, match="reach_rad is 4"):
        starts(rover_mount(), 3, reach_rad=4.0)
    with pytest.raises(DomainError, match="looks through the camera"):
        starts(rover_mount(), 3, [LookAhead(1.0, 0.5)])
