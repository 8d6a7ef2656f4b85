"""The verdicts of the cheapest rows of ``studies.gradient_flow`` beside a committed table: none may
worsen. Write the table anew with ``python -m tests.gradients.test_verdicts``."""

import csv
from pathlib import Path

import pytest
import torch

from codesign import events
from studies.gradient_flow.__main__ import Config
from studies.gradient_flow.certificates import picture, topic
from studies.gradient_flow.topic import NOT_JUDGEABLE, RIGHT, WRONG, Row

TABLE = Path(__file__).with_name("verdicts.csv")
COLUMNS = ("scene", "junction", "group", "verdict")
WORSE = (RIGHT, NOT_JUDGEABLE, WRONG)
# one draw: where no silhouette moves film samples make no noise
CONFIG = Config(quick=True, film_samples=8, draws=1, directions=1)
JOBS = (
    *(("smooth plane", part) for part in ("events", "spikes", "flow", "true flow", "seen")),
    *(("dark room", part) for part in ("events", "spikes")),
)


def measured(jobs=JOBS):
    """Every row of some jobs."""
    return [row for job in jobs for row in topic.measure(CONFIG, *job)]


def verdicts(rows):
    """State of every row by its names."""
    return {row.names: row.state for row in rows}


def committed():
    with TABLE.open(encoding="utf-8") as file:
        return {
            tuple(row[name] for name in COLUMNS[:3]): row["verdict"] for row in csv.DictReader(file)
        }


def worsened(rows):
    """Names of the rows that are worse than in the table, or not in it."""
    found, table = verdicts(rows), committed()
    return [
        names
        for names, state in found.items()
        if names not in table or WORSE.index(state) > WORSE.index(table[names])
    ]


def test_no_verdict_is_worse_than_in_the_table():
    rows = measured()
    assert worsened(rows) == []
    assert verdicts(rows).keys() == committed().keys()
    # float64 and no silhouette: nothing but rounding, and three times the bending; the final loss has
    # kinks where a level stands still
    for row in rows:
        if row.names[1] != "final loss":
            assert row.numbers["relative_error"] <= 1e-4 + 1 / row.numbers["signal_to_noise"], row


def test_a_threshold_gradient_that_is_3_per_cent_too_long_is_found(monkeypatch):
    srm = events.srm

    def wrong(drive, *, theta, **options):
        return srm(drive, theta=theta + 0.03 * (theta - theta.detach()), **options)

    monkeypatch.setattr(events, "srm", wrong)
    assert worsened(measured([("smooth plane", "spikes")])) == [
        ("smooth plane", "spiking neurons", "threshold")
    ]


def test_frames_whose_gradient_is_3_per_cent_too_short_are_found(monkeypatch):
    frames, lines = picture.frames, picture.lines

    def wrong(*asked):
        image = frames(*asked)
        return image - 0.03 * (image - image.detach())

    monkeypatch.setattr(picture, "frames", wrong)
    monkeypatch.setattr(
        picture, "lines", lambda *asked: [each for each in lines(*asked) if each[0] == "pose x"]
    )
    assert worsened(measured([("smooth plane", "seen")])) == [
        ("smooth plane", "frames", "pose x"),
        ("smooth plane", "final loss", "pose x"),
    ]


@pytest.mark.parametrize(("error", "state", "never"), [(0, "pass", "fail"), (0.2, "fail", "pass")])
def test_the_judge_of_draws_knows_its_own_noise(error, state, never):
    """600 groups of one number, 4 draws, noise of 1 % each: of right gradients 2 x 1.5e-4 are
    called wrong, 0.2 of 600, and more than two once in a thousand times; a wrong one lies 40
    standard errors away."""
    generator = torch.Generator().manual_seed(0)
    noise = 0.01 * torch.randn(4, 600, generator=generator, dtype=torch.float64)
    chosen = [(str(k), torch.ones(1)) for k in range(600)]
    rows = picture.judged(
        chosen, 1 + error + noise, torch.ones_like(noise), torch.zeros(600, dtype=torch.float64)
    )
    assert sum(row.verdict == state for row in rows) >= 500
    assert sum(row.verdict == never for row in rows) <= 2


def test_the_headline_counts_the_rows():
    def rows(**states):
        numbers = {"relative_error": 0.04}
        return [
            Row(("room", "frames", "pose x"), numbers, state.replace("_", " "))
            for state, count in states.items()
            for _ in range(count)
        ]

    assert topic.headline(rows(right=37, not_judgeable=3)) == (
        "Every gradient that can be judged is right within 1 % or its own noise; 3 of 40 cannot be "
        "judged at this noise."
    )
    assert topic.headline(rows(right=5, wrong=1)) == (
        "1 of 6 gradients that can be judged are wrong by more than 1 %, the worst by 0.04 "
        "of its length (room, frames, pose x); 0 of 6 cannot be judged at this noise."
    )


if __name__ == "__main__":
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows((*names, state) for names, state in verdicts(measured()).items())
