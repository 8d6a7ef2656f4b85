"""What event flow needs of a lens: faults of the size asked for, limits read off curves, point images in numbers."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

from codesign import render
from codesign.errors import DomainError, ShapeError
from codesign.lens import Pinhole
from codesign.lens.spectrum import LINE_UM, Spectrum
from codesign.render.sampling import film_pupil_pattern
from codesign.system.objectives import angular_error_mrad
from codesign.types import FlowField
from scenes import worlds
from studies.flow_needs import cases, page, real_lenses
from studies.flow_needs.__main__ import Config, study, units
from studies.flow_needs.conditions import BASE_VIEW, FAULTS
from studies.flow_needs.faulty_lens import FaultyLens
from studies.flow_needs.measure import MRAD_PER_PX, Targets, camera_of
from studies.flow_needs.predictors import (
    bearable,
    left_out_residual,
    mtf,
    point_images_px,
    predictors,
    rms_px,
)
from studies.flow_needs.results import Results
from studies.flow_needs.summary import Curve, Limit, first_above, rising
from studies.frame.run import main, open_run

EFL_MM = 11.0
EDGE_MM = 4.0


def faulty(**faults):
    return FaultyLens(EFL_MM, EDGE_MM, **faults)


def spot_mm(lens, distance_m, slope=0.05):
    """Where light of one point of space lands on the film, over the pupil: camera_rays inverted by Newton's method."""
    camera = render.Camera(lens, 64, 64, 0.1)
    _, pupil = film_pupil_pattern(4096, seed=3)
    point = torch.tensor([slope * distance_m, 0.0, distance_m], dtype=torch.float64).expand(len(pupil), 3)
    return camera.film_mm(render.project(camera, point, pupil))


@pytest.mark.parametrize("shape", FaultyLens.SHAPES)
@pytest.mark.parametrize("distance_m", [0.4, 5.0])
def test_a_point_image_has_the_rms_radius_asked_for(shape, distance_m):
    landed = spot_mm(faulty(blur_mm=0.03, blur=shape), distance_m)
    away = landed - torch.tensor([0.05 * EFL_MM, 0.0], dtype=torch.float64)
    assert float(away.square().sum(1).mean().sqrt()) == pytest.approx(
        0.03, rel=2e-3
    )  # 4096 points of a sequence
    assert float(away.mean(0).norm()) < 3e-4


def test_shapes_hold_their_light_within_the_radii_of_their_closed_forms():
    radius = {
        shape: spot_mm(faulty(blur_mm=1e-2, blur=shape), 2.0, 0.0).norm(dim=1) / 1e-2
        for shape in FaultyLens.SHAPES
    }
    assert float(radius["disc"].max()) == pytest.approx(math.sqrt(2), rel=1e-3)
    assert float((radius["disc"] < 1).double().mean()) == pytest.approx(0.5, abs=3e-3)
    # cut at three standard deviations: sigma^2 = 1 / (2 mean of -ln(1 - k t)), k = 1 - exp(-4.5)
    k = 1 - math.exp(-4.5)
    t = (np.arange(200_000) + 0.5) / 200_000
    sigma = (2 * np.mean(-np.log1p(-k * t))) ** -0.5
    inside = (1 - math.exp(-0.5 / sigma**2)) / k
    assert float((radius["gaussian"] < 1).double().mean()) == pytest.approx(inside, abs=3e-3)
    assert float(radius["gaussian"].max()) == pytest.approx(3 * sigma, rel=1e-2)
    assert float((radius["flare"] < 0.25 * math.sqrt(2)).double().mean()) == pytest.approx(0.8, abs=3e-3)


@pytest.mark.parametrize("percent", [-30.0, -5.0, 3.0, 16.0])
def test_distortion_at_the_edge_is_that_asked_for(percent):
    lens = faulty(distortion_percent=percent)
    camera = render.Camera(lens, 90, 90, 0.1)
    ideal_mm = EDGE_MM / (1 + percent / 100)
    points = torch.tensor([[ideal_mm / EFL_MM, 0.0, 1.0], [0.0, 1e-3, 1.0]], dtype=torch.float64)
    landed = camera.film_mm(render.project(camera, points))
    assert landed[0].tolist() == pytest.approx([EDGE_MM, 0.0], abs=1e-6)
    assert landed[1].tolist() == pytest.approx([0.0, 1e-3 * EFL_MM], rel=1e-4)  # none on the axis


