"""Training windows of sensors that all differ: layers that bend, against what is seen where they lead; and
how many events come, against what was asked for."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import grid_sample

from scenes.flow_bends import STEEPEST, Bent, displacement, pace
from scenes.flow_sensors import Sensors, SensorWindows
from scenes.flow_windows import LEAD, Draws

QUIET = Sensors(
    duration_s=(1e-3, 1e-3),
    mismatch=(1e-3, 2e-3),
    cutoff_hz=(1e6, 1e7),
    shot_rate_hz=(1e-6, 1e-5),
    leak_rate_hz=(1e-6, 1e-5),
    refractory_s=(1e-9, 1e-8),
    hot_share=0.0,
    pace=0.0,
)
"""Next to ideal sensors."""


def points(height, width):
    y, x = np.mgrid[:height, :width]
    return torch.from_numpy(np.stack([x - (width - 1) / 2, y - (height - 1) / 2], -1)).float()


def bent(seed=0, rms_px=3.0):
    draw = np.random.default_rng(seed)
    homographies = torch.eye(3).repeat(3, 1, 1)
    homographies[1:, 0, 2] = torch.tensor([1.0, 2.0])
    homographies[2, 0, 1] = 0.03
    field = displacement(draw, 48, 40, rms_px)
    return Bent(homographies, field, torch.tensor([0.0, 0.5, 1.0]))


def test_a_bent_layer_shows_at_the_end_what_it_showed_at_the_start():
    """The texture seen at ``end(q)`` at the last time is that of q: to the fixed point's 0.25^12 of a few px."""
    layer = bent()
    start = points(40, 48)
    end = layer.end(start)
    assert float((end - start).norm(dim=-1).mean()) > 2.0
    seen = layer.texels(torch.eye(3), end)[-1].movedim(0, -1)
    torch.testing.assert_close(seen, start, rtol=0, atol=1e-4)


def test_a_bent_layer_begins_flat():
    start = points(40, 48)
    torch.testing.assert_close(bent().texels(torch.eye(3), start)[0].movedim(0, -1), start, rtol=0, atol=1e-5)


def test_displacements_have_the_length_asked_for_unless_they_were_steep():
    field = displacement(np.random.default_rng(1), 64, 64, 0.5)
    assert float(field.square().sum(0).mean().sqrt()) == pytest.approx(0.5, rel=1e-5)
    steep = displacement(np.random.default_rng(1), 64, 64, 1e3)
    assert max(float(steep.diff(dim=axis).abs().max()) for axis in (1, 2)) == pytest.approx(
        STEEPEST, rel=1e-4
    )


def test_pace_keeps_both_ends_and_changes_speed_by_no_more_than_asked():
    """d/dt of swing sin(2 pi f t + phase) is at most 2 pi f swing <= most; the line that keeps the ends adds
    as much."""
    t = np.linspace(0, 1, 401)
    for seed in range(20):
        found = pace(np.random.default_rng(seed), t, 0.3)
        assert found[[0, -1]] == pytest.approx([0.0, 1.0], abs=1e-12)
        assert np.abs(np.diff(found) * 400 - 1).max() <= 0.6
    assert pace(np.random.default_rng(0), t, 0.0) == pytest.approx(t, abs=1e-12)


def test_flow_leads_to_the_same_brightness():
    """One bending plane without noise: the end frame read at q + flow(q) is the start frame, up to bilinear
    reading of a texture blurred by 1.3 px."""
    draws = Draws("fine", layers=(0, 0), flow_px=(2.0, 5.0), scale=(0.7, 0.9), blur_px=(1.3, 1.3))
    windows = SensorWindows(draws, replace(QUIET, bend=0.4), seed=3).batch(range(6))
    flow = windows.truth.flow_px
    x = torch.arange(64.0)
    at = torch.stack([x + flow[:, 0], x[:, None] + flow[:, 1]], -1)
    read = grid_sample(windows.frames[:, 1:], (2 * at + 1) / 64 - 1, align_corners=False)[:, 0]
    inside = ((at > 0) & (at < 63)).all(-1)
    start = windows.frames[:, 0]
    left = (read - start)[inside].square().mean()
    moved = (windows.frames[:, 1] - start)[inside].square().mean()
    assert float(left) < 0.01 * float(moved)


@pytest.mark.parametrize(("asked", "expected"), [(0.4, 0.4**2 / 2), (3.0, 3.0 - 0.5)])
def test_memorised_levels_start_as_after_a_long_time(asked, expected):
    """All pixels brighten by ``asked`` thresholds. From a triangular start D between the thresholds, the mean
    of floor(asked + D) is asked^2 / 2 below one threshold and asked - 1/2 from one on. Standard error of
    16,384 pixels: 0.002 and 0.004."""
    source = SensorWindows(Draws("fine"), replace(QUIET, density=(asked, asked), imbalance=(1.0, 1.0 + 1e-9)))
    ramp = torch.linspace(0, 1, source.intervals + 1)
    frames = torch.cat([torch.zeros(LEAD), ramp]).mul(2.0).exp()[:, None, None].expand(-1, 128, 128)
    counts = source._events(np.random.default_rng(4), frames)
    assert float(counts[:, 0].sum()) / 128**2 == pytest.approx(expected, abs=0.015)
    assert not bool(counts[:, 1].any())


@pytest.mark.bits
def test_a_sample_is_the_same_in_any_batch():
    source = SensorWindows(Draws(layers=(0, 2)), Sensors(bend=0.4), seed=8, height_px=32, width_px=40)
    together = source.batch([3, 4])
    alone = source.batch([4])
    assert torch.equal(together.truth.flow_px[1:], alone.truth.flow_px)
    torch.testing.assert_close(together.volume.counts[1:], alone.volume.counts, rtol=1e-5, atol=1e-6)
    assert not torch.equal(together.volume.counts[0], together.volume.counts[1])


def test_noise_is_a_share_of_the_scene_at_most():
    """Still scenes with the noisiest sensors: no more events than half of what contrast was set for, plus
    leaks and hot pixels."""
    sensors = Sensors(
        density=(0.2, 0.2), shot_rate_hz=(1e3, 1e3), leak_rate_hz=(1e-3, 2e-3), hot_share=0.0, pace=0.0
    )
    draws = Draws("fine", "similarity", (0, 0), (0.0, 0.0))
    counts = SensorWindows(draws, sensors, seed=6).batch(range(8)).volume.counts
    assert 0.01 < float(counts.sum() / (8 * 64 * 64)) < 0.5 * 0.2 * 1.1
