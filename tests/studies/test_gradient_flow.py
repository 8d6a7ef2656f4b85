"""The study of gradients: its judges against enumeration, closed forms and made-up numbers, its
core in a few seconds, and that it goes on where it was cut."""

import dataclasses
import math

import pytest
import torch

from codesign.system import check
from studies.gradient_flow import __main__ as study
from studies.gradient_flow import chain, silhouettes
from studies.gradient_flow.topic import Row
from tests.numbers import randn64
from tests.studies.browser import check_page
from tests.studies.runs import page, ran


def test_the_study_goes_on_where_it_was_cut(tmp_path, monkeypatch):
    measured = []
    topic = study.CASES["silhouettes"]

    def measure(config, *job):
        measured.append(job)
        if len(measured) == 2:
            raise KeyboardInterrupt
        error = 0.5 if job[0] == "cubes" else 0.01
        yield Row(job, {"with_boundary": error, "one_estimate": 0.05})

    monkeypatch.setitem(study.CASES, "silhouettes", dataclasses.replace(topic, measure=measure))
    out = tmp_path / "run"
    assert ran(study, "--quick --cases silhouettes --out", out) == 130
    assert "Interrupted" in page(out)
    assert [f"<td>{job[2]}</td>" in page(out) for job in measured] == [True, False]
    assert ran(study, "--resume", out) == 0
    jobs = topic.jobs(True)
    assert measured == [*jobs[:2], *jobs[1:]]
    short = sum(job[0] == "cubes" for job in jobs)
    assert 0 < short < len(jobs)
    assert f"silhouettes: {short} of {len(jobs)} rows" in page(out)
    first, _ = page(out).split("Below what is asked", 1)
    assert f"{len(jobs)} of {len(jobs)} gradients (silhouettes) are judged" in first
    assert f"are judged, and {len(jobs) - short} of" in first
    check_page("gradient_flow", out)


def test_a_silhouette_makes_a_row_that_is_judged():
    config = study.Config(samples=64, seeds=2)
    (row,) = study.CASES["silhouettes"].measure(config, "cubes", "pinhole", "pose")
    assert row.numbers["with_boundary"] < 0.1 < row.numbers["interior_only"]
    worse = Row(row.names, {**row.numbers, "with_boundary": 0.04})
    assert study.CASES["silhouettes"].asked(row).missed(worse)


def test_the_first_line_counts_what_is_judged_and_what_is_right_of_it():
    """Of the chain all rows are asked for something, of the scenes none that is not judgeable."""
    errors = {"relative_error": 1e-7, "cosine": 0.95}
    rows = {
        "chain": [
            Row((chain.RAYS, "conic"), errors),
            Row((chain.RAYS, "index"), {**errors, "relative_error": 1e-5}),
            Row((chain.HARD, "pose"), errors),
            Row((chain.HARD, "all"), {**errors, "cosine": 0.8}),
            Row((chain.HARD, "lens"), {**errors, "cosine": math.nan}),
        ],
        "scenes": [Row(("room", "events", "theta"), errors, "not judgeable")],
    }
    said = study.headline(rows)
    assert said.startswith("5 of 6 gradients (chain, scenes) are judged, and 2 of these are")


# ---- silhouettes


def test_the_judge_finds_the_error_noise_and_cosine_that_were_put_in(generator):
    truth = randn64(generator, 18)
    noise = randn64(generator, 400, 18)
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
