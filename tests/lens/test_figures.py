"""Figures of a lens as a contract: gradients to the lens and to the object distance against
differences, parallel light as the limit, several distances as each alone, single precision; and
depth of field."""

import math
from functools import partial

import pytest
import torch

from codesign import lens
from codesign.lens import (
    aimed_rays,
    analysis,
    diffraction,
    paraxial,
    pupil_grid,
    relative_illumination,
)
from codesign.lens.design import Limits, fit_apertures
from codesign.lens.design.constraints import evaluate, penalty
from codesign.lens.design.hits import paraxial_semi_aperture_mm, traced_semi_aperture_mm
from codesign.lens.design.tolerance import linear_figures, spot_errors, squared_spots
from codesign.lens.seidel import seidel_sums
from codesign.lens.solves import focus_paraxial, focus_rays, hold_efl
from tests.lens.systems import LINES, check_gradient, check_lens_gradient, close, glass
from tests.numbers import f64

FIELDS = (0.0, 0.15)
PICTURE = torch.linspace(1, 2, 64, dtype=torch.float64).reshape(8, 8)


def pictured(spread, grid, geo, at_m):
    return (spread(geo, 0.02, 0.004, 8, LINES, grid=grid, at_m=at_m).energy * PICTURE).sum()


def polychromatic_spot(geo, at_m):
    return analysis.spot_radius_mm(*analysis.polychromatic_spot(geo, 0.35, LINES, 8, at_m=at_m))


# figures that light in focus alone has a use for
FOCUSED = {
    "point spread": partial(pictured, analysis.psf_on_pixels, 128),
    "geometric spread": partial(pictured, analysis.geometric_psf, 32),
    "MTF": lambda geo, at_m: analysis.diffraction_mtf(
        geo, 0.2, [10.0, 40.0], LINES, grid=64, at_m=at_m
    ),
    "depth of field": lambda geo, at_m: analysis.depth_of_field(geo.focus_at(at_m), 0.02).near_m,
}
FIGURES = {
    "spots": lambda geo, at_m: lens.rms_spot_mm(geo, FIELDS, grid=8, at_m=at_m),
    "wavefront": lambda geo, at_m: analysis.rms_waves(
        analysis.wavefront(geo, 0.15, grid=16, at_m=at_m)
    ),
    "fan": lambda geo, at_m: analysis.ray_fan(geo, 0.15, count=7, at_m=at_m).tangential_mm.square(),
    "fan paths": lambda geo, at_m: analysis.ray_fan(
        geo, 0.35, count=5, at_m=at_m
    ).tangential_waves.square(),
    "seidel": lambda geo, at_m: seidel_sums(geo, 0.15, at_m=at_m).per_surface.square(),
    "distortion": lambda geo, at_m: analysis.distortion_percent(geo, [0.15], at_m=at_m),
    "field curvature": lambda geo, at_m: analysis.focus_shift_mm(geo, [0.15], at_m=at_m),
    "axial colour": lambda geo, at_m: analysis.chromatic_focus_shift_mm(geo, [0.48], at_m=at_m),
    "encircled": lambda geo, at_m: analysis.encircled_radius_mm(geo, 0.15, grid=8, at_m=at_m),
    "polychromatic spot": polychromatic_spot,
    "geometric MTF": lambda geo, at_m: analysis.geometric_mtf(geo, 0.15, [5.0], at_m=at_m),
    # an object at 0.9 m asks for 128 cells
    "fine geometric MTF": lambda geo, at_m: analysis.geometric_mtf(geo, 0.15, [15.0], at_m=at_m),
    "through focus": lambda geo, at_m: analysis.through_focus_spot_mm(
        geo, FIELDS, [0.1], grid=8, at_m=at_m
    ),
    "apertures": lambda geo, at_m: paraxial_semi_aperture_mm(geo, 0.15, at_m=at_m),
    "fitted apertures": lambda geo, at_m: (
        fit_apertures(geo, (0.0, 0.3), at_m=at_m).semi_aperture_mm
    ),
    "image": lambda geo, at_m: geo.focus_at(at_m).thickness_mm[-1],
    "least spot": lambda geo, at_m: geo.focus_at(at_m, spot_grid=8).thickness_mm[-1],
    "ray focus": lambda geo, at_m: focus_rays(geo, [0.0, 0.35], at_m=at_m).thickness_mm[-1],
}


def aimed_spot(geo, at_m):
    return geo.trace(*aimed_rays(geo, 0.3, pupil_grid(4))).position_mm[:, 1].square()


def irradiance(geo, at_m):
    film, pupil = f64([[0.0, 5.0]]).expand(12, 2).to(geo.dtype), pupil_grid(4).to(geo.dtype)
    return geo.camera_rays(film, pupil, aim=True).irradiance


