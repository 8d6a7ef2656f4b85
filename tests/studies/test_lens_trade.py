"""The trade study: its problem against analyses of their own, its summary against tables made up, its page for every
outcome."""

import json
import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import WAVELENGTH_UM
from codesign.lens.analysis import pupil_grid
from codesign.lens.design.tolerance import errors_of
from studies.frame.run import open_run
from studies.lens_opt.task import PITCH_MM, TRAINING
from studies.lens_trade import __main__ as lens_trade
from studies.lens_trade import cases, designers
from studies.lens_trade.designers import by_spots
from studies.lens_trade.problem import DEPTHS_M, FAR_M, FIELDS, FLAT, LINES, NEAR_M, Weights
from studies.lens_trade.summary import gains, reach
from studies.lens_trade.trades import DIM, TRADES, owned

TRACK = TRADES["track"]


def problem(value=1.2, trade=TRACK):
    return trade.problem(value, trade.template(value))


def start():
    found = problem()
    return found, found.variables(found.template)


def test_variables_give_the_lens_back():
    found, x = start()
    geo = found.lens(x)
    for name in ("curvature_per_mm", "thickness_mm"):
        torch.testing.assert_close(getattr(geo, name), getattr(found.template, name), rtol=1e-12, atol=1e-12)


def test_focal_length_and_aperture_are_held_for_every_variable():
    found, x = start()
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        geo = found.lens(x * (1 + 0.05 * torch.randn(len(x), generator=generator, dtype=x.dtype)))
        figures = geo.first_order()
        assert float(figures.efl_mm) == pytest.approx(found.efl_mm, rel=1e-10)
        assert float(figures.fno) == pytest.approx(2.8, rel=1e-10)


def test_spots_are_those_of_the_light_from_points_of_space():
    """The rows start rays at the pupil; ``film_points`` sends light from points through the whole pupil."""
    found, x = start()
    geo = found.lens(x)
    pupil = pupil_grid(8)
    for d, depth_m in enumerate(DEPTHS_M):
        for k, h in enumerate(FIELDS):
            point = torch.tensor([[0.0, h * math.tan(found.half_field_rad), 1.0]]).double() * depth_m * 1e3
            film = torch.cat(
                [
                    geo.film_points(point.expand(len(pupil), 3), pupil, WAVELENGTH_UM[line])[0]
                    for line in LINES
                ]
            )
            rms = (film - film.mean(0)).square().sum(1).mean().sqrt() / PITCH_MM
            # film_points aims at the pupil of each colour, the rows at that of the d line: 1e-7 of the spot
            assert float(found.spots_px(geo)[d, k]) == pytest.approx(float(rms), rel=1e-6)


def test_weights_share_out_one_and_lean_as_they_say():
    for weights in (FLAT, Weights(0.4, 0.0), Weights(1.0, -1.0)):
        assert float(weights.table().sum()) == pytest.approx(1, rel=1e-12)
    leaning = Weights(0.4, -1.0).table()
    even = FLAT.table()
    assert float(leaning[0, 0] / even[0, 0]) < float(
        leaning[-1, 0] / even[-1, 0]
    )  # far counts more than near
    assert float(leaning[0, -1] / leaning[0, 0]) == pytest.approx(
        0.4 * float(even[0, -1] / even[0, 0]), rel=1e-12
    )


def test_least_squares_lower_the_spot_within_the_limits():
    found, x = start()
    optimum = found.lens(by_spots(found, x, FLAT, 30))
    assert found.rms_px(optimum) < 0.5 * found.rms_px(found.lens(x))
    assert found.violation(optimum) < 1e-3 * found.efl_mm
    assert float(optimum.thickness_mm.sum()) < 1.2 * found.efl_mm * 1.001


def test_a_weight_on_far_objects_sharpens_them():
    found, x = start()
    even, far = (
        found.spots_px(found.lens(by_spots(found, x, w, 30))).square().mean(1) for w in (FLAT, Weights(1, -1))
    )
    assert float(far[-1]) < float(even[-1])
    assert float(far[0]) > float(even[0])


def _errors(found, geo):
    errors = errors_of(geo, found.made)
    return errors, torch.randn(len(errors), generator=torch.Generator().manual_seed(3), dtype=geo.dtype)