def test_an_even_wall_is_darker_at_the_edge_by_the_illumination_asked_for():
    camera = render.Camera(faulty(edge_illumination=0.25), 41, 3, 0.2, samples_per_pixel=16)
    wall = worlds.wall(np.full((4, 4), 100.0))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pose[1, 3] = -2.0
    row = render.frames(camera, wall, pose[None])[0, 1] / 100
    assert float(row[20]) == pytest.approx(1.0, abs=1e-3)
    assert float(row[-1]) == pytest.approx(0.25, abs=5e-3)  # its centre lies at 4 mm
    assert float(row[30]) == pytest.approx(1 - 0.75 / 4, abs=5e-3)


def test_lateral_colour_is_the_difference_of_heights_in_c_and_f_light():
    lens = faulty(lateral_colour_mm=0.05)
    film = torch.tensor([[1.0, 0.0]], dtype=torch.float64)

    def height_mm(line):
        rays = lens.camera_rays(film, torch.zeros_like(film), LINE_UM[line])
        return EDGE_MM / EFL_MM * float(rays.direction[0, 2] / rays.direction[0, 0])

    assert height_mm("C") - height_mm("F") == pytest.approx(0.05, rel=1e-9)
    assert height_mm("d") == pytest.approx(EDGE_MM, rel=1e-12)


@pytest.mark.bits
@pytest.mark.parametrize("light", [None, Spectrum.visible_FdC()])
def test_without_faults_the_picture_is_a_pinholes_bit_for_bit(light):
    batch = next(cases.batches("photos", 2.0, 1, seed=0))
    film = cases.film("corner")
    pinhole, lens = (
        render.Camera(optics, 64, 64, cases.PITCH_MM, 6, film=film, spectrum=light)
        for optics in (Pinhole(cases.EFL_MM), FaultyLens(cases.EFL_MM, cases.EDGE_MM))
    )
    poses = batch.T_world_body[:, :2]
    assert torch.equal(render.frames(pinhole, batch.scene, poses), render.frames(lens, batch.scene, poses))


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        ({"blur": "square"}, "blur is 'square'; give one of disc, gaussian, flare"),
        ({"blur_mm": -0.1}, "blur_mm = -0.1"),
        ({"distortion_percent": 60.0}, "distortion_percent = 60.0"),
        ({"edge_illumination": 0.0}, "edge_illumination = 0.0"),
        ({"lateral_colour_mm": math.nan}, "lateral_colour_mm = nan"),
    ],
)
def test_faults_that_no_lens_has_are_refused(faults, said):
    with pytest.raises(DomainError, match=said):
        faulty(**faults)


def test_a_film_beyond_the_light_is_refused():
    film = torch.tensor([[0.0, 1.3 * EDGE_MM]], dtype=torch.float64)
    with pytest.raises(DomainError, match=r"reaches 5\.2 mm"):
        faulty(edge_illumination=0.1).camera_rays(film, torch.zeros_like(film))


@pytest.mark.parametrize("speed_px", [0.5, 4.0])
def test_motions_have_the_length_asked_for(speed_px):
    (batch,) = cases.batches("photos", speed_px, 3, seed=1)
    (again,) = cases.batches("photos", speed_px, 3, seed=1)
    assert torch.equal(batch.T_world_body, again.T_world_body)
    pixel = render.Camera(Pinhole(cases.EFL_MM), 1, 1, cases.PITCH_MM)  # on the axis, where nothing turns
    for scene, poses in zip(batch.scene, batch.T_world_body, strict=True):
        flow_px, _ = render.true_flow(pixel, scene, poses, stride=cases.FRAMES - 1)
        # the approach of 0.5 % per pixel of motion, standard deviation, brings the wall nearer
        assert float(flow_px.norm()) == pytest.approx(speed_px, rel=4 * cases.APPROACH * speed_px)


