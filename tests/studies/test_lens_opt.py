"""The main job: its start, its rivals' limits, who wins, what goes together, and a run that is
resumed after its end."""

import html
import math
from types import SimpleNamespace

import pytest
import torch

from codesign import events, flow, lens
from codesign.lens.analysis import polychromatic_spot, spot_radius_mm
from codesign.lens.design import edge_thickness_mm
from codesign.lens.spectrum import daylight_d65, silicon_response
from studies.frame.compare import log_ratio
from studies.frame.config import configured
from studies.frame.run import QUICK
from studies.lens_opt import __main__ as lens_opt
from studies.lens_opt import rivals
from studies.lens_opt.page import verdict
from studies.lens_opt.spots import spot_rays
from studies.lens_opt.stages import estimator, weights_of
from studies.lens_opt.task import DISTANCE_M, LIGHT, PITCH_MM, LensTask, make_task
from tests import refusals
from tests.studies.browser import check_page
from tests.studies.runs import numbers, page, ran

SMALL = (
    "--quick --after-steps=1 --cases=1 --scored=1 --spot-steps=1 --steps=2 --judged=3 --samples=4 "
    "--out"
)


@pytest.fixture(scope="module")
def task():
    return make_task("cooke-triplet", 0)


def test_the_light_is_daylight_as_silicon_sees_it():
    light = lens.Spectrum.from_curves(silicon_response(), daylight_d65(), 4)
    assert light.weights == LIGHT.weights
    assert light.wavelengths_um == pytest.approx(LIGHT.wavelengths_um, rel=1e-14)


def squared_spot(optics, shift_mm, task):
    moved = optics.replace(
        thickness_mm=optics.thickness_mm
        + shift_mm * torch.eye(len(optics.thickness_mm)).double()[-1]
    )
    return float(spot_rays(moved, task.fields_rad, DISTANCE_M, LIGHT).rms_mm().square().sum())


def test_the_start_is_in_best_focus_at_the_asked_spot_and_the_shown_twin_is_not(task):
    start = task.design.lens(torch.zeros(task.design.basis.shape[1], dtype=torch.float64))
    here = squared_spot(start, 0.0, task)
    for shift_mm in (-0.1, -0.002, 0.002, 0.1):
        assert squared_spot(start, shift_mm, task) > here
    spots = spot_rays(task.defocused, task.fields_rad, DISTANCE_M, LIGHT, grid=8)
    in_focus = spots.shifted(spots.best_focus_mm()).rms_mm()  # by the rays that the search looks at
    assert float(in_focus.mean()) == pytest.approx(1.5 * PITCH_MM, rel=1e-9)
    assert torch.equal(start.curvature_per_mm[:-1], task.defocused.curvature_per_mm[:-1])
    assert squared_spot(task.defocused, 0.0, task) > 4 * here


def test_spots_of_the_wall_agree_with_those_of_the_lens_package():
    geo = lens.load("cooke-triplet").scaled(0.22).freeze()
    # where the soft edges of the apertures take away less than 1e-7 of the light
    fields = (0.0, 0.1)
    green = lens.Spectrum.line("d")
    ours = spot_rays(geo, fields, 2.0, green, grid=32).rms_mm()
    assert torch.allclose(ours, lens.rms_spot_mm(geo, fields, at_m=2.0), rtol=1e-9)
    ours = spot_rays(geo, fields, math.inf, LIGHT, grid=32).rms_mm()
    for rms_mm, field in zip(ours, fields, strict=True):
        theirs = spot_radius_mm(*polychromatic_spot(geo, field, LIGHT))
        assert float(rms_mm) == pytest.approx(float(theirs), rel=1e-7)


def test_rivals_keep_focal_length_aperture_and_floors_of_the_design(task):
    def judge(optics):
        return float(task.rms_spot_um(optics).mean())

    design = task.design
    start_um = judge(design.reference)
    refocused = rivals.refocus(task, judge)
    spots = rivals.shrink_spots(task, judge, 4, 1, 0)
    assert rivals.least(spots).error_mrad < 0.7 * start_um
    for variant in (*refocused, *spots):
        made = variant.optics
        assert float(made.first_order().efl_mm) == pytest.approx(design.efl_mm, rel=1e-9)
        assert float(made.first_order().fno) == pytest.approx(
            float(task.nominal.first_order().fno), rel=1e-9
        )
        assert bool((made.thickness_mm >= design.floor_mm).all())
        # the hinge gives way a little
        assert bool((edge_thickness_mm(made) > design.edge_floor_mm - 0.002).all())
    for variant in refocused:  # nothing but the film has moved
        assert torch.equal(variant.optics.curvature_per_mm, design.reference.curvature_per_mm)
        assert torch.equal(variant.optics.thickness_mm[:-1], design.reference.thickness_mm[:-1])
    assert all("has not converged in 4 steps" in variant.complaint for variant in spots)


