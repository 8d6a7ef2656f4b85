"""Solves against first-order optics worked by hand, brute force and differences."""

import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.design.solves import focus_paraxial, focus_rays, hold_efl, holding_surface

D = torch.float64
CROWN = Glass.from_indices(1.5, 1.5, 1.5)
PLATE = Glass.from_indices(1.6, 1.6, 1.6)
INF = math.inf


def efl(geo):
    return float(geo.first_order().efl_mm.detach())


def covered(stop_behind=False):
    """A biconvex lens, then a plane-parallel cover glass, then maybe a stop in air."""
    rows = [
        Surface(40.0, 4.0, CROWN, 6.0),
        Surface(-60.0, 30.0, None, 6.0),
        Surface(INF, 2.0, PLATE, 8.0),
        Surface(INF, 5.0, None, 8.0),
    ]
    return GeoLens(rows + ([Surface(INF, 3.0, None, 8.0, is_stop=True)] if stop_behind else []), 8.0)


@pytest.mark.parametrize(
    ("geo", "expected"),
    [
        (covered(), 1),
        (covered(stop_behind=True), 1),
        (lens.load("cooke-triplet"), 5),
        (lens.load("la1509"), 1),  # the plane side of a plano-convex lens is a shape of its own
        (
            GeoLens([Surface(INF, 3.0, CROWN, 5.0), Surface(INF, 50.0, None, 5.0)], 4.0),
            1,
        ),  # all plane: the start of a design
        (GeoLens([Surface(-100.0, 40.0, None, 10.0, mirror=True)], 10.0), 0),
    ],
)
def test_the_last_surface_with_a_shape_holds_the_focal_length(geo, expected):
    assert holding_surface(geo) == expected


@pytest.mark.parametrize("stop_behind", [False, True])
@pytest.mark.parametrize("target_mm", [35.0, 80.0, -120.0])
def test_the_focal_length_is_held_in_front_of_a_cover_glass(stop_behind, target_mm):
    geo = covered(stop_behind)
    held = hold_efl(geo, target_mm)
    assert abs(efl(held) / target_mm - 1) <= 1e-13  # rounding of a five-surface y-u trace
    # the lens maker's equation for the thick lens in air; a plane-parallel plate has no power
    n = 1.5
    t = 4.0
    c1 = 1 / 40
    c2 = (1 / (target_mm * (n - 1)) - c1) / (t * (n - 1) / n * c1 - 1)
    assert held.curvature_per_mm[1].item() == pytest.approx(c2, rel=1e-12)
    assert torch.equal(
        held.curvature_per_mm[[0, *range(2, held.curvature_per_mm.numel())]],
        geo.curvature_per_mm[[0, *range(2, held.curvature_per_mm.numel())]],
    )


@pytest.mark.parametrize("surface", range(6))
def test_any_surface_of_a_triplet_can_hold_it(surface):
    geo = lens.load("cooke-triplet")
    held = hold_efl(geo, 55.0, surface)
    assert abs(efl(held) / 55 - 1) <= 1e-12
    assert [
        i
        for i, (a, b) in enumerate(
            zip(held.curvature_per_mm.tolist(), geo.curvature_per_mm.tolist(), strict=True)
        )
        if a != b
    ] == [surface]


def test_holding_inside_the_lens_is_differentiable():
    geo = covered()
    held = hold_efl(geo, 50.0, 1)
    found = torch.autograd.grad(held.curvature_per_mm[1], [geo.curvature_per_mm, geo.thickness_mm])
    for name, slope in zip(("curvature_per_mm", "thickness_mm"), found, strict=True):
        base = getattr(geo, name).detach()
        for i in range(base.numel()):
            step = 1e-4 * (0.01 if name == "curvature_per_mm" else 1) * torch.eye(base.numel(), dtype=D)[i]
            ahead, behind = (
                hold_efl(geo.replace(**{name: base + s * step}), 50.0, 1).curvature_per_mm[1].item()
                for s in (1, -1)
            )
            truth = (ahead - behind) / (2 * float(step.sum()))
            assert abs(float(slope[i]) - truth) <= 1e-9 + 1e-6 * abs(
                truth
            )  # rounding 1e-17 over 1e-6 at worst, and bend


