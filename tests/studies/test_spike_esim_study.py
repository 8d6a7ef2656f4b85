"""The Spike-ESIM study: figures of judgement, thesis variants, digits and saccades against closed
forms and values worked out by hand; a run that goes on where it stopped."""

import json
import math
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from codesign import events
from codesign.events import SensorModel, SpikeEsim
from scenes.digits import (
    BLUR_PX,
    FONTS,
    LEG_S,
    PHOTOS,
    SIDE_PX,
    coverage,
    draw_pictures,
    frame_times,
    frames,
    position_px,
    softened,
)
from studies.frame.run import main
from studies.spike_esim import __main__ as study
from studies.spike_esim import classes, judge, train
from tests.studies.browser import check_page

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


def test_saccades_go_round_an_equilateral_triangle_at_the_speed_of_their_closed_form():
    corners = position_px(torch.tensor([0, LEG_S, 2 * LEG_S, 3 * LEG_S], dtype=D))
    assert corners[0].tolist() == [0, 0]
    assert torch.allclose(corners[3], corners[0], atol=1e-12)
    assert (corners[1:] - corners[:-1]).norm(dim=1).tolist() == pytest.approx(
        [SIDE_PX] * 3, abs=1e-12
    )
    # half of the way after half of the time, at 15/8 of the mean speed; central differences of 1 us
    # err by h^2 s'''/6 = 2e-8 px/s
    for leg in range(3):
        middle_s = (leg + 0.5) * LEG_S
        before, at, after = position_px(middle_s + torch.tensor([-1e-6, 0, 1e-6], dtype=D))
        assert torch.allclose(at, (corners[leg] + corners[leg + 1]) / 2, atol=1e-12)
        assert float((after - before).norm()) / 2e-6 == pytest.approx(
            15 / 8 * SIDE_PX / LEG_S, rel=1e-6
        )
    still = position_px(LEG_S + torch.tensor([-1e-5, 1e-5], dtype=D))
    # at rest at the corners: 10 u^3 of 4 px with u = 1.7e-4 is 2e-10 px
    assert float((still[1] - still[0]).norm()) < 1e-9


def test_frames_of_waves_are_those_waves_moved():
    # 5 and 3 periods across and down a tile of 64 px: band-limited, so every sub-pixel shift has a
    # closed form
    at = torch.arange(64, dtype=D)

    def wave(x, y):
        return 50 + 20 * torch.sin(2 * math.pi * (5 * x + 3 * y) / 64 + 0.4)

    t_s = frame_times(100.0)
    found = frames(wave(at, at[:, None])[None], t_s)
    assert found.shape == (19, 1, 32, 32)
    seen = at[16:48]
    for frame, (dx, dy) in zip(found[:, 0], position_px(t_s).tolist(), strict=True):
        assert float((frame - wave(seen - dx, seen[:, None] - dy)).abs().max()) < 1e-10


@pytest.mark.parametrize("label", [0, 8])
def test_the_area_of_a_digit_is_that_of_its_outlines(label):
    for font in FONTS[::2]:
        file = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / f"{font}.ttf"
        outlines = TextPath(
            (0, 0), str(label), size=100, prop=FontProperties(fname=file)
        ).to_polygons()
        low, high = (end(np.concatenate(outlines)[:, 1]) for end in (np.min, np.max))
        # signed areas: holes run the other way round than what they are holes of
        area = abs(
            sum(
                0.5 * np.sum(p[:-1, 0] * p[1:, 1] - p[1:, 0] * p[:-1, 1])
                for p in (np.asarray(o) for o in outlines)
            )
        )
        truth_px = area * (20 / (high - low)) ** 2
        # a raster of quarter pixels errs by about the square root of the edge cells, some 400 of
        # 1/16 px each: 1 px; areas are 60 to 150 px
        assert coverage(label, font, 20.0, 10.0, (0.3, -0.7)).sum() == pytest.approx(
            truth_px, abs=2.5
        )