def paraxial_figures(geo, at_m):
    rays = paraxial.paraxial_rays(geo, 0.2)
    lengths = paraxial.cardinal_points(geo).front_nodal_z_mm, geo.thin().image_distance_mm
    heights = rays.chief_angle.square().sum() + rays.marginal_height_mm.sum()
    return heights + sum(lengths) + paraxial.system_matrix(geo).square().sum()


# of one distance
STILL = {
    "aimed spot": aimed_spot,
    "irradiance": irradiance,
    "illumination": lambda geo, at_m: relative_illumination(geo, [0.2], grid=8),
    "paraxial": paraxial_figures,
    "held focal length": lambda geo, at_m: hold_efl(geo, 50.0).curvature_per_mm[5],
    "incidence": lambda geo, at_m: penalty(
        evaluate(geo, Limits(incidence_deg=35.0, fields_rad=(0.35,)))
    ),
}
# relative steps, and what differences over them know: light steps from cell to cell, and bilinear
# shares need steps so small that hardly a ray changes its pixel
STEPS = {
    "point spread": (1e-6, 1e-5),
    "geometric spread": (2e-9, 1e-3),
    "MTF": (1e-7, 1e-5),
    "irradiance": (1e-4, 1e-5),
    "illumination": (1e-4, 1e-5),
    "incidence": (1e-5, 1e-5),
}
ALL = FIGURES | FOCUSED | STILL


@pytest.mark.parametrize("name", ALL)
def test_gradients_of_figures_to_the_lens_are_those_of_differences(name, triplet):
    step, rel = STEPS.get(name, (2e-5, 1e-6))
    names = "curvature_per_mm thickness_mm"
    check_lens_gradient(
        triplet, names, lambda geo: ALL[name](geo, math.inf).sum(), step=step, rel=rel
    )


# a chief ray, and its distortion, is the same at every distance
@pytest.mark.parametrize("name", [name for name in ALL if name not in {*STILL, "distortion"}])
def test_gradients_of_figures_to_the_distance_are_those_of_differences(name, triplet):
    geo = triplet.focus_at(1.0) if name in FOCUSED else triplet
    step, rel = (1e-5, 1e-6) if name == "MTF" else STEPS.get(name, (1e-4, 1e-6))
    check_gradient(lambda at_m: ALL[name](geo, at_m).sum(), f64(0.9), step=step, rel=rel)


@torch.no_grad()
@pytest.mark.parametrize("name", FIGURES)
def test_figures_tend_to_those_of_parallel_light(name, triplet):
    parallel, far, farther = (
        float(FIGURES[name](triplet, at_m).sum()) for at_m in (math.inf, 1e5, 1e6)
    )
    close(far, parallel, 1e-2)
    # an error goes as 1 / distance
    assert abs(farther - parallel) <= 0.11 * abs(far - parallel) + 1e-11 * abs(parallel)


# lens numbers are rounded to 6e-8 of themselves: 6e-6 mm of path, 0.01 waves each, mostly alike for
# all rays
@pytest.mark.parametrize(
    ("figure", "atol"),
    [
        (lambda geo: analysis.diffraction_mtf(geo, 0.1, [10.0, 40.0]), 1e-4),
        (lambda geo: analysis.wavefront(geo, 0.0, grid=8).waves, 0.1),
        (lambda geo: relative_illumination(geo, [0.1, 0.2], grid=8), 2e-5),
        (lambda geo: irradiance(geo, math.inf), 2e-5),
        (lambda geo: torch.cat(aimed_rays(geo, 0.2, pupil_grid(4).to(geo.dtype))), 2e-5),
    ],
)
@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
@torch.no_grad()
def test_figures_in_single_precision(name, figure, atol):
    found, truth = (figure(lens.load(name, dtype)) for dtype in (torch.float32, torch.float64))
    assert found.dtype == torch.float32
    close(found, truth, 1e-5, atol=atol)


DISTANCES = (0.4, 3.0, math.inf)


@torch.no_grad()
@pytest.mark.parametrize(
    "figure",
    [
        *(FIGURES[name] for name in ("spots", "distortion", "field curvature", "axial colour")),
        lambda geo, at_m: analysis.lateral_colour_mm(geo, FIELDS, [0.48, 0.65], at_m=at_m),
        lambda geo, at_m: analysis.trace_field(geo, 0.1, pupil_grid(6), at_m=at_m).path_mm,
    ],
)
def test_figures_of_several_distances_are_those_of_each(figure):
    geo = lens.load("double-gauss")
    each = torch.stack([figure(geo, d) for d in DISTANCES])
    close(figure(geo, DISTANCES), each, 1e-10, atol=1e-13)


