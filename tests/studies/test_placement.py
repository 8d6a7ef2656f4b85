"""The placement study: its descent on a noisy valley, draws of samples, gradients against
differences, controls that see nothing, its bad input, and the whole of it, resumed."""

import contextlib
import csv
import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.system import load_hand_over
from scenes.robots import pair as robot_pair
from scenes.robots.pairs import PAIRS
from studies.frame.files import check_same
from studies.placement import __main__ as placement
from studies.placement import outcome
from studies.placement.controls import controls, looking_back
from studies.placement.page import answer
from studies.placement.problem import Problem, traced_camera
from studies.placement.race import FINAL_DRAWS, Race, feasible, fingerprints, kept
from studies.placement.searches import descend
from tests.studies.browser import check_page
from tests.studies.runs import numbers, page, ran

F = torch.float64


class FakeRun:
    """A run that keeps nothing."""

    def __init__(self):
        self.config = placement.Config()

    def load_state(self):
        return None

    def save_state(self, tensors, numbers):
        pass

    @contextlib.contextmanager
    def progress(self, total, description):
        yield self

    def advance(self, error):
        pass


@pytest.fixture(scope="module")
def problem():
    return Problem(PAIRS["outdoors"](), robot_pair.training(2), spread=2, per_world=2)


def test_descent_finds_the_end_of_a_noisy_valley():
    """A valley ten times as steep across as along, gradients as noisy as they are long."""
    goal = torch.tensor([0.8, 0.3, 0.55, 0.1, 0.62, 0.4], dtype=F)
    steep = torch.tensor([10.0, 1.0, 3.0, 1.0, 5.0, 2.0], dtype=F)
    noise = torch.Generator().manual_seed(0)

    def slope(share, step):
        exact = steep * (share - goal)
        return float((exact * (share - goal)).sum()), exact + exact.norm() / 6**0.5 * torch.randn(
            6, generator=noise, dtype=F
        )

    start = torch.full((6,), 0.05, dtype=F)
    found = descend(slope, start, 40)
    assert torch.equal(found.share[0], start)
    assert len(found.error) == 41
    assert float((found.share[-1] - goal).norm()) < 0.15 < 0.2 * float((start - goal).norm())


def test_descent_goes_along_a_wall():
    """The goal lies beyond a wall: the other numbers still arrive, and no step leaves the cube."""
    goal = torch.tensor([1.7, 0.5], dtype=F)
    found = descend(lambda x, k: (0.0, x - goal), torch.tensor([0.2, 0.1], dtype=F), 60)
    assert found.share.min() >= 0
    assert found.share.max() <= 1
    assert found.share[-1].tolist() == pytest.approx([1.0, 0.5], abs=0.03)


def test_draws_see_all_worlds_and_are_the_same_for_every_mount(problem):
    many = replace(problem, numbers=range(6), spread=2)
    drawn = [many.draw(k) for k in range(3)]
    assert sorted(n for each in drawn for n in each.numbers) == list(range(6))
    assert many.draw(1) == many.draw(1) != many.draw(4)
    batch = problem.batch(problem.draw(0))
    assert torch.equal(batch.twist, problem.batch(problem.draw(0)).twist)
    assert batch.twist.shape == (4, 6)


def test_differences_of_geometry_are_those_of_rendered_mounts():
    """In the corridor, with the forks in view: height, and pitch, whose slope at the mount itself
    points the other way."""
    problem = Problem(PAIRS["corridor"](), robot_pair.training(6), spread=6, per_world=4)
    samples = problem.draw(0)
    rendered = torch.zeros(6, dtype=F)
    moved = 0.12 * torch.eye(6, dtype=F)
    problem.expected_around(problem.start, samples, 0.12, learn=True)
    for k in (2, 4):
        ends = [problem.start + sign * moved[k] for sign in (-1, 1)]
        low, high = (problem.expected_around(end, samples, 0.12, learn=True)[0] for end in ends)
        rendered[k] = (high - low) / 0.24
    before = problem.rendered
    value, slope = problem.expected_around(problem.start, samples, 0.12)
    assert problem.rendered == before + problem.samples
    assert 0 < float(value) < 1
    assert rendered[2] < -0.2 < 0.1 < rendered[4]
    assert float((slope - rendered)[[2, 4]].norm()) < 0.4 * float(rendered.norm())


def test_differences_end_at_a_wall(problem):
    """Of h^2 over a step of 0.12 to both sides, or to one: (0.62^2 - 0.38^2) / 0.24 and
    (1 - 0.88^2) / 0.12."""
    watched = replace(problem)
    watched._carried = lambda field, here, samples, poses: problem.ranges.share_at(poses)[:, 2] ** 2
    for height, expected in ((0.5, 1.0), (1.0, 1.88)):
        share = torch.full((6,), 0.5, dtype=F)
        share[2] = height
        _, slope = watched.expected_around(share, problem.draw(0), 0.12)
        torch.testing.assert_close(slope, expected * torch.eye(6, dtype=F)[2], rtol=0, atol=1e-9)


