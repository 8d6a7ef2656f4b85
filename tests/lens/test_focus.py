"""Solves: focal lengths held by a curvature, focus at a distance, semi-apertures that follow the rays;
against first-order optics worked by hand, brute force and differences."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Pinhole, Surface, ThinLens
from codesign.lens.analysis import pupil_grid
from codesign.lens.design import fit_apertures
from codesign.lens.design.hits import rim_rays
from codesign.lens.solves import focus_paraxial, focus_rays, hold_efl, holding_surface
from tests.lens.systems import NAMES, PLANE, check_gradient, efl, glass

D = torch.float64
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
    assert efl(held) == pytest.approx(target_mm, rel=1e-13)
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
    assert efl(held) == pytest.approx(target_mm, rel=1e-12)
    assert (held.curvature_per_mm != geo.curvature_per_mm).nonzero().tolist() == [[surface]]


def test_holding_is_differentiable_and_leaves_no_freedom():
    geo = lens.load("cooke-triplet")
    tensors = [geo.curvature_per_mm, geo.thickness_mm]
    slopes = torch.autograd.grad(hold_efl(geo, 50.0).first_order().efl_mm, tensors)
    for slope, value in zip(slopes, tensors, strict=True):
        # d efl vanishes; its two halves are as large as d efl / d c of the free lens, some 1e3, and cancel to
        # rounding
        assert float((slope * value.detach().abs().mean()).abs().max()) <= 1e-10
    inner = covered()
    for made, at in ((geo, 5), (inner, 1)):
        check_gradient(
            lambda c, t, made=made, at=at: hold_efl(
                made.replace(curvature_per_mm=c, thickness_mm=t), 50.0, at
            ).curvature_per_mm[at],
            made.curvature_per_mm,
            made.thickness_mm,
        )


def test_paraxial_focus_of_a_ball_lens():
    # a ball of index n and radius R focuses n R / (2 (n - 1)) from its centre
    ball = GeoLens([Surface(5.0, 10.0, CROWN, 3.0), Surface(-5.0, 1.0, None, 3.0)], 2.0)
    for defocus in (0.0, 0.3):
        found = focus_paraxial(ball, defocus_mm=defocus).thickness_mm[-1].item()
        assert found == pytest.approx(1.5 * 5 / (2 * 0.5) - 5 + defocus, rel=1e-13)


def mean_square(geo, fields, wavelengths, back_mm):
    """Mean square spot over fields, computed directly from traced rays."""
    moved = geo.replace(thickness_mm=torch.cat([geo.thickness_mm[:-1], torch.tensor([back_mm], dtype=D)]))
    total = 0.0
    for field in fields:
        points = torch.cat([lens.spots(moved, [field], w, grid=16)[0][0] for w in wavelengths])
        total += float((points - points.mean(0)).square().sum(1).mean())
    return total


@pytest.mark.parametrize(
    "wavelengths", [(lens.WAVELENGTH_UM["d"],), (lens.WAVELENGTH_UM["F"], lens.WAVELENGTH_UM["C"])]
)
def test_best_focus_is_the_bottom_of_the_traced_parabola(wavelengths):
    geo = lens.load("cooke-triplet").freeze()
    fields = [0.0, 0.2, 0.35]
    best = focus_rays(geo, fields, wavelengths).thickness_mm[-1].item()
    # three traced points give the parabola exactly, since rays are straight: its bottom by Lagrange
    a, b, c = (mean_square(geo, fields, wavelengths, 42.0 + k) for k in (0.0, 0.1, 0.2))
    # squares of 1e-4 mm^2 known to 1e-17, curvature 0.02: 1e-12 over 0.1 and two differences
    assert best == pytest.approx(42.0 + 0.1 * (0.5 + (a - b) / (a - 2 * b + c)), abs=1e-9)


def test_best_focus_forgets_where_the_image_plane_was_and_is_differentiable():
    geo = lens.load("cooke-triplet").freeze()

    def solved(t):
        return focus_rays(geo.replace(thickness_mm=t), [0.0, 0.35]).thickness_mm[-1]

    t = geo.thickness_mm.clone().requires_grad_()
    # z - z, each 1
    assert abs(float(torch.autograd.grad(solved(t), t)[0][-1])) <= 1e-11
    check_gradient(solved, geo.thickness_mm)


@pytest.mark.parametrize("distance_m", [0.06, 1.0, math.inf])
def test_thin_lenses_follow_their_equation(distance_m):
    found = ThinLens(50.0, 10.0, 60.0).focus_at(distance_m).image_distance_mm.item()
    assert found == pytest.approx(1 / (1 / 50 - 1 / (1e3 * distance_m)), rel=1e-14)
    assert Pinhole(50.0).focus_at(math.inf).image_distance_mm.item() == 50.0


def fan(geo, distance_m, heights, wavelength_um=0.5875618):
    """Rays from the axial point to heights [N] mm of the entrance pupil, and where they cross the axis
    behind the film, [N] mm."""
    z = float(geo.first_order().entrance_pupil_z_mm)
    toward = torch.tensor([[0.0, h, z] for h in heights], dtype=D)
    start = torch.tensor([[0.0, 0.0, z - 1e3 * distance_m]], dtype=D).expand_as(toward)
    if math.isinf(distance_m):
        start = toward - torch.tensor([0.0, 0.0, z + 5.0], dtype=D)
    direction = torch.nn.functional.normalize(toward - start, dim=1)
    out = geo.trace(start.contiguous(), direction, wavelength_um)
    return out, -out.position_mm[:, 1] * out.direction[:, 2] / out.direction[:, 1]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("wavelength_um", [0.4861327, 0.5875618])
@pytest.mark.parametrize("distance_m", [0.3, 2.0, math.inf])
@torch.no_grad()
def test_paraxial_rays_of_the_point_meet_on_the_film(name, distance_m, wavelength_um):
    before = lens.load(name)
    geo = before.focus_at(distance_m, wavelength_um)
    _, crossing = fan(geo, distance_m, [0.02, 0.04], wavelength_um)
    # the crossing goes as h^2, h^4, ...: two heights leave h^4, below 1e-9 mm here
    assert abs(float(4 * crossing[0] - crossing[1]) / 3) <= 1e-9
    if math.isinf(distance_m):
        bfl = before.first_order(wavelength_um).bfl_mm
        torch.testing.assert_close(geo.thickness_mm[-1], bfl, rtol=1e-14, atol=0)


@pytest.mark.parametrize("grid", [None, 8])
def test_gradients_of_the_image_distance_against_differences(grid):
    geo = lens.load("cooke-triplet")

    def image(distance_m, c, t):
        moved = geo.replace(curvature_per_mm=c, thickness_mm=t)
        return moved.focus_at(distance_m, spot_grid=grid).thickness_mm[-1]

    check_gradient(image, torch.tensor(1.2, dtype=D), geo.curvature_per_mm, geo.thickness_mm)


@torch.no_grad()
@pytest.mark.parametrize("distance_m", [0.5, math.inf])
def test_the_least_spot_is_the_least(distance_m):
    geo = lens.load("la1509")
    paraxial = geo.focus_at(distance_m)
    best = geo.focus_at(distance_m, spot_grid=12)
    # of a round lens, from a point of the axis
    heights = (pupil_grid(12).norm(dim=1) * 10.0).tolist()

    def spot(shift):
        placed = best.replace(thickness_mm=best.thickness_mm + torch.tensor([0.0, shift], dtype=D))
        return float(fan(placed, distance_m, heights)[0].position_mm[:, 1].square().mean().sqrt())

    assert spot(0.0) < min(spot(-0.01), spot(0.01))
    behind = float(paraxial.thickness_mm[-1] - best.thickness_mm[-1])
    assert spot(0.0) < 0.6 * spot(behind)
    # undercorrected: the rim focuses short
    assert behind > 0


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
    fitted = fit_apertures(planes(), (0.0, 0.3), margin=0.1).semi_aperture_mm[:2].tolist()
    assert fitted == pytest.approx([3.0 * 1.1, (3.0 + 20.0 * math.tan(0.3)) * 1.1], rel=1e-12)
    near = fit_apertures(planes(), (0.0,), at_m=(math.inf, 0.1), margin=0.0).semi_aperture_mm[1].item()
    assert near == pytest.approx(3.0 * (1 + 20.0 / 100.0), rel=1e-12)


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
def test_the_full_pupil_passes_and_nothing_more(name):
    geo = lens.load(name).freeze()
    rays = rim_rays(geo, (0.0, 0.1, 0.2))
    fitted = fit_apertures(geo, (0.0, 0.1, 0.2), margin=1e-6)
    assert bool(fitted.trace(*rays).inside.all())
    for surface in range(len(geo.surfaces)):
        less = fitted.semi_aperture_mm.clone()
        less[surface] *= 1 - 1e-5
        assert not bool(geo.replace(semi_aperture_mm=less).trace(*rays).inside.all())


def test_semi_apertures_are_differentiable(generator):
    geo = lens.load("cooke-triplet").freeze()
    weights = torch.randn(6, dtype=D, generator=generator)

    def total(c, t):
        fitted = fit_apertures(geo.replace(curvature_per_mm=c, thickness_mm=t), (0.0, 0.3))
        return (fitted.semi_aperture_mm * weights).sum()

    check_gradient(total, geo.curvature_per_mm, geo.thickness_mm)


def test_a_sphere_ends_at_its_radius():
    ball = [Surface(5.0, 10.0, glass(1.2), 4.0, is_stop=True), Surface(-5.0, 5.0, None, 4.0)]
    fitted = fit_apertures(GeoLens(ball, 9.8).freeze(), (0.0,), margin=0.05)
    found = fitted.semi_aperture_mm[0].item()
    assert found == pytest.approx(5.0, rel=1e-8)
    assert found < 5.0
    assert GeoLens(fitted.to_surfaces(), 9.8).surfaces[0].semi_aperture_mm == found


def test_fitted_apertures_go_into_files_and_scaled_lenses(tmp_path):
    fitted = fit_apertures(lens.load("cooke-triplet").freeze(), (0.0, 0.3))
    lens.save(fitted, tmp_path / "fitted.json")
    assert torch.equal(lens.load(tmp_path / "fitted.json").semi_aperture_mm, fitted.semi_aperture_mm)
    torch.testing.assert_close(fitted.scaled(2.0).semi_aperture_mm, 2 * fitted.semi_aperture_mm)
