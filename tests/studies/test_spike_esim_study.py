"""The Spike-ESIM study: figures of judgement, thesis variants, against closed forms and values
worked out by hand."""

import math

import pytest
import torch

from codesign import events
from codesign.events import SensorModel, SpikeEsim
from studies.spike_esim import __main__ as study
from studies.spike_esim import judge, train

D = torch.float64
DT_S = 2e-3


def made(pictures, counts):
    return train.Sequence(
        "made", pictures, torch.arange(len(pictures), dtype=D) * DT_S, counts, counts
    )


def sequence(counts):
    return made(torch.zeros(len(counts) + 1, *counts.shape[2:]), counts)


def noise(seed, mean=0.5, steps=100, side=16):
    rate = torch.full((steps, 2, side, side), mean)
    return torch.poisson(rate, generator=torch.Generator().manual_seed(seed))


def walk(side):
    """Pictures whose log level goes at random."""
    draw = torch.randn(80, side, side, generator=torch.Generator().manual_seed(8))
    return (3.5 + (0.1 * draw).cumsum(0)).clamp(0, 5.5).exp()


def test_figures_of_silence_of_the_target_and_of_its_multiples():
    target = noise(0)
    for factor in (0, 1, 3):
        found = judge.judge([(factor * target, sequence(target))], 10, 0)
        loss = (factor - 1) ** 2
        assert found["loss"].value == pytest.approx(loss, abs=1e-6)
        assert found["loss"].low - 1e-6 <= loss <= found["loss"].high + 1e-6
        assert found["rate_ratio"].value == pytest.approx(factor, abs=1e-6)
        assert found["flicker_ratio"] == pytest.approx(factor**2, abs=1e-9)
        correlations = [found[f"{kind}_correlation"] for kind in ("rate", "cell")]
        assert correlations == pytest.approx([float(factor > 0)] * 2, abs=1e-6)


def test_two_draws_of_one_poisson_rate_lie_twice_their_variance_apart():
    # per pixel E(a - b)^2 = 2 m for the difference; for silence the mean m adds: ratio = 2 m e / (m
    # e + (m K)^2) with e = sum eps_k^2, K = sum eps_k
    mean = 0.05
    steps = 2000
    h = DT_S / judge.TAU_S
    k = torch.arange(1, steps, dtype=torch.float64)
    eps = k * h * torch.exp(1 - k * h)
    power = float(eps.square().sum())
    area = float(eps.sum())
    truth = 2 * mean * power / (mean * power + (mean * area) ** 2)
    found = judge.distance([(noise(1, mean, steps), sequence(noise(2, mean, steps)))])
    # 512 pixels and 2000 steps of a correlation time of about 10: 1e5 independent terms, so 1 %;
    # the first steps, not yet full, 1 % more
    assert found == pytest.approx(truth, rel=0.03)


def test_rates_correlate_as_their_noise_says():
    # equal shares of common and own variance: correlation 1/2
    common, one, other = (noise(seed, 4.0) for seed in (3, 4, 5))
    sides = [[judge.binned(common + own, DT_S, 2)] for own in (one, other)]
    # the smaller one of two, of 1280 bins and cells each
    assert judge.correlation(*sides) == pytest.approx(0.5, abs=4 / math.sqrt(20 * 64))


def test_flicker_is_the_power_above_fifty_hertz():
    t_s = torch.arange(200, dtype=D) * DT_S

    def wave(high):
        return 10 + torch.sin(2 * math.pi * 10 * t_s) + high * torch.sin(2 * math.pi * 100 * t_s)

    power = [
        judge.flicker(wave(high)[:, None, None, None].expand(-1, 2, 16, 16), DT_S)
        for high in (2.0, 1.0)
    ]
    # the taper leaks below 1e-6 at this distance
    assert power[0] / power[1] == pytest.approx(4.0, rel=1e-6)


def test_the_median_takes_lone_events_out_and_leaves_edges():
    counts = torch.zeros(5, 2, 16, 16)  # one bin of 10 ms
    counts[0, 0, 4, 4] = 3
    counts[2, 1, :, 8:] = 1
    found = judge.filtered(counts, DT_S)
    assert torch.equal(found, torch.stack([torch.zeros(16, 16), counts[2, 1]])[None])


def test_an_ideal_generator_follows_an_ideal_sensor_through_every_threshold(monkeypatch):
    # both are left out of the sweep
    noisy = SensorModel(0.18, 0.22, shot_rate_hz=50.0, leak_rate_hz=5.0)
    monkeypatch.setattr(study, "SENSOR", noisy)
    rows = study.swept(SpikeEsim(0.18, 0.22), [made(walk(16), None)])
    # some 5000 events; a level within rounding of a threshold may tell one more or less
    assert [row["rate_ratio"] for row in rows] == pytest.approx(
        [1.0] * len(study.FACTORS), abs=1e-3
    )


def test_delay_is_found_with_its_sign():
    target = noise(6, 0.1)
    for steps in (-3, 0, 4):
        assert judge.delay([target.roll(steps, 0)], [target], 15) == steps


def test_best_theta_is_that_of_the_target():
    frames = walk(16)
    truth = train.THETAS[4]
    one = made(frames, None)
    target = made(frames, train.esim(one, truth))
    assert train.best_theta([target]) == truth


def test_calibration_finds_the_thresholds_of_a_sensor():
    frames = walk(16).clamp(min=math.exp(0.1))
    t_s = torch.arange(80, dtype=D) * DT_S
    target = made(frames, events.dense_counts(frames, t_s, SensorModel(0.3, 0.24)))
    model = SpikeEsim(0.2, 0.2)
    train.calibrate(model, [target], rounds=8)
    # about 6000 events: as many events within 1 % mean thresholds within about 1 %
    assert model.thetas().tolist() == pytest.approx([0.3, 0.24], rel=0.02)


def test_training_forgets_batches_without_events():
    silent = sequence(torch.zeros(10, 2, 40, 40))
    loud = sequence(noise(9, 0.5, 10, 40))
    _, _, counts = train.crops([silent, loud], torch.Generator().manual_seed(0), batch=1)
    assert counts.sum() > 0


def test_the_objective_is_zero_for_the_target_and_one_and_a_tenth_for_silence():
    target = noise(1)
    assert float(train.objective(target, target, DT_S)) == 0
    assert float(train.objective(torch.zeros_like(target), target, DT_S)) == pytest.approx(1.1)
