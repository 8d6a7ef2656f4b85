"""Timing "v2e" against the recorded events of v2e itself, and the statistics of its noise for both
timings."""

import json
import math

import numpy as np
import pytest
import torch

from codesign.events import SensorModel, SensorState, concatenate, simulate
from tests.event_streams import same

CONFIGURATIONS = ("ideal", "asym", "cut30", "refr3ms", "leak20_det")
STATISTICS = (
    "shot5_dn0",
    "shot5_dn20",
    "shot5_dn128",
    "shot5_dn255",
    "shot5_dn128_sig.03",
    "leak1",
    "leak1_jit0_cov0",
    "leak1_cov.3",
    "leak1_sig.03",
)


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


@pytest.mark.bits
@pytest.mark.parametrize("sequence", ["edge", "grating", "flicker"])
@pytest.mark.parametrize("configuration", CONFIGURATIONS)
def test_every_event_of_v2e_to_the_microsecond(shared, sequence, configuration):
    file = np.load(shared(f"refs/events/seq_{sequence}.npz"))
    frames = torch.from_numpy(file["frames"])
    t_s = torch.from_numpy(file["t"])
    data = np.load(shared(f"refs/events/v2e_{sequence}_{configuration}.npz"))
    sensor = sensor_of(json.loads(str(data["params"])), "v2e")
    state = SensorState()
    events = simulate(frames, t_s, sensor, state=state)
    t_us = np.round(data["t"].astype(np.float64) * 1e6).astype(np.int64)
    rank = np.lexsort((data["p"], data["x"], data["y"], t_us))
    for mine, theirs in zip(
        (events.t_us, events.x, events.y, events.p), (t_us, data["x"], data["y"], data["p"]), strict=True
    ):
        assert np.array_equal(mine.numpy(), theirs[rank].astype(np.int64))
    assert np.array_equal(state.reference.numpy(), data["base_log_frame"])
    assert np.array_equal(state.level.numpy(), data["lp_log_frame"])
    parts_state = SensorState()
    parts = concatenate(
        [simulate(frames[a:b], t_s[a:b], sensor, state=parts_state) for a, b in ((0, 2), (2, 3), (3, 120))]
    )
    assert same(parts, events)


@pytest.mark.parametrize("timing", ["v2e", "interpolated"])
@pytest.mark.parametrize("case", STATISTICS)
def test_noise_rates_are_those_of_v2e(shared, timing, case):
    truth = json.loads(shared("refs/events/v2e_stats.json").read_text())[case]
    frames = torch.full((truth["frames"], *truth["shape"]), float(truth["dn"]))
    t_s = torch.arange(truth["frames"], dtype=torch.float64) * truth["dt"]
    events = simulate(frames, t_s, sensor_of(truth["params"], timing), torch.Generator().manual_seed(7))
    for polarity, name in ((1, "on"), (-1, "off")):
        per_pixel = torch.bincount(
            (events.y * 64 + events.x)[events.p == polarity], minlength=4096
        ).double() / float(t_s[-1])
        # both are samples: their 95 % intervals add as squares; 1.7 of it is passed once in a thousand
        interval = math.hypot(truth[name]["ci95"], 1.96 * float(per_pixel.std()) / 64)
        assert abs(float(per_pixel.mean()) - truth[name]["mean_hz"]) <= 1.7 * interval + 1e-9
        # standard error of a deviation: at most 2 % here (4096 pixels, tails of the log-normal included), of
        # two samples
        assert float(per_pixel.std()) == pytest.approx(truth[name]["pix_std"], rel=0.09, abs=1e-9)


def grating(frames, side=64):
    """Sinusoid of 17.3 px and 12.7 Hz at 0.35 rad, one frame a millisecond: v2e's recorded sequence "grating"
    in closed form (to 1e-12)."""
    t, y, x = torch.meshgrid(
        *(torch.arange(count, dtype=torch.float64) for count in (frames, side, side)), indexing="ij"
    )
    along = x * math.cos(0.35) + y * math.sin(0.35)
    return 127.5 + 100.3 * torch.sin(2 * math.pi * (along / 17.3 - 12.7e-3 * t))


@pytest.mark.parametrize("timing", ["v2e", "interpolated"])
@pytest.mark.parametrize("sigma", [0.03, 0.05])
def test_counts_under_mismatch_are_those_of_v2e(shared, timing, sigma):
    truth = json.loads(shared("refs/events/v2e_stats.json").read_text())[f"grating40_counts_sigma{sigma:g}"]
    sensor = SensorModel(theta_sigma=sigma, timing=timing)
    streams = [
        simulate(
            grating(40),
            torch.arange(40, dtype=torch.float64) * 1e-3,
            sensor,
            torch.Generator().manual_seed(seed),
        )
        for seed in range(5)
    ]
    for polarity, name in ((1, "on"), (-1, "off")):
        mean = np.mean([int((stream.p == polarity).sum()) for stream in streams])
        # means of five seeds each: their difference has sd * sqrt(2/5); 3.3 of it is passed once in a
        # thousand
        assert abs(mean - truth[f"{name}_mean"]) <= 3.3 * truth[f"{name}_sd"] * math.sqrt(2 / 5)


def test_slots_keep_microseconds_at_epoch_times_and_late():
    frames = torch.tensor([50.0, 80.0, 50.0, 120.0])[:, None, None]
    for start_s in (0.0, 1_700_000_000.0):
        for gap_s in (1e-3, 20.0):  # beyond 8 s single precision no longer resolves a microsecond
            t_s = start_s + torch.arange(4, dtype=torch.float64) * gap_s
            events = simulate(frames, t_s, SensorModel(timing="v2e"))
            # ln 1.6 = 0.47: two of 0.2, back by two, then ln 2.4 = 0.875: four
            truth = []
            steps = [2, 2, 4]
            for k, n in enumerate(steps):
                truth += [round(start_s * 1e6) + round((k + (i + 1) / n) * gap_s * 1e6) for i in range(n)]
            assert max(abs(a - b) for a, b in zip(events.t_us.tolist(), truth, strict=True)) <= 1
            assert events.p.tolist() == [1, 1, -1, -1, 1, 1, 1, 1]


def test_a_noise_event_of_either_polarity_resets_the_memorised_level():
    # a rise of 0.15 below the threshold of 0.2: whatever fires is noise, and where nothing fires the
    # memorised
    # level stays where it was
    frames = torch.tensor([80.0, 80.0 * math.exp(0.15)])[:, None, None].expand(2, 40, 50)
    state = SensorState()
    sensor = SensorModel(shot_rate_hz=1.0, timing="v2e")
    events = simulate(frames, [0.0, 0.8], sensor, torch.Generator().manual_seed(3), state)
    assert int((events.p > 0).sum()) > 100
    assert int((events.p < 0).sum()) > 100
    for polarity in (1, -1):
        fired = events.p == polarity
        at = state.reference[events.y[fired], events.x[fired]]
        assert at.tolist() == pytest.approx([math.log(80) + 0.15] * len(at), abs=1e-6)
    quiet = torch.ones(40, 50, dtype=torch.bool)
    quiet[events.y, events.x] = False
    assert state.reference[quiet].tolist() == pytest.approx([math.log(80)] * int(quiet.sum()), abs=1e-6)
