"""The DAVIS study's parts against hand-computed values and closed forms, and its fit against thresholds that
are known."""

import json
import math
from typing import Any

import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import DomainError, FileFormatError, ShapeError
from codesign.events.stream import ordered
from studies.davis_fit import __main__ as study
from studies.davis_fit.compare import judge
from studies.davis_fit.limits import cancelled_share, median_motion_px, still_events
from studies.davis_fit.loss import LOSSES, match
from studies.davis_fit.model import Clip, FittedSensor, blur, clip
from studies.davis_fit.recording import Recording, load
from studies.davis_fit.score import (
    block_sums,
    correlation,
    correlation_draws,
    draws,
    interval,
    pooled,
    ratio_draws,
)
from studies.davis_fit.search import descend, naive_counts
from studies.davis_fit.upsample import between, flows
from studies.frame.run import main

D = torch.float64


def ones(blocks):
    return torch.ones(1, blocks, dtype=D)


def test_correlation_equals_a_value_worked_out_by_hand():
    # deviations (-1.5, -0.5, 0.5, 1.5) and (-0.5, -1.5, 1.5, 0.5): products 0.75 + 0.75 + 0.75 + 0.75 = 3,
    # squares 5 and 5
    assert correlation(
        torch.tensor([1.0, 2.0, 3.0, 4.0]), torch.tensor([2.0, 1.0, 4.0, 3.0])
    ) == pytest.approx(0.6, abs=1e-15)
    assert correlation(torch.arange(5.0), torch.full((5,), 2.0)) == 0.0
    with pytest.raises(ShapeError, match="cannot be correlated"):
        correlation(torch.zeros(3), torch.zeros(4))


def test_pooling_and_ratios_equal_sums_by_hand():
    counts = torch.zeros(1, 2, 4, 5)
    counts[0, 0, 0, 0], counts[0, 0, 1, 1], counts[0, 0, 3, 3], counts[0, 1, 2, 0], counts[0, 0, 0, 4] = (
        3,
        2,
        1,
        4,
        9,
    )
    assert pooled(counts, 2).tolist() == [
        [[[5, 0], [0, 1]], [[0, 0], [4, 0]]]
    ]  # the fifth column fills no square
    on, off = ratio_draws(2 * counts, counts + (counts > 0), ones)
    assert float(on[0]) == pytest.approx(30 / 19)  # (3 + 2 + 1 + 9) * 2 over one more in each of four pixels
    assert float(off[0]) == pytest.approx(8 / 5)
    with pytest.raises(DomainError, match="no event"):
        ratio_draws(counts, torch.zeros_like(counts), ones)
    with pytest.raises(DomainError, match="do not fit"):
        pooled(counts, 6)