@pytest.mark.bits
def test_errors_of_manufacture_repeat_by_seed_and_are_refocused():
    trade = TRADES["tolerance"]
    found = problem(8.0, trade)
    geo = found.lens(found.variables(found.template))
    once, twice, other = (found.manufactured(geo, seed) for seed in (3, 3, 4))
    assert torch.equal(once.curvature_per_mm, twice.curvature_per_mm)
    assert not torch.equal(once.curvature_per_mm, other.curvature_per_mm)

    def defocus(g):
        """Film minus the place of the least mean square spot, from the parabola through three films."""
        fields = [h * found.half_field_rad for h in (-1.0, -0.5, 0.0, 0.5, 1.0)]
        shifts = (-0.02, 0.0, 0.02)
        squares = [
            float(
                lens.rms_spot_mm(
                    g.replace(thickness_mm=torch.cat([g.thickness_mm[:-1], g.thickness_mm[-1:] + s])),
                    fields,
                    grid=16,
                )
                .square()
                .mean()
            )
            for s in shifts
        ]
        below, here, above = squares
        return 0.02 * (above - below) / (2 * (above - 2 * here + below))

    assert defocus(once) == pytest.approx(defocus(geo), abs=1e-6)
    assert abs(defocus(once) - defocus(lens.design.tolerance.perturbed(geo, *_errors(found, geo)))) > 1e-4
    assert problem().manufactured(geo, 3) is geo


def test_descent_and_search_are_never_worse_than_their_start_on_their_own_score(monkeypatch):
    monkeypatch.setattr(designers, "SCORED", 2)
    found, x = start()
    light = TRACK.light
    fixed = {
        count: cases.judged_cases(TRAINING, first, count, found.efl_mm)
        for count, first in ((2, 7_000_000), (4, 7_100_000))
    }

    def score(v, count):
        with torch.no_grad():
            geo = found.lens(v)
            penalty = designers.PENALTY * float(found.limit_rows(geo).square().sum())
            return designers.mean_log_error(found, light, geo, fixed[count], designers.SAMPLES) + penalty

    assert score(designers.by_flow(found, light, x, steps=2, batch=1, seed=0), 2) <= score(x, 2) + 1e-9
    assert score(designers.by_search(found, light, x, tries=2, seed=0), 4) <= score(x, 4) + 1e-9


def test_cases_lie_at_the_distances_they_claim():
    for seed in range(40):
        case = cases.draw_case(("speckle-1",), seed)
        eye = case.T_world_body[0, :3, 3]
        forward = case.T_world_body[0, :3, 2]
        distance = float(-eye[1] / forward[1])  # to the wall y = 0 along the axis
        assert NEAR_M - 1e-9 <= distance <= FAR_M + 1e-9
        slant = math.acos(min(1.0, float(forward[1].abs())))
        assert slant <= cases.MOST_SLANT_RAD + 1e-9


def test_judged_cases_cover_all_distances_and_textures_once():
    names = ("speckle-1", "speckle-2")
    drawn = cases.judged_cases(names, 0, 8, 11.0)
    distances = sorted(float(-c.T_world_body[0, 1, 3] / c.T_world_body[0, 1, 2]) for c in drawn)
    wanted = [NEAR_M * (FAR_M / NEAR_M) ** ((k + 0.5) / 8) for k in range(8)]
    assert distances == pytest.approx(wanted, rel=1e-9)


def test_light_falls_with_the_square_of_the_f_number():
    assert DIM.gain(1.4) == pytest.approx(4 * DIM.gain(2.8))
    assert cases.Light().gain(2.8) == 1.0


def test_reach_goes_to_the_tightest_place_with_the_error():
    places, errors = [0.0, 1.0, 2.0], [1.0, 2.0, 4.0]
    assert reach(places, errors, 3.0) == pytest.approx(1.5)
    assert reach(places, errors, 5.0) == 2.0
    assert reach(places, errors, 0.5) == 0.0
    assert reach(places, [1.0, 3.0, 2.0], 2.0) == 2.0  # beyond a bump


