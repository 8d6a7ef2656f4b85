"""What ``codesign.select`` chooses, beside every combination tried by hand and beside optics."""

import itertools
from dataclasses import replace

import pytest
import torch

import codesign
from codesign import events, lens, pose, render
from codesign.errors import DomainError
from codesign.fidelity import Fidelity, Survey, Task, levels_of, search
from codesign.fidelity.levels import batch_of, finer
from codesign.fidelity.search import cheapest
from codesign.fidelity.survey import PARTS, change, outcome

T_S = torch.linspace(0, 0.05, 9, dtype=torch.float64)
PLANE = render.TexturedPlane([[2.0, 1.5], [1.2, -2.4], [3.0, 0.4]], [0.3] * 3, [0.0, 1.0, 2.0])
FEW = {
    "samples": (4, 16),
    "frames": (5, 9),
    "events": ("memory", "hard"),
    "bins": (4,),
    "flow": ("affine",),
}


def task(optics, distance_m=1.0, **options):
    """A camera of 24 x 24 pixels that passes the plane by about two pixels."""
    camera = render.Camera(optics, 24, 24, 0.12, samples_per_pixel=16)
    poses = pose.look_at((0, -0.01, distance_m), (0, 0, 0)).repeat(9, 1, 1)
    poses[:, 0, 3] += 0.03 * distance_m * T_S / T_S[-1]
    return Task(camera, events.SensorModel(0.1, 0.1), poses, T_S, **options)


def test_changes_are_root_mean_squares_less_the_noise_of_the_sensor():
    """Of flow off by (3, 4) px everywhere the length is 5; independent noise of 2 px beside it
    leaves 5 within four deviations: a mean of products over 20000 pixels and 6 pairs of draws."""
    truth = torch.zeros(1, 5, 2, 40, 100)
    bias = torch.tensor([3.0, 4.0])[:, None, None].expand(1, 5, 2, 40, 100).clone()
    assert change(bias, truth) == pytest.approx(5)
    draws = 2 * torch.randn(4, 5, 2, 40, 100, generator=torch.Generator().manual_seed(0))
    deviation = (5 * 2 * 2 / 2 / 20000**0.5 + 4 / (6 * 10000) ** 0.5) / 10
    assert change(bias + draws, truth.expand_as(draws)) == pytest.approx(5, abs=4 * deviation)
    assert change(bias + draws, truth.expand_as(draws)) < change((bias + draws)[:1], truth) - 0.5
    bias[0, 0, 0, 0, 0] = torch.nan
    assert change(bias, truth) == torch.inf
    with pytest.raises(DomainError, match="not finite on every draw"):
        change(truth, bias)


def test_levels_share_the_ends_of_the_drive_and_colours_their_samples():
    levels = levels_of(task(lens.load("cooke-triplet").scaled(0.2)))
    assert levels["camera"] == ("pinhole", "thin", "psf", "traced")
    assert levels["samples"] == (1, 4, 16)
    assert levels["frames"] == (3, 5, 9)
    coarse = Fidelity("thin", 4, 3, "memory", 4, "affine")
    assert torch.equal(batch_of(task(lens.Pinhole(8.0)), coarse).t_s, T_S[::4])
    assert finer(coarse, levels) == Fidelity("traced", 16, 5, "hard", 6, "chosen")
    camera = task(lens.Pinhole(8.0)).camera
    coloured = render.Camera(
        camera.lens, 24, 24, 0.12, 24, spectrum=lens.Spectrum((0.5, 0.55, 0.6), (0.2, 0.5, 0.3))
    )
    assert levels_of(replace(task(lens.Pinhole(8.0)), camera=coloured))["samples"] == (6, 24)
    with pytest.raises(DomainError, match="events has no level 'soft' here"):
        levels_of(task(lens.Pinhole(8.0)), {"events": ("soft",)})
    with pytest.raises(DomainError, match="events has no level to choose"):
        levels_of(task(lens.Pinhole(8.0), gradient=True), {"events": ("hard",)})
    for wrong in (6, "46", (4.5, 6), (6, 4)):
        with pytest.raises(DomainError, match=r"give a list|whole numbers that rise"):
            levels_of(task(lens.Pinhole(8.0)), {"bins": wrong})


def made_up():
    """A survey of two levels in two stages beside fixed ones: changes and ratios of time."""
    levels = {
        "camera": ("pinhole", "thin", "traced"),
        "samples": (1, 4, 16),
        "frames": (9,),
        "events": ("memory",),
        "bins": (5,),
        "flow": ("affine",),
    }
    changes = {"pinhole": 0.3, "thin": 0.1, 1: 0.25, 4: 0.06}
    speeds = {"pinhole": 0.2, "thin": 0.5, 1: 0.1, 4: 0.3}
    pairs = [(stage, level) for stage, found in levels.items() for level in found]
    rows = [{"stage": s, "level": v, "change": changes.get(v, 0.0), "cpu_s": 1.0} for s, v in pairs]
    ratios = {(s, v): {**dict.fromkeys(PARTS, 1.0), "frames": speeds.get(v, 1.0)} for s, v in pairs}
    return Survey(
        levels,
        rows,
        dict(zip(PARTS, (8.0, 0.1, 0.1, 0.0), strict=True)),
        ratios,
        {},
        torch.zeros(1),
    )


