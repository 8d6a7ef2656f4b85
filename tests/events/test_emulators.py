"""The two baselines: the seed's sigmoid and the naive frame difference."""

import math

import pytest
import torch

from codesign.errors import DomainError
from codesign.events import lin_log, naive, soft


def test_sigmoid_fires_half_at_the_threshold_and_ghosts_without_change():
    level = torch.tensor([0.0, 0.0, 0.2, 0.0, 2.0], dtype=torch.float64)[:, None]
    counts = soft(level, 0.2, log_input=True)[:, :, 0]
    ghost = 1 / (1 + math.exp(5))
    miss = 1 / (1 + math.exp(10))
    assert abs(ghost - 0.0067) < 1e-4
    truth = [
        [ghost, ghost],
        [0.5, miss],
        [miss, 0.5],
        [1 / (1 + math.exp(-45)), math.exp(-55) / (1 + math.exp(-55))],
    ]
    torch.testing.assert_close(counts, torch.tensor(truth, dtype=torch.float64), rtol=1e-12, atol=0)


def test_sigmoid_sharpness_and_gradient():
    frames = (
        torch.rand(4, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 200 + 21
    ).requires_grad_()
    theta = torch.tensor([0.2, 0.3], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(soft, (frames, theta))
    assert torch.equal(soft(frames, 0.25), soft(frames, 0.25, sharpness=20.0))
    for sharpness in (0, -1.0, math.nan, math.inf):
        with pytest.raises(DomainError, match="sharpness"):
            soft(frames, 0.2, sharpness=sharpness)


def test_frame_difference_caps_at_one_and_forgets():
    # per pixel: a slow ramp (never seen), one step of 1.1 (one event), exactly -theta (one event), below
    # -theta
    level = torch.tensor(
        [[[0.0, 0.0, 0.0, 0.0]], [[0.15, 1.1, -0.25, -0.24]], [[0.3, 1.1, -0.5, -0.48]]], dtype=torch.float64
    )
    events = naive(level, [0.0, 0.01, 0.02], 0.25, log_input=True)
    assert (events.height_px, events.width_px) == (1, 4)
    rows = torch.stack((events.t_us, events.x, events.y, events.p), dim=1).tolist()
    assert rows == [[10_000, 1, 0, 1], [10_000, 2, 0, -1], [20_000, 2, 0, -1]]


def test_frame_difference_against_a_plain_loop():
    frames = torch.rand(6, 5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 255
    t_s = torch.linspace(2, 3, 6, dtype=torch.float64)
    level = lin_log(frames)
    truth = []
    for k in range(1, 6):
        for y in range(5):
            for x in range(4):
                change = float(level[k, y, x] - level[k - 1, y, x])
                if abs(change) >= 0.3:
                    truth.append((2_000_000 + 200_000 * k, y, x, 1 if change > 0 else -1))
    events = naive(frames, t_s, 0.3)
    assert list(zip(*(v.tolist() for v in (events.t_us, events.y, events.x, events.p)), strict=True)) == truth