def test_gains_of_a_table_made_up():
    """Error e = 1 / track for the rival and 0.9 / track for flow: flow gets each error 10 % shorter."""
    values = (1.25, 1.0, 0.8, 0.64)
    rival = torch.tensor([[-math.log(v)] * 5 for v in values], dtype=torch.float64)
    flow = rival + math.log(0.9)
    found = gains(values, rival, flow, torch.Generator().manual_seed(0))
    for gain in found[:-1]:
        assert gain.value == pytest.approx(-math.log(0.9), rel=1e-9)
        assert gain.low == pytest.approx(gain.value)
        assert gain.high == pytest.approx(gain.value)
    assert found[-1].value == 0  # beyond what was looked at nothing is claimed


def test_an_error_that_falls_towards_tight_is_no_gain_of_the_flow_designer():
    errors = torch.tensor([[3.0] * 4, [1.0] * 4, [2.0] * 4], dtype=torch.float64)
    found = gains((4.0, 2.0, 1.0), errors, errors, torch.Generator().manual_seed(0))
    assert [(gain.value, gain.low, gain.high) for gain in found] == [(0.0, 0.0, 0.0)] * 3


def made_up(trade, factor):
    """Rows whose flow errors are ``factor`` times the rival's, case by case, with errors that rise towards tight."""
    rows = {}
    for at, value in enumerate(TRADES[trade].values):
        held_out = [0.2 * at + 0.01 * k for k in range(6)]

        def designed(shift, at=at, held_out=held_out):
            return {
                "start": "start 0",
                "weights": {"field": 1.0, "near": 0.0},
                "rms_px": 1.0 + at,
                "violation": 0.0,
                "track_mm": 12.0,
                "held_out": [e + shift for e in held_out],
            }

        group = [
            {"start": "start 0", "rms_px": 1.0 + at + 0.1 * k, "development": 0.2 * at + 0.05 * k}
            for k in range(3)
        ]
        rows[f"{trade}_{at}"] = {
            "trade": trade,
            "value": value,
            "at": at,
            "starts": 1,
            "efl_mm": 11.0,
            "candidates": {"spots": group, "flow": group, "flow_from": group},
            "textbook": designed(0.05),
            "spots": designed(0.0),
            "flow": designed(math.log(factor)),
        }
    return rows


@pytest.mark.parametrize(("factor", "wins"), [(0.7, True), (1.0, False), (1.2, False)])
def test_page_of_a_raw_table_says_who_wins(tmp_path, factor, wins):
    raw = tmp_path / "raw.json"
    raw.write_text(json.dumps(made_up("track", factor)))
    config = lens_trade.Config(trades=("track",), raw=str(raw), out=tmp_path / "run")
    run = open_run("lens_trade", config)
    lens_trade.study(run)
    text = (tmp_path / "run" / "report.html").read_text()
    assert ("wins clearly in 1 of 1" in text) is wins
    assert ("is not beaten in any of 1" in text) is not wins
    assert run.metrics["trades_won"] == int(wins)
    assert run.metrics["flow_over_spots_percent_track_1_2"] == pytest.approx(100 * (factor - 1), abs=1e-6)


def test_a_foreign_raw_table_is_refused(tmp_path):
    raw = tmp_path / "raw.json"
    raw.write_text("[1, 2]")
    config = lens_trade.Config(trades=("track",), raw=str(raw), out=tmp_path / "run")
    with pytest.raises(Exception, match="no raw table of this study"):
        lens_trade.study(open_run("lens_trade", config))


def test_the_starts_that_are_judged_are_those_that_were_made():
    """Starts go by the run's seed: with another seed a value must look for other files."""
    effort = lens_trade._check(lens_trade.Config(seed=7, starts=2))
    assert effort.starts == (7, 8)


def test_unknown_trades_are_refused(tmp_path):
    with pytest.raises(DomainError, match="choose out of track, elements"):
        lens_trade.study(open_run("lens_trade", lens_trade.Config(trades=("weight",), out=tmp_path / "run")))


def test_a_lens_of_its_own_is_the_same_lens():
    found, x = start()
    geo = found.lens(x)
    assert torch.allclose(owned(geo).thickness_mm, geo.thickness_mm, rtol=1e-14)