@pytest.mark.parametrize(
    ("tolerance", "camera", "samples"),
    [(0.6, "pinhole", 1), (0.37, "thin", 1), (0.2, "thin", 4), (0.07, "traced", 4)],
)
def test_the_cheapest_whose_changes_add_up_to_the_tolerance(tolerance, camera, samples):
    """8 s of frames times the ratios and 0.2 s besides: by hand .2 x .1, .2 x .3, .5 x .3 and .3;
    the finest samples are the reference alone."""
    pick = cheapest(made_up(), task(lens.Pinhole(8.0)), tolerance)
    assert (pick.camera, pick.samples) == (camera, samples)
    assert made_up().predicted(pick) <= tolerance


def test_combinations_about_as_fast_are_told_apart_by_what_they_change():
    known = made_up()
    for row in known.ratios.values():
        row["frames"] = 1.0
    pick = cheapest(known, task(lens.Pinhole(8.0)), 1.0)
    assert (pick.camera, pick.samples) == ("traced", 4)


@pytest.mark.parametrize(("focus_m", "sharp"), [(1.0, True), (0.12, False)])
def test_an_aperture_matters_where_the_scene_is_out_of_focus(focus_m, sharp):
    """At 1 m a lens of 8 mm f/1.6 focused there sees the points that a pinhole sees; focused at 12
    cm it blurs by 5 x 8 / 120 mm x .88, 2.5 pixels, which hides waves."""
    optics = lens.ThinLens(8.0, 5.0).focus_at(focus_m)
    only = {**FEW, "camera": ("pinhole", "thin"), "samples": (16,)}
    found = codesign.select(PLANE, task(optics), 0.06, levels=only)
    pinhole = found.survey.changed("camera", "pinhole")
    assert pinhole < 0.01 if sharp else pinhole > 0.06
    assert sharp or found.fidelity.camera == "thin"


def test_what_is_chosen_stays_within_the_tolerance_of_the_finest_and_repeats():
    wanted = task(lens.ThinLens(8.0, 1.0).focus_at(1.0))
    found = codesign.select(PLANE, wanted, 0.2, levels=FEW)
    finest = Fidelity("thin", 16, 9, "hard", 4, "affine")
    off = [outcome(PLANE, wanted, each).judged for each in (found.fidelity, finest)]
    assert change(*off) <= 0.2
    frames = outcome(PLANE, wanted, finest).frames
    assert "frames" not in outcome(PLANE, wanted, finest, frames=frames).cpu_s  # not timed
    again = codesign.select(PLANE, wanted, 0.2, levels=FEW)
    changes = [[row["change"] for row in each.survey.rows] for each in (found, again)]
    assert changes[0] == changes[1]
    lines = str(found).splitlines()
    assert [line.split()[0] for line in lines[:6]] == list(levels_of(wanted))
    assert "would change flow by" in lines[1]
    assert found.system({"sum": lambda field: field.flow_px.sum()}).bins == 4


def test_a_survey_that_promises_too_much_is_found_out_by_the_finer_run(monkeypatch):
    wanted = task(lens.ThinLens(8.0, 5.0).focus_at(0.12))
    real = search.survey

    def blind(*given):
        known = real(*given)
        return replace(known, rows=[{**row, "change": 0.0} for row in known.rows])

    only = {**FEW, "camera": ("pinhole", "thin"), "samples": (16,)}
    monkeypatch.setattr(search, "survey", blind)
    assert codesign.select(PLANE, wanted, 0.06, levels=only).fidelity.camera == "thin"


def test_a_tolerance_that_nothing_meets_names_the_best_found():
    wanted = task(lens.Pinhole(8.0), gradient=True)
    with pytest.raises(DomainError, match=r"within 1e-09 px; the best found, pinhole .* is off by"):
        codesign.select(PLANE, wanted, 1e-9, levels={**FEW, "samples": (16,), "frames": (9,)})


def test_other_things_than_flow_are_judged_in_their_own_unit():
    mean = {"estimate": lambda field: field.flow_px.mean((2, 3)), "unit": "px/window"}
    wanted = task(lens.Pinhole(8.0), judged=lambda estimate: estimate, name="drift", **mean)
    found = codesign.select(PLANE, wanted, 0.3, levels=FEW)
    reference = outcome(PLANE, wanted, Fidelity("pinhole", 16, 9, "hard", 4, "affine")).judged
    tried = {
        pick: change(outcome(PLANE, wanted, pick).judged, reference)
        for pick in itertools.islice(found.survey.combinations(wanted), 8)
    }
    assert tried[found.fidelity] <= 0.3
    assert "px/window (0.3 tolerated)" in str(found)
