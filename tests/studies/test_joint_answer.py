"""The answer over all robots: known errors, and tables that cannot answer."""

import json
import math
from itertools import product

import pytest

from studies import joint_answer
from studies.frame.sweep import plain
from tests import refusals
from tests.studies.browser import check_page
from tests.studies.runs import numbers, page, ran

SETTING = {"family": None, "light": 1.0, "speed": 1.0, "free": [], "held": {}}
ORDERS = ("lens > mount > read-out", "mount > lens > read-out")
FACTORS = {ORDERS[0]: 1.0, ORDERS[1]: 1.1, "joint": 0.9, "book": 2.0, "default": 1.5}


def table(path, pair, nested, without=None):
    """Answers from six starts in two worlds, those of nested ``nested`` times the better order's."""
    with path.open("w") as lines:
        for seed, (arm, factor) in product(range(6), {**FACTORS, "nested": nested}.items()):
            if arm != without:
                errors = [0.01 * (seed + 1) * factor, 0.02 * (seed + 1) * factor]
                row = {"share": [0.5] * 9, "errors": errors, "setting": {**SETTING, "pair": pair}}
                lines.write(json.dumps([{"seed": seed, "arm": arm}, [row]]) + "\n")
    return path


def test_the_answer_is_the_mean_over_robots(tmp_path):
    raw = [table(tmp_path / "a", "outdoors", 0.5), table(tmp_path / "b", "corridor", 0.8)]
    assert ran(joint_answer, "--raw", *raw, "--out", tmp_path / "run") == 0
    found = numbers(tmp_path / "run")
    for name in ("", "_low", "_high"):  # every start has the same ratio
        assert found[f"nested_over_best_order{name}"] == pytest.approx(math.sqrt(0.5 * 0.8))
    assert found["nested_over_best_order_corridor"] == pytest.approx(0.8)
    assert found["joint_over_book"] == pytest.approx(0.9 / 2)
    assert found["nested_over_best_order_ahead"] == 12
    # two of 4096 signs are as far off, times five rivals
    assert found["nested_over_best_order_p"] == pytest.approx(5 * 2 / 4096)
    assert found[f"nested_over_{plain(ORDERS[1])}"] == pytest.approx(math.sqrt(0.4) / 1.1)
    assert "Over 12 starts (outdoors, corridor): Nested leaves 0.63" in page(tmp_path / "run")
    check_page("joint_answer", tmp_path / "run")


@refusals.table(__file__, "joint_answer")
def test_tables_that_cannot_answer_are_refused(row, refuses, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table(tmp_path / "whole", "outdoors", 0.5)
    table(tmp_path / "lacking", "outdoors", 0.5, "nested")
    refuses(joint_answer, row)
