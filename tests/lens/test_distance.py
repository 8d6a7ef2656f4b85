"""Objects at a distance: where their rays start, several at once, the limit of parallel light, gradients, focus."""

import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError, ShapeError
from codesign.lens import analysis, plates, wave
from codesign.lens.analysis import field_rays, pupil_grid
from codesign.lens.design import Limits, focus_paraxial, focus_rays
from codesign.lens.design.constraints import evaluate
from codesign.lens.design.hits import paraxial_semi_aperture_mm, traced_semi_aperture_mm
from codesign.lens.design.tolerance import linear_figures
from codesign.lens.design.tolerance_spot import spot_errors, squared_spots
from codesign.lens.seidel import seidel_sums

D = torch.float64
FIELDS = (0.0, 0.15)


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss", "la1509"])
@torch.no_grad()
def test_rays_come_from_one_point_and_cross_the_pupil_where_asked(name):
    geo = lens.load(name)
    pupil = pupil_grid(8)
    figures = geo.first_order()
    start, direction = field_rays(geo, 0.15, pupil, at_m=0.4)
    at_pupil = start + direction * ((figures.entrance_pupil_z_mm - start[:, 2:]) / direction[:, 2:])
    wanted = pupil * figures.entrance_pupil_diameter_mm / 2
    torch.testing.assert_close(at_pupil[:, :2], wanted, rtol=0, atol=1e-13)
    back = start + direction * ((figures.entrance_pupil_z_mm - 400.0 - start[:, 2:]) / direction[:, 2:])
    point = torch.tensor([0.0, -400 * math.tan(0.15)], dtype=D)  # seen under the field angle
    torch.testing.assert_close(back[:, :2], point.expand(len(pupil), 2), rtol=0, atol=1e-11)


@torch.no_grad()
def test_several_distances_are_one_trace_and_equal_each_alone(monkeypatch):
    geo = lens.load("double-gauss").focus_at(0.7)
    distances = (0.3, 0.7, math.inf)
    alone = torch.stack([lens.rms_spot_mm(geo, FIELDS, at_m=d) for d in distances])
    traces = []
    trace = lens.GeoLens.trace
    monkeypatch.setattr(lens.GeoLens, "trace", lambda *of: traces.append(of) or trace(*of))
    together = lens.rms_spot_mm(geo, FIELDS, at_m=distances)
    assert len(traces) == 1
    torch.testing.assert_close(together, alone, rtol=1e-12, atol=0)
    torch.testing.assert_close(lens.rms_spot_mm(geo, FIELDS), alone[-1], rtol=1e-12, atol=0)


@torch.no_grad()
def test_parallel_light_is_the_limit():
    geo = lens.load("cooke-triplet")
    parallel, *far = lens.spots(geo, FIELDS, at_m=[math.inf, 1e6, 1e7])[0]
    errors = [float((p - parallel).abs().max()) for p in far]
    assert errors[1] < 1e-5
    assert errors[0] == pytest.approx(10 * errors[1], rel=1e-3)  # an error goes as 1 / distance


def test_gradient_to_the_distance_is_that_of_differences():
    geo = lens.load("cooke-triplet")
    at_m = torch.tensor([0.5, 2.0], dtype=D, requires_grad=True)
    lens.rms_spot_mm(geo, FIELDS, at_m=at_m).sum().backward()
    step = 1e-5
    with torch.no_grad():
        up, down = (lens.rms_spot_mm(geo, FIELDS, at_m=at_m + s).sum(1) for s in (step, -step))
    torch.testing.assert_close(at_m.grad, (up - down) / (2 * step), rtol=1e-8, atol=0)


def test_solves_at_a_distance():
    geo = lens.load("cooke-triplet")
    for at_m in (0.5, 3.0, math.inf):
        paraxial = focus_paraxial(geo, at_m=at_m).thickness_mm[-1]
        assert float(paraxial.detach()) == pytest.approx(
            float(geo.focus_at(at_m).thickness_mm[-1].detach()), rel=1e-14
        )
        sharp = focus_rays(geo, (0.0,), at_m=at_m).thickness_mm[-1]
        assert float(sharp.detach()) == pytest.approx(
            float(geo.focus_at(at_m, spot_grid=16).thickness_mm[-1].detach()), rel=1e-12
        )
    distances = (0.5, 0.6)
    shared = focus_rays(geo, FIELDS, at_m=distances)

    def mean_square(shift):
        moved = shared.replace(
            thickness_mm=shared.thickness_mm + shift * torch.eye(len(geo.surfaces), dtype=D)[-1]
        )
        return float(lens.rms_spot_mm(moved, FIELDS, grid=16, at_m=distances).detach().square().mean())

    here, less, more = map(mean_square, (0.0, -0.01, 0.01))
    assert here < min(less, more)
    assert less == pytest.approx(more, rel=1e-9)  # a parabola about its least


