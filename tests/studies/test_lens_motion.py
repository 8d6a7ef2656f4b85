"""A lens for the motion: contrast along a direction, flow directions, forms, what is chosen, a
quick run, refusals."""

import math

import pytest
import torch
from scipy.special import j1

from codesign.errors import DomainError, FileFormatError
from codesign.pose import se3_exp
from scenes.tum import write_tum
from studies.frame.compare import log_ratio
from studies.lens_motion import __main__ as lens_motion
from studies.lens_motion import rivals
from studies.lens_motion.forms import BENDING, STEPS, make_form
from studies.lens_motion.motions import HEIGHT_PX, SPEED_PX, Motion, drawn_world, flow_px
from studies.lens_opt import __main__ as lens_opt
from studies.lens_opt.spots import SpotRays
from studies.lens_opt.task import DISTANCE_M, PITCH_MM
from tests import refusals
from tests.studies.browser import check_page
from tests.studies.runs import lines, numbers, page, ran


def cloud(x_px, y_px):
    """Rays of one point at these places on the film."""
    position = torch.stack([x_px, y_px], 1)[None] * PITCH_MM
    share = torch.full(position.shape[:2], 1 / position.shape[1], dtype=torch.float64)
    return SpotRays(position, torch.zeros_like(position), share, torch.zeros(()))


