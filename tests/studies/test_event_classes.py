"""The classification study's parts against closed forms and hand-computed values, and its classifier on a set
that any classifier must solve."""

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
from codesign.errors import DomainError, ShapeError
from codesign.types import EventStream
from studies.event_classes import __main__ as study
from studies.event_classes import spiking
from studies.event_classes.generators import PHYSICAL, SOURCES, of_ideal, of_naive, voxels_of
from studies.event_classes.network import SHIFT_PX, predict, shifted, train
from studies.event_classes.pictures import BLUR_PX, FONTS, PHOTOS, coverage, draw_pictures, softened
from studies.event_classes.saccades import DURATION_S, LEG_S, SIDE_PX, frame_times, frames, position_px
from studies.event_classes.score import by_seed, interval
from studies.frame.run import main

D = torch.float64


def test_saccades_go_round_an_equilateral_triangle_at_the_speed_of_their_closed_form():
    corners = position_px([0, LEG_S, 2 * LEG_S, DURATION_S])
    assert corners[0].tolist() == [0, 0]
    assert torch.allclose(corners[3], corners[0], atol=1e-12)
    assert (corners[1:] - corners[:-1]).norm(dim=1).tolist() == pytest.approx([SIDE_PX] * 3, abs=1e-12)
    # half of the way after half of the time, at 15/8 of the mean speed; central differences of 1 us err by
    # h^2 s'''/6 = 2e-8 px/s
    for leg in range(3):
        middle_s = (leg + 0.5) * LEG_S
        before, at, after = position_px([middle_s - 1e-6, middle_s, middle_s + 1e-6])
        assert torch.allclose(at, (corners[leg] + corners[leg + 1]) / 2, atol=1e-12)
        assert float((after - before).norm()) / 2e-6 == pytest.approx(15 / 8 * SIDE_PX / LEG_S, rel=1e-6)
    still = position_px([LEG_S - 1e-5, LEG_S + 1e-5])
    assert (
        float((still[1] - still[0]).norm()) < 1e-9
    )  # at rest at the corners: 10 u^3 of 4 px with u = 1.7e-4 is 2e-10 px
    with pytest.raises(DomainError, match="last from 0"):
        position_px([0.0, 1.0])


def test_frames_of_waves_are_those_waves_moved():
    # 5 and 3 periods across and down a tile of 64 px: band-limited, so every sub-pixel shift has a closed
    # form
    at = torch.arange(64, dtype=D)

    def wave(x, y):
        return 50 + 20 * torch.sin(2 * math.pi * (5 * x + 3 * y) / 64 + 0.4)

    t_s = frame_times(100.0)
    found = frames(wave(at, at[:, None])[None], t_s)
    assert found.shape == (19, 1, 32, 32)
    seen = at[16:48]
    for frame, (dx, dy) in zip(found[:, 0], position_px(t_s).tolist(), strict=True):
        assert float((frame - wave(seen - dx, seen[:, None] - dy)).abs().max()) < 1e-10
    with pytest.raises(DomainError, match="whole number"):
        frame_times(99.0)


def test_a_picture_at_a_corner_a_whole_number_of_pixels_away_is_the_tile_itself(generator):
    tiles = torch.rand(2, 64, 64, generator=generator, dtype=D)
    moved = frames(tiles, [0.0, 2 * LEG_S])  # the second corner lies SIDE_PX to the right
    assert torch.allclose(moved[0], tiles[:, 16:48, 16:48], atol=1e-12)
    assert torch.allclose(moved[1], tiles[:, 16:48, 16 - int(SIDE_PX) : 48 - int(SIDE_PX)], atol=1e-12)


@pytest.mark.parametrize("label", [0, 1, 4, 8])
def test_the_area_of_a_digit_is_that_of_its_outlines(label):
    for font in FONTS:
        file = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / f"{font}.ttf"
        outlines = TextPath((0, 0), str(label), size=100, prop=FontProperties(fname=file)).to_polygons()
        low, high = (end(np.concatenate(outlines)[:, 1]) for end in (np.min, np.max))
        # signed areas: holes run the other way round than what they are holes of
        area = abs(
            sum(
                0.5 * np.sum(p[:-1, 0] * p[1:, 1] - p[1:, 0] * p[:-1, 1])
                for p in (np.asarray(o) for o in outlines)
            )
        )
        truth_px = area * (20 / (high - low)) ** 2
        # a raster of quarter pixels errs by about the square root of the edge cells, some 400 of 1/16 px
        # each: 1 px; areas are 60 to 150 px
        assert coverage(label, font, 20.0, 10.0, (0.3, -0.7)).sum() == pytest.approx(truth_px, abs=2.5)


