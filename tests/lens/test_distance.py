"""Objects at a distance: several at once, the limit of parallel light, gradients, focus, depth of field."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import analysis, diffraction
from codesign.lens.analysis import pupil_grid
from codesign.lens.design import Limits
from codesign.lens.design.constraints import evaluate
from codesign.lens.design.hits import paraxial_semi_aperture_mm, traced_semi_aperture_mm
from codesign.lens.design.tolerance import linear_figures, spot_errors, squared_spots
from codesign.lens.seidel import seidel_sums
from codesign.lens.solves import focus_paraxial, focus_rays
from tests.lens.systems import check_gradient, glass

D = torch.float64
FIELDS = (0.0, 0.15)


@pytest.fixture
def triplet():
    return lens.load("cooke-triplet").freeze()


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
def test_parallel_light_is_the_limit(triplet):
    parallel, *far = lens.spots(triplet, FIELDS, at_m=[math.inf, 1e6, 1e7])[0]
    errors = [float((p - parallel).abs().max()) for p in far]
    assert errors[1] < 1e-5
    # an error goes as 1 / distance
    assert errors[0] == pytest.approx(10 * errors[1], rel=1e-3)


def test_solves_at_a_distance(triplet):
    def last(geo):
        return geo.thickness_mm[-1].item()

    for at_m in (0.5, 3.0, math.inf):
        assert last(focus_paraxial(triplet, at_m=at_m)) == pytest.approx(
            last(triplet.focus_at(at_m)), rel=1e-14
        )
        sharp = last(triplet.focus_at(at_m, spot_grid=16))
        assert last(focus_rays(triplet, (0.0,), at_m=at_m)) == pytest.approx(sharp, rel=1e-12)
    distances = (0.5, 0.6)
    shared = focus_rays(triplet, FIELDS, at_m=distances)

    def mean_square(shift):
        moved = shared.replace(thickness_mm=shared.thickness_mm + shift * torch.eye(6, dtype=D)[-1])
        return lens.rms_spot_mm(moved, FIELDS, grid=16, at_m=distances).square().mean().item()

    here, less, more = map(mean_square, (0.0, -0.01, 0.01))
    assert here < min(less, more)
    # a parabola about its least
    assert less == pytest.approx(more, rel=1e-9)


# figures that light in focus alone has a use for
FOCUSED = {
    "point spread": lambda geo, at_m: analysis.psf_on_pixels(geo, 0.0, 0.004, 8, grid=128, at_m=at_m).energy[
        4, 4
    ],
    "MTF": lambda geo, at_m: analysis.diffraction_mtf(geo, 0.0, [20.0], grid=128, at_m=at_m),
    "depth of field": lambda geo, at_m: analysis.depth_of_field(geo.focus_at(at_m), 0.02).near_m,
}
FIGURES = {
    "spots": lambda geo, at_m: lens.rms_spot_mm(geo, FIELDS, at_m=at_m),
    "wavefront": lambda geo, at_m: analysis.rms_waves(analysis.wavefront(geo, 0.15, grid=16, at_m=at_m)),
    "fan": lambda geo, at_m: analysis.ray_fan(geo, 0.15, count=7, at_m=at_m).tangential_mm.square(),
    "seidel": lambda geo, at_m: seidel_sums(geo, 0.15, at_m=at_m).per_surface.square(),
    "distortion": lambda geo, at_m: analysis.distortion_percent(geo, [0.15], at_m=at_m),
    "field curvature": lambda geo, at_m: analysis.focus_shift_mm(geo, [0.15], at_m=at_m),
    "axial colour": lambda geo, at_m: analysis.chromatic_focus_shift_mm(geo, [0.48], at_m=at_m),
    "encircled": lambda geo, at_m: analysis.encircled_radius_mm(geo, 0.15, grid=8, at_m=at_m),
    "geometric MTF": lambda geo, at_m: analysis.geometric_mtf(geo, 0.15, [5.0], grid=8, at_m=at_m),
    "through focus": lambda geo, at_m: analysis.through_focus_spot_mm(geo, FIELDS, [0.1], grid=8, at_m=at_m),
    "apertures": lambda geo, at_m: paraxial_semi_aperture_mm(geo, 0.15, at_m=at_m),
}


@pytest.mark.parametrize("name", [*FIGURES, *FOCUSED])
def test_gradients_of_figures_to_the_distance_are_those_of_differences(name, triplet):
    geo = triplet.focus_at(1.0) if name in FOCUSED else triplet
    figure = (FIGURES | FOCUSED)[name]
    check_gradient(lambda at_m: figure(geo, at_m).sum(), torch.tensor(0.9, dtype=D))


@torch.no_grad()
@pytest.mark.parametrize("name", FIGURES)
def test_figures_tend_to_those_of_parallel_light(name, triplet):
    parallel, far, farther = (float(FIGURES[name](triplet, at_m).sum()) for at_m in (math.inf, 1e5, 1e6))
    assert far == pytest.approx(parallel, rel=1e-2)
    assert abs(farther - parallel) <= 0.11 * abs(far - parallel) + 1e-11 * abs(parallel)


DISTANCES = (0.4, 3.0, math.inf)


@torch.no_grad()
@pytest.mark.parametrize(
    "figure",
    [
        lambda geo, at_m: analysis.distortion_percent(geo, FIELDS, at_m=at_m),
        lambda geo, at_m: analysis.focus_shift_mm(geo, FIELDS, at_m=at_m),
        lambda geo, at_m: analysis.lateral_colour_mm(geo, FIELDS, [0.48, 0.65], at_m=at_m),
        lambda geo, at_m: analysis.chromatic_focus_shift_mm(geo, [0.48, 0.65], at_m=at_m),
        lambda geo, at_m: analysis.trace_field(geo, 0.1, pupil_grid(6), at_m=at_m).path_mm,
    ],
)
def test_figures_of_several_distances_are_those_of_each(figure):
    geo = lens.load("double-gauss")
    each = torch.stack([figure(geo, d) for d in DISTANCES])
    torch.testing.assert_close(figure(geo, DISTANCES), each, rtol=1e-10, atol=1e-13)


@torch.no_grad()
def test_limits_and_tolerances_see_the_distance(triplet):
    geo = lens.load("double-gauss")
    each = torch.stack([traced_semi_aperture_mm(geo, FIELDS, at_m=d) for d in DISTANCES])
    widest = traced_semi_aperture_mm(geo, FIELDS, at_m=DISTANCES)
    torch.testing.assert_close(widest, each.amax(0), rtol=1e-12, atol=0)
    sizes = lens.rms_spot_mm(geo, FIELDS, grid=12, at_m=(0.4, 3.0)).square().reshape(-1)
    found = squared_spots(spot_errors(FIELDS, at_m=(0.4, 3.0))(geo), 4)
    torch.testing.assert_close(found, sizes, rtol=1e-10, atol=0)
    near, far = (
        evaluate(triplet, Limits(incidence_deg=40.0, fields_rad=FIELDS, at_m=d))[0] for d in (0.2, math.inf)
    )
    assert near.name == "incidence on surface 1"
    assert float(near.value) != pytest.approx(float(far.value), rel=1e-3)
    focused = triplet.focus_at(0.5)
    # the mean point of a spot lies near the chief ray, whose distortion this is
    found = 100 * linear_figures(0.15, at_m=0.5)(focused)[2].item()
    assert found == pytest.approx(analysis.distortion_percent(focused, [0.15], at_m=0.5).item(), abs=0.15)


@pytest.mark.parametrize("focus_m", [0.5, 4.0, math.inf])
@torch.no_grad()
def test_depth_of_field_of_a_thin_lens_is_that_of_its_circle_of_confusion(focus_m):
    # no thickness: all at the pupil
    front = lens.Surface(50.0, 0.0, glass(1.5), 10.0, is_stop=True)
    geo = lens.GeoLens([front, lens.Surface(-50.0, 50.0, None, 10.0)], 10.0)
    found = analysis.depth_of_field(geo.focus_at(focus_m), 0.05)
    thin = geo.focus_at(focus_m).thin()
    for limit in filter(math.isfinite, (float(found.near_m), float(found.far_m))):
        # D |s (1 / f - 1 / d) - 1| for pupil D, film distance s and object distance d from the lens
        blur = 10.0 * abs(float(thin.image_distance_mm) * (1 / float(thin.efl_mm) - 1e-3 / limit) - 1)
        assert blur == pytest.approx(0.05, rel=1e-10)
    hyperfocal = float(analysis.hyperfocal_m(geo, 0.05))
    assert hyperfocal == pytest.approx((50.0**2 / (5.0 * 0.05) + 50.0) / 1e3, rel=1e-12)
    wide = analysis.depth_of_field(geo.focus_at(hyperfocal), 0.05 * (1 + 1e-9))
    # from half of it, for a thin lens
    assert (float(wide.near_m), float(wide.far_m)) == (pytest.approx(hyperfocal / 2, rel=1e-6), math.inf)


@torch.no_grad()
def test_traced_depth_of_field_has_the_limit_at_its_ends(triplet):
    geo = triplet.focus_at(0.6, spot_grid=16)
    found = analysis.traced_depth_of_field(geo, 0.06)
    sizes = lens.rms_spot_mm(geo, [0.0], grid=16, at_m=(float(found.near_m), float(found.far_m)))
    assert sizes[:, 0].tolist() == pytest.approx([0.06 / math.sqrt(8)] * 2, rel=1e-5)
    assert found.near_m < 0.6 < found.far_m
    assert float(found.focus_m) == pytest.approx(0.6, rel=2e-3)


@torch.no_grad()
@pytest.mark.parametrize("defocus_rad", [10.0, -80.0])
def test_traced_depth_of_field_is_found_where_a_plate_moves_it(defocus_rad, triplet):
    plate = diffraction.ZernikePlate({4: defocus_rad}, 6.0)
    plated = diffraction.with_plate(triplet.focus_at(2.0), plate, z_mm=1.0)
    found = analysis.traced_depth_of_field(plated, 0.1, grid=8)
    # 1 / m
    at = torch.linspace(1 / 50, 1 / 0.5, 4001, dtype=D)
    sizes = lens.rms_spot_mm(plated, [0.0], grid=8, at_m=1 / at)[:, 0]
    sharp = at[sizes <= 0.1 / math.sqrt(8)]
    truth = [float(v) for v in (sharp[0], sharp[-1], at[sizes.argmin()])]
    inverse = [1 / float(v) for v in (found.far_m, found.near_m, found.focus_m)]
    assert inverse == pytest.approx(truth, abs=float(at[1] - at[0]))