@pytest.mark.parametrize("bad", [-1.0, 0.0, math.nan, 0.004, (1.0, -2.0), -math.inf])
def test_distances_that_cannot_be_get_a_sentence(bad):
    geo = lens.load("cooke-triplet")
    for call in (
        lambda: lens.rms_spot_mm(geo, FIELDS, at_m=bad),
        lambda: focus_rays(geo, FIELDS, at_m=bad),
    ):
        with pytest.raises(DomainError, match=r"not lie before the lens; give distances above 0\.01"):
            call()
    with pytest.raises(ShapeError, match="one number or a list"):
        lens.spots(geo, FIELDS, at_m=[[1.0]])


FIGURES = {
    "wavefront": lambda geo, at_m: analysis.rms_waves(analysis.wavefront(geo, 0.15, grid=16, at_m=at_m)),
    "fan": lambda geo, at_m: analysis.ray_fan(geo, 0.15, count=7, at_m=at_m).tangential_mm.square().sum(),
    "seidel": lambda geo, at_m: seidel_sums(geo, 0.15, at_m=at_m).per_surface.square().sum(),
    "distortion": lambda geo, at_m: analysis.distortion_percent(geo, [0.15], at_m=at_m).sum(),
    "field curvature": lambda geo, at_m: analysis.focus_shift_mm(geo, [0.15], at_m=at_m).sum(),
    "axial colour": lambda geo, at_m: analysis.chromatic_focus_shift_mm(geo, [0.48], at_m=at_m).sum(),
    "encircled": lambda geo, at_m: analysis.encircled_radius_mm(geo, 0.15, grid=8, at_m=at_m),
    "geometric MTF": lambda geo, at_m: analysis.geometric_mtf(geo, 0.15, [5.0], grid=8, at_m=at_m).sum(),
    "through focus": lambda geo, at_m: analysis.through_focus_spot_mm(
        geo, FIELDS, [0.1], grid=8, at_m=at_m
    ).sum(),
    "point spread": lambda geo, at_m: analysis.psf_on_pixels(
        geo.focus_at(1.0), 0.0, 0.004, 8, grid=128, at_m=at_m
    ).energy[4, 4],
    "MTF": lambda geo, at_m: analysis.diffraction_mtf(
        geo.focus_at(1.0), 0.0, [20.0], grid=128, at_m=at_m
    ).sum(),
    "depth of field": lambda geo, at_m: analysis.depth_of_field(geo, 0.02, at_m).near_m,
    "apertures": lambda geo, at_m: paraxial_semi_aperture_mm(geo, 0.15, at_m=at_m).sum(),
}


