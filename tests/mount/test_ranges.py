"""Shares of bounds to mounts and back: against rotations written by hand, differences, and bad
bounds."""

import math

import pytest
import torch

from codesign.mount import Mount, MountRanges
from codesign.pose import check_poses
from tests.numbers import close, f64, rand64

LOW = (0.1, -0.2, 0.3, -2.0, -1.4, -3.0)
HIGH = (0.3, 0.1, 0.7, 3.0, 1.5, 3.0)


def changed(bounds, k, value):
    return tuple(value if i == k else each for i, each in enumerate(bounds))


def test_directions_of_known_angles(generator):
    """Columns of the rotation: the view by its azimuth and elevation, the image's right level
    before it rolls."""
    share = rand64(generator, 3, 7, 6)
    poses = MountRanges(LOW, HIGH).pose(share)
    check_poses(poses)
    low, high = f64([LOW, HIGH])
    numbers = low.lerp(high, share)
    close(poses[..., :3, 3], numbers[..., :3], atol=1e-15)
    yaw, pitch, roll = numbers[..., 3:].unbind(-1)
    view = torch.stack([yaw.cos() * pitch.cos(), yaw.sin() * pitch.cos(), -pitch.sin()], -1)
    level = torch.stack([yaw.sin(), -yaw.cos(), torch.zeros_like(yaw)], -1)
    right = level * roll.cos()[..., None] + torch.linalg.cross(view, level) * roll.sin()[..., None]
    down = torch.linalg.cross(view, right)
    for column, expected in enumerate((right, down, view)):
        close(poses[..., :3, column], expected, atol=1e-14)


# the second looks backwards: yaw around pi, where its arc tangent changes sign
@pytest.mark.parametrize(
    "ends", [(LOW, HIGH), (changed(LOW, 3, math.pi - 1), changed(HIGH, 3, math.pi + 1))]
)
def test_shares_are_read_back(ends, generator):
    ranges = MountRanges(*ends)
    share = rand64(generator, 50, 6)
    # angles near the pole (1.5 of pi / 2) lose 1 / cos 1.5 = 14 times eps
    close(ranges.share_at(ranges.pose(share)), share, atol=1e-13)


def test_a_held_number_stays_and_has_the_middle_share(generator):
    ranges = MountRanges(LOW, changed(changed(HIGH, 1, LOW[1]), 4, LOW[4]))
    share = rand64(generator, 9, 6)
    numbers = ranges.numbers(share)
    assert numbers[:, [1, 4]].unique(dim=0).tolist() == [[LOW[1], LOW[4]]]
    middle = changed(changed(tuple(share.T), 1, torch.full((9,), 0.5)), 4, torch.full((9,), 0.5))
    expected = torch.stack([each.double() for each in middle], 1)
    close(ranges.share_at(ranges.pose(share)), expected, atol=1e-13)
    close(ranges.clamped(share), expected)


def test_bounds_are_met_exactly_and_shares_beyond_are_clamped():
    ranges = MountRanges(LOW, HIGH)
    ends = ranges.numbers(f64([[0.0], [1.0]]).expand(2, 6))
    assert ends.tolist() == [list(LOW), list(HIGH)]
    beyond = ranges.clamped(f64([-0.1, 0.0, 0.3, 1.0, 1.1, 7.0]))
    assert beyond.tolist() == [0.0, 0.0, 0.3, 1.0, 1.0, 1.0]


def test_gradient_against_differences(generator):
    ranges = MountRanges(LOW, changed(HIGH, 1, LOW[1]))
    share = rand64(generator, 2, 3, 6).requires_grad_()
    assert torch.autograd.gradcheck(ranges.pose, (share,), atol=1e-8)
    (slope,) = torch.autograd.grad(ranges.pose(share)[..., 1, 3].sum(), share)
    assert slope[..., 1].tolist() == [[0.0] * 3] * 2, "what is held is not learned"


def test_the_same_attitude_as_a_mount():
    ranges = MountRanges((0.2, 0, 0, 0.3, -0.4, 0.5), (0.2, 0, 0, 0.3, -0.4, 0.5))
    mount = Mount((0.2, 0.0, 0.0), (0.0, 0.0, 0.0), yaw_rad=0.3, pitch_rad=-0.4, roll_rad=0.5)
    close(ranges.pose(torch.rand(6)), mount().detach())