def test_pictures_come_from_their_seed_and_the_lens_fades_a_wave_as_a_gaussian():
    first, again, other = (draw_pictures(12, "training", seed) for seed in ((0, 1), (0, 1), (0, 2)))
    assert torch.equal(first.tiles, again.tiles)
    assert not torch.equal(first.tiles, other.tiles)
    assert first.labels.tolist() == [*range(10), 0, 1]
    assert not set(PHOTOS["training"]) & set(PHOTOS["test"])
    assert float(first.tiles.min()) > 0
    at = np.arange(64)
    wave = np.sin(2 * np.pi * 8 * at / 64) * np.ones((1, 64, 1))
    assert np.allclose(softened(wave), wave * math.exp(-2 * (math.pi * BLUR_PX / 8) ** 2), atol=1e-13)
    with pytest.raises(DomainError, match="'training', 'test'"):
        draw_pictures(3, "validation", 0)


def test_voxels_hold_every_event_once_and_in_its_own_picture():
    pictures = draw_pictures(5, "test", 7)
    t_s = frame_times(100.0)
    seen = frames(pictures.tiles, t_s)
    sensor = events.SensorModel(0.15, 0.15)
    made = of_ideal(0.15)(seen, t_s, torch.Generator())
    voxels = voxels_of(made, t_s, 4, 32)
    assert voxels.shape == (5, 2, 4, 32, 32)
    for k in range(5):
        alone = events.simulate(seen[:, k], t_s, sensor)
        for polarity, sign in enumerate((1, -1)):
            # single precision sums some 500 shares of at most 1: 1e-4
            assert float(voxels[k, polarity].sum()) == pytest.approx(int((alone.p == sign).sum()), abs=1e-3)
    assert float(voxels.sum()) == pytest.approx(len(made), abs=1e-2)
    counts = events.dense_counts(seen, t_s, sensor)
    assert float(voxels_of(counts, t_s, 4, 32).sum()) == pytest.approx(len(made), abs=1e-2)
    # the mean time of all events, from bins of 60 ms: linear sharing keeps it exactly for a stream
    nodes_s = torch.linspace(0, DURATION_S, 4, dtype=D)
    mean_s = float((voxels.double().sum((0, 1, 3, 4)) * nodes_s).sum() / voxels.double().sum())
    assert mean_s == pytest.approx(float(made.t_us.double().mean()) * 1e-6, abs=1e-6)


def test_generators_count_a_step_as_worked_out_by_hand():
    # ln 100 -> ln 200 (0.693) in one interval, and back over two: ESIM 3 up and 3 down at 0.2; naive 1 up, 2
    # down (0.405 and 0.288)
    frame = (
        torch.tensor([100.0, 100.0, 200.0, 200.0 / 1.5, 100.0])[:, None, None, None]
        .expand(-1, 2, 3, 4)
        .contiguous()
    )
    t_s = torch.arange(5, dtype=D) * 0.01
    for make, up, down in ((of_ideal(0.2), 3, 3), (of_naive(0.2), 1, 2)):
        made = make(frame, t_s, torch.Generator())
        assert isinstance(made, EventStream)
        assert [int((made.p == sign).sum()) for sign in (1, -1)] == [24 * up, 24 * down]
    assert [source.key for source in (*SOURCES, PHYSICAL) if source.rate == "sensor"] == ["physical"]


def separable(count, generator):
    """Recordings whose class is the one channel (of 2 polarities x 5 bins) that has events, at random
    places."""
    labels = torch.arange(count) % 10
    voxels = torch.zeros(count, 10, 32 * 32)
    for k, label in enumerate(labels.tolist()):
        voxels[k, label] = (torch.rand(32 * 32, generator=generator) < 0.2).float()
    return voxels.reshape(count, 2, 5, 32, 32), labels


@pytest.mark.bits
def test_a_trivially_separable_set_is_learnt_completely_and_training_repeats_from_its_seed(generator):
    voxels, labels = separable(200, generator)
    unseen, truth = separable(50, generator)
    net = train(voxels, labels, 6, seed=3)
    assert predict(net, unseen).tolist() == truth.tolist()
    torch.rand(7)  # the global generator has no say
    again = train(voxels, labels, 6, seed=3)
    other = train(voxels[:50], labels[:50], 1, seed=4)
    weights = [torch.cat([p.detach().flatten() for p in each.parameters()]) for each in (net, again, other)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])
    with pytest.raises(DomainError, match="0 events"):
        train(torch.zeros_like(voxels), labels, 1, 0)
    with pytest.raises(ShapeError, match="labels"):
        train(voxels, labels[:5], 1, 0)


def test_shifts_reach_every_place_and_move_events_unchanged(generator):
    dot = torch.zeros(1, 1, 9, 9)
    dot[..., 4, 4] = 3
    places = set()
    for _ in range(400):  # 25 places: one is missed with probability 25 (24/25)^400 = 2e-6
        moved = shifted(dot, generator)
        assert float(moved.sum()) == 3
        places.add(tuple(moved[0, 0].nonzero()[0].tolist()))
    assert places == {
        (row, column)
        for row in range(4 - SHIFT_PX, 5 + SHIFT_PX)
        for column in range(4 - SHIFT_PX, 5 + SHIFT_PX)
    }


