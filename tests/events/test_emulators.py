"""The two baselines: the seed's sigmoid and the naive frame difference."""

import math

import torch

from codesign.events import naive, soft


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
