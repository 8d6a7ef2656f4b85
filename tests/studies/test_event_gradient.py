"""The judge of gradients: means over beginnings against enumeration and closed forms, and what cosine and scale see."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from codesign import events
from studies.event_gradient import __main__ as study
from studies.event_gradient import case, compare, curves, judge, sensors, timing
from studies.frame.run import main

T_S = torch.tensor([0.0, 0.01, 0.02], dtype=torch.float64)


def climbing(size_px, *steps, dtype=torch.float64):
    """Frames that move the level of every pixel by these steps from ln 60."""
    level = math.log(60) + torch.tensor([0.0, *steps], dtype=dtype).cumsum(0)
    return level.exp()[:, None, None].expand(-1, size_px, size_px)


@pytest.mark.parametrize(("on", "off"), [(0.2, 0.2), (0.1, 0.3)])
def test_the_mean_over_beginnings_is_that_of_enumeration(on, off):
    """A level rises by 0.47 and falls by 0.62; a slow sensor walks through 20,000 beginnings."""
    steps = (0.47, -0.62)
    truth = np.zeros((2, 2))
    begun = np.linspace(-off / 2, on / 2, 20_001)[:-1] + (on + off) / 80_000
    for distance in begun:
        for interval, step in enumerate(steps):
            distance += step
            while distance >= on:
                distance -= on
                truth[interval, 0] += 1
            while distance <= -off:
                distance += off
                truth[interval, 1] += 1
    truth /= len(begun)
    frames = climbing(16, *steps)
    found = judge.Judge(events.SensorModel(on, off), count=16).mean(
        frames, T_S, lambda counts: counts.flatten(0, 1)
    )
    # evenly spread, a pixel's mean is off by at most 1/16 for each place where its count jumps; 256 pixels
    # with independent starts are off by that over 16
    assert found.mean((1, 2)).numpy() == pytest.approx(truth.flatten(), abs=4 / 16 / 16)


def test_streams_begin_where_counts_do():
    frames = climbing(4, 0.47, -0.62)
    sensor = judge.Judge(events.SensorModel(0.1, 0.3, refractory_s=0.003), count=4)

    def totals(stream):
        cell = (stream.p < 0).long() * 16 + stream.y * 4 + stream.x
        return torch.bincount(cell, minlength=32).reshape(2, 4, 4).double()

    counts = sensor.mean(frames, T_S, lambda counts: counts.sum(0))
    assert counts.sum() > 0
    assert torch.equal(sensor.mean_of_streams(frames, T_S, totals), counts)


def test_behind_a_history_the_phase_is_even_over_the_threshold_just_used():
    """Who comes from far below, in one direction, fires a/C_on times on a further rise by a, and 0 times on a fall of
    less than C_off - C_on."""
    frames, t_s = compare.led_in(climbing(32, 0.25, -0.1), T_S)
    lead = frames[: compare.LEAD]
    from_below = (lead[0] < lead[1]) & (lead[1] < frames[compare.LEAD])
    assert 0.1 < from_below.double().mean() < 0.4
    sensor = judge.Judge(events.SensorModel(0.1, 0.3), count=32)
    counts = sensor.mean(frames, t_s, lambda counts: counts[compare.LEAD :].flatten(0, 1))[:, from_below]
    assert counts.mean(1).tolist() == pytest.approx([2.5, 0, 0, 0], abs=0.01)


def test_cosine_and_scale_of_known_vectors(generator):
    difference = torch.randn(8, 16, generator=generator, dtype=torch.float64)
    aside = torch.randn(8, 16, generator=generator, dtype=torch.float64)
    aside -= difference * (aside * difference).sum() / (difference**2).sum()
    aside *= difference.norm() / aside.norm()
    numbers = compare.row(("a", 5), [compare.Pair(2 * difference, difference)]).numbers
    assert list(numbers.values()) == pytest.approx([1, 2, 1, 1])
    askew = compare.row(("a", 5), [compare.Pair(difference + aside, difference)])
    assert askew.numbers["cosine"] == pytest.approx(math.sqrt(0.5))
    assert askew.numbers["scale"] == pytest.approx(1)
    assert askew.numbers["cosine_low"] < math.sqrt(0.5) < askew.numbers["cosine_high"]
    assert set(askew.metrics("Some")) == {f"{key}_some_a_5" for key in askew.numbers}


def test_derivatives_over_sections_add_up_to_the_difference():
    """Of a quadratic function of the frames, whose difference over a section is exactly the derivative in its middle."""
    ends = torch.rand(5, 3, 8, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def square(frames, t_s):
        return torch.stack((frames.square().sum(0), (frames[0] * frames[1])))

    found = compare.pair(ends, T_S, square, square)
    assert found.slope.shape == (2, compare.BLOCKS**2)
    torch.testing.assert_close(found.slope, found.difference, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", curves.KINDS)
def test_a_curve_is_scaled_moved_in_time_and_set_off(kind):
    """Half an amplitude's step, one frame of phase, and a step behind the first frame."""

    def level(parameter, s):
        return curves.frames(kind, 240, parameter, s, seed=3).double().log() - curves.BASE

    still = level("phase", 0.0)
    one_frame = 1 / 24 / curves.PHASE
    close = {"rtol": 0, "atol": 1e-5}  # single precision of intensities up to 200 and down to 40
    torch.testing.assert_close(level("amplitude", 0.5), still * math.exp(curves.AMPLITUDE_LOG / 2), **close)
    torch.testing.assert_close(level("phase", one_frame)[:-1], still[1:], **close)
    torch.testing.assert_close(level("offset", 1.0)[1:], still[1:] + curves.OFFSET, **close)
    assert torch.equal(level("offset", 1.0)[0], still[0])


