"""The study of gradients: its judges against enumeration, closed forms and made-up numbers, its
core in a few seconds, and that it goes on where it was cut."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from codesign import events
from codesign.system import check
from studies.frame.run import main
from studies.gradient_flow import __main__ as study
from studies.gradient_flow import chain, silhouettes
from studies.gradient_flow.events import case as scene
from studies.gradient_flow.events import compare, topics
from studies.gradient_flow.topic import Row
from tests.studies.browser import check_page

D = torch.float64
T_S = torch.tensor([0.0, 0.01, 0.02], dtype=torch.float64)


def test_the_study_goes_on_where_it_was_cut(tmp_path, monkeypatch):
    ran = []
    topic = study.CASES["layers"]

    def measure(config, *job):
        ran.append(job)
        if len(ran) == 2:
            raise KeyboardInterrupt
        layer, rate_hz, name = job
        yield Row((layer, name, f"{rate_hz}fps"), {"cosine": 0.5, "scale": 1.0})

    monkeypatch.setitem(study.CASES, "layers", dataclasses.replace(topic, measure=measure))
    options = ["--quick", "--cases", "layers"]
    assert main(study.study, study.Config, [*options, "--out", str(tmp_path / "run")]) == 130
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "Interrupted" in page
    assert [f"<td>{job[0]}</td>" in page for job in ran] == [True, False]
    assert main(study.study, study.Config, ["--resume", str(tmp_path / "run")]) == 0
    jobs = topic.jobs(True)
    assert ran == [*jobs[:2], *jobs[1:]]
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    short = sum(job[0] == "memory" for job in jobs)  # nothing is asked of the others
    assert 0 < short < len(jobs)
    assert f"layers: {short} of {short} rows" in page
    check_page("gradient_flow", tmp_path / "run")


@pytest.mark.parametrize("wrong", [["--cases", "none"], ["--cases"], ["--seeds", "1"]])
def test_wrong_options_are_refused(tmp_path, wrong):
    assert main(study.study, study.Config, [*wrong, "--out", str(tmp_path / "other")]) == 2


def test_a_case_of_every_kind_makes_rows_that_are_judged():
    """Layers and silhouettes at their smallest."""
    config = study.Config(samples=64, seeds=2, scenes=1)
    (row,) = study.CASES["layers"].measure(config, "memory", 60, "contrast")
    assert row.numbers["cosine"] > 0.98
    assert not study.CASES["layers"].asked(row).missed(row)
    (row,) = study.CASES["silhouettes"].measure(config, "cubes", "pinhole", "pose")
    assert row.numbers["with_boundary"] < 0.1 < row.numbers["interior_only"]
    worse = Row(row.names, {**row.numbers, "with_boundary": 0.04})
    assert study.CASES["silhouettes"].asked(row).missed(worse)


# ---- event layers


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
    found = compare.Judge(events.SensorModel(on, off), count=16).mean(
        frames, T_S, lambda counts: counts.flatten(0, 1)
    )
    # evenly spread, a pixel's mean is off by at most 1/16 for each place where its count jumps; 256
    # pixels with independent starts are off by that over 16
    assert found.mean((1, 2)).numpy() == pytest.approx(truth.flatten(), abs=4 / 16 / 16)


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
    """Of a quadratic function of the frames, whose difference over a section is exactly the
    derivative in its middle."""
    ends = torch.rand(5, 3, 8, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def square(frames, t_s):
        return torch.stack((frames.square().sum(0), (frames[0] * frames[1])))

    found = compare.pair(ends, T_S, square, square)
    assert found.slope.shape == (2, compare.BLOCKS**2)
    torch.testing.assert_close(found.slope, found.difference, rtol=1e-12, atol=1e-12)


def test_a_number_that_all_pixels_share_is_differentiated_block_by_block():
    weights = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    value = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    found = topics.of_number(weights * value**2, value)
    torch.testing.assert_close(found, 1.4 * compare.blocks(weights))


def test_a_physical_layer_and_its_judge_draw_the_same_thresholds():
    """Thresholds spread by a third; a rise of 1.503 gives floor((1.503 + D)/C_on) events from a
    distance D at the start."""
    frames = climbing(16, 1.503, 0.0)
    sensor = events.SensorModel(0.15, 0.15, theta_sigma=0.05)
    on, off = events.draw_thresholds(
        sensor, (16, 16), torch.Generator().manual_seed(0), dtype=torch.float64
    )
    layer, truth = topics.physical_maps(sensor)
    torch.testing.assert_close(layer(frames, T_S)[0], (1.503 / on).floor(), rtol=0, atol=0)
    place = (torch.arange(4000, dtype=torch.float64)[:, None, None] + 0.5) / 4000
    exact = ((1.503 + place * (on + off) / 2 - off / 2) / on).floor().mean(0)
    # the mean over evenly spread places is off by at most one of them for every place where the
    # count jumps
    jumps = ((on + off) / 2 / on).ceil()
    assert ((truth(frames, T_S)[0] - exact).abs() <= jumps / compare.BEGINNINGS + 0.001).all()


def test_the_timing_judge_sees_what_the_stream_shows(generator):
    """Sums and volume from counts per tenth of a millisecond, beside those of single events."""
    level = 4 + 0.3 * torch.randn(3, 4, 4, generator=generator, dtype=torch.float64).cumsum(0)
    t_s = scene.times(topics.TRUTH_HZ)
    share = torch.linspace(0, 2, len(t_s), dtype=torch.float64)[:, None, None]
    path = torch.where(
        share < 1, torch.lerp(level[0], level[1], share), torch.lerp(level[1], level[2], share - 1)
    )
    counts = events.dense_counts(path, t_s, topics.IDEAL, log_input=True)
    stream = events.simulate(path, t_s, topics.IDEAL, log_input=True)
    found = topics.observed(counts[:, :, None], t_s)[:, 0]
    end_us = round(scene.DURATION_S * 1e6)
    volume = events.from_stream(stream, 0, end_us, topics.BINS, dtype=torch.float64).counts[0]
    assert torch.equal(found[:2], volume.sum(1).round())
    # times are off by at most half a tenth of a millisecond
    assert (
        float((found[2:] - volume.flatten(0, 1)).abs().max())
        <= float(volume.sum(1).max()) * 5e-5 / 0.025
    )


# ---- silhouettes


def test_the_judge_finds_the_error_noise_and_cosine_that_were_put_in(generator):
    truth = torch.randn(18, generator=generator, dtype=D)
    noise = torch.randn(400, 18, generator=generator, dtype=D)
    values = torch.stack(
        [truth + 0.5 * noise, 0 * noise - truth, 1.25 * truth + 0 * noise, 0 * noise], 1
    )
    row = silhouettes.judged(values)
    size = float(truth.norm())
    # 18 numbers of a standard error of 0.5 / 20 each, known to 1 in sqrt(2 x 18 x 399)
    assert row["noise"] == pytest.approx(0.025 * math.sqrt(18) / size, rel=0.05)
    found = truth + 0.5 * noise.mean(0)
    away = (1.25 * truth - found).norm() / found.norm()
    assert row["with_boundary"] == pytest.approx(float(away), rel=1e-12)
    assert row["noise_with_boundary"] == pytest.approx(0, abs=1e-12)
    assert row["one_estimate"] == pytest.approx(1, rel=1e-12)
    cosine = float(truth @ found / (truth.norm() * found.norm()))
    assert (row["cosine"], row["cosine_interior"]) == pytest.approx((cosine, -cosine), rel=1e-12)


# ---- lens, mount, thresholds and network in one graph


@pytest.fixture(scope="module")
def batch():
    return chain.draw_batch(4, 1000)


def test_every_group_of_one_graph_has_the_gradient_of_differences(batch, monkeypatch):
    # a difference is made of two neighbouring steps; two more look for better ones
    monkeypatch.setattr(chain, "LADDER", chain.LADDER[::2])
    system = chain.make_system(10_000, 0)
    assert sum(p.numel() for p in system.flow.parameters()) >= 10_000
    for row in chain.joint_rows(system, batch, directions=4):
        assert row.relative_error <= 0.05, row
        assert row.cosine >= 0.99, row


def test_one_optimiser_lowers_the_loss_of_all_groups_together(batch):
    system = chain.make_system(10_000, 0)
    learned = [p for p in system.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam(learned, lr=0.01)
    first = check(system, batch, optimiser).loss.item()
    before = [p.detach().clone() for p in learned]
    for _ in range(25):
        optimiser.zero_grad()
        system(batch).backward()
        optimiser.step()
    assert system(batch).loss.item() < 0.8 * first
    assert all(not torch.equal(a, b) for a, b in zip(learned, before, strict=True))