@pytest.mark.parametrize("texture", ["photos", "rooms"])
def test_errors_are_those_of_the_angular_objective(texture):
    camera = camera_of(FaultyLens(cases.EFL_MM, cases.EDGE_MM, distortion_percent=-10.0), "corner")
    (batch,) = cases.batches(texture, 2.0, 2, seed=4)
    judge = Targets.of(camera, batch)
    generator = torch.Generator().manual_seed(0)
    flow_px = 2 * torch.randn(2, 2, 64, 64, generator=generator, dtype=torch.float64)
    field = FlowField(flow_px, torch.ones(2, 64, 64, dtype=torch.bool), cases.DURATION_S)
    expected = angular_error_mrad(field, camera, batch.scene, batch.T_world_body, every_px=8)
    assert torch.allclose(judge.error_px(field) * MRAD_PER_PX, expected, rtol=1e-12)


def test_the_limit_of_a_made_up_table_is_found():
    levels = (0.0, 1.0, 2.0, 4.0)
    clean = np.outer([1.0, 1.05, 1.2, 1.6], [0.2, 0.5, 3.0])
    curve = Curve(levels, clean)
    assert curve.ratio == pytest.approx([1.0, 1.05, 1.2, 1.6])
    for rise, at in ((0.1, 1 + 0.05 / 0.15), (0.25, 2 + 2 * 0.05 / 0.4)):
        limit = curve.limit(rise, seed=0)
        assert (limit.value, limit.low, limit.high) == pytest.approx((at, at, at))
    assert curve.limit(0.7, seed=0) == Limit(math.inf, math.inf, math.inf)
    assert curve.limit(0.7, seed=0).text(4.0) == ">4"


def test_the_interval_of_a_limit_is_as_wide_as_its_spread():
    """Ratios exp(0.1 x + noise that grows as x): the limit scatters by the noise of the slope over the slope."""
    draw = np.random.default_rng(5)
    levels = np.linspace(0, 4, 41)
    count, spread = 200, 0.2
    noise = spread * draw.standard_normal(count)
    noise -= noise.mean()
    curve = Curve(levels, np.exp(levels[:, None] * (0.1 + noise)))
    limit = curve.limit(0.1, seed=0)
    at = math.log(1.1) / 0.1
    assert limit.value == pytest.approx(at, rel=1e-3)
    slope = 1.96 * noise.std() / math.sqrt(count)
    assert limit.low == pytest.approx(math.log(1.1) / (0.1 + slope), rel=0.03)
    assert limit.high == pytest.approx(
        math.log(1.1) / (0.1 - slope), rel=0.05
    )  # 1000 draws know a 2.5 % tail to 10 %


def test_a_step_that_is_high_by_chance_is_no_limit():
    """Logarithms 0.12, -0.06, 0.03 have the rising fit 0.03, 0.03, 0.03; 0.1 lies on the way to 0.3."""
    logs = [0.0, 0.12, -0.06, 0.03, 0.3]
    curve = Curve((0.0, 1.0, 2.0, 3.0, 4.0), np.exp(np.outer(logs, np.ones(5))))
    at = 3 + (1.1 - math.exp(0.03)) / (math.exp(0.3) - math.exp(0.03))
    assert curve.limit(0.1, seed=0).value == pytest.approx(at, rel=1e-6)
    assert rising(np.exp([[0.0, -0.2, 0.1]]))[0].tolist() == pytest.approx(
        [1.0, 1.0, math.exp(0.1)], rel=1e-6
    )


def test_a_curve_that_falls_again_has_the_first_limit():
    ratios = np.array([[1.0, 1.2, 0.9, 1.5], [1.0, 0.9, 1.0, 1.05]])
    assert first_above([0, 1, 2, 3], ratios, 1.1).tolist() == pytest.approx([0.5, math.inf])


@pytest.mark.parametrize(
    ("levels", "errors", "kind"),
    [
        ((0.0, 1.0), np.ones((3, 5)), ShapeError),
        ((0.0, 0.0), np.ones((2, 5)), DomainError),
        ((0.0, 1.0), np.zeros((2, 5)), DomainError),
    ],
)
def test_tables_that_are_no_curve_are_refused(levels, errors, kind):
    with pytest.raises(kind):
        Curve(levels, errors)