def test_controls_see_nothing(problem):
    found = controls(problem, problem.ranges.pose(problem.start), problem.draw(0))
    for name in ("no_texture", "shuffled_events", "only_the_robot"):
        assert found[name] == pytest.approx(found["always_zero"], abs=0.05)
    assert found["as_found"] < 0.8 * found["always_zero"]
    back = looking_back(problem)
    assert torch.linalg.det(back[:3, :3]) == pytest.approx(1.0)
    # view not upwards
    assert all(looking_back(Problem(each(), range(1)))[2, 2] < 0.5 for each in PAIRS.values())


def test_ratios_are_of_paired_starts_and_worlds():
    """Medians with an even number of starts are the mean of two; drives in a world err alike: means
    of four worlds 0, 1, 2, 3 deviate by sqrt(5 / 3), over the root of four; a ratio over worlds is
    one of means, 4 / 6 of 1 / 2 and 3 / 4."""
    found = outcome.paired(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 2.5, 2.0]))
    assert (found.median, found.ahead, found.count) == (pytest.approx(0.8), 2, 3)
    assert (found.low, found.high) == pytest.approx((0.5, 1.5))
    found = outcome.paired(torch.arange(1.0, 13.0, dtype=F), torch.ones(12, dtype=F))
    assert found.median == pytest.approx(6.5)
    assert found.high - 6.5 == pytest.approx(6.5 - found.low)
    errors = torch.arange(4.0, dtype=F).repeat_interleave(6)
    assert outcome.standard_error(errors, 4) == pytest.approx((5 / 3) ** 0.5 / 2)
    assert outcome.standard_error(errors[:1], 1) == 0.0
    ours = torch.tensor([0.5, 1.5, 2.0, 4.0], dtype=F)
    theirs = torch.tensor([1.0, 3.0, 4.0, 4.0], dtype=F)
    assert outcome.over_worlds(ours, theirs, 2) == pytest.approx((4 / 6, 0.5, 0.75))


def test_a_run_that_goes_on_is_the_one_that_was_begun(tmp_path):
    world = tmp_path / "room.obj"
    world.write_text("v 0 0 0")
    pair = replace(PAIRS["outdoors"](), files=(world,))
    begun = json.loads(json.dumps(fingerprints(pair)))
    check_same(begun, fingerprints(pair))
    other = replace(pair, page="world_unit_m=0.01")
    with pytest.raises(DomainError, match="the robot's page changed since this run was begun"):
        check_same(begun, fingerprints(other))
    with pytest.raises(DomainError, match=r"room\.obj' changed since .*, now not there"):
        check_same(begun, fingerprints(replace(pair, files=())))
    world.write_text("v 0 0 1")
    with pytest.raises(DomainError, match=r"room\.obj' changed"):
        check_same(begun, fingerprints(pair))


def test_searches_look_only_at_what_is_allowed_and_free(problem):
    """Outdoors most of the cube looks down too far to see ahead; held numbers stay; rivals see
    always the same drives."""
    pair = problem.pair
    held = {name: getattr(pair.design, name) for name in ("x_m", "y_m", "yaw_rad", "roll_rad")}
    narrow = replace(pair, low=replace(pair.low, **held), high=replace(pair.high, **held))
    watched = Problem(narrow, range(1), 1, 1)
    looked = []

    def error(share, samples):
        looked.append((share, samples.seed))
        return float((watched.ranges.numbers(share) - 0.3).square().sum())

    watched.error = error
    race = Race(FakeRun(), watched)
    race.tensors["gradient/2/samples"] = torch.tensor(8)
    for name in ("random", "CMA-ES"):
        looked.clear()
        race.search(2, name, watched.start)
        found = race.trail(2, name).share
        assert [seed for _, seed in looked] == [2000] * 8
        assert all(kept(watched, share) for share in found)
        assert len({tuple(row) for row in found[:, ~watched.ranges.held].tolist()}) == 8
        assert torch.equal(
            found[:, watched.ranges.held], watched.start[watched.ranges.held].expand(8, 4)
        )


def test_starts_are_those_given_and_others_at_random(problem):
    """An own robot's own mount, and the first that are drawn."""
    given, *others = feasible(problem, 3, 5, [problem.start])
    assert torch.equal(given, problem.start)
    assert torch.equal(torch.stack(others), torch.stack(feasible(problem, 2, 5)))
    fixed = Problem(
        replace(problem.pair, low=problem.pair.design, high=problem.pair.design), range(1), 1, 1
    )
    with pytest.raises(DomainError, match="hold all six"):
        feasible(fixed, 1, 0)


def test_the_answer_says_that_the_default_stays():
    """Of one descent and of three."""
    problem = Problem(PAIRS["flight"](), robot_pair.training(1), 1, 1)
    told = {
        "race": SimpleNamespace(problem=problem),
        "unseen": problem,
        "share": problem.start,
        "best": (0, "default"),
        "rivals": {},
    }
    errors = {"error": 0.5, "default_error": 0.5}
    one, three = (answer(SimpleNamespace(**told, **errors, starts=count)) for count in (1, 3))
    assert "on training drives the one place found is not better (error 0.500" in one
    assert "on training drives none of 3 places found is better (error 0.500" in three


