"""The design variables of a lens: focal length held, steps of equal effect, floors, penalties, detuning."""

import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.design import LensDesign, detune, edge_thickness_mm, hold_efl, make_design

D = torch.float64
GLASS = Glass.from_indices(1.5, 1.5, 1.5)
FIELDS = [0.0, math.radians(10.0)]


@pytest.fixture(scope="module")
def design():
    return make_design(lens.load("cooke-triplet"), FIELDS, step_mm=0.01)


def efl(geo):
    return float(geo.first_order().efl_mm.detach())


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
@pytest.mark.parametrize("target_mm", [35.0, 50.0, 210.0])
def test_the_focal_length_is_held_exactly(name, target_mm):
    held = hold_efl(lens.load(name), target_mm)
    assert abs(efl(held) / target_mm - 1) <= 1e-13  # rounding of an eleven-surface y-u trace
    before = lens.load(name).curvature_per_mm
    assert torch.equal(held.curvature_per_mm[:-1], before[:-1])


@pytest.mark.parametrize(
    "surfaces",
    [
        [Surface(20.0, 40.0, GLASS, 5.0)],  # one surface, the image inside the glass
        [
            Surface(30.0, 4.0, GLASS, 5.0),
            Surface(-80.0, 40.0, Glass.named("F2"), 5.0),
        ],  # the image inside the second glass
        [
            Surface(30.0, 4.0, GLASS, 5.0),
            Surface(-80.0, 40.0, None, 5.0, asphere=(-1e-3, 1e-6)),
        ],  # the last surface has an r^2 term
    ],
)
def test_the_focal_length_is_held_in_any_medium(surfaces):
    assert abs(efl(hold_efl(GeoLens(surfaces, 4.0), 77.0)) / 77.0 - 1) <= 1e-13


def test_holding_is_differentiable_and_leaves_no_freedom():
    geo = lens.load("cooke-triplet")
    held = hold_efl(geo, 50.0)
    tensors = [geo.curvature_per_mm, geo.thickness_mm]
    for grad, value in zip(torch.autograd.grad(held.first_order().efl_mm, tensors), tensors, strict=True):
        # d efl vanishes; its two halves are as large as d efl / d c of the free lens, some 1e3, and cancel to
        # rounding
        assert float((grad * value.detach().abs().mean()).abs().max()) <= 1e-10
    held = hold_efl(geo, 50.0)

    def solved(t):
        return hold_efl(geo.replace(thickness_mm=t), 50.0).curvature_per_mm[-1]

    t = geo.thickness_mm.detach()
    (found,) = torch.autograd.grad(held.curvature_per_mm[-1], geo.thickness_mm)
    for i in range(t.numel()):
        step = 1e-4 * torch.eye(t.numel(), dtype=D)[i]
        truth = float((solved(t + step) - solved(t - step)).detach()) / 2e-4
        assert abs(float(found[i]) - truth) <= 1e-9 + 1e-7 * abs(truth)  # rounding 1e-17 over 1e-4, bend 1e-9


def test_a_surface_without_power_is_refused():
    with pytest.raises(DomainError, match="index step 0"):
        hold_efl(
            GeoLens([Surface(30.0, 4.0, GLASS, 5.0), Surface(-80.0, 40.0, GLASS, 5.0)], 4.0), 50.0, surface=1
        )


def test_zero_variables_are_the_reference(design):
    geo = design.lens(torch.zeros_like(design.basis[0]))
    reference = lens.load("cooke-triplet")
    torch.testing.assert_close(geo.curvature_per_mm, reference.curvature_per_mm, rtol=1e-13, atol=1e-15)
    torch.testing.assert_close(
        geo.thickness_mm, reference.thickness_mm, rtol=1e-13, atol=0
    )  # 33 widths above the floor: exp(-33)


def test_making_a_design_leaves_the_lens_alone():
    geo = lens.load("la1509")
    before = {k: v.clone() for k, v in geo.state_dict().items()}
    made = make_design(geo, [0.0], 0.01)
    assert all(p.requires_grad for p in geo.parameters())
    with torch.no_grad():
        geo.thickness_mm.mul_(2)
    torch.testing.assert_close(made.reference.thickness_mm, before["thickness_mm"])


def motion(design, variables):
    """Ray motion about each spot's mean per unit along a direction of the variables, [rays * 2] mm,
    RMS-normalised."""
    ahead, behind = (lens.spots(design.lens(0.01 * s * variables), FIELDS)[0] for s in (1, -1))
    moved = (ahead - behind) / 0.02
    return (moved - moved.mean(1, keepdim=True)).reshape(-1) / (moved.shape[0] * moved.shape[1]) ** 0.5


def test_every_unit_variable_moves_the_rays_by_the_stated_rms_each_in_its_own_way(design):
    units = torch.eye(design.basis.shape[0], dtype=D)
    jacobian = torch.stack([motion(design, unit) for unit in units], 1)
    size = torch.cat(
        [design.reference.curvature_per_mm.abs().mean().expand(5), design.reference.thickness_mm]
    )
    held = (design.basis.abs() / size[:, None]).amax(0) >= 0.1 * (
        1 - 1e-9
    )  # a tenth of a curvature or thickness is the limit
    gram = jacobian.T @ jacobian / 0.01**2
    free = ~held
    assert int(free.sum()) >= 3  # the strong modes: defocus and its kin
    # differences over a hundredth of a step and those that made the modes bend by some 1e-5 of their motion
    torch.testing.assert_close(gram[free][:, free], torch.eye(int(free.sum()), dtype=D), rtol=0, atol=1e-3)
    assert bool((gram.diagonal()[held] < 1).all())


