"""Starts are spread over what is allowed."""

import torch

from codesign.mount import (
    CableSide,
    Clearance,
    Housing,
    LookAhead,
    Mount,
    MountRanges,
    judge,
    starts,
)
from tests.numbers import D, close, rand64, randn64

RANGES = MountRanges((0.0, -0.1, 0.3, -3.0, -1.5, -3.0), (0.3, 0.1, 0.6, 3.0, 1.5, 3.0))


def test_numbers_give_their_poses_back(generator):
    mount = Mount((0.15, 0.0, 0.45), (0.15, 0.1, 0.15), pitch_rad=0.4)
    numbers = randn64(generator, 40, 6)
    mount.unit[:] = rand64(generator, 6) + 0.5
    # the pose of numbers up to 3 lies within tanh 4.5 of the wall: its inverse loses cosh^2 4.5 =
    # 2000 times eps
    close(mount.numbers_at(mount(numbers)), numbers, atol=1e-11)


def test_starts_fill_the_inner_bounds_and_keep_what_is_required(rover, camera):
    wanted = [
        Clearance(rover, Housing(0.03), margin_m=0.01),
        CableSide((0, 0, 1), 0.6),
        LookAhead(3.0, share=0.2),
    ]
    free, allowed = starts(RANGES, 256, seed=3), starts(RANGES, 12, wanted, camera, seed=3)
    # 256 even numbers leave a hundredth at either end with a probability of 0.99^256 = 8 % each:
    # five hundredths
    assert 0.05 <= free.min() < 0.06 < 0.94 < free.max() <= 0.95
    close(free.mean(0), torch.full((6,), 0.5, dtype=D), atol=5 * 0.26 / 16)
    for pose in RANGES.pose(allowed):
        assert all(verdict.kept for verdict in judge(wanted, pose, camera))
    assert torch.equal(starts(RANGES, 256, seed=3), free)
    assert not torch.equal(starts(RANGES, 256, seed=4), free)


def test_the_seed_left_out_is_0_as_everywhere():
    assert torch.equal(starts(RANGES, 4), starts(RANGES, 4, seed=0))


def test_global_random_numbers_stay_as_they_are():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    starts(RANGES, 4)
    assert torch.equal(torch.rand(3), expected)