def test_the_study_goes_on_where_it_was_cut(tmp_path, monkeypatch):
    ran = []
    topic = study.TOPICS["curves"]

    def measure(cases, *job):
        ran.append(job)
        if len(ran) == 2:
            raise KeyboardInterrupt
        on, off, beginning, kind, gradient = job
        yield compare.Row((f"{on}/{off}", gradient, beginning, kind, "phase"), {"cosine": 0.5, "scale": 1.0})

    monkeypatch.setitem(study.TOPICS, "curves", dataclasses.replace(topic, measure=measure))
    options = ["--quick", "--topics", "curves"]
    assert main(study.study, study.Config, [*options, "--out", str(tmp_path / "run")]) == 130
    assert main(study.study, study.Config, ["--resume", str(tmp_path / "run")]) == 0
    jobs = topic.jobs(True)
    assert ran == [*jobs[:2], *jobs[1:]]
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    exact = sum("exact" in job for job in jobs)  # nothing is asked of the play
    assert 0 < exact < len(jobs)
    assert f"curves: {exact} of {exact} rows" in page
    assert main(study.study, study.Config, ["--topics", "none", "--out", str(tmp_path / "other")]) == 2


def test_the_memory_layer_points_the_way_of_the_hard_sensor(tmp_path):
    """Equal thresholds, where its mean is exact: turning points of random curves, without and with a history."""
    for beginning in study.thresholds.BEGINNINGS:
        rows = list(study.thresholds.measure_curves([study.Case(5)], 0.2, 0.2, beginning, "turns", "exact"))
        assert [row.names[-1] for row in rows] == list(curves.PARAMETERS)
        for row in rows:
            assert row.numbers["cosine"] > 0.99
            assert row.numbers["scale"] == pytest.approx(1, abs=0.05)


def test_a_number_that_all_pixels_share_is_differentiated_block_by_block():
    weights = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    value = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    found = sensors.of_number(weights * value**2, value)
    torch.testing.assert_close(found, 1.4 * compare.blocks(weights))


def test_a_physical_layer_and_its_judge_draw_the_same_thresholds():
    """Thresholds spread by a third; a rise of 1.503 gives floor((1.503 + D)/C_on) events from a distance D at the start."""
    frames = climbing(16, 1.503, 0.0)
    sensor = events.SensorModel(0.15, 0.15, theta_sigma=0.05)
    on, off = events.draw_thresholds(sensor, (16, 16), torch.Generator().manual_seed(0), dtype=torch.float64)
    layer, truth = sensors.maps(sensor)
    torch.testing.assert_close(layer(frames, T_S)[0], (1.503 / on).floor(), rtol=0, atol=0)
    place = (torch.arange(4000, dtype=torch.float64)[:, None, None] + 0.5) / 4000
    exact = ((1.503 + place * (on + off) / 2 - off / 2) / on).floor().mean(0)
    # the mean over evenly spread places is off by at most one of them for every place where the count jumps
    jumps = ((on + off) / 2 / on).ceil()
    assert ((truth(frames, T_S)[0] - exact).abs() <= jumps / judge.BEGINNINGS + 0.001).all()


def test_the_timing_judge_sees_what_the_stream_shows(generator):
    """Sums, volume and surface at the end, from counts per tenth of a millisecond, beside those of single events."""
    level = 4 + 0.3 * torch.randn(3, 4, 4, generator=generator, dtype=torch.float64).cumsum(0)
    t_s = case.times(timing.TRUTH_HZ)
    share = torch.linspace(0, 2, len(t_s), dtype=torch.float64)
    path = torch.cat(
        [torch.lerp(level[k], level[k + 1], (share[share.floor() == k] - k)[:, None, None]) for k in (0, 1)]
        + [level[2:]]
    )
    counts = events.dense_counts(path, t_s, timing.SENSOR, log_input=True)
    stream = events.simulate(path, t_s, timing.SENSOR, log_input=True)
    found = timing.observed(counts[:, :, None], t_s, timing.hard_surface)[:, 0]
    end_us = round(case.DURATION_S * 1e6)
    volume = events.from_stream(stream, 0, end_us, timing.BINS, dtype=torch.float64).counts[0]
    surface = events.surface_from_stream(stream, [end_us], timing.TAU_S, dtype=torch.float64)[0]
    assert torch.equal(found[:2], volume.sum(1).round())
    # times are off by at most half a tenth of a millisecond
    assert (
        float((found[2:-2] - volume.flatten(0, 1)).abs().max()) <= float(volume.sum(1).max()) * 5e-5 / 0.025
    )
    assert float((found[-2:] - surface).abs().max()) <= 5.1e-5 / timing.TAU_S