def test_a_spot_designer_that_finds_nothing_ends_at_the_start_and_says_so(task, monkeypatch):
    monkeypatch.setattr(rivals, "_solved", lambda *_: SimpleNamespace(loss=math.inf))
    (found,) = rivals.shrink_spots(task, lambda optics: 7.0, 5, 2, 0)
    assert (
        "finds no smaller spot from 2 starts in 5 steps, so its lens is the start"
        in found.complaint
    )
    assert torch.equal(found.optics.curvature_per_mm, task.design.reference.curvature_per_mm)
    assert found.error_mrad == 7.0


def test_the_first_words_say_who_wins():
    rows = {"the spot designer": [0.5, 0.51, 0.49], "refocusing alone": [0.8, 0.82, 0.79]}
    design = [0.40, 0.41, 0.39]
    said = verdict("the flow design", {name: log_ratio(design, row) for name, row in rows.items()})
    assert said.startswith(
        "The flow design wins: its flow error against its best rival, the spot designer, is -20"
    )
    # all that win or are undecided are named, those that win first
    design = [0.60, 0.62, 0.59]
    rows |= {"refocusing alone": [0.59, 0.62, 0.60], "the edge": design}
    said = verdict("the flow design", {name: log_ratio(design, row) for name, row in rows.items()})
    assert said.startswith(
        "The spot designer wins: the flow error of the flow design against it is +20"
    )
    assert (
        "; refocusing alone is undecided: the flow error of the flow design against it is +0"
        in said
    )
    assert said.endswith("%); the edge and the flow design err exactly alike on 3 unseen cases.")


@refusals.table(__file__, "estimators of lens_opt")
def test_what_makes_no_sense_is_refused_with_the_reason(row):
    row.holds(globals())


def test_networks_come_trained_or_to_be_trained():
    assert estimator("closed-form", False, "flow", 1, 0) is flow.estimate_lk
    assert weights_of(flow.estimate_lk) == []
    assert weights_of(estimator("refiner", False, "flow", 1, 0)) == []
    trained = weights_of(estimator("spiking", True, "flow", 30_000, 0))
    assert 30_000 <= sum(p.numel() for p in trained) < 60_000


@pytest.mark.parametrize("layer", ["sigmoid", "srm", "physical"])
def test_every_event_layer_hands_the_lens_a_gradient(layer, task):
    options = configured(lens_opt.Config, True, events=layer, cases=1, scored=1)
    job = lens_opt.prepare(options, task)
    (slope,) = torch.autograd.grad(job.system(job.probe).loss, job.camera.variables)
    assert int((slope != 0).sum()) == slope.numel()
    assert layer in events.LAYERS


class Killed(BaseException):
    pass


def test_a_run_killed_while_it_judges_goes_on_there_and_ends_with_the_same_figures(
    tmp_path, capsys, monkeypatch
):
    judge = LensTask.judge
    last = lens_opt.JUDGED + 2
    asked = set()

    def watched(task, optics, case, *rest):
        asked.add(case.seed)
        if case.seed == last and len(asked) > 1:
            raise Killed
        return judge(task, optics, case, *rest)

    folder = tmp_path / "a run"
    with monkeypatch.context() as patched:
        patched.setattr(LensTask, "judge", watched)
        with pytest.raises(Killed):
            ran(lens_opt, SMALL, folder)
        assert last - 1 in asked
        asked.clear()
        # what was judged before is not judged again
        assert ran(lens_opt, "--resume", folder) == 0
        assert last in asked
        assert last - 1 not in asked
    first = numbers(folder)
    said = capsys.readouterr().out.splitlines()[-1]
    lead = page(folder).split('<div class="lead">')[1]
    assert html.unescape(lead).startswith(f"<p>{QUICK} <strong>{said}</strong></p>")
    monkeypatch.setattr(rivals, "refocus", None)  # the rivals are stored: nobody makes them again
    monkeypatch.setattr(rivals, "shrink_spots", None)
    (folder / "report.html").unlink()
    assert ran(lens_opt, "--resume", folder) == 0
    again = numbers(folder)
    check_page("lens_opt", folder)
    for name in (
        *("flow_error_mrad_hard_optimised", "rms_spot_um_optimised", "rms_spot_um_spots", "steps"),
        *("seconds_per_step", "log_ratio_edge", "log_ratio_after_spots_over_spots_high"),
    ):
        assert again[name] == pytest.approx(first[name], rel=1e-6), name