def test_a_lens_that_bends_nothing_or_a_surface_in_an_image_is_refused():
    with pytest.raises(DomainError, match="no surface changes the index"):
        holding_surface(GeoLens([Surface(INF, 3.0, None, 5.0, is_stop=True)], 4.0))
    # one surface focuses at n R / (n - 1) = 90 mm inside the glass: a surface there meets the axial ray at
    # height 0
    at_image = GeoLens([Surface(30.0, 90.0, CROWN, 5.0), Surface(-40.0, 10.0, None, 5.0)], 4.0)
    with pytest.raises(DomainError, match="surface 2 cannot hold"):
        hold_efl(at_image, 50.0)


def test_paraxial_focus_of_a_ball_lens():
    # a ball of index n and radius R focuses n R / (2 (n - 1)) from its centre
    ball = GeoLens([Surface(5.0, 10.0, CROWN, 3.0), Surface(-5.0, 1.0, None, 3.0)], 2.0)
    assert focus_paraxial(ball).thickness_mm[-1].item() == pytest.approx(1.5 * 5 / (2 * 0.5) - 5, rel=1e-13)
    assert focus_paraxial(ball, defocus_mm=0.3).thickness_mm[-1].item() == pytest.approx(2.8, rel=1e-13)


def mean_square(geo, fields, wavelengths, back_mm):
    """Mean square spot over fields, computed directly from traced rays."""
    moved = geo.replace(
        thickness_mm=torch.cat([geo.thickness_mm.detach()[:-1], torch.tensor([back_mm], dtype=D)])
    )
    total = 0.0
    for field in fields:
        points = torch.cat([lens.spots(moved, [field], w, grid=16)[0][0] for w in wavelengths]).detach()
        total += float((points - points.mean(0)).square().sum(1).mean())
    return total


@pytest.mark.parametrize(
    "wavelengths", [(lens.WAVELENGTH_UM["d"],), (lens.WAVELENGTH_UM["F"], lens.WAVELENGTH_UM["C"])]
)
def test_best_focus_is_the_bottom_of_the_traced_parabola(wavelengths):
    geo = lens.load("cooke-triplet")
    fields = [0.0, 0.2, 0.35]
    best = float(focus_rays(geo, fields, wavelengths).thickness_mm.detach()[-1])
    # three traced points give the parabola exactly, since rays are straight: its bottom by Lagrange
    a, b, c = (mean_square(geo, fields, wavelengths, 42.0 + k) for k in (0.0, 0.1, 0.2))
    bottom = 42.0 + 0.1 * (0.5 + (a - b) / (a - 2 * b + c))
    assert best == pytest.approx(
        bottom, abs=1e-9
    )  # squares of 1e-4 mm^2 known to 1e-17, curvature 0.02: 1e-12 over 0.1 and two differences


def test_best_focus_forgets_where_the_image_plane_was_and_is_differentiable():
    geo = lens.load("cooke-triplet").freeze()
    fields = [0.0, 0.35]

    def solved(t):
        return focus_rays(geo.replace(thickness_mm=t), fields).thickness_mm[-1]

    t = geo.thickness_mm.clone().requires_grad_()
    (slope,) = torch.autograd.grad(solved(t), t)
    assert abs(float(slope[-1])) <= 1e-11  # z - z, each 1
    for i in range(5):
        step = 1e-4 * torch.eye(6, dtype=D)[i]
        truth = float(solved(geo.thickness_mm + step) - solved(geo.thickness_mm - step)) / 2e-4
        assert abs(float(slope[i]) - truth) <= 1e-7 * max(1.0, abs(truth))


def test_rays_that_leave_parallel_have_no_focus():
    # a plane-parallel plate
    with pytest.raises(DomainError, match="parallel"):
        focus_rays(
            GeoLens(
                [Surface(INF, 3.0, CROWN, 5.0), Surface(INF, 3.0, None, 5.0), Surface(1e9, 1.0, CROWN, 5.0)],
                4.0,
            ),
            [0.0],
        )