@torch.no_grad()
@pytest.mark.parametrize("at_m", [0.5, 3.0, math.inf])
def test_two_ways_to_focus_agree(at_m, triplet):
    close(
        focus_paraxial(triplet, at_m=at_m).thickness_mm, triplet.focus_at(at_m).thickness_mm, 1e-14
    )
    for wavelength_um in (0.4861327, 0.5875618):
        image = triplet.focus_at(math.inf, wavelength_um).thickness_mm[-1]
        close(image, triplet.first_order(wavelength_um).bfl_mm, 1e-14)
    sharp = triplet.focus_at(at_m, spot_grid=16).thickness_mm
    close(focus_rays(triplet, (0.0,), at_m=at_m).thickness_mm, sharp, 1e-12)


@torch.no_grad()
def test_limits_and_tolerances_see_the_distance(triplet):
    geo = lens.load("double-gauss")
    each = torch.stack([traced_semi_aperture_mm(geo, FIELDS, at_m=d) for d in DISTANCES])
    widest = traced_semi_aperture_mm(geo, FIELDS, at_m=DISTANCES)
    close(widest, each.amax(0), 1e-12)
    sizes = lens.rms_spot_mm(geo, FIELDS, grid=12, at_m=(0.4, 3.0)).square().reshape(-1)
    found = squared_spots(spot_errors(FIELDS, at_m=(0.4, 3.0))(geo), 4)
    close(found, sizes, 1e-10)
    near, far = (
        evaluate(triplet, Limits(incidence_deg=40.0, fields_rad=FIELDS, at_m=d))[0]
        for d in (0.2, math.inf)
    )
    assert near.name == "incidence on surface 1"
    assert float(near.value) != pytest.approx(float(far.value), rel=1e-3)
    focused = triplet.focus_at(0.5)
    # the mean point of a spot lies near the chief ray, whose distortion this is
    found = 100 * linear_figures(0.15, at_m=0.5)(focused)[2].item()
    close(found, analysis.distortion_percent(focused, [0.15], at_m=0.5)[0], atol=0.15)


def test_near_the_axis_an_eye_full_of_water_sends_rays_as_its_thin_lens_does():
    cornea = lens.Surface(5.55, 23.0, glass(1.333), 3.0, is_stop=True)
    eye = lens.GeoLens([cornea], 2.0).freeze()
    film_mm, pupil = f64([[1e-3, 0.0], [0.0, 2e-3]]), f64([[2e-3, 0.0], [0.0, 1e-3]])
    traced, thin = (of.camera_rays(film_mm, pupil) for of in (eye, eye.thin()))
    close(traced.direction, thin.direction, atol=1e-9)  # of slopes of 1e-4
    close(traced.origin_m, thin.origin_m, atol=1e-11)


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
        close(
            10.0 * abs(thin.image_distance_mm * (1 / thin.efl_mm - 1e-3 / limit) - 1), 0.05, 1e-10
        )
    hyperfocal = float(analysis.hyperfocal_m(geo, 0.05))
    close(hyperfocal, (50.0**2 / (5.0 * 0.05) + 50.0) / 1e3, 1e-12)
    wide = analysis.depth_of_field(geo.focus_at(hyperfocal), 0.05 * (1 + 1e-9))
    # from half of it, for a thin lens
    assert (float(wide.near_m), float(wide.far_m)) == (
        pytest.approx(hyperfocal / 2, rel=1e-6),
        math.inf,
    )


@torch.no_grad()
def test_traced_depth_of_field_has_the_limit_at_its_ends(triplet):
    geo = triplet.focus_at(0.6, spot_grid=16)
    found = analysis.traced_depth_of_field(geo, 0.06)
    sizes = lens.rms_spot_mm(geo, [0.0], grid=16, at_m=(float(found.near_m), float(found.far_m)))
    close(sizes[:, 0], [0.06 / math.sqrt(8)] * 2, 1e-5)
    assert found.near_m < 0.6 < found.far_m
    close(found.focus_m, 0.6, 2e-3)


@torch.no_grad()
@pytest.mark.parametrize("defocus_rad", [10.0, -80.0])
def test_traced_depth_of_field_is_found_where_a_plate_moves_it(defocus_rad, triplet):
    plate = diffraction.ZernikePlate({4: defocus_rad}, 6.0)
    plated = diffraction.with_plate(triplet.focus_at(2.0), plate, z_mm=1.0)
    found = analysis.traced_depth_of_field(plated, 0.1, grid=8)
    # 1 / m
    at = torch.linspace(1 / 50, 1 / 0.5, 4001, dtype=torch.float64)
    sizes = lens.rms_spot_mm(plated, [0.0], grid=8, at_m=1 / at)[:, 0]
    sharp = at[sizes <= 0.1 / math.sqrt(8)]
    truth = [float(v) for v in (sharp[0], sharp[-1], at[sizes.argmin()])]
    inverse = [1 / float(v) for v in (found.far_m, found.near_m, found.focus_m)]
    close(inverse, truth, atol=float(at[1] - at[0]))
