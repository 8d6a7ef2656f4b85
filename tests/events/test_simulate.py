"""The hard sensor against closed forms, published emulators, and the statistics of its noise."""

import json
import math

import numpy as np
import pytest
import torch

from codesign.events import (
    SensorModel,
    draw_shot_counts,
    draw_thresholds,
    lin_log,
    memory,
    simulate,
    to_counts,
)
from codesign.events.stream import ordered


def intensity(level):
    """Frames whose lin-log level is ``level`` (>= 3)."""
    return level.exp()


def reference(path, t_s):
    """A recorded stream and the counts per pixel and frame."""
    data = np.load(path)
    t_us = torch.from_numpy(np.round(data["t"].astype(np.float64) * 1e6).astype(np.int64))
    x, y, p = (torch.from_numpy(data[name].astype(np.int64)) for name in "xyp")
    height, width = data["base_log_frame"].shape
    stream = ordered(t_us, x, y, p, height, width)
    return data, stream, to_counts(stream, t_s)


@pytest.mark.parametrize("offset_s", [0.0, 1_700_000_000.0])
def test_a_ramp_of_log_intensity_fires_at_known_microseconds(offset_s):
    # level rises by 1 per 0.1 s from 3: crossing j at 0.02 j s; falls by 0.5 in the next 0.1 s from 4:
    # reference 4, crossing j at 0.1 + 0.05 j
    level = torch.tensor([3.0, 4.0 + 1e-9, 3.5 - 1e-9], dtype=torch.float64)[:, None, None].expand(3, 1, 2)
    events = simulate(
        intensity(level), torch.tensor([0, 0.1, 0.2], dtype=torch.float64) + offset_s, SensorModel(0.2, 0.25)
    )
    truth = [20_000, 40_000, 60_000, 80_000, 100_000, 150_000, 200_000]
    for column in (0, 1):
        mine = events.x == column
        # an epoch time in float64 seconds is exact to 0.24 us
        assert (events.t_us[mine] - int(offset_s * 1e6) - torch.tensor(truth)).abs().max() <= (
            1 if offset_s else 0
        )
        assert events.p[mine].tolist() == [1] * 5 + [-1] * 2
    assert events.t_us.dtype == torch.int64


@pytest.mark.bits
@pytest.mark.parametrize("sequence", ["edge", "grating", "flicker"])
@pytest.mark.parametrize("configuration", ["ideal", "asym"])
def test_counts_equal_v2e_in_every_pixel_and_frame(shared, sequence, configuration):
    frames = np.load(shared(f"refs/events/seq_{sequence}.npz"))
    frames, t_s = torch.from_numpy(frames["frames"]), torch.from_numpy(frames["t"])
    data, stream, truth = reference(shared(f"refs/events/v2e_{sequence}_{configuration}.npz"), t_s)
    given = json.loads(str(data["params"]))
    thetas = given["pos_thres"], given["neg_thres"]
    # v2e rounds the double-precision log level to 1e-8 and goes on in single precision
    counts, memorised = memory(((lin_log(frames) * 1e8).round() / 1e8).float(), *thetas, log_input=True)
    assert torch.equal(counts, truth)
    assert counts.sum((1, 2, 3)).tolist() == data["per_frame"][1:].tolist()
    assert torch.equal(memorised[0], torch.from_numpy(data["base_log_frame"]))
    events = simulate(frames.float(), t_s, SensorModel(*thetas))
    assert len(events) == len(stream)
    assert torch.equal(to_counts(events, t_s), truth)
    # in double precision a level that meets a threshold to 1e-7 may count a frame later: a handful of events
    # in 1e5
    moved = to_counts(simulate(frames, t_s, SensorModel(*thetas)), t_s) - truth
    assert moved.cumsum(0).abs().max() <= 1
    assert int((moved != 0).sum()) <= 1e-4 * len(stream)


@pytest.mark.bits
def test_hard_counts_are_those_of_the_memory_layer_with_the_same_mismatch():
    frames = torch.rand(12, 7, 6, generator=torch.Generator().manual_seed(1)) * 255
    t_s = torch.arange(12, dtype=torch.float64) / 240
    sensor = SensorModel(0.2, 0.3, theta_sigma=0.06)
    thetas = draw_thresholds(sensor, (7, 6), torch.Generator().manual_seed(9))
    events = simulate(frames, t_s, sensor, torch.Generator().manual_seed(9))
    assert torch.equal(to_counts(events, t_s), memory(frames, *thetas)[0])