def test_intervals_and_confusions_are_those_worked_out_by_hand():
    found = interval(torch.tensor([0.8, 0.9, 1.0], dtype=D))
    # deviation 0.1, Student's 97.5 % point for 2 degrees of freedom 4.30265
    assert (found.mean, found.high - found.mean) == (
        pytest.approx(0.9),
        pytest.approx(4.30265 * 0.1 / math.sqrt(3), rel=1e-5),
    )
    labels = torch.tensor([0, 0, 1, 1])
    made = by_seed([torch.tensor([0, 1, 1, 1]), torch.tensor([0, 0, 0, 1])], labels)
    assert made.accuracy.tolist() == [0.75, 0.75]
    assert made.confusion.tolist() == [[0.75, 0.25], [0.25, 0.75]]
    with pytest.raises(ShapeError, match="predictions"):
        by_seed([labels[:2]], labels)


def test_a_filter_of_stacked_pictures_sees_no_neighbour(generator):
    pictures = torch.rand(3, 4, 6, 5, generator=generator, dtype=D)
    weight = torch.rand(1, 1, 3, 3, generator=generator, dtype=D)
    steps = spiking.tall(pictures).diff(dim=0)[:, None]
    together = torch.conv2d(steps, weight, padding=1)[:, 0].unflatten(1, (4, -1))[..., :-1, :]
    for k in range(4):
        alone = torch.conv2d(pictures[:, k].diff(dim=0)[:, None], weight, padding=1)[:, 0]
        assert torch.allclose(together[:, k], alone, atol=1e-14)


@pytest.mark.bits
def test_spiking_generators_see_each_picture_alone_and_are_judged_against_silence():
    pictures = draw_pictures(3, "training", 5)
    t_s = frame_times(50.0)
    seen = frames(pictures.tiles, t_s)
    target = events.dense_counts(seen, t_s, events.SensorModel())
    ours = spiking.Ours(seen, 0)
    thesis = spiking.Thesis(seen, 0)
    moved = (
        ours.quiet(seen, t_s, torch.Generator()) - target
    )  # before it is fitted, Spike-ESIM is the ideal sensor
    # its filter rounds levels by 1e-6: of 27,648 levels some 27,648 * 1e-6 / 0.2 are that near a threshold;
    # even pictures bring ties, hence 1e-3
    assert moved.cumsum(0).abs().max() <= 1
    assert int((moved != 0).sum()) <= 1e-3 * target.numel()
    together = thesis.generate(seen, t_s, torch.Generator())
    assert float(together.sum()) > 0
    for k in range(3):
        alone = thesis.generate(seen[:, k : k + 1], t_s, torch.Generator())
        # a convolution of three pictures may round differently from one of one, by 9 products of 1e-7: as
        # above, a spike so near its threshold comes a step later
        assert int((together[:, :, k : k + 1] != alone).sum()) <= 1e-3 * alone.numel()
    assert float(spiking.objective(target, target, 0.02, 0.1)) == 0
    assert float(spiking.objective(torch.zeros_like(target), target, 0.02, 0.1)) == pytest.approx(1.1)


def test_the_study_without_spiking_generators_goes_on_where_it_stopped(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(spiking, "MODELS", {})
    monkeypatch.setattr(
        study, "SOURCES", [source for source in SOURCES if source.key in ("naive", "naive_best", "esim_best")]
    )
    options = ["--quick", "--training", "20", "--test", "20", "--calibration", "10", "--device", "cpu"]
    assert main(study.study, study.Config, [*options, "--out", str(tmp_path / "a")]) == 0
    first = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert 0 <= first["naive_accuracy"] <= 1
    assert first["physical_accuracy"] * 40 == pytest.approx(
        round(first["physical_accuracy"] * 40)
    )  # 20 pictures, 2 seeds
    # naive events of the very pictures, counted in another way
    pictures = draw_pictures(20, "training", (0, study.TRAINING, 0))
    t_s = frame_times(100.0)
    steps = events.lin_log(frames(pictures.tiles, t_s).flatten(1, 2)).diff(dim=0)
    assert first["naive_events_per_picture"] == pytest.approx(int((steps.abs() >= 0.2).sum()) / 20, abs=1e-3)
    calls = []
    monkeypatch.setattr(study, "train", lambda *given: calls.append(given))
    assert (
        main(study.study, study.Config, ["--resume", str(tmp_path / "a")]) == 0
    )  # every training is found again
    assert not calls
    again = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert {name: value for name, value in again.items() if isinstance(value, float)} == {
        name: value for name, value in first.items() if isinstance(value, float)
    }
    assert main(study.study, study.Config, ["--seeds", "1", "--out", str(tmp_path / "b")]) == 2
    assert "at least 2 seeds" in capsys.readouterr().err
