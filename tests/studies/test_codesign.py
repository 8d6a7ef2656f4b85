"""The joint study: designs and their shares, slopes against rendered differences, arms on a known
valley, and the whole of it, resumed."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from scenes.robots import pair as robot_pair
from scenes.robots.costs import Costs
from scenes.robots.pairs import PAIRS
from studies.codesign import __main__ as codesign
from studies.codesign import couplings, gallery, slopes
from studies.codesign import race as codesign_race
from studies.codesign.arms import ARMS, Task, Way, chosen_by_the_book, read_out
from studies.codesign.design import Space
from studies.codesign.landscape import Looks
from studies.codesign.objective import Objective
from studies.codesign.page import best_order, every_ratio
from studies.codesign.problem import Drawn
from studies.codesign.race import NEAR, Judge, compared, kept, start
from studies.frame.config import StudyConfig
from studies.frame.run import open_run
from tests import refusals
from tests.studies.browser import check_page
from tests.studies.runs import lines, numbers, page, ran

F = torch.float64


@pytest.fixture(scope="module")
def space():
    return Space(PAIRS["outdoors"](), rays_per_px=4)


@pytest.fixture(scope="module")
def drawn(space):
    return Drawn(space, robot_pair.training(2), 2, 2)


def test_shares_and_numbers_of_a_design_are_each_other(space):
    share = torch.linspace(0.1, 0.9, len(space.free), dtype=F)
    numbers = space.numbers(share)
    assert torch.allclose(space.share(**{name: numbers[name] for name in space.free}), share)
    middle = space.numbers(torch.full((len(space.free),), 0.5, dtype=F))
    # half way between 1.2 and 8 is their geometric mean, between 0 and 8 their mean
    assert middle["fno"] == pytest.approx(math.sqrt(1.2 * 8))
    assert middle["focus_per_m"] == pytest.approx(4.0)
    assert space.numbers(space.start)["efl_mm"] == pytest.approx(6.5)


def test_numbers_are_held_where_they_are_told_to_be():
    space = Space.of("outdoors", None, held={"fno": 4.0})
    assert "fno" not in space.free
    assert space.made(space.start).numbers["fno"] == 4.0
    assert space.costs.gain(4.0) == pytest.approx(0.09)


@refusals.table(__file__, "spaces of designs")
def test_spaces_that_cannot_be_are_refused(row):
    row.holds(globals())


def test_what_is_carried_to_the_same_design_is_what_was_seen(drawn, space):
    objective = Objective(drawn)
    share = space.share(efl_mm=4.0, fno=2.0, z_m=0.4, pitch_rad=0.5)
    _, _, looked = objective(share, drawn.draw(0), [])
    again = objective.carried(looked, [looked.whole] * 3)
    assert torch.allclose(again, looked.expected.mean().expand(3), rtol=1e-9)


def test_a_swaying_mast_is_an_error_that_is_expected(drawn, space):
    """A hard error grows with sway; so does the one to be expected, on the same drives."""
    high = space.share(efl_mm=4.0, z_m=0.7, pitch_rad=0.6, theta=0.2, cutoff_hz=150.0)
    still = Space(space.pair, Costs(sway_per_m_s=0.0), rays_per_px=4)
    shaken = Space(space.pair, Costs(sway_per_m_s=8.0), rays_per_px=4)
    errors = {}
    for name, each in (("still", still), ("shaken", shaken)):
        seen = Drawn(each, robot_pair.training(2), 2, 4).looked(each.made(high), drawn.draw(0))
        errors[name] = float(seen.hard().mean()), float(seen.expected.mean())
    assert errors["shaken"][0] > errors["still"][0] + 0.1
    assert errors["shaken"][1] > errors["still"][1] + 0.1


def test_joint_descent_reaches_the_bottom_of_a_valley_that_one_pass_over_the_blocks_does_not(
    space,
):
    size = len(space.free)
    curvature = 2 * torch.eye(size, dtype=F)
    curvature[0, 4] = curvature[4, 0] = 1.6
    valley = couplings.Valley(space, curvature, torch.full((size,), 0.5, dtype=F), 0.0)
    begun = valley.bottom.clone()
    begun[0], begun[4] = 0.1, 0.9
    joint, one_pass, alternating = (
        valley.raced(begun, arm, 48)
        for arm in ("joint", "lens > mount > read-out", "alternating 8")
    )
    assert joint < 2e-3
    # minimising along the lens, then along the mount leaves (1 - 0.64) 0.64 of the squared start
    assert one_pass == pytest.approx(0.36 * 0.64 * 0.16, abs=0.015)
    assert joint < alternating < one_pass
    told = couplings.foretold(replace(valley, error=0.1), [begun], 48, "lens > mount > read-out")
    assert told["at_budget"] > 1.2
    assert couplings.foretold(valley, [begun], 48, "alternating 8").keys() == {"at_budget"}


def test_a_read_out_is_settled_at_the_bottom_of_what_recorded_frames_tell(space):
    """Expected errors that are known, in place of flow's: least at given shares of sensor and
    estimator."""
    bottom = space.share(theta=0.2, cutoff_hz=300.0, prior_px=4.0)
    free = space.block("sensor") + space.block("network")

    def again(whole):
        away = (space.share(**dict(whole.numbers)) - bottom)[free]
        return SimpleNamespace(expected=away.square().sum()[None])

    begun = space.share(theta=0.3, cutoff_hz=150.0, prior_px=6.0)
    way = Way(recorded=[SimpleNamespace(again=again, whole=space.made(begun))])
    known = Objective(SimpleNamespace(space=space))
    found = read_out(Task(known, begun, 16, 0, 0, 60), begun, way)
    held = [k for k in range(len(begun)) if k not in free]
    assert torch.equal(found[held], begun[held])
    assert (found - bottom)[free].abs().max() < 0.02


def test_couplings_of_a_known_valley_are_its_own(space):
    """A quadratic valley in which lens and mount pull at each other: its curvature, its canonical
    coupling, and what one pass leaves, all in closed form."""
    size = len(space.free)
    true = torch.eye(size, dtype=F)
    lens_at, mount_at = space.block("lens")[0], space.block("mount")[0]
    true[lens_at, mount_at] = true[mount_at, lens_at] = 0.8
    bottom = torch.full((size,), 0.5, dtype=F)

    def looked(share, samples):
        away = share - bottom
        return SimpleNamespace(expected=(0.1 + away @ true @ away / 2)[None])

    known = SimpleNamespace(
        space=SimpleNamespace(free=space.free, made=lambda share: share),
        draw=lambda number: number,
        looked=looked,
    )
    rows = [
        {"draw": draw, **row}
        for draw in range(2)
        for row in couplings.curvatures(known, bottom, draw)
    ]
    found, spread, error = couplings.hessian(space, rows)
    assert torch.allclose(found, true, atol=1e-9)
    assert float(spread.max()) < 1e-9
    assert couplings.bowl(-true) is None
    # ten numbers that stand alone, each mixed difference known to 0.1: the largest of twelve such
    # values is about 0.3
    chance = couplings.by_noise(
        space, torch.eye(size, dtype=F), torch.full((size, size), 0.1, dtype=F)
    )
    assert 0.2 < chance["lens and mount"] < 0.5
    assert error == pytest.approx(0.1)
    pulls = couplings.coupled(space, found)
    assert pulls["lens and mount"] == pytest.approx(0.8)
    assert pulls["lens and read-out"] == pytest.approx(0.0, abs=1e-9)
    begun = bottom.clone()
    begun[mount_at] += 0.3
    # the lens goes to -0.8 x 0.3, then the mount to 0.64 x 0.3
    lens_away, mount_away = -0.8 * 0.3, 0.64 * 0.3
    left = (lens_away**2 + mount_away**2 + 1.6 * lens_away * mount_away) / 2
    valley = couplings.Valley(space, found, bottom, error)
    # heights over the bottom are bounded, as errors are
    bounded = left * 0.9 / (left + 0.9)
    assert valley.one_pass(begun, ("lens", "mount")) == pytest.approx(0.1 + bounded)


def test_starts_keep_what_is_required(space):
    requirements = space.pair.requirements()
    first, again, other = start(space, 3), start(space, 3), start(space, 4)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert kept(space, first, requirements)
    assert kept(space, other, requirements)
    near = start(space, 5, first.tolist())
    assert 0 < (near - first).abs().max() <= NEAR
    assert kept(space, near, requirements)


def test_spaces_with_other_numbers_free_begin_alike_in_those_they_share(space):
    held = Space.of("outdoors", None, held={"fno": 2.0})
    shared = [name for name in space.free if name in held.free]
    assert len(shared) == len(space.free) - 1
    for seed in range(3):
        one, other = (
            [float(start(each, seed)[each.free.index(name)]) for name in shared]
            for each in (space, held)
        )
        assert one == other


def test_the_book_takes_the_longest_lens_that_sees_ahead_and_focuses_it_hyperfocally(space):
    found = chosen_by_the_book(space, space.pair.requirements())
    # full light makes 70 at f/1.2, the knee is at 20: f/1.2 sqrt(70 / 20)
    assert found["fno"] == pytest.approx(1.2 * math.sqrt(3.5))
    requirements = space.pair.requirements()
    assert kept(space, space.share(**found), requirements)
    hyperfocal = 1e3 * found["fno"] * robot_pair.PITCH_MM / found["efl_mm"] ** 2
    assert found["focus_per_m"] == pytest.approx(hyperfocal)


def test_the_comparison_is_of_pairs():
    rows = [
        {
            "arm": arm,
            "seed": seed,
            "errors": [scale * (1 + 0.1 * seed + 0.02 * world) for world in range(4)],
        }
        for seed in range(6)
        for arm, scale in (("joint", 0.8), ("book", 1.0), ("random", 0.8))
    ]
    found = compared(rows)
    over, p = found["book"]
    assert (math.exp(over.value), math.exp(over.low), math.exp(over.high)) == pytest.approx(
        (0.8, 0.8, 0.8)
    )
    # of 64 signs two are as extreme, and two tests were made
    assert p == pytest.approx(2 * 2 / 64)
    assert found["random"][0].outcome == "is undecided"
    every = every_ratio(rows)
    assert len(every) == 6
    assert every["book", "random"][0].value == pytest.approx(1.25)
    assert every["joint", "book"][1] == p
    for (arm, other), (ratio, _) in every.items():
        ends = [1 / each for each in (ratio.value, ratio.high, ratio.low)]
        back, _ = every[other, arm]
        assert [back.value, back.low, back.high] == pytest.approx(ends, rel=1e-9)


def test_the_best_order_is_the_one_that_errs_least_whatever_joint_does():
    given = {"joint": [0.9, 0.1], "a > b > c": [0.3, 0.3], "b > a > c": [0.2, 0.5], "book": [0.1]}
    rows = [{"arm": arm, "errors": [each]} for arm, errors in given.items() for each in errors]
    assert best_order(rows) == "a > b > c"
    assert best_order([row for row in rows if ">" not in row["arm"]]) == "book"


def test_a_way_keeps_the_last_rounds_that_were_recorded():
    way = Way()
    for k in range(8):
        way.add(torch.tensor([float(k)]), 0.0, k)
    assert way.recorded == [5, 6, 7]


def test_agreement_of_slopes_is_that_of_their_means():
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(400, 3, generator=generator, dtype=F)
    true = torch.tensor([3.0, 0.0, 4.0], dtype=F)
    found = slopes.agreement(2 * true + noise, true + noise)
    assert found.cosine == pytest.approx(1.0, abs=0.01)
    assert found.length == pytest.approx(2.0, abs=0.1)
    assert found.beyond == pytest.approx(1.0, abs=0.01)  # twice as long is a whole length too far
    assert found.signal_to_noise == pytest.approx(10 / 3**0.5, rel=0.1)


def test_slopes_of_a_resumed_run_are_those_of_one_in_one_go(space, tmp_path, monkeypatch):
    """Of an objective whose slope is the draws that it learnt from: the same for every draw."""

    class Learning:
        def __init__(self, drawn, penalised):
            self.learnt = []

        def __call__(self, share, draw, free, learn=True):
            if learn:
                self.learnt.append(draw)
            return 0.0, torch.full((len(free),), float(sum(self.learnt)), dtype=F), None

        def forget(self):
            pass

    looked = SimpleNamespace(expected=torch.zeros(1), hard=lambda: torch.zeros(1))
    drawn = SimpleNamespace(draw=lambda number: number, looked=lambda whole, draw: looked)
    monkeypatch.setattr(slopes, "Objective", Learning)
    run = open_run("slopes", StudyConfig(out=tmp_path / "run"))
    rows = slopes.slopes(run, space, drawn, {"here": space.start}, 2)
    assert {row["slope"] for row in rows} == {float(sum(slopes.FIRST - k for k in range(1, 5)))}


def test_a_held_lens_is_focused_by_the_book_as_what_it_is():
    held = Space.of("outdoors", None, light=0.1, held={"fno": 4.0})
    found = chosen_by_the_book(held, [])
    assert found["focus_per_m"] == pytest.approx(
        1e3 * 4.0 * robot_pair.PITCH_MM / found["efl_mm"] ** 2
    )


def test_blur_over_the_view_goes_with_the_aperture(space, tmp_path):
    """By similar triangles, whatever the camera sees."""
    size = SimpleNamespace(worlds=2, per_draw=2)
    looks = Looks(SimpleNamespace(config=size, path=lambda name: tmp_path / name), space)
    wide, stopped = (
        looks.row(str(fno), space.share(fno=fno, focus_per_m=0.5))["blur_span_px"] for fno in (2, 8)
    )
    assert wide == pytest.approx(4 * stopped, rel=0.01)
    assert wide > 1


SMALL = (
    "--quick --steps 2 --worlds 1 --per-draw 1 --judged-worlds 1 --judged-drives 1 --family thin "
    "--free efl_mm z_m theta --arms joint default --out"
)


@pytest.fixture(scope="module")
def race(tmp_path_factory):
    """Runs the small race with more options: its exit code, folder and judged answers. Its
    landscape is always the same one, and looked at once."""
    real = codesign.landscape
    known = []

    def landscape(*given):
        return known[0] if known else known.append(real(*given)) or known[0]

    def raced(*more):
        folder = tmp_path_factory.mktemp("race") / "run"
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(codesign, "landscape", landscape)
            code = ran(codesign, SMALL, folder, *more)
        return code, folder, lines(folder / "answers.jsonl")

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(codesign, "LEAST_STEPS", 2)
        yield raced


@pytest.fixture(scope="module")
def here(race):
    """A small race with everything beside it."""
    return race("--slopes", "2", "--couplings", "2")


def test_a_small_race_says_that_it_decides_nothing(here):
    code, folder, _ = here
    assert code == 0
    assert "decides nothing" in page(folder)
    check_page("codesign", folder)
    found = numbers(folder)
    ratio = found["race_joint_median"] / found["race_default_median"]
    for name, value in (("joint_over_default", ratio), ("default_over_joint", 1 / ratio)):
        assert found[f"{name}_median_outdoors"] == pytest.approx(value)
    assert "joint_over_best_order_median_outdoors" not in found  # no order was raced
    assert found["race_joint_drives"] == 2
    assert 0 < found["race_joint_median"] <= 1
    assert found["race_joint_median_with_head"] != found["race_joint_median"]
    assert 0 <= found["parts_lens_and_mount_coupling"] < 1
    assert found["hand_over_score_again"] == pytest.approx(found["hand_over_score"], abs=1e-6)
    assert "design.yaml is the answer of" in page(folder)
    before = (folder / "race.jsonl").read_bytes()
    assert ran(codesign, "--resume", folder) == 0
    assert (folder / "race.jsonl").read_bytes() == before


def test_the_best_answer_of_any_arm_is_handed_over():
    """On drives of its own: what expected least on its way there need not be the best."""

    class Known:
        space = Space.of("outdoors", None)

        def draw(self, number):
            return number

        def looked(self, whole, samples):
            return SimpleNamespace(expected=torch.tensor([whole.numbers["fno"]]))

    def answer(arm, place, expected):
        return {"arm": arm, "share": [place] * 9, "expected": expected}

    rows = [answer("joint", 0.5, 0.2), answer("nested", 0.3, 0.3), answer("default", 0.4, None)]
    rows += [answer("book", 0.1, 0.9 + k) for k in range(codesign.SHORTLIST)]
    assert codesign.best_answer(Known(), rows)["arm"] == "book"
    assert codesign.best_answer(Known(), rows[:3])["arm"] == "nested"
    rows[2]["share"] = [0.0] * 9
    assert codesign.best_answer(Known(), rows)["arm"] == "default"


def test_a_search_expects_the_least_that_it_has_seen(drawn, space):
    _, way = ARMS["random"](Task(Objective(drawn), space.start, 4, 0, 1, 5))
    assert way.expected == min(way.errors) < way.errors[-1]


def test_a_design_begins_at_the_nearest_f_number_of_its_family():
    for family in lens.family_names():
        space = Space.of("outdoors", family)
        found = space.numbers(space.start)["fno"]
        assert found == pytest.approx(lens.family(family).fno[0])


def test_a_traced_design_is_handed_over_with_its_lens(tmp_path):
    space = Space.of("outdoors", "retrofocus-4")
    whole = space.made(start(space, 0))
    judge = Judge(space, 1, 1)
    (error,) = judge.of(whole)["errors"]
    gallery.save(tmp_path / "design.yaml", whole, {"error_unseen": error})
    again = judge.of(gallery.loaded(tmp_path / "design.yaml", whole))["errors"]
    assert again == [pytest.approx(error, rel=1e-9)]
    drawn = lens.load(tmp_path / "design.zmx").freeze().first_order()
    assert float(drawn.efl_mm) == pytest.approx(whole.numbers["efl_mm"], rel=1e-6)


def test_a_race_of_another_robot_is_not_gone_on_with(here, monkeypatch, capsys):
    _, folder, _ = here
    monkeypatch.setattr(codesign, "fingerprints", lambda pair: {"the robot's page": "another"})
    assert ran(codesign, "--resume", folder) == 2
    assert "the robot's page changed since this run was begun" in capsys.readouterr().err


def test_designs_are_carried_together_as_each_alone(drawn, space):
    objective = Objective(drawn)
    share = space.share(efl_mm=4.0, fno=2.0, z_m=0.4, pitch_rad=0.5)
    _, _, looked = objective(share, drawn.draw(0), [])
    changes = ({"efl_mm": 5.0}, {"z_m": 0.5}, {"focus_per_m": 1.0, "pitch_rad": 0.6}, {"z_m": 0.3})
    wholes = [looked.whole.with_numbers(**change) for change in changes]
    together = objective.carried(looked, wholes)
    alone = torch.cat([objective.carried(looked, [whole]) for whole in wholes])
    assert torch.allclose(together, alone, rtol=1e-9)
    assert len({round(value, 6) for value in alone.tolist()}) == 4


def test_frames_are_blurred_by_what_their_optics_say(drawn, space):
    """A point of light in every window, whose mean square radius is that of the blur; the trend
    learns what it is told."""
    looked = drawn.looked(space.made(space.start), drawn.draw(0))
    frames = torch.zeros_like(looked.run["frames"])
    frames[..., 16, 16] = 255.0
    points = replace(looked, run={"field": looked.run["field"], "frames": frames})
    soft, optics = points.blurred(torch.Generator().manual_seed(0))
    light = soft.run["frames"].double()
    away = torch.arange(32, dtype=F) - 16
    square = away[:, None] ** 2 + away**2
    radius = ((light * square).sum((-2, -1)) / light.sum((-2, -1))).sqrt()
    expected = (optics[..., 1].expm1() ** 2 - looked.optics[..., 1].expm1() ** 2).sqrt()
    assert 0.1 < float(expected.min()) < 0.5 < 1.2 < float(expected.max()) < 2.0
    wide = expected > 1.0  # below, a Gaussian's taps on whole pixels spread it otherwise
    torch.testing.assert_close(
        radius.flatten(0, 1).movedim(1, 2)[wide],
        expected[..., None].expand(-1, -1, frames.shape[2])[wide],
        rtol=0.02,
        atol=0,
    )
    torch.testing.assert_close(optics[..., 0], looked.optics[..., 0])
    objective = Objective(drawn)
    objective._learn(looked)
    told = [
        objective.trend.told(looked.seen.surfaces, looked.seen.flow_px, looked.seen.covered, each)
        for each in (looked.optics, looked.optics + torch.tensor([0.0, 0.5], dtype=F))
    ]
    seen = looked.seen.surfaces.share > 0
    # flow is told worse behind more blur: log precision falls
    assert float((told[1] - told[0])[seen][:, 0].mean()) < -0.1


def test_an_answer_that_is_not_allowed_gives_way_to_one_that_is_settled_too(monkeypatch):
    """Allowed are cameras below 0.4 m: of the way 0.3 m is the last one."""
    space = Space.of("outdoors", None, free=("z_m", "theta"))
    drawn = SimpleNamespace(space=space, requirements=[])
    monkeypatch.setattr(
        codesign_race, "kept", lambda space, share, _: space.numbers(share)["z_m"] < 0.4
    )
    task = Task(SimpleNamespace(drawn=drawn, space=space), space.share(z_m=0.2), 2, 0, 0)
    way = Way(shares=[space.share(z_m=z_m) for z_m in (0.3, 0.5)])
    settled = space.block("sensor")

    def read_out(task, share, way):
        share = share.clone()
        share[settled] = 0.75
        return share

    monkeypatch.setattr(codesign_race, "read_out", read_out)
    for z_m, chosen_m in ((0.35, 0.35), (0.6, 0.3)):
        share, keeps = codesign_race.settled_and_kept(task, space.share(z_m=z_m), way)
        assert space.numbers(share)["z_m"] == pytest.approx(chosen_m)
        assert keeps == (z_m == chosen_m)
        assert share[settled].tolist() == [0.75]
    with pytest.raises(DomainError, match="there is no default"):
        codesign_race.settled_and_kept(task, space.share(z_m=0.6), Way())


def test_answers_of_an_earlier_run_are_not_raced_again(race, here, tmp_path, capsys):
    _, folder, one = here
    known = tmp_path / "known.jsonl"
    cells = {cell["arm"]: (cell, row) for cell, (row,) in one}
    cell, row = cells["default"]
    known.write_text(json.dumps([cell, [{**row, "cpu_s": 1e6}]]) + "\n")
    # a process of its own finds the same for the arm that is left
    code, _, again = race("--raw", known, "--processes", "1")
    assert code == 0
    found = {cell["arm"]: row for cell, (row,) in again}
    assert found.keys() == cells.keys() == {"joint", "default"}
    assert found["default"]["cpu_s"] == 1e6
    assert found["joint"]["share"] == cells["joint"][1]["share"]
    assert race("--raw", folder / "race.jsonl")[0] == 0
    assert race("--raw", known, "--light", "0.5")[0] == 2
    assert "light is 1.0 there and 0.5 here" in capsys.readouterr().err