def test_order_is_by_time_row_column_polarity():
    frames = torch.rand(6, 5, 4, generator=torch.Generator().manual_seed(2)) * 255
    events = simulate(frames, torch.arange(6) * 1e-5, SensorModel(0.1, 0.1))  # 10 us frames: many ties
    keys = list(zip(*(getattr(events, name).tolist() for name in ("t_us", "y", "x", "p")), strict=True))
    assert keys == sorted(keys)
    assert len(set(events.t_us.tolist())) < len(keys)


def test_thresholds_follow_a_clamped_normal_distribution():
    sensor = SensorModel(0.2, 0.1, theta_sigma=0.05)
    on, off = (
        theta.double() for theta in draw_thresholds(sensor, (500, 400), torch.Generator().manual_seed(3))
    )
    # 200000 draws: standard error of the mean 1.1e-4, of the deviation 8e-5; five of them allowed
    assert abs(on.mean() - 0.2) < 5.6e-4
    assert abs(on.std() - 0.05) < 4e-4
    below = 0.5 * math.erfc((0.1 - 0.01) / 0.05 / math.sqrt(2))  # share clamped at 0.01: 3.6 %
    assert abs(float((off == torch.tensor(0.01).double()).double().mean()) - below) < 5 * math.sqrt(
        below / 200_000
    )
    assert float(off.min()) == pytest.approx(0.01)
    assert abs(float(((on - on.mean()) * (off - off.mean())).mean())) < 5 * 0.05**2 / math.sqrt(200_000)
    again = draw_thresholds(sensor, (500, 400), torch.Generator().manual_seed(3))
    assert torch.equal(again[0].double(), on)


def test_drawn_shot_counts_are_poisson_per_pixel_and_polarity():
    sensor = SensorModel(shot_rate_hz=40.0)
    interval_s = torch.tensor([0.01, 0.03, 0.05])
    counts = draw_shot_counts(
        sensor, (200, 250), interval_s, torch.Generator().manual_seed(4), dtype=torch.float64
    )
    for k, expected in enumerate((0.2, 0.6, 1.0)):  # 20 Hz per polarity
        for polarity in (0, 1):
            found = counts[k, polarity]
            assert abs(found.mean() - expected) < 5 * math.sqrt(expected / 50_000)
            # variance of the sample variance of a Poisson count: (m + 2 m^2)/n
            assert abs(found.var() - expected) < 5 * math.sqrt((expected + 2 * expected**2) / 50_000)


def test_single_precision_keeps_the_times_of_long_ramps():
    """Each event once rounded the memorised level alike: microseconds too early or late after some dozens."""
    generator = torch.Generator().manual_seed(0)
    speed = (5 + 5 * torch.rand(40, dtype=torch.float64, generator=generator)) * torch.tensor(
        [1.0, -1.0]
    ).repeat(20)
    t_s = torch.arange(31, dtype=torch.float64) / 60
    frames = intensity(7.5 + speed * (t_s[:, None] - 0.25)).float()[:, None]
    events = simulate(frames, t_s, SensorModel(0.05, 0.05))
    levels = np.log(frames[:, 0].double().numpy())  # of the frames as they are, in double precision
    for x in range(40):
        gone = np.abs(levels[:, x] - levels[0, x])
        truth_us = np.interp(0.05 * np.arange(1, int(gone[-1] / 0.05) + 1), gone, t_s.numpy()) * 1e6
        # half a microsecond of rounding, and half a last digit of two levels below 16 at 5 per second: 0.2 us
        assert np.abs(events.t_us[events.x == x].numpy() - truth_us).max() < 0.75


def test_a_leak_below_the_last_digit_of_a_level_still_leaks():
    # 10 thresholds of 0.001 per second, 1e-7 per frame: half of what single precision tells at a level of 5.3
    frames = torch.full((25_001, 1, 1), 200.0)
    events = simulate(
        frames, torch.arange(25_001, dtype=torch.float64) / 1e5, SensorModel(1e-3, 1e-3, leak_rate_hz=10.0)
    )
    assert events.p.tolist() == [1, 1]
    assert (
        np.abs(events.t_us.numpy() - np.array([100_000, 200_000])).max() <= 20
    )  # a last digit of the level: 48 us