def test_gradients_reach_every_variable(design, generator):
    at = (0.1 * torch.randn(design.basis.shape[0], dtype=D, generator=generator)).requires_grad_()
    weights = torch.randn(2, 812, 2, dtype=D, generator=generator)

    def loss(v):
        return (lens.spots(design.lens(v), FIELDS)[0] * weights).sum()

    (found,) = torch.autograd.grad(loss(at), at)
    for v in range(at.numel()):
        step = torch.zeros_like(design.basis[0])
        step[v] = 1e-4
        truth = float((loss(at + step) - loss(at - step)).detach()) / 2e-4
        assert abs(float(found[v]) - truth) <= 1e-6 * float(
            found.abs().max()
        )  # steps of 1e-4 units bend by 1e-8 or so


def test_thicknesses_stay_above_their_floors(design):
    count = design.reference.curvature_per_mm.numel()
    crushed = torch.cat([torch.zeros(count - 1, dtype=D), torch.full((count,), -1e4, dtype=D)])
    thickness = design.changed(crushed).thickness_mm
    assert bool((thickness >= design.floor_mm).all())
    torch.testing.assert_close(thickness, design.floor_mm, rtol=1e-6, atol=0)
    torch.testing.assert_close(
        design.floor_mm, 0.6 * lens.load("cooke-triplet").thickness_mm.detach(), rtol=1e-14, atol=0
    )


def test_a_lens_with_a_zero_gap_makes_a_design_of_finite_steps():
    cemented = GeoLens(
        [
            Surface(50.0, 3.0, GLASS, 5.0),
            Surface(-50.0, 0.0, Glass.named("F2"), 5.0),
            Surface(-80.0, 60.0, None, 5.0),
        ],
        8.0,
    )
    made = make_design(cemented, [0.0], 0.01)
    assert bool(made.basis.isfinite().all())
    assert not made.basis[3].any()  # a change relative to nothing
    assert float(made.lens(torch.ones(5)).thickness_mm[1]) <= 2e-5


def test_edge_thickness_by_hand():
    # R = 50 and -40 at the larger semi-aperture 12: sags 50 - sqrt(50^2 - 144) and -(40 - sqrt(40^2 - 144))
    geo = GeoLens([Surface(50.0, 6.0, GLASS, 12.0), Surface(-40.0, 30.0, None, 10.0)], 8.0)

    def sag(R):
        return R - math.sqrt(R * R - 144)

    assert edge_thickness_mm(geo).tolist() == pytest.approx([6 - sag(50.0) - sag(40.0)], abs=1e-13)
    # a paraboloid r^2 / 2R and an r^4 term
    bent = GeoLens(
        [
            Surface(50.0, 6.0, GLASS, 12.0, conic=-1.0),
            Surface(math.inf, 30.0, None, 10.0, asphere=(0.0, 1e-5)),
        ],
        8.0,
    )
    assert edge_thickness_mm(bent).tolist() == pytest.approx([6 - 144 / 100 + 1e-5 * 144**2], abs=1e-13)


def test_penalty_by_hand_and_its_slope():
    geo = GeoLens([Surface(50.0, 6.0, GLASS, 12.0), Surface(-40.0, 30.0, None, 10.0)], 8.0)
    edge = float(edge_thickness_mm(geo).detach())

    def wants(floor):
        return LensDesign(geo, 50.0, torch.eye(3, dtype=D), geo.thickness_mm, torch.tensor([floor], dtype=D))

    assert wants(edge - 0.1).penalty(geo).item() == 0
    lacking = wants(edge + 0.25)
    assert lacking.penalty(geo).item() == pytest.approx(
        (0.25 / 0.5) ** 2, rel=1e-12
    )  # 1 % of 50 mm is 0.5 mm
    (slope,) = torch.autograd.grad(lacking.penalty(geo), geo.thickness_mm)
    assert slope.tolist() == pytest.approx([-2 * 0.25 / 0.5**2, 0.0], rel=1e-12)


@pytest.mark.bits
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_detuning_reaches_its_target_and_keeps_the_other_thicknesses(design, seed):
    geo = detune(design, FIELDS, 0.05, torch.Generator().manual_seed(seed))
    assert abs(float(lens.rms_spot_mm(geo, FIELDS).mean()) / 0.05 - 1) <= 1e-9  # forty halvings
    assert abs(efl(geo) / design.efl_mm - 1) <= 1e-12
    torch.testing.assert_close(geo.thickness_mm[:-1], design.reference.thickness_mm[:-1], rtol=1e-12, atol=0)
    assert (
        float((geo.curvature_per_mm / design.reference.curvature_per_mm - 1).abs().min()) > 0
    )  # every curvature took part
    again = detune(design, FIELDS, 0.05, torch.Generator().manual_seed(seed))
    assert torch.equal(geo.curvature_per_mm, again.curvature_per_mm)


def test_a_target_that_is_never_reached_is_refused():
    with pytest.raises(DomainError, match="never reaches an RMS spot of 500"):
        detune(make_design(lens.load("la1509"), [0.0], 0.01), [0.0], 500.0, torch.Generator().manual_seed(0))
