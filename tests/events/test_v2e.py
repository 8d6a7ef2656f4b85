"""The sensor against the recorded events of v2e itself, and the statistics of its noise for both
timings."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.events import (
    SensorModel,
    SensorState,
    concatenate,
    lin_log,
    memory,
    simulate,
    to_counts,
)
from codesign.events.stream import ordered
from tests.event_streams import rows, same
from tests.numbers import D, close, seeded

STATISTICS = [f"shot5_{case}" for case in ("dn0", "dn20", "dn128", "dn255", "dn128_sig.03")]
STATISTICS += [f"leak1{case}" for case in ("", "_jit0_cov0", "_cov.3", "_sig.03")]


def sensor_of(given, timing):
    leaks = given["leak_rate_hz"] > 0
    return SensorModel(
        given["pos_thres"],
        given["neg_thres"],
        given["sigma_thres"],
        given["cutoff_hz"],
        given["leak_rate_hz"],
        given.get("leak_jitter_fraction", 0.1) if leaks else 0.0,
        given.get("noise_rate_cov_decades", 0.1) if leaks else 0.0,
        given["shot_noise_rate_hz"],
        given["refractory_period_s"],
        timing=timing,
    )


def recorded(shared, sequence, configuration):
    """Frames, times, the recorded stream and its file."""
    file = np.load(shared(f"refs/events/seq_{sequence}.npz"))
    frames, t_s = torch.from_numpy(file["frames"]), torch.from_numpy(file["t"])
    data = np.load(shared(f"refs/events/v2e_{sequence}_{configuration}.npz"))
    t_us = torch.from_numpy(np.round(data["t"].astype(np.float64) * 1e6).astype(np.int64))
    x, y, p = (torch.from_numpy(data[name].astype(np.int64)) for name in "xyp")
    return frames, t_s, ordered(t_us, x, y, p, *frames.shape[1:]), data


@pytest.mark.bits
@pytest.mark.parametrize("sequence", ["edge", "grating", "flicker"])
@pytest.mark.parametrize("configuration", ["ideal", "asym", "cut30", "refr3ms", "leak20_det"])
def test_every_event_of_v2e_to_the_microsecond(shared, sequence, configuration):
    frames, t_s, truth, data = recorded(shared, sequence, configuration)
    sensor = sensor_of(json.loads(str(data["params"])), "v2e")
    state = SensorState()
    parts = [
        simulate(frames[a:b], t_s[a:b], sensor, state=state) for a, b in ((0, 2), (2, 3), (3, 120))
    ]
    assert same(concatenate(parts), truth)
    assert np.array_equal(state.reference.numpy(), data["base_log_frame"])
    assert np.array_equal(state.level.numpy(), data["lp_log_frame"])


@pytest.mark.bits
@pytest.mark.parametrize("sequence", ["edge", "grating", "flicker"])
@pytest.mark.parametrize("configuration", ["ideal", "asym"])
def test_counts_of_the_interpolated_sensor_equal_v2e_in_every_pixel_and_frame(
    shared, sequence, configuration
):
    frames, t_s, stream, data = recorded(shared, sequence, configuration)
    truth = to_counts(stream, t_s)
    given = json.loads(str(data["params"]))
    thetas = given["pos_thres"], given["neg_thres"]
    # v2e rounds the double-precision log level to 1e-8 and goes on in single precision
    level = ((lin_log(frames) * 1e8).round() / 1e8).float()
    counts, memorised = memory(level, *thetas, log_input=True)
    assert torch.equal(counts, truth)
    assert torch.equal(memorised[0], torch.from_numpy(data["base_log_frame"]))
    assert torch.equal(to_counts(simulate(frames.float(), t_s, SensorModel(*thetas)), t_s), truth)
    # in double precision a level that meets a threshold to 1e-7 may count a frame later: a handful
    # of events in 1e5
    moved = to_counts(simulate(frames, t_s, SensorModel(*thetas)), t_s) - truth
    assert moved.cumsum(0).abs().max() <= 1
    assert (moved != 0).sum() <= 1e-4 * len(stream)


# v2e's leaks all begin with the run and give half an event less: test_sensor has our rates
@pytest.mark.parametrize(
    ("timing", "case"),
    [("v2e", case) for case in STATISTICS]
    + [("interpolated", case) for case in STATISTICS if case.startswith("shot")],
)
def test_noise_rates_are_those_of_v2e(shared, timing, case):
    truth = json.loads(shared("refs/events/v2e_stats.json").read_text())[case]
    frames = torch.full((truth["frames"], *truth["shape"]), float(truth["dn"]))
    t_s = torch.arange(truth["frames"], dtype=D) * truth["dt"]
    events = simulate(frames, t_s, sensor_of(truth["params"], timing), seeded(7))
    for polarity, name in ((1, "on"), (-1, "off")):
        pixels = (events.y * 64 + events.x)[events.p == polarity]
        per_pixel = torch.bincount(pixels, minlength=4096).double() / float(t_s[-1])
        # both are samples: their 95 % intervals add as squares; 1.7 of it is passed once in a
        # thousand
        interval = math.hypot(truth[name]["ci95"], 1.96 * float(per_pixel.std()) / 64)
        assert abs(per_pixel.mean() - truth[name]["mean_hz"]) <= 1.7 * interval + 1e-9
        # standard error of a deviation: at most 2 % here (4096 pixels, tails of the log-normal
        # included), of two samples
        assert float(per_pixel.std()) == pytest.approx(truth[name]["pix_std"], rel=0.09, abs=1e-9)


@pytest.mark.parametrize("start_s", [0.0, 1_700_000_000.0])
# beyond 8 s single precision no longer resolves a microsecond
@pytest.mark.parametrize("gap_s", [1e-3, 20.0])
def test_slots_keep_microseconds_at_epoch_times_and_late(start_s, gap_s):
    frames = torch.tensor([50.0, 80.0, 50.0, 120.0])[:, None, None]
    events = simulate(frames, start_s + torch.arange(4, dtype=D) * gap_s, SensorModel(timing="v2e"))
    # ln 1.6 = 0.47: two of 0.2, back by two, then ln 2.4 = 0.875: four
    slots = [
        (k + (i + 1) / n, p) for k, (n, p) in enumerate(((2, 1), (2, -1), (4, 1))) for i in range(n)
    ]
    for (t_us, _, _, p), (slot, sign) in zip(rows(events), slots, strict=True):
        assert abs(t_us - round(start_s * 1e6) - round(slot * gap_s * 1e6)) <= 1
        assert p == sign


def test_a_noise_event_of_either_polarity_resets_the_memorised_level():
    # a rise of 0.15 below the threshold of 0.2: whatever fires is noise, and where nothing fires
    # the memorised level stays where it was
    frames = torch.tensor([80.0, 80.0 * math.exp(0.15)])[:, None, None].expand(2, 40, 50)
    state = SensorState()
    sensor = SensorModel(shot_rate_hz=1.0, timing="v2e")
    events = simulate(frames, [0.0, 0.8], sensor, seeded(3), state)
    assert min(int((events.p > 0).sum()), int((events.p < 0).sum())) > 100
    wanted = torch.full((40, 50), math.log(80))
    wanted[events.y, events.x] += 0.15
    close(state.reference, wanted, atol=1e-6)


def test_many_events_of_a_pixel_wait_for_their_slots():
    """The first run has one slot a frame; a pixel then looks for more. Frame by frame, as v2e works,
    there are as many events."""
    level = torch.zeros(40, 1, 1, dtype=D)
    level[1::2] = 3000.0
    t_s = torch.arange(40, dtype=D) * 1e-3
    sensor = SensorModel(0.011, 0.011, refractory_s=1e-5, timing="v2e")
    assert len(simulate(level, t_s, sensor, log_input=True)) == 3697


def test_a_dead_time_may_end_between_chunks():
    """The sum of the times is that of v2e's way, frame by frame."""
    frames = 255 * torch.rand(70, 8, 8, generator=seeded(0))
    t_s = torch.arange(70, dtype=D) * 1e-3
    waits = SensorModel(0.02, 0.02, refractory_s=1e-3, timing="v2e")
    for _ in range(3):
        state = SensorState()
        simulate(frames[:9], t_s[:9], waits, state=state)
        found = simulate(frames[9:], t_s[9:], replace(waits, refractory_s=0.0), state=state)
        assert int(found.t_us.sum()) == 8017549090
