"""The parts of the Spike-ESIM study against hand-computed values and closed forms."""

import math

import pytest
import torch

from codesign import events
from codesign.errors import DomainError
from codesign.events import SensorModel
from codesign.events.spiking.spike_esim import SpikeEsim
from studies.frame.run import main
from studies.spike_esim import __main__ as study
from studies.spike_esim import jobs, score
from studies.spike_esim import train as training
from studies.spike_esim.data import Sequence, part, tiles

DT_S = 2e-3


def sequence(counts):
    frames = torch.zeros(len(counts) + 1, *counts.shape[2:])
    return Sequence("made", frames, torch.arange(len(counts) + 1, dtype=torch.float64) * DT_S, counts)


def noise(seed, mean=0.5, steps=100, side=16):
    return torch.poisson(
        torch.full((steps, 2, side, side), mean), generator=torch.Generator().manual_seed(seed)
    )


def test_losses_of_silence_of_the_target_and_of_twice_the_target():
    target = noise(0)
    for factor, loss, ratio in ((0, 1.0, 0.0), (1, 0.0, 1.0), (2, 1.0, 2.0), (3, 4.0, 3.0)):  # (factor - 1)^2
        found = score.losses([score.Pair(factor * target, sequence(target))], 10, 0)
        assert found[0].value == pytest.approx(loss, abs=1e-9)
        assert found[1].value == pytest.approx(ratio, abs=1e-12)
    assert training.total_distance(lambda s: 3 * s.counts, [sequence(target)]) == pytest.approx(4.0, rel=1e-6)


def test_two_draws_of_one_poisson_rate_lie_twice_their_variance_apart():
    # per pixel E(a - b)^2 = 2 m for the difference; for silence the mean m adds: ratio = 2 m e / (m e + (m
    # K)^2) with e = sum eps_k^2, K = sum eps_k
    mean = 0.05
    steps = 2000
    h = DT_S / training.TAU_S
    k = torch.arange(1, steps, dtype=torch.float64)
    eps = k * h * torch.exp(1 - k * h)
    power = float(eps.square().sum())
    area = float(eps.sum())
    truth = 2 * mean * power / (mean * power + (mean * area) ** 2)
    found, _ = score.losses([score.Pair(noise(1, mean, steps), sequence(noise(2, mean, steps)))], 10, 0)
    # 512 pixels and 2000 steps of a correlation time of about 10: 1e5 independent terms, so 1 %; the first
    # steps, not yet full, 1 % more
    assert found.value == pytest.approx(truth, rel=0.03)


def test_rates_correlate_as_their_noise_says():
    # equal shares of common and own variance: correlation 1/2
    common = noise(3, 4.0)
    one = noise(4, 4.0)
    other = noise(5, 4.0)
    pairs = [score.Pair(common + one, sequence(common + other))]
    for value in score.rate_correlation(pairs, side_px=2):
        assert value == pytest.approx(0.5, abs=4 / math.sqrt(20 * 64))  # 1280 bins and cells per polarity
    assert score.rate_correlation([score.Pair(3 * common, sequence(common))]) == pytest.approx([1.0, 1.0])


def test_flicker_is_the_power_above_fifty_hertz():
    t_s = torch.arange(200, dtype=torch.float64) * DT_S

    def wave(high):
        return 10 + torch.sin(2 * math.pi * 10 * t_s) + high * torch.sin(2 * math.pi * 100 * t_s)

    made = [wave(high)[:, None, None, None].expand(-1, 2, 16, 16) for high in (2.0, 1.0)]
    assert score.flicker([score.Pair(made[0], sequence(made[1]))]) == pytest.approx(
        4.0, rel=1e-6
    )  # the taper leaks below 1e-6 at this distance


def test_delay_is_found_with_its_sign():
    target = noise(6, 0.1)
    for steps in (-3, 0, 4):
        assert score.delay_s([score.Pair(target.roll(steps, 0), sequence(target))]) == pytest.approx(
            steps * DT_S
        )


def test_median_removes_lone_events_and_keeps_an_edge():
    counts = torch.zeros(5, 2, 16, 16)
    counts[0, 0, 3, 3] = 1
    counts[1, 1, :, 8:] = 1
    kept = score.median_filtered(counts, DT_S)
    assert kept.shape == (1, 2, 16, 16)
    assert kept[0, 0].sum() == 0
    assert torch.equal(kept[0, 1], counts[1, 1])