@pytest.mark.parametrize("name", FIGURES)
def test_gradients_of_figures_to_the_distance_are_those_of_differences(name):
    geo = lens.load("cooke-triplet").requires_grad_(False)
    at_m = torch.tensor(0.9, dtype=D, requires_grad=True)
    FIGURES[name](geo, at_m).backward()
    step = 1e-4
    with torch.no_grad():
        values = [FIGURES[name](geo, 0.9 + k * step) for k in (-2, -1, 1, 2)]
    difference = float(8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * step)
    assert float(at_m.grad) == pytest.approx(difference, rel=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("name", [n for n in FIGURES if n not in ("point spread", "MTF", "depth of field")])
def test_figures_tend_to_those_of_parallel_light(name):
    geo = lens.load("cooke-triplet")
    parallel, far, farther = (float(FIGURES[name](geo, at_m)) for at_m in (math.inf, 1e5, 1e6))
    assert far == pytest.approx(parallel, rel=1e-2)
    assert abs(farther - parallel) <= 0.11 * abs(far - parallel) + 1e-11 * abs(parallel)


@torch.no_grad()
def test_figures_of_several_distances_are_those_of_each():
    geo = lens.load("double-gauss")
    distances = (0.4, 3.0, math.inf)
    for figure in (
        lambda at_m: analysis.distortion_percent(geo, FIELDS, at_m=at_m),
        lambda at_m: analysis.focus_shift_mm(geo, FIELDS, at_m=at_m),
        lambda at_m: analysis.lateral_colour_mm(geo, FIELDS, [0.48, 0.65], at_m=at_m),
        lambda at_m: analysis.chromatic_focus_shift_mm(geo, [0.48, 0.65], at_m=at_m),
        lambda at_m: analysis.trace_field(geo, 0.1, pupil_grid(6), at_m=at_m).path_mm,
    ):
        each = torch.stack([figure(d) for d in distances])
        torch.testing.assert_close(figure(distances), each, rtol=1e-10, atol=1e-13)
    widest = traced_semi_aperture_mm(geo, FIELDS, at_m=distances)
    each = torch.stack([traced_semi_aperture_mm(geo, FIELDS, at_m=d) for d in distances])
    torch.testing.assert_close(widest, each.amax(0), rtol=1e-12, atol=0)
    errors = spot_errors(FIELDS, at_m=(0.4, 3.0))(geo)
    sizes = lens.rms_spot_mm(geo, FIELDS, grid=12, at_m=(0.4, 3.0)).square().reshape(-1)
    torch.testing.assert_close(squared_spots(errors, 4), sizes, rtol=1e-10, atol=0)


@torch.no_grad()
def test_limits_and_tolerances_see_the_distance():
    geo = lens.load("cooke-triplet")
    near, far = (
        {c.name: float(c.value) for c in evaluate(geo, Limits(incidence_deg=40.0, fields_rad=FIELDS, at_m=d))}
        for d in (0.2, math.inf)
    )
    assert near["incidence on surface 1"] != pytest.approx(far["incidence on surface 1"], rel=1e-3)
    focused = geo.focus_at(0.5)
    found = linear_figures(0.15, at_m=0.5)(focused)[2]
    # the mean point of a spot lies near the chief ray, whose distortion this is
    assert 100 * float(found) == pytest.approx(
        float(analysis.distortion_percent(focused, [0.15], at_m=0.5)), abs=0.15
    )


@pytest.mark.parametrize("focus_m", [0.5, 4.0, math.inf])
@torch.no_grad()
def test_depth_of_field_of_a_thin_lens_is_that_of_its_circle_of_confusion(focus_m):
    glass = lens.Glass.from_indices(1.5, 1.5, 1.5)
    surfaces = [
        lens.Surface(50.0, 0.0, glass, 10.0, is_stop=True),  # no thickness: all at the pupil
        lens.Surface(-50.0, 50.0, None, 10.0),
    ]
    geo = lens.GeoLens(surfaces, 10.0)
    found = analysis.depth_of_field(geo, 0.05, focus_m)
    thin = geo.focus_at(focus_m).thin()
    for limit in (found.near_m, found.far_m):
        if bool(limit.isfinite()):
            blur = lens.paraxial.circle_of_confusion_mm(thin, float(limit))
            assert float(blur) == pytest.approx(0.05, rel=1e-10)
    hyperfocal = analysis.hyperfocal_m(geo, 0.05)
    assert float(hyperfocal) == pytest.approx((50.0**2 / (5.0 * 0.05) + 50.0) / 1e3, rel=1e-12)
    wide = analysis.depth_of_field(geo, 0.05 * (1 + 1e-9), float(hyperfocal))
    assert math.isinf(float(wide.far_m))
    assert float(wide.near_m) == pytest.approx(float(hyperfocal) / 2, rel=1e-6)  # half of it, for a thin lens


@torch.no_grad()
def test_traced_depth_of_field_has_the_limit_at_its_ends():
    geo = lens.load("cooke-triplet").focus_at(0.6, spot_grid=16)
    found = analysis.traced_depth_of_field(geo, 0.06)
    for limit in (found.near_m, found.far_m):
        assert float(lens.rms_spot_mm(geo, [0.0], grid=16, at_m=float(limit))) == pytest.approx(
            0.06 / math.sqrt(8), rel=1e-5
        )
    assert found.near_m < 0.6 < found.far_m
    assert float(found.focus_m) == pytest.approx(0.6, rel=2e-3)


@torch.no_grad()
@pytest.mark.parametrize("defocus_rad", [10.0, -50.0, -80.0])
def test_traced_depth_of_field_is_found_where_a_plate_moves_it(defocus_rad):
    geo = lens.load("cooke-triplet").focus_at(2.0)
    plated = plates.with_plate(geo, plates.ZernikePlate({4: defocus_rad}, 6.0), z_mm=1.0)
    found = analysis.traced_depth_of_field(plated, 0.1, grid=8)
    at = torch.linspace(1 / 50, 1 / 0.5, 4001, dtype=D)  # 1 / m
    sizes = lens.rms_spot_mm(plated, [0.0], grid=8, at_m=1 / at)[:, 0]
    sharp = at[sizes <= 0.1 / math.sqrt(8)]
    step = float(at[1] - at[0])
    assert 1 / float(found.far_m) == pytest.approx(float(sharp[0]), abs=step)
    assert 1 / float(found.near_m) == pytest.approx(float(sharp[-1]), abs=step)
    assert 1 / float(found.focus_m) == pytest.approx(float(at[sizes.argmin()]), abs=step)


@torch.no_grad()
def test_depth_of_field_refuses_what_it_cannot_answer():
    geo = lens.load("cooke-triplet")
    for blur in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(DomainError, match="give a positive diameter"):
            analysis.depth_of_field(geo, blur)
    with pytest.raises(DomainError, match=r"above the .* of a disc of 0\.005 mm; allow more blur"):
        analysis.traced_depth_of_field(geo, 0.005, 1.0)
    with pytest.raises(DomainError, match=r"limit of blur: .* is not one finite number"):
        analysis.depth_of_field(geo, [0.1, 0.2])
    with pytest.raises(ShapeError, match="fields_rad must be a list of angles"):
        analysis.traced_depth_of_field(geo, 0.1, fields_rad=0.1)
    short = geo.replace(thickness_mm=geo.thickness_mm * torch.tensor([1.0] * 5 + [0.9], dtype=D))
    with pytest.raises(DomainError, match=r"no point before the lens has a blur of 0\.02 mm or less"):
        analysis.depth_of_field(short, 0.02)


@pytest.mark.parametrize("bad", ["0.5", None, 1j, [0.5, "a"]])
@pytest.mark.parametrize(
    "call",
    [
        lambda geo, bad: lens.rms_spot_mm(geo, [0.0], at_m=bad),
        lambda geo, bad: geo.focus_at(bad),
        lambda geo, bad: focus_paraxial(geo, at_m=bad),
        lambda geo, bad: seidel_sums(geo, 0.1, at_m=bad),
        lambda geo, bad: geo.variables("curvature", focus_at_m=bad or "a"),
        lambda geo, bad: wave.before_image(geo, 1.0, 0.001, 8, at_m=bad),
    ],
)
def test_distances_that_are_no_numbers_get_a_sentence(call, bad):
    with pytest.raises(
        DomainError, match=r"distances: .* is no real number and no list of them; give numbers"
    ):
        call(lens.load("cooke-triplet"), bad)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda geo: lens.rms_spot_mm(geo, [0.0], grid=-1), "pupil grid of -1 samples"),
        (lambda geo: focus_rays(geo, [0.0], grid=0), "pupil grid of 0 samples"),
        (lambda geo: geo.focus_at(1.0, spot_grid=-1), "pupil grid of -1 samples"),
        (lambda geo: focus_rays(geo, [0.0], wavelengths_um=()), "no wavelength was given"),
        (lambda geo: lens.GeoLens([lens.Surface(20.0, 2.0, "N-BK7", 5.0)], 4.0), "give Glass.named"),
    ],
)
def test_counts_and_names_that_cannot_be_get_a_sentence(call, said):
    with pytest.raises(DomainError, match=said):
        call(lens.load("cooke-triplet"))


def test_figures_of_one_distance_refuse_several():
    geo = lens.load("cooke-triplet")
    several = (0.5, 1.0)
    for call in (
        lambda: analysis.wavefront(geo, 0.1, at_m=several),
        lambda: analysis.ray_fan(geo, 0.1, at_m=several),
        lambda: analysis.polychromatic_spot(geo, 0.1, 0.58, at_m=several),
        lambda: analysis.through_focus_spot_mm(geo, [0.1], [0.0], at_m=several),
        lambda: analysis.diffraction_mtf(geo, 0.1, [10.0], at_m=several),
        lambda: seidel_sums(geo, 0.1, at_m=several),
        lambda: focus_paraxial(geo, at_m=several),
    ):
        with pytest.raises(ShapeError, match="figure of one object distance"):
            call()


@pytest.mark.parametrize("function", ["wavefront", "ray_fan", "diffraction_psf", "pupil_function"])
def test_every_analysis_refuses_a_distance_in_the_lens(function):
    with pytest.raises(DomainError, match="not lie before the lens"):
        getattr(analysis, function)(lens.load("cooke-triplet"), 0.1, at_m=0.01)