def test_pictures_come_from_their_seed_and_the_lens_fades_a_wave_as_a_gaussian():
    (first, labels), (again, _), (other, _) = (
        draw_pictures(12, "training", (0, k)) for k in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert labels.tolist() == [*range(10), 0, 1]
    assert not set(PHOTOS["training"]) & set(PHOTOS["test"])
    assert float(first.min()) > 0
    at = np.arange(64)
    wave = np.sin(2 * np.pi * 8 * at / 64) * np.ones((1, 64, 1))
    assert np.allclose(
        softened(wave), wave * math.exp(-2 * (math.pi * BLUR_PX / 8) ** 2), atol=1e-13
    )


def test_voxels_hold_every_event_once_and_in_its_own_picture():
    pictures, _ = draw_pictures(5, "test", 7)
    t_s = frame_times(100.0)
    seen = frames(pictures, t_s)
    sensor = events.SensorModel(0.15, 0.15)
    made = classes.of_esim(0.15)(seen, t_s, torch.Generator())
    voxels = classes.voxels_of(made, t_s, 4)
    assert voxels.shape == (5, 2, 4, 32, 32)
    for k in range(5):
        alone = events.simulate(seen[:, k], t_s, sensor)
        for polarity, sign in enumerate((1, -1)):
            # single precision sums some 500 shares of at most 1: 1e-4
            assert float(voxels[k, polarity].sum()) == pytest.approx(
                int((alone.p == sign).sum()), abs=1e-3
            )
    assert float(voxels.sum()) == pytest.approx(len(made), abs=1e-2)
    of_counts = classes.voxels_of(events.dense_counts(seen, t_s, sensor), t_s, 4)
    assert float(of_counts.sum()) == pytest.approx(len(made), abs=1e-2)
    # the mean time of all events, from bins of 60 ms: linear sharing keeps it exactly for a stream
    nodes_s = torch.linspace(0, 3 * LEG_S, 4, dtype=D)
    mean_s = float((voxels.double().sum((0, 1, 3, 4)) * nodes_s).sum() / voxels.double().sum())
    assert mean_s == pytest.approx(float(made.t_us.double().mean()) * 1e-6, abs=1e-6)


def separable(count, generator):
    """Recordings whose class is the one channel (of 2 polarities x 5 bins) that has events, at
    random places."""
    labels = torch.arange(count) % 10
    voxels = torch.zeros(count, 10, 32 * 32)
    for k, label in enumerate(labels.tolist()):
        voxels[k, label] = (torch.rand(32 * 32, generator=generator) < 0.2).float()
    return voxels.reshape(count, 2, 5, 32, 32), labels


@pytest.mark.bits
def test_a_trivially_separable_set_is_learnt_completely_and_training_repeats_from_its_seed(
    generator,
):
    voxels, labels = separable(200, generator)
    unseen, truth = separable(50, generator)
    net = classes.train(voxels, labels, 6, seed=3)
    assert classes.predict(net, unseen).tolist() == truth.tolist()
    torch.rand(7)  # the global generator has no say
    again = classes.train(voxels, labels, 6, seed=3)
    other = classes.train(voxels[:50], labels[:50], 1, seed=4)
    weights = [
        torch.cat([p.detach().flatten() for p in each.parameters()]) for each in (net, again, other)
    ]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


@pytest.mark.bits
def test_the_network_of_the_thesis_sees_each_picture_alone():
    t_s = frame_times(50.0)
    seen = frames(draw_pictures(3, "training", 5)[0], t_s)
    network = events.TwoBranchSpikes(1, seed=0).requires_grad_(False)
    network.wake(classes.tall(seen) / 255)
    together = classes.spikes_of(network, seen)
    assert float(together.sum()) > 0
    for k in range(3):
        alone = classes.spikes_of(network, seen[:, k : k + 1])
        # a convolution of three pictures may round differently from one of one, by 9 products of
        # 1e-7: of 27,648 potentials few are that near a threshold, and their spikes come a step
        # later
        assert int((together[:, :, k : k + 1] != alone).sum()) <= 1e-3 * alone.numel()


def test_a_classification_that_was_stopped_goes_on_with_what_is_left(tmp_path, monkeypatch, capsys):
    kept = {key: classes.SOURCES[key] for key in ("naive", "esim", "physical")}
    monkeypatch.setattr(classes, "SOURCES", kept)
    monkeypatch.setattr(classes, "ASKED", (("esim", "naive"),))
    for name in ("best_thresholds", "fitted"):
        monkeypatch.setattr(classes, name, lambda *given: {})
    sizes = ["--training", "20", "--test", "20", "--calibration", "10", "--device", "cpu"]
    folder = tmp_path / "a"
    assert (
        main(study.study, study.Config, ["--classes", "--quick", *sizes, "--out", str(folder)]) == 0
    )
    first = json.loads((folder / "metrics.json").read_text())
    # 20 pictures, 2 seeds
    assert first["physical_mean"] * 40 == pytest.approx(round(first["physical_mean"] * 40))
    # naive events of the very pictures, counted in another way
    tiles, _ = draw_pictures(20, "training", (0, classes.TRAINING, 0))
    steps = events.lin_log(frames(tiles, frame_times(100.0)).flatten(1, 2)).diff(dim=0)
    assert first["naive_events_per_picture"] == pytest.approx(
        int((steps.abs() >= 0.2).sum()) / 20, abs=1e-3
    )
    # every training is found again
    monkeypatch.setattr(classes, "train", None)
    assert main(study.study, study.Config, ["--resume", str(folder)]) == 0
    again = json.loads((folder / "metrics.json").read_text())
    assert all(again[name] == value for name, value in first.items() if not isinstance(value, dict))
    check_page("spike_esim", folder)


@pytest.mark.parametrize("options", [["--steps", "1"], ["--classes", "--seeds", "1"]])
def test_too_small_a_study_is_refused(options, tmp_path, capsys):
    assert main(study.study, study.Config, [*options, "--out", str(tmp_path / "a")]) == 2
    assert "at least" in capsys.readouterr().err