def test_parts_and_tiles_keep_their_events():
    whole = sequence(noise(7))
    assert torch.equal(part(whole, 10, 20).counts, whole.counts[10:20])
    assert part(whole, 10, 20).t_s[0] == whole.t_s[10]
    assert sum(tile.counts.sum() for tile in tiles(whole)) == whole.counts.sum()


def test_best_theta_is_that_of_the_target():
    frames = (
        (3.5 + (0.1 * torch.randn(80, 12, 12, generator=torch.Generator().manual_seed(8))).cumsum(0))
        .clamp(0, 5.5)
        .exp()
    )
    t_s = torch.arange(80, dtype=torch.float64) * DT_S
    truth = training.THETAS[4]
    made = Sequence("made", frames, t_s, training.esim_counts(frames, t_s, truth))
    assert training.best_theta([made]) == truth


def spikes_by_loop(drive, reset, response):
    """Spikes of threshold 1, step by step from all steps so far; kernels [T], by lag."""
    spikes = torch.zeros_like(drive)
    for t in range(len(drive)):
        back = [kernel[: t + 1].flip(0) for kernel in (response, reset)]
        spikes[t] = (
            torch.tensordot(back[0], drive[: t + 1], 1) + torch.tensordot(back[1], spikes[: t + 1], 1) >= 1
        )
    return spikes


def test_thesis_variants_spike_when_a_loop_over_their_own_kernels_does():
    frames = torch.rand(60, 6, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    lag = torch.arange(59, dtype=torch.float64)
    fast, slow = (lag * DT_S / tau_s for tau_s in (1e-3, 1e-2))
    none, alpha = (lag == 0).double(), slow * (1 - slow).exp()
    slayer, own = -2 * fast * (1 - fast).exp(), -2 * (1 - fast).exp() * (lag > 0)
    kernels = {"thesis": (slayer, none), "own_reset": (own, none), "smoothed": (slayer, alpha)}
    for name, made in jobs.VARIANTS.items():
        network = made(1, dt=1e3 * DT_S, seed=0).double()
        network.wake(frames, 0.2)
        first = getattr(network, "first", network)
        weights = torch.stack((first.weight_on, -first.weight_off)).detach()
        drive = torch.nn.functional.conv2d(frames.diff(dim=0)[:, None], weights, padding=1)
        truth = spikes_by_loop(drive, *kernels.get(name, kernels["own_reset"]))
        if name == "second_module":
            truth = spikes_by_loop(network.weight.detach() * truth, own, alpha)
        assert truth.any()
        assert torch.equal(network(frames)[0], truth), name


def test_gradient_of_the_second_module_is_that_of_differences():
    module = jobs.SecondModule(1, dt=1e3 * DT_S, seed=0).double()
    given = torch.rand(12, 2, 2, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64)

    def smooth_twin(weight, given):  # the spike is the integral of its surrogate
        return module.second(given, smooth=True, through_reset="full")[0]

    assert torch.autograd.gradcheck(smooth_twin, (module.weight, given.requires_grad_()))


def test_calibration_finds_the_thresholds_of_a_sensor():
    frames = (
        (3.5 + (0.1 * torch.randn(80, 16, 16, generator=torch.Generator().manual_seed(8))).cumsum(0))
        .clamp(0.1, 5.5)
        .exp()
    )
    t_s = torch.arange(80, dtype=torch.float64) * DT_S
    made = Sequence("made", frames, t_s, events.dense_counts(frames, t_s, SensorModel(0.3, 0.24)))
    scale = training.calibrated_scale(SpikeEsim(0.2, 0.2), [made], rounds=8)
    # about 6000 events: as many events within 1 % mean thresholds within about 1 %
    assert scale == pytest.approx([1.5, 1.2], rel=0.02)


def test_too_small_a_study_is_refused(tmp_path, capsys):
    assert main(study.study, study.Config, ["--steps", "1", "--out", str(tmp_path / "a")]) == 2
    assert "at least" in capsys.readouterr().err


def test_training_forgets_batches_without_events():
    silent = sequence(torch.zeros(10, 2, 40, 40))
    loud = sequence(noise(9, 0.5, 10, 40))
    _, _, counts = training.crops([silent, loud], torch.Generator().manual_seed(0), batch=1)
    assert counts.sum() > 0


def test_sensor_and_scores_refuse_nothing_silently():
    with pytest.raises(DomainError):
        score.losses([score.Pair(torch.full((10, 2, 16, 16), math.nan), sequence(noise(10, 0.5, 10)))], 10, 0)
