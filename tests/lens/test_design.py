"""The design variables of a lens: focal length held, steps of equal effect, floors, penalties, detuning."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.design import LensDesign, detune, edge_thickness_mm, make_design
from tests.lens.systems import PLANE, check_gradient, efl, glass

D = torch.float64
CROWN = glass(1.5)
FIELDS = [0.0, math.radians(10.0)]
BICONVEX = [Surface(50.0, 6.0, CROWN, 12.0), Surface(-40.0, 30.0, None, 10.0)]


@pytest.fixture(scope="module")
def design():
    return make_design(lens.load("cooke-triplet"), FIELDS, step_mm=0.01)


def test_zero_variables_are_the_reference(design):
    geo = design.lens(torch.zeros_like(design.basis[0]))
    reference = lens.load("cooke-triplet")
    # thicknesses 33 widths above the floor: exp(-33)
    for name in ("curvature_per_mm", "thickness_mm"):
        torch.testing.assert_close(
            getattr(geo, name), getattr(reference, name).detach(), rtol=1e-13, atol=1e-15
        )


def test_making_a_design_leaves_the_lens_alone():
    geo = lens.load("la1509")
    before = geo.thickness_mm.detach().clone()
    made = make_design(geo, [0.0], 0.01)
    assert all(p.requires_grad for p in geo.parameters())
    with torch.no_grad():
        geo.thickness_mm.mul_(2)
    torch.testing.assert_close(made.reference.thickness_mm, before)


def motion(design, variables):
    """Ray motion about each spot's mean per unit along a direction of the variables, [rays * 2] mm,
    RMS-normalised."""
    ahead, behind = (lens.spots(design.lens(0.01 * s * variables), FIELDS)[0] for s in (1, -1))
    moved = (ahead - behind) / 0.02
    return (moved - moved.mean(1, keepdim=True)).reshape(-1) / (moved.shape[0] * moved.shape[1]) ** 0.5


def test_every_unit_variable_moves_the_rays_by_the_stated_rms_each_in_its_own_way(design):
    jacobian = torch.stack([motion(design, unit) for unit in torch.eye(len(design.basis), dtype=D)], 1)
    curvatures = design.reference.curvature_per_mm.abs().mean().expand(5)
    size = torch.cat([curvatures, design.reference.thickness_mm])
    # a tenth of a curvature or thickness is the limit
    held = (design.basis.abs() / size[:, None]).amax(0) >= 0.1 * (1 - 1e-9)
    gram = jacobian.T @ jacobian / 0.01**2
    free = ~held
    # the strong modes: defocus and its kin
    assert int(free.sum()) >= 3
    # differences over a hundredth of a step and those that made the modes bend by some 1e-5 of their motion
    torch.testing.assert_close(gram[free][:, free], torch.eye(int(free.sum()), dtype=D), rtol=0, atol=1e-3)
    assert bool((gram.diagonal()[held] < 1).all())


def test_gradients_reach_every_variable(design, generator):
    weights = torch.randn(2, 812, 2, dtype=D, generator=generator)
    at = 0.1 * torch.randn(len(design.basis), dtype=D, generator=generator)
    check_gradient(lambda v: (lens.spots(design.lens(v), FIELDS)[0] * weights).sum(), at)


def test_thicknesses_stay_above_their_floors(design):
    crushed = torch.cat([torch.zeros(5, dtype=D), torch.full((6,), -1e4, dtype=D)])
    thickness = design.changed(crushed).thickness_mm
    assert bool((thickness >= design.floor_mm).all())
    torch.testing.assert_close(thickness, design.floor_mm, rtol=1e-6, atol=0)
    published = lens.load("cooke-triplet").thickness_mm.detach()
    torch.testing.assert_close(design.floor_mm, 0.6 * published, rtol=1e-14, atol=0)


def test_a_lens_with_a_zero_gap_makes_a_design_of_finite_steps():
    faces = Surface(50.0, 3.0, CROWN, 5.0), Surface(-50.0, 0.0, Glass.named("F2"), 5.0)
    made = make_design(GeoLens([*faces, Surface(-80.0, 60.0, None, 5.0)], 8.0), [0.0], 0.01)
    assert bool(made.basis.isfinite().all())
    # a change relative to nothing
    assert not made.basis[3].any()
    assert float(made.lens(torch.ones(5)).thickness_mm[1]) <= 2e-5


def sag(radius):
    return radius - math.sqrt(radius * radius - 144)


# at the larger semi-aperture 12: two spheres; a paraboloid r^2 / 2R and an r^4 term
@pytest.mark.parametrize(
    ("surfaces", "edge"),
    [
        (BICONVEX, 6 - sag(50.0) - sag(40.0)),
        (
            [
                Surface(50.0, 6.0, CROWN, 12.0, conic=-1.0),
                Surface(PLANE, 30.0, None, 10.0, asphere=(0.0, 1e-5)),
            ],
            6 - 144 / 100 + 1e-5 * 144**2,
        ),
    ],
)
def test_edge_thickness_by_hand(surfaces, edge):
    assert edge_thickness_mm(GeoLens(surfaces, 8.0)).tolist() == pytest.approx([edge], abs=1e-13)


def test_penalty_by_hand_and_its_slope():
    geo = GeoLens(BICONVEX, 8.0)
    edge = edge_thickness_mm(geo).item()

    def penalty(floor):
        floors = geo.thickness_mm, torch.tensor([floor], dtype=D)
        return LensDesign(geo, 50.0, torch.eye(3, dtype=D), *floors).penalty(geo)

    assert penalty(edge - 0.1).item() == 0
    short = penalty(edge + 0.25)
    # 1 % of 50 mm is 0.5 mm
    assert short.item() == pytest.approx((0.25 / 0.5) ** 2, rel=1e-12)
    (slope,) = torch.autograd.grad(short, geo.thickness_mm)
    assert slope.tolist() == pytest.approx([-2 * 0.25 / 0.5**2, 0.0], rel=1e-12)


@pytest.mark.bits
@pytest.mark.parametrize("seed", [0, 1])
def test_detuning_reaches_its_target_and_keeps_the_other_thicknesses(design, seed):
    geo, again = (detune(design, FIELDS, 0.05, torch.Generator().manual_seed(seed)) for _ in range(2))
    # forty halvings
    assert float(lens.rms_spot_mm(geo, FIELDS).mean()) == pytest.approx(0.05, rel=1e-9)
    assert efl(geo) == pytest.approx(design.efl_mm, rel=1e-12)
    torch.testing.assert_close(geo.thickness_mm[:-1], design.reference.thickness_mm[:-1], rtol=1e-12, atol=0)
    # every curvature took part
    assert bool((geo.curvature_per_mm != design.reference.curvature_per_mm).all())
    assert torch.equal(geo.curvature_per_mm, again.curvature_per_mm)