def even_disc(count=40_000):
    """Points that cover the unit disc evenly (a sunflower)."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    return (k / count).sqrt() * torch.exp(1j * k * (math.pi * (3 - math.sqrt(5))))


@pytest.mark.parametrize("radius_px", [0.5, 2.0, 4.0])
def test_contrast_of_a_defocused_disc_is_that_of_the_airy_function_in_every_direction(radius_px):
    disc = radius_px * even_disc()
    found = rivals.mtf(cloud(disc.real, disc.imag), torch.linspace(0, 3, 7).double()[None])
    x = 2 * math.pi * rivals.FREQUENCY_PER_PX * radius_px
    # the error of the sunflower's sum falls as 1 / count
    assert torch.allclose(found, torch.full_like(found, abs(2 * j1(x) / x)), atol=1e-3)


def test_contrast_of_an_astigmatic_line_depends_on_the_direction_as_it_projects():
    half_px = 3.0
    disc = even_disc()
    line = cloud(half_px * disc.real, 0 * disc.imag)  # across the radius
    angle = torch.tensor([[0.0, 0.4, 1.0, math.pi / 2]], dtype=torch.float64)
    x = 2 * math.pi * rivals.FREQUENCY_PER_PX * half_px * angle[0].sin().numpy()
    expected = [1.0, *(abs(2 * j1(x[1:]) / x[1:]))]
    assert rivals.mtf(line, angle)[0].tolist() == pytest.approx(expected, abs=1e-3)


def test_forward_flow_is_radial_and_that_of_a_turn_horizontal():
    at = torch.tensor([[157.0, 0.0], [-90.0, 60.0]], dtype=torch.float64)
    drive = torch.zeros(2, 6, dtype=torch.float64)
    drive[0, 2] = 0.02  # forward: x -> x Z / (Z - d)
    drive[1, 4] = 1e-4  # a small turn: f w (1 + x^2) sideways, f w x y up or down
    moved = flow_px(at, drive, 9.0)
    share = 0.02 / (DISTANCE_M - 0.02)
    assert torch.allclose(moved[:, 0], share * at, rtol=1e-9)
    slope = at * PITCH_MM / 9.0
    sideways = torch.stack([1 + slope[:, 0] ** 2, slope[:, 0] * slope[:, 1]], 1)
    assert torch.allclose(moved[:, 1], -1e-4 * 9.0 / PITCH_MM * sideways, rtol=1e-3)


@pytest.mark.parametrize(("turned", "axial"), [(False, 1.0), (True, 0.0)])
def test_directions_lie_along_the_radius_and_across_it_when_turned(turned, axial):
    motion = Motion("forward", 9.0, turned)
    along = motion.directions_rad(200).cos().abs()
    assert float((along - axial).abs().median()) < 0.1  # the stray tenth of the speed
    case = motion.case([None], 5)
    whole = torch.linalg.inv(case.T_world_body[0]) @ case.T_world_body[-1]
    # forward and backward, or about the axis; the flow at the windows has about the speed asked for
    size = whole[2, 3] / DISTANCE_M if not turned else torch.atan2(whole[1, 0], whole[0, 0])
    assert 0.2 * SPEED_PX < HEIGHT_PX * abs(float(size)) < 5 * SPEED_PX


def test_a_turned_turn_goes_up_and_down_and_hovering_every_way():
    sideways = Motion("turn", 9.0).directions_rad(100)
    upward = Motion("turn", 9.0, turned=True).directions_rad(100)
    assert float(sideways.cos().abs().median()) > 0.95
    assert float(upward.cos().abs().median()) < 0.3
    around = torch.exp(2j * Motion("hover", 9.0).directions_rad(2000))
    # the mean of 2000 even directions has a length of about 1 / sqrt(2000)
    assert float(around.mean().abs()) < 0.1


def test_poses_of_a_file_give_their_own_directions(tmp_path):
    t_s = torch.linspace(0, 1, 11, dtype=torch.float64)
    path = tmp_path / "forward.txt"
    steps = torch.zeros(11, 6, dtype=torch.float64)
    steps[:, 2] = 0.5 * t_s
    write_tum(path, t_s, se3_exp(steps))
    found = Motion(str(path), 9.0).directions_rad(8)
    assert torch.allclose(found.sin(), torch.zeros_like(found), atol=1e-9)


@pytest.mark.parametrize("name", ["singlet", "achromat", "pair"])
def test_forms_hold_focal_length_and_aperture_and_bend_without_changing_power(name):
    form = make_form(name)
    point = torch.tensor([1.0, 0.4 * BENDING, *([0.0] * len(form.free))], dtype=torch.float64)
    bent = form.optics(point)
    assert float(bent.first_order().efl_mm) == pytest.approx(form.efl_mm, rel=1e-9)
    change = bent.curvature_per_mm[:-1] - form.start.curvature_per_mm[:-1]
    assert torch.allclose(change, torch.full_like(change, 0.4 * BENDING * STEPS[1]))
    image = bent.focus_at(DISTANCE_M).thickness_mm[-1]
    assert float(bent.thickness_mm[-1] - image) == pytest.approx(STEPS[0], rel=1e-9)


def test_each_designer_is_best_by_its_own_measure():
    form, motion = make_form("singlet"), Motion("forward", 9.0)
    along = motion.directions_rad()
    around = rivals.ALL_ROUND.expand(len(along), -1)
    found = {}
    for name in ("spots", "mtf", "mtf_along"):
        optics = form.optics(torch.tensor(rivals.design(name, form, motion, 0, 20)))
        rays = rivals.rays_at(optics, motion.points_px(), 24)
        contrast = [float(rivals.mtf(rays, angles).mean()) for angles in (around, along)]
        found[name] = (-rivals.rms_px(rays), *contrast)
    best = [max(found, key=lambda name: found[name][k]) for k in range(3)]
    assert best == ["spots", "mtf", "mtf_along"]


def test_the_smallest_detectable_change_is_seen_four_times_in_five():
    generator = torch.Generator().manual_seed(3)
    count, spread = 40, 0.5
    noise = spread * torch.randn(4000, count, generator=generator, dtype=torch.float64)
    typical = log_ratio(
        [1.0] * count, noise[0].sub(noise[0].mean()).div(noise[0].std()).mul(spread).exp().tolist()
    )
    shift = lens_motion.detectable(typical)
    mean, half = noise.mean(1) - shift, noise.std(1) / math.sqrt(count) * 2.0227
    # 4000 draws: 0.8 within 0.02, and the normal quantile of the power
    assert float((mean + half < 0).double().mean()) == pytest.approx(0.8, abs=0.02)


def test_a_quick_run_is_reached_from_the_main_job_and_says_that_it_decides_nothing(tmp_path):
    out = tmp_path / "run"
    command = "--motion turn --quick --steps=2 --developed=1 --judged=2 --judged-turned=2 --out"
    assert ran(lens_opt.start, command, out) == 0
    metrics = numbers(out)
    for name in ("refocused", "spots", "mtf", "mtf_along", "edge"):
        low, value, high = (metrics[f"log_ratio_{name}{end}"] for end in ("_low", "", "_high"))
        assert low <= value <= high
    assert "decides nothing" in page(out)
    check_page("lens_motion", out)
    rows = [row for _, case in lines(out / "judged.jsonl") for row in case]
    own, other = (
        [row["error_mrad"] for row in rows if row["lens"] == name] for name in ("flow", "spots")
    )
    assert metrics["log_ratio_spots"] == pytest.approx(log_ratio(own, other).value)
    assert ran(lens_motion, "--resume", out) == 0
    assert numbers(out)["log_ratio_spots"] == metrics["log_ratio_spots"]


@refusals.table(__file__, "lens_motion")
def test_bad_input_is_refused_in_a_sentence_before_the_first_frame(row, refuses):
    refuses(lens_opt.start, row)


def test_what_has_no_direction_cannot_be_turned_and_a_bad_file_is_named(tmp_path):
    with pytest.raises(DomainError, match="no direction of its own"):
        Motion("hover", 9.0, turned=True)
    path = tmp_path / "poses.txt"
    path.write_text("not a pose\n")
    with pytest.raises(FileFormatError, match=r"poses\.txt"):
        Motion(str(path), 9.0).directions_rad()
    write_tum(
        path, torch.linspace(0, 1, 5, dtype=torch.float64), se3_exp(torch.zeros(5, 6).double())
    )
    with pytest.raises(DomainError, match=r"moves the picture by less than 0\.1 px"):
        Motion(str(path), 9.0).directions_rad()


def test_a_verdict_is_that_of_textures_where_cases_of_one_are_alike():
    """Sixty cases that err alike on each of six textures: as sure as six, not as sixty."""
    rows = []
    for case in range(60):
        drawn = torch.Generator().manual_seed(lens_motion.JUDGED + case)
        world = drawn_world(len(lens_motion.HELD_OUT), drawn)
        for name, error in (("flow", math.exp(0.3 * (-1) ** world)), ("spots", 1.0)):
            rows.append({"case": case, "turned": 0, "lens": name, "error_mrad": error})
    found = lens_motion.ratios(rows, "flow")["spots"]
    assert found.count == 60
    assert found.high - found.low > 0.3 > 4 * 0.3 / 60**0.5


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda rows: rows + rows[1:2], "every case of 'spots' once"),
        (lambda rows: rows[:-1], "every case of 'flow' once"),
        (lambda rows: [rows[0], *(row[:-1] + "x" for row in rows[1:])], "damaged"),
        (lambda rows: rows[:1], "has no row"),
        (lambda rows: [row.replace("turned", "way") for row in rows], "'turned'"),
    ],
)
def test_a_table_is_read_case_by_case_and_a_damaged_one_refused(change, sentence, tmp_path):
    rows = [f"a,0,{case},{name},{case + 1}.5" for case in (1, 0) for name in ("spots", "flow")]
    rows = ["setting,turned,case,lens,error_mrad", *rows]
    (tmp_path / "whole.csv").write_text("\n".join(rows))
    found = lens_motion._read(tmp_path / "whole.csv")
    assert [row["error_mrad"] for row in found] == [1.5, 1.5, 2.5, 2.5]
    (tmp_path / "raw.csv").write_text("\n".join(change(rows)))
    with pytest.raises(FileFormatError, match=sentence):
        lens_motion._read(tmp_path / "raw.csv")
