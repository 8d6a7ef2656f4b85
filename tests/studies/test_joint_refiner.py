"""Designs and the refiner's weights in one optimiser: the slope that weights get, and what is left
of it where one of the two does not move."""

from copy import deepcopy

import pytest
import torch

from codesign import flow
from scenes.robots import pair as robot_pair
from studies import joint_refiner
from studies.codesign.cells import setting, space_of
from studies.codesign.design import Space
from studies.codesign.race import Judge
from studies.codesign.refined import AFTERWARDS, JOINT, Refined, descended, raced
from tests.studies.browser import check_page
from tests.studies.runs import numbers, page, ran

SETTING = {"steps": 2, "updates": 2, "rate": 1e-4, "settling": 6}


@pytest.fixture(scope="module")
def drawn():
    space = Space.of("outdoors", None, free=("efl_mm", "z_m", "theta"))
    made = Refined(space, robot_pair.training(1), 1, 2)
    made.network = flow.load("refiner")
    return made


@pytest.mark.slow
def test_weights_get_the_slope_of_the_velocity_error(drawn):
    looked = drawn.looked(drawn.space.made(drawn.space.start), drawn.draw(0))
    plain = drawn.network
    drawn.network = network = deepcopy(plain).double()
    generator = torch.Generator().manual_seed(0)
    ways = [
        weight.detach().abs().mean() * torch.randn(weight.shape, generator=generator).double()
        for weight in network.parameters()
    ]

    @torch.no_grad()
    def error(step):
        moved = deepcopy(network)
        for weight, way in zip(moved.parameters(), ways, strict=True):
            weight += step * way
        drawn.network = moved
        return float(drawn.error(looked))

    drawn.error(looked).backward()
    slope = sum(
        float((weight.grad * way).sum())
        for weight, way in zip(network.parameters(), ways, strict=True)
    )
    by_differences = (error(1e-4) - error(-1e-4)) / 2e-4
    drawn.network = plain
    assert abs(slope) > 1e-4
    # the places where depth is read follow the flow, and are held in the gradient (EgoVelocity)
    assert slope == pytest.approx(by_differences, rel=0.1)


@pytest.mark.slow
def test_one_optimiser_moves_what_it_is_given_and_nothing_else(drawn):
    start, delivered = drawn.space.start, drawn.network

    def ended(design, weights, rate=1e-4):
        drawn.network = deepcopy(delivered)
        given = {**SETTING, "rate": rate}
        share, seen = descended(drawn, start, 0, given, design, weights)
        moved = any(
            not torch.equal(one, other)
            for one, other in zip(drawn.network.parameters(), delivered.parameters(), strict=True)
        )
        assert len(seen) == SETTING["steps"]
        drawn.network = delivered
        return share, moved

    alone, moved = ended(design=True, weights=False)
    assert not moved
    assert not torch.equal(alone, start)
    held, moved = ended(design=False, weights=True)
    assert moved
    assert torch.equal(held, start)
    # weights that take no steps leave the design to itself
    together, moved = ended(design=True, weights=True, rate=0.0)
    assert not moved
    assert torch.equal(together, alone)


@pytest.mark.slow
def test_the_closed_form_of_a_start_is_judged_as_the_race_judges_it():
    size = joint_refiner.Config(steps=1, worlds=1, per_draw=1, judged_worlds=1, judged_drives=1)
    given = setting(size, free=["efl_mm", "theta"]) | {"rate": 1e-4, "updates": 1}
    given |= {"judged_worlds": 1, "judged_drives": 1, "settling": 4}
    rows = raced(0, given, 0)
    assert [row["arm"] for row in rows][-2:] == [AFTERWARDS, JOINT]
    judge = Judge(space_of(given), 1, 1)
    for row in rows:
        assert row["closed_form_errors"] == judge(row["share"])["errors"]
    assert rows[0]["errors"] != rows[0]["closed_form_errors"]


def test_ratios_are_those_of_the_errors_and_few_starts_decide_nothing(tmp_path, monkeypatch):
    errors = {"default": 0.4, "design alone": 0.2, AFTERWARDS: 0.25, JOINT: 0.1}

    def known(seed, **_):
        return [
            {"arm": arm, "errors": [(1 + seed) * error] * 2, "closed_form_errors": [0.5] * 2}
            for arm, error in errors.items()
        ]

    monkeypatch.setattr(joint_refiner, "raced", known)
    assert ran(joint_refiner, "--seeds 2 --out", tmp_path / "run") == 0
    check_page("joint_refiner", tmp_path / "run")
    assert "decide nothing" in page(tmp_path / "run")
    found = numbers(tmp_path / "run")
    assert found["joint_over_design_then_weights"] == pytest.approx(0.4)
    assert found["joint_over_default"] == pytest.approx(0.25)
    assert found["arm_default_closed_form"] == pytest.approx(0.5)
