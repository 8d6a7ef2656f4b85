"""The map of joint design and the shares of its parts: known valleys, known errors, one small
race."""

import math
from itertools import product

import pytest
import torch

from studies import joint_levers, joint_map
from studies.codesign import cells, couplings
from studies.codesign.design import BLOCKS
from studies.codesign.race import start
from tests.studies.browser import check_page
from tests.studies.runs import lines, numbers, page, ran

F = torch.float64
SMALL = (
    "--worlds 1 --per-draw 1 --judged-worlds 2 --judged-drives 1 --steps 2 --settling 5 --seeds 1 "
    "--fnos 4 --lights 0.5 --speeds 1 --couplings 0 --out"
)


def test_a_map_says_which_cells_are_won_and_what_their_valleys_foretell(tmp_path, monkeypatch):
    """Errors that are known: joint .8 of the better order in daylight and 1.25 of it in the dark;
    a valley in which the lens and the mount pull at each other by day and not by night."""
    asked = {}

    def answers(run, regimes, arms):
        asked.update(regimes)
        rows = []
        for cell, seed, arm in product(regimes, range(run.config.seeds), arms):
            joint = 0.2 if cell.startswith("light 1,") else 0.3125
            error = {"joint": joint, arms[1]: 0.25}.get(arm, 0.5)
            rows.append(
                {"regime": cell, "seed": seed, "arm": arm, "errors": [error] * 3, "expected": error}
            )
        return rows

    def pulls(run, regimes, rows, draws):
        found = []
        for cell, given in regimes.items():
            space = cells.space_of(given)
            pull = 0.8 if cell.startswith("light 1,") else 0.0
            a, b = space.block("lens")[0], space.block("mount")[0]
            for one, other in product(range(len(space.free)), repeat=2):
                if one <= other:
                    value = float(one == other) + pull * ((one, other) == (a, b))
                    names = {"one": space.free[one], "other": space.free[other]}
                    found.append(
                        {"regime": cell, "draw": 0, **names, "curvature": value, "error": 0.1}
                        | {"at": [0.5] * len(space.free)}
                    )
        return found

    monkeypatch.setattr(joint_map, "answers", answers)
    monkeypatch.setattr(joint_map, "pulls_of", pulls)
    assert ran(joint_map, "--fnos 0 --speeds 1 0.5 0.3 --out", tmp_path / "map") == 0
    figures = numbers(tmp_path / "map")
    assert (figures["cells"], figures["cells_won"], figures["cells_lost"]) == (6, 3, 3)
    day, night = ("cell_light_1_f_free_speed_1", "cell_light_0_1_f_free_speed_1")
    assert figures[f"{day}_value"] == pytest.approx(0.8)
    assert figures[f"{night}_value"] == pytest.approx(1.25)
    # one pass over parts that stand alone ends at the bottom
    assert figures[f"{night}_at_the_bottom"] == pytest.approx(1.0)
    given = asked["light 1, f free, speed 1"]
    space = cells.space_of(given)
    b = space.block("mount")[0]
    left = []
    for seed in range(6):
        away = float(start(space, seed)[b] - 0.5)
        # the lens goes to -.8 of the mount's place, the mount to .64 of its own
        lens, mount = max(-0.8 * away, -0.5), 0.64 * away
        height = (lens**2 + mount**2 + 1.6 * lens * mount) / 2
        left.append(1 + height * 0.9 / (height + 0.9) / 0.1)
    expected = 1 / float(torch.tensor(left, dtype=F).quantile(0.5))
    assert figures[f"{day}_at_the_bottom"] == pytest.approx(expected)
    # equal values share their rank
    assert figures["rank_of_foretold"] == pytest.approx(1.0)
    assert -1 <= figures["rank_of_foretold_low"] <= figures["rank_of_foretold_high"] <= 1.0 + 1e-9
    assert "in 3, loses in 3, and is undecided in 0" in page(tmp_path / "map")
    check_page("joint_map", tmp_path / "map")
    assert ran(joint_map, "--fnos 0 --speeds 1 0.5 0.3 --seeds 2 --out", tmp_path / "few") == 0
    assert "So few cells or starts decide nothing" in page(tmp_path / "few")


def test_parts_that_act_by_themselves_have_their_own_factors(tmp_path, monkeypatch):
    """Every part multiplies the error by a factor, whatever else is designed: its Shapley value."""
    factors = {"lens": 0.5, "mount": 0.9, "sensor": 0.7, "network": 1.1}

    def answers(run, regimes, arms):
        rows = []
        for parts in joint_levers.SUBSETS:
            cell = joint_levers.told(parts)
            assert set(regimes[cell]["free"]) <= {n for part in parts for n in BLOCKS[part]}
            error = 0.4 * math.prod(factors[part] for part in parts)
            rows += [
                {"regime": cell, "seed": seed, "arm": "joint", "errors": [error] * 3}
                for seed in range(run.config.seeds)
            ]
        return rows

    monkeypatch.setattr(joint_levers, "answers", answers)
    monkeypatch.setattr(joint_levers, "judged_errors", lambda *_: {"errors": [0.4, 0.4, 0.4]})
    assert ran(joint_levers, "--out", tmp_path / "levers") == 0
    figures = numbers(tmp_path / "levers")
    for part, factor in factors.items():
        assert figures[f"share_{joint_levers.NAMES[part]}"] == pytest.approx(factor)
    assert "the lens brings most (lens over sensor" in page(tmp_path / "levers")
    check_page("joint_levers", tmp_path / "levers")


def test_cells_are_raced_judged_and_taken_up_again(tmp_path):
    assert ran(joint_map, SMALL, tmp_path / "map") == 0
    table = tmp_path / "map" / "answers.jsonl"
    rows = lines(table)
    assert [axes["arm"] for axes, _ in rows] == ["joint", *joint_map.ORDERS]
    assert all(found["fno"] == 4.0 for _, (found,) in rows if "fno" in found)
    assert all(len(found["errors"]) == 2 and found["drives"] == 2 for _, (found,) in rows)
    before = table.read_bytes()
    assert ran(joint_map, "--resume", tmp_path / "map") == 0
    assert table.read_bytes() == before


def test_the_best_answer_of_a_cell_is_that_of_which_least_is_expected():
    class Known:
        space = type("S", (), {"made": staticmethod(lambda share: share)})

        def draw(self, number):
            return number

        def looked(self, share, samples):
            return type("L", (), {"expected": (share - 0.3).square().sum()[None]})

    rows = [{"share": [value] * 2} for value in (0.9, 0.35, 0.0)]
    assert couplings.best_of(Known(), rows) is rows[1]
    assert cells.setting(joint_map.Config())["calibration"] == []