def test_numbers_of_a_disc_are_those_of_the_closed_forms():
    blur_px = 1.5
    lens = FaultyLens(cases.EFL_MM, cases.EDGE_MM, blur_mm=blur_px * cases.PITCH_MM)
    points = point_images_px(camera_of(lens, "centre"))
    rim = math.sqrt(2) * blur_px
    found = predictors(points)
    assert found["RMS radius, px"] == pytest.approx(blur_px, rel=5e-3)
    assert found["mean radius, px"] == pytest.approx(2 / 3 * rim, rel=5e-3)
    assert found["radius of 80 % of the light, px"] == pytest.approx(rim * math.sqrt(0.8), rel=1e-2)
    for frequency in (0.05, 0.15, 0.3):
        argument = 2 * math.pi * frequency * rim
        assert mtf(points, frequency) == pytest.approx(abs(2 * j1(argument) / argument), abs=5e-3)


def test_a_defocused_triplet_has_the_defocus_of_geometry():
    make, first = real_lenses.families()["defocus"]
    start = real_lenses.nominal()
    camera = camera_of(start, "centre")
    found = real_lenses.ramp(make, camera, 1.5, first)
    assert rms_px(point_images_px(camera.with_lens(found))) == pytest.approx(1.5, rel=5e-3)
    shift_mm = float(found.thickness_mm[-1] - start.thickness_mm[-1])
    figures = start.first_order()
    away = float(start.thickness_mm[-1]) - float(figures.exit_pupil_z_mm)  # from the pupil to the film
    rim_mm = shift_mm * float(figures.exit_pupil_diameter_mm) / 2 / away
    assert rim_mm / math.sqrt(2) / cases.PITCH_MM == pytest.approx(
        1.5, rel=0.03
    )  # and 0.05 px of other aberrations


def test_a_lens_that_never_blurs_enough_is_refused():
    with pytest.raises(DomainError, match="less than 2"):
        real_lenses.ramp(
            lambda amplitude: Pinhole(cases.EFL_MM), camera_of(Pinhole(cases.EFL_MM), "centre"), 2.0, 1.0
        )


def test_a_number_that_tells_the_error_leaves_no_residual():
    x = [1.0, 2.0, 3.0] * 2
    families = ["a"] * 3 + ["b"] * 3
    told = [0.1, 0.5, 0.7] * 2
    assert left_out_residual(x, told, families) == pytest.approx(0.0, abs=1e-12)
    assert bearable(x, told, math.expm1(0.3)) == pytest.approx(1.5)
    offset = [*told[:3], 0.3, 0.7, 0.9]  # each family is wrong about the other by 0.2
    assert left_out_residual(x, offset, families) == pytest.approx(0.2)
    with pytest.raises(DomainError, match="give two"):
        left_out_residual(x, told, ["a"] * 6)


def test_the_page_shows_the_limits_of_its_errors(tmp_path):
    """Errors made up so that one pixel of blur costs 20 %, along a straight line: 10 % at 0.5 px, 25 % at 1.25 px."""
    run = open_run("flow_needs", Config(quick=True, out=tmp_path / "run"))
    blur = FAULTS[0]
    sharp = torch.linspace(0.1, 2.0, 6, dtype=torch.float64)
    errors, numbers = {}, {}
    for unit in units(quick=True):
        level = next((x for x in blur.levels if unit.name == blur.unit(x, BASE_VIEW)), 0.0)
        for sensor in unit.sensors:
            errors[f"{unit.name} / {sensor} / events"] = sharp
            for judged in ("closed form", "closed form / ignored"):
                errors[f"{unit.name} / {sensor} / {judged}"] = sharp * (1 + 0.2 * level)
        numbers[unit.name] = predictors(point_images_px(unit.camera)) if unit.blurred else {}
    page.write(run, Results(errors, numbers, 0), ["closed form"])
    start = "blur_photos_theta_0.2_2_px_closed_form_at_plus"
    assert run.metrics[f"{start}_10_percent"] == pytest.approx(0.5)
    assert run.metrics[f"{start}_25_percent_low"] == pytest.approx(1.25)
    assert "falloff_dim_light_closed_form_at_plus_10_percent_is_beyond" in run.metrics
    assert run.metrics["blur_theta_0.4_closed_form_error_without_px"] == pytest.approx(float(sharp.mean()))
    assert (tmp_path / "run" / "report.html").is_file()


def test_too_few_cases_are_one_sentence(tmp_path, capsys):
    assert main(study, Config, ["--cases", "2", "--out", str(tmp_path / "run")]) == 2
    assert "--cases is 2; give at least 4" in capsys.readouterr().err