def test_bootstrap_draws_are_the_figures_of_the_drawn_pixels(generator):
    simulated, recorded = (
        torch.randint(0, 5, (3, 2, 40, 60), generator=generator).double() for _ in range(2)
    )
    chosen = [0, 0, 4, 5, 2, 2]  # of two rows of three blocks of 20 px
    weights = torch.zeros(1, 6, dtype=D).index_add_(1, torch.tensor(chosen), torch.ones(1, 6, dtype=D))

    def cut(counts):
        return np.concatenate(
            [
                (counts[:, 0] - counts[:, 1])[:, 20 * (b // 3) :, 20 * (b % 3) :][:, :20, :20].numpy().ravel()
                for b in chosen
            ]
        )

    found = correlation_draws(simulated, recorded, 1, lambda blocks: weights)
    assert float(found[0]) == pytest.approx(np.corrcoef(cut(simulated), cut(recorded))[0, 1], abs=1e-12)
    assert block_sums(recorded, 20).sum(-1).tolist() == recorded.sum((2, 3)).tolist()
    taken = draws(6, 500, generator)
    assert taken[0].tolist() == [1] * 6
    assert taken.sum(1).tolist() == [6] * 501


def test_bootstrap_interval_has_the_width_of_theory(generator):
    # 400 blocks, each with one recorded event and with simulated ones of mean 2 and variance 2: the ratio's
    # standard error is sqrt(2/400) = 0.0707
    simulated = torch.zeros(1, 2, 400, 400, dtype=D)
    simulated[0, :, ::20, ::20] = torch.poisson(torch.full((2, 20, 20), 2.0, dtype=D), generator=generator)
    recorded = torch.zeros_like(simulated)
    recorded[0, :, ::20, ::20] = 1
    for row in ratio_draws(simulated, recorded, lambda blocks: draws(blocks, 2000, generator)):
        found = interval(row)
        # the sample's own spread is good to 1/sqrt(800) = 3.5 % and the ends of 2000 draws to 3 %: three of
        # both together are 14 %
        assert (found.high - found.low) / 2 == pytest.approx(1.96 * math.sqrt(2 / 400), rel=0.14)
        assert found.low < found.value < found.high


def test_losses_equal_values_by_hand():
    recorded = torch.zeros(1, 2, 1, 3)
    recorded[0, 0, 0], recorded[0, 1, 0] = torch.tensor([4.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 9.0])
    # twice the counts: correlation 1; log ratios ln(9/5) and ln(19/10)
    assert float(match(2 * recorded, recorded)) == pytest.approx(
        (math.log(9 / 5) ** 2 + math.log(19 / 10) ** 2) / 2, abs=1e-6
    )
    assert float(LOSSES["squares"](2 * recorded, recorded)) == pytest.approx((16 + 81) / 3)
    assert float(LOSSES["roots"](recorded + 1, recorded)) == pytest.approx(
        (
            4 * (math.sqrt(1.375) - math.sqrt(0.375)) ** 2
            + (math.sqrt(5.375) - math.sqrt(4.375)) ** 2
            + (math.sqrt(10.375) - math.sqrt(9.375)) ** 2
        )
        / 6,
        rel=1e-5,
    )
    assert float(LOSSES["poisson"](recorded + 1, recorded)) == pytest.approx(
        (13 + 6 - 4 * math.log(5) - 9 * math.log(10)) / 6, rel=1e-6
    )
    # in one pixel 3 ON and 1 OFF: two of four events are undone
    assert cancelled_share(torch.tensor([3.0, 1.0]).reshape(1, 2, 1, 1)) == pytest.approx(0.5)


def test_judging_twice_the_recorded_counts_gives_what_follows(generator):
    recorded = torch.poisson(torch.full((2, 2, 40, 40), 3.0), generator=generator)
    found = judge(2 * recorded, recorded, 50, 0)
    for value in found.correlation.values():
        assert (value.value, value.low, value.high) == pytest.approx((1, 1, 1), abs=1e-9)
    assert [ratio.value for ratio in found.ratio] == pytest.approx([2, 2])
    assert found.by_interval == pytest.approx([1, 1])
    assert (found.slope, found.by_polarity) == pytest.approx((2, 1))
    # some 4800 events per interval and polarity: one more on either side of the ratio moves 2 by 1/4800
    assert found.rate_factor == pytest.approx(2, rel=3e-4)


def test_still_pixels_and_motion_are_counted_as_by_hand():
    # three pixels in a row; the second flickers and is not still. Two intervals of 0.5 s hold events of still
    # pixels: 2 ON; then 1 ON, 1 OFF
    frames = torch.tensor([[5.0, 0.0, 7.0], [5.0, 90.0, 7.0], [5.0, 0.0, 7.0]])[:, None]
    t_us = torch.tensor([100_000, 200_000, 300_000, 600_000, 900_000, 950_000])
    x = torch.tensor([0, 2, 1, 0, 1, 2])
    p = torch.tensor([1, 1, 1, -1, -1, 1])
    recording = Recording(
        frames, torch.tensor([0.0, 0.5, 1.0], dtype=D), 0.1, ordered(t_us, x, torch.zeros_like(x), p, 1, 3)
    )
    found = still_events(recording)
    assert found["still_pixel_share"] == pytest.approx(2 / 3)
    assert found["still_pixel_event_share"] == pytest.approx(4 / 6)
    assert (found["still_pixel_on_hz"], found["still_pixel_off_hz"]) == pytest.approx(
        (1.5, 0.5)
    )  # per pixel in one second
    assert found["still_pixel_hz_in_quietest_interval"] == pytest.approx(
        2.0
    )  # three events each: the first counts; 2 of still pixels in 2 x 0.5 s
    flow = torch.tensor([[3.0, 0.0, 9.0], [4.0, 2.0, 9.0]]).reshape(1, 2, 1, 3)
    counts = torch.tensor([[[2.0, 1.0, 0.0]], [[0.0, 1.0, 0.0]]])[None]
    assert median_motion_px(flow, counts) == pytest.approx(
        [2.0]
    )  # of 5 and 2, the two that fired twice; torch takes the lower


def test_blur_is_a_gaussian_of_one_pixel():
    point = torch.zeros(1, 21, 21, dtype=D)
    point[0, 10, 10] = 1
    spread = blur(point)[0]
    place = torch.arange(-10, 11, dtype=D)
    assert float(spread.sum()) == pytest.approx(1, abs=1e-12)
    # cut at 4 px: the variance misses 2 * 4^2 * exp(-8)/sqrt(2 pi) and what lies beyond, about 0.5 %
    assert float((spread.sum(0) * place.square()).sum()) == pytest.approx(1, rel=6e-3)


def test_pictures_move_along_a_known_flow():
    x = torch.arange(40, dtype=D).expand(30, 40)
    field = np.zeros((2, 30, 40), dtype=np.float32)
    field[1] = 6.0
    made = between(2 * x, 2 * (x - 6), field, -field, 3)
    assert torch.equal(made[0], 2 * x)
    for step in (
        1,
        2,
    ):  # away from the edges a straight slope moves exactly; flow and place are single precision
        assert (made[step] - 2 * (x - 2 * step))[:, 6:-6].abs().max() < 1e-4
    with pytest.raises(DomainError, match="whole number"):
        between(x, x, field, field, 0)


def test_flow_of_a_moved_texture_is_found():
    y, x = np.indices((48, 64))

    def texture(dx, dy):
        return (
            60 + 25 * np.sin((x - dx) / 4.1) * np.cos((y - dy) / 5.3) + 15 * np.sin((x - dx + y - dy) / 7.0)
        )

    there, back = flows(texture(0, 0), texture(1.5, -1.0))
    for field, sign in (
        (there, 1),
        (back, -1),
    ):  # smoothness pulls at the rims; the middle is good to a fifth of a pixel at the median
        assert np.median(np.abs(field[0, 8:-8, 8:-8] + sign * 1.0)) < 0.2
        assert np.median(np.abs(field[1, 8:-8, 8:-8] - sign * 1.5)) < 0.2


def drifting(t_s):
    """Gratings that drift over a bright and a dark ground, 0.4 rad per 40 ms: [T, 32, 32], never below 3."""
    y, x = torch.meshgrid(torch.arange(32, dtype=D), torch.arange(32, dtype=D), indexing="ij")
    ground = torch.where(y < 16, 70.0, 18.0)
    return ground * (1 + 0.8 * torch.sin((x - 30 * t_s[:, None, None]) / 3.0 + 0.4 * y))


def test_the_fit_recovers_thresholds_that_are_known():
    dark_offset = 6.0
    thetas = (0.15, 0.21)
    fine_s = torch.arange(0, 481, dtype=D) * 1e-3
    stream = events.simulate(
        (drifting(fine_s) + dark_offset).log(), fine_s, events.SensorModel(*thetas), log_input=True
    )
    recorded = events.to_counts(stream, fine_s[::40])
    recorded += torch.poisson(
        torch.full_like(recorded, 0.04 * 0.1), generator=torch.Generator().manual_seed(7)
    )  # 0.1 noise events per pixel and second
    seen = clip(drifting(fine_s[::20]).float(), 0.02, 2)
    sensor = FittedSensor(blur_odds=1e-3, time_constant_s=1e-4, noise_on_hz=0.1, noise_off_hz=0.1)
    descend(sensor, seen, recorded, slice(0, 8), match, 120, lambda loss: None)
    found = {name: float(value.detach()) for name, value in sensor.values().items()}
    # A swing between turning points is some 8 thresholds, of which whole ones count: with the known
    # parameters the 8 intervals' event numbers are off by up to 2 % where 20 ms samples move a turning point.
    # The dark offset moves with the thresholds, and is known less well.
    assert found["theta_on"] == pytest.approx(thetas[0], rel=0.04)
    assert found["theta_off"] == pytest.approx(thetas[1], rel=0.04)
    assert found["dark_offset"] == pytest.approx(dark_offset, rel=0.12)
    held_out = sensor.expected(seen)[8:].sum((0, 2, 3)) / recorded[8:].sum((0, 2, 3))
    assert held_out.tolist() == pytest.approx([1, 1], abs=0.04)


def test_noise_fades_with_light_and_is_poisson():
    frames = torch.zeros(3, 100, 200)
    frames[:, :, 100:] = 10.0
    seen = Clip(frames, frames, 0.25, 1)
    sensor = FittedSensor(dark_offset=10.0, noise_on_hz=4.0, noise_off_hz=8.0)
    counts = sensor.draw(seen, torch.Generator().manual_seed(1))
    for polarity, expected in ((0, 1.0), (1, 2.0)):
        for half, share in (
            (counts[:, polarity, :, :100], 1.0),
            (counts[:, polarity, :, 100:], 0.25),
        ):  # (10/(10 + 10))^2
            assert float(half.mean()) == pytest.approx(
                expected * share, abs=5 * math.sqrt(expected * share / half.numel())
            )


def test_naive_counts_and_levels_are_those_of_a_step_worked_out_by_hand():
    frames = torch.tensor([10.0, 10.0, 30.0, 30.0, 10.0])[:, None, None]
    # ln(35/15) = 0.85 up and down; with steps in pairs both fall into the second interval
    assert naive_counts(frames, 0.02, 2, 0.8, 5.0).flatten().tolist() == [1, 0, 0, 1]
    assert naive_counts(frames, 0.02, 2, 0.9, 5.0).flatten().tolist() == [0, 0, 0, 0]
    sensor = FittedSensor(theta_on=0.2, theta_off=0.35, dark_offset=5.0, blur_odds=1e-6, time_constant_s=1e-7)
    assert sensor.signal(Clip(frames, frames, 0.02, 2)).flatten().tolist() == [
        4,
        0,
        0,
        2,
    ]  # 0.85/0.2; from 0.8 back to 0: 0.8/0.35


def write_recording(path, **changed):
    """A made-up recording of 40 x 48 pixels with 7 frames: a bright bar passes; events of a sensor with θ
    0.15 and 0.2."""
    fine_s = torch.arange(0, 261, dtype=D) * 1e-3
    x = torch.arange(48, dtype=D)
    frames = (10 + 100 * torch.exp(-((x - 4 - 150 * fine_s[:, None]) / 4).square()))[:, None].expand(
        -1, 40, -1
    )
    stream = events.simulate((frames + 8).log(), fine_s, events.SensorModel(0.15, 0.2), log_input=True)
    middle_us = 10_000 + 40_000 * np.arange(7)
    seen = frames[10::40][:7].round().to(torch.uint8)
    exposure_us = np.stack((middle_us - 2000, middle_us + 2000), 1)
    entries = {
        "t": stream.t_us,
        "x": stream.x,
        "y": stream.y,
        "p": stream.p > 0,
        "frames": seen,
        "exposure": exposure_us,
    }
    kept: dict[str, Any] = {
        name: np.asarray(value) for name, value in {**entries, **changed}.items() if value is not None
    }
    np.savez(path, **kept)
    return stream


def test_a_recording_is_read_and_a_bad_one_refused(tmp_path):
    path = tmp_path / "made.npz"
    stream = write_recording(path)
    recording = load(path)
    assert recording.mid_s.tolist() == pytest.approx([0.01 + 0.04 * k for k in range(7)])
    assert recording.exposure_s == pytest.approx(0.004)
    inside = (stream.t_us > 14_000) & (stream.t_us <= 254_000)
    assert float(recording.counts(offset_s=0.004).sum()) == int(inside.sum())
    for changed, error, words in (
        ({"x": None}, FileFormatError, "no array x"),
        ({"exposure": np.zeros((3, 2))}, FileFormatError, "exposure"),
        ({"frames": np.zeros((4, 40, 48)), "exposure": np.zeros((4, 2))}, ShapeError, "at least 5"),
    ):
        write_recording(path, **changed)
        with pytest.raises(error, match=words):
            load(path)
    path.write_bytes(b"no archive")
    with pytest.raises(FileFormatError, match="a recording holds"):
        load(path)


def test_both_formats_of_the_shared_recording_are_the_same(shared):
    folder = shared("data/davis346_newton_cradle/demo-01.npz").parent
    repacked = load(folder / "demo-01.npz")
    original = load(folder / "demo-01.aedat4")
    assert len(repacked.stream) == 319_512  # as the folder's README says
    assert torch.equal(repacked.frames, original.frames)
    assert torch.allclose(repacked.mid_s.diff(), original.mid_s.diff(), atol=1e-9)
    offset_s = float(original.mid_s[0] - repacked.mid_s[0])
    assert torch.equal(original.counts(), repacked.counts()), offset_s


def test_the_study_records_what_the_files_say(tmp_path, capsys):
    assert (
        main(
            study.study,
            study.Config,
            ["--recording", str(tmp_path / "none.npz"), "--out", str(tmp_path / "a")],
        )
        == 2
    )
    assert "the recording is not there" in capsys.readouterr().err
    path = tmp_path / "made.npz"
    stream = write_recording(path)
    assert (
        main(
            study.study,
            study.Config,
            ["--quick", "--upsample", "1", "--recording", str(path), "--out", str(tmp_path / "b")],
        )
        == 0
    )
    metrics = json.loads((tmp_path / "b" / "metrics.json").read_text())
    with np.load(path) as data:
        frames = data["frames"].astype(np.float64)
    level = np.where(frames <= 20, frames * math.log(20) / 20, np.log(np.maximum(frames, 20)))
    on = (np.diff(level, axis=0)[3:] >= 0.2).sum()  # the second half: intervals 3 to 5
    recorded = int(((stream.t_us > 130_000) & (stream.t_us <= 250_000) & (stream.p > 0)).sum())
    assert metrics["naive_on_second_half_ratio_on"] == pytest.approx(on / recorded)
    assert metrics["fitted_on_second_half_correlation_1px"] > metrics["naive_on_second_half_correlation_1px"]
    page = (tmp_path / "b" / "report.html").read_text()
    assert "A real event camera against simulation" in page
