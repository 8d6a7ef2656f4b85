"""Solves: focal lengths held by a curvature, focus at a distance, semi-apertures that follow the
rays; against first-order optics worked by hand, brute force and differences."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Pinhole, Surface, ThinLens, analysis
from codesign.lens.design import fit_apertures
from codesign.lens.solves import focus_paraxial, hold_efl, holding_surface
from tests.lens.systems import PLANE, close, efl, glass
from tests.numbers import f64

CROWN = glass(1.5)


def covered(stop_behind=False):
    """A biconvex lens, then a plane-parallel cover glass, then maybe a stop in air."""
    rows = [
        Surface(40.0, 4.0, CROWN, 6.0),
        Surface(-60.0, 30.0, None, 6.0),
        Surface(PLANE, 2.0, glass(1.6), 8.0),
        Surface(PLANE, 5.0, None, 8.0),
    ]
    return GeoLens(rows + [Surface(PLANE, 3.0, None, 8.0, is_stop=True)] * stop_behind, 8.0)


@pytest.mark.parametrize(
    ("geo", "expected"),
    [
        (covered(), 1),
        (covered(stop_behind=True), 1),
        (lens.load("cooke-triplet"), 5),
        # the plane side of a plano-convex lens is a shape of its own
        (lens.load("la1509"), 1),
        # all plane: the start of a design
        (GeoLens([Surface(PLANE, 3.0, CROWN, 5.0), Surface(PLANE, 50.0, None, 5.0)], 4.0), 1),
        (GeoLens([Surface(-100.0, 40.0, None, 10.0, mirror=True)], 10.0), 0),
    ],
)
def test_the_last_surface_with_a_shape_holds_the_focal_length(geo, expected):
    assert holding_surface(geo) == expected


@pytest.mark.parametrize("stop_behind", [False, True])
@pytest.mark.parametrize("target_mm", [35.0, -120.0])
def test_the_focal_length_is_held_in_front_of_a_cover_glass(stop_behind, target_mm):
    geo = covered(stop_behind)
    held = hold_efl(geo, target_mm)
    # rounding of a five-surface y-u trace
    close(efl(held), target_mm, 1e-13)
    # the lens maker's equation for the thick lens in air; a plane-parallel plate has no power
    n, t, c1 = 1.5, 4.0, 1 / 40
    c2 = (1 / (target_mm * (n - 1)) - c1) / (t * (n - 1) / n * c1 - 1)
    truth = geo.curvature_per_mm.tolist()
    truth[1] = pytest.approx(c2, rel=1e-12)
    assert held.curvature_per_mm.tolist() == truth


SOLID = [Surface(30.0, 4.0, CROWN, 5.0)]


@pytest.mark.parametrize(
    ("geo", "surface"),
    [
        *((lens.load("cooke-triplet"), i) for i in range(6)),
        (lens.load("double-gauss"), 10),
        # the image inside the glass; inside the second glass; the last surface has an r^2 term
        (GeoLens([Surface(20.0, 40.0, CROWN, 5.0)], 4.0), 0),
        (GeoLens([*SOLID, Surface(-80.0, 40.0, Glass.named("F2"), 5.0)], 4.0), 1),
        (GeoLens([*SOLID, Surface(-80.0, 40.0, None, 5.0, asphere=(-1e-3, 1e-6))], 4.0), 1),
    ],
)
@pytest.mark.parametrize("target_mm", [55.0, 210.0])
def test_any_surface_can_hold_it_in_any_medium(geo, surface, target_mm):
    held = hold_efl(geo, target_mm, surface)
    close(efl(held), target_mm, 1e-12)
    assert (held.curvature_per_mm != geo.curvature_per_mm).nonzero().tolist() == [[surface]]


def test_paraxial_focus_of_a_ball_lens():
    # a ball of index n and radius R focuses n R / (2 (n - 1)) from its centre
    ball = GeoLens([Surface(5.0, 10.0, CROWN, 3.0), Surface(-5.0, 1.0, None, 3.0)], 2.0)
    for defocus in (0.0, 0.3):
        found = focus_paraxial(ball, defocus_mm=defocus).thickness_mm[-1]
        close(found, 1.5 * 5 / (2 * 0.5) - 5 + defocus, 1e-13)


def test_paraxial_focus_inside_glass():
    # one surface of radius R into n focuses parallel light n R / (n - 1) behind it
    found = focus_paraxial(GeoLens([Surface(20.0, 40.0, CROWN, 5.0)], 4.0)).thickness_mm[-1]
    close(found, 1.5 * 20 / 0.5, 1e-13)


@pytest.mark.parametrize("distance_m", [0.06, 1.0, math.inf])
def test_thin_lenses_follow_their_equation(distance_m):
    found = ThinLens(50.0, 10.0, 60.0).focus_at(distance_m).image_distance_mm
    close(found, 1 / (1 / 50 - 1 / (1e3 * distance_m)), 1e-14)
    assert Pinhole(50.0).focus_at(math.inf).image_distance_mm.item() == 50.0


def test_a_lens_with_an_intermediate_image_is_focused():
    """Two thin lenses of 50 and 25 mm, 100 mm apart: the second images the first's focus at 50 mm,
    upside down."""

    def other_side(efl_mm, distance_mm):
        return 1 / (1 / efl_mm - 1 / distance_mm)

    faces = (50.0, 0.0, CROWN), (-50.0, 100.0, None), (25.0, 0.0, CROWN), (-25.0, 50.0, None)
    relay = GeoLens([Surface(*face, 9.0) for face in faces], 10.0)
    close(efl(relay), -50.0, 1e-13)
    image_mm = other_side(25.0, 100 - other_side(50.0, 2e3))
    close(relay.focus_at(2.0).thickness_mm[-1], image_mm, 1e-12)
    # parallel light, 10 mm wide at the second lens too, is blurred to 0.05 mm 0.25 mm further back
    focus_mm = other_side(50.0, 100 - other_side(25.0, 50.25))
    close(1e3 * analysis.hyperfocal_m(relay, 0.05), focus_mm, 1e-11)


def planes(gap_mm=20.0):
    """A stop in air, a plane behind it, and a lens far behind that only makes it a lens."""
    surfaces = [
        Surface(PLANE, gap_mm, None, 50.0, is_stop=True),
        Surface(PLANE, 1.0, None, 50.0),
        Surface(80.0, 1.0, CROWN, 50.0),
        Surface(-80.0, 70.0, None, 50.0),
    ]
    return GeoLens(surfaces, 6.0).freeze()


def test_light_widens_by_its_field_and_its_cone():
    fitted = fit_apertures(planes(), (0.0, 0.3), margin=0.1).semi_aperture_mm[:2]
    close(fitted, [3.0 * 1.1, (3.0 + 20.0 * math.tan(0.3)) * 1.1], 1e-12)
    near = fit_apertures(planes(), (0.0,), at_m=(math.inf, 0.1), margin=0.0).semi_aperture_mm[1]
    close(near, 3.0 * (1 + 20.0 / 100.0), 1e-12)


def test_apertures_of_a_decentred_lens_are_about_its_own_middle():
    """Light of 3 mm on planes whose middles are 0.4 and 1 mm aside reaches as much farther there."""
    aside = planes().replace(decentre_mm=f64([[0.0, 0.4], [1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]))
    fitted = fit_apertures(aside, (0.0,), margin=0.0).semi_aperture_mm[:2]
    close(fitted, [3.4, 4.0], 1e-12)


def test_a_sphere_ends_at_its_radius():
    ball = [Surface(5.0, 10.0, glass(1.2), 4.0, is_stop=True), Surface(-5.0, 5.0, None, 4.0)]
    fitted = fit_apertures(GeoLens(ball, 9.8).freeze(), (0.0,), margin=0.05)
    found = fitted.semi_aperture_mm[0].item()
    close(found, 5.0, 1e-8)
    assert found < 5.0
    assert GeoLens(fitted.to_surfaces(), 9.8).surfaces[0].semi_aperture_mm == found


def test_fitted_apertures_go_into_files_and_scaled_lenses(tmp_path):
    fitted = fit_apertures(lens.load("cooke-triplet").freeze(), (0.0, 0.3))
    lens.save(fitted, tmp_path / "fitted.json")
    assert torch.equal(
        lens.load(tmp_path / "fitted.json").semi_aperture_mm, fitted.semi_aperture_mm
    )
    torch.testing.assert_close(fitted.scaled(2.0).semi_aperture_mm, 2 * fitted.semi_aperture_mm)