def test_answers_are_chosen_by_their_errors_alone(problem):
    """On twelve draws of training drives: the second start's random search errs least, though it
    has a penalty, and though the judge's drives would have another."""
    watched = replace(problem)
    errors = {0.1: 0.5, 0.2: 0.4, 0.3: 0.4, 0.4: 0.2}
    drawn = []

    def bounded(share, samples):
        drawn.append(samples)
        return errors.get(float(share[0]), 0.45)

    watched.bounded, watched.penalty = bounded, lambda mount: torch.tensor(0.5)
    run = FakeRun()
    run.config = placement.Config(searches=("random",))
    race = Race(run, watched)
    places = {(0, "gradient"): 0.1, (0, "random"): 0.2, (1, "gradient"): 0.3, (1, "random"): 0.4}
    race.answer = lambda *which: torch.full((6,), places[which], dtype=F)
    judged = {which: torch.full((8,), 0.1, dtype=F) for which in [*places, (0, "start")]}
    judged |= {(0, "default"): torch.full((8,), 0.4, dtype=F), (1, "start"): judged[0, "start"]}
    judged[1, "random"] = torch.full((8,), 0.2, dtype=F)
    found = outcome.Outcome(race, watched, judged)
    assert found.best == (1, "random")
    assert torch.equal(found.share, race.answer(1, "random"))
    assert found.error == pytest.approx(0.2)
    assert {samples.seed for samples in drawn} == {-1 - k for k in range(FINAL_DRAWS)}
    said = answer(found)
    assert "may be better off at" in said
    assert (
        "found by random search: its error there is 0.50 (of 2 worlds, too few to decide)" in said
    )
    assert str(found.rivals["random"]) == "0.75, ahead 1 of 2"
    errors |= dict.fromkeys(errors, 0.5)
    race.tensors.clear()
    assert race.chosen(2) == (0, "default")


def test_a_traced_lens_has_the_focal_length_and_focus_asked_for():
    pair = PAIRS["outdoors"]()
    optics = traced_camera(pair, "cooke-triplet").lens
    assert float(optics.first_order().efl_mm) == pytest.approx(pair.design.efl_mm)
    nearer = traced_camera(
        replace(pair, design=replace(pair.design, focus_per_m=4.0)), "cooke-triplet"
    ).lens
    shift_mm = float(nearer.thickness_mm[-1] - optics.thickness_mm[-1])
    newton_mm = pair.design.efl_mm**2 * 1e-3 * (4.0 - pair.design.focus_per_m)
    assert shift_mm == pytest.approx(newton_mm, rel=0.05)


def test_the_whole_study_and_its_resumption(tmp_path):
    out = tmp_path / "run"
    sizes = "--seeds 1 --steps 2 --worlds 1 --per-world 1 --judged-worlds 1 --judged-drives 2"
    assert ran(placement, f"{sizes} --searches random --out", out) == 0
    found = numbers(out)
    assert found["hand_over_score_again"] == pytest.approx(found["hand_over_score"], rel=1e-9)
    before = (out / "race.csv").read_text()
    rows = list(csv.DictReader(before.splitlines()))
    assert {row["search"] for row in rows} == {"default", "start", "gradient", "random"}
    assert {int(row["samples"]) for row in rows if row["search"] in ("gradient", "random")} == {2}
    handed = load_hand_over(out / "mount.yaml")
    chosen = "gradient" if found["chosen_is_gradient"] else "random"
    chosen = "default" if found["chosen_start"] < 0 else chosen
    row = next(row for row in rows if row["search"] == chosen)
    assert handed.mount()[2, 3].item() == pytest.approx(float(row["z_m"]), abs=1e-4)
    assert 0 < found["forward_error_p50_m_s"] < found["forward_error_p90_m_s"]
    (out / "report.html").unlink()
    assert ran(placement, "--resume", out) == 0
    assert (out / "race.csv").read_text() == before
    shown = page(out)
    assert ("may be better off at" in shown) == (found["hand_over_score"] < found["default_error"])
    assert not any(name.endswith("90") for name in found)
    assert ("stays at" in shown) == (found["chosen_start"] < 0)
    assert "tensor(" not in shown
    check_page("placement", out)


def test_requirements_are_asked_of_the_real_camera_whatever_renders():
    pair = PAIRS["outdoors"]()
    problem = Problem(pair, robot_pair.training(1), 1, 1)
    pose = problem.ranges.pose(problem.start)
    before = problem.penalty(pose), kept(problem, problem.start)
    problem.camera = problem.camera.with_lens(lens.Pinhole(30.0))  # sees a small part ahead
    assert (problem.penalty(pose), kept(problem, problem.start)) == before
