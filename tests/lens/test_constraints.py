"""Limits of a lens against geometry worked by hand, a plain ray trace, and differences."""

import dataclasses
import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.analysis import field_rays
from codesign.lens.design import LensDesign, detune, edge_thickness_mm, make_design
from codesign.lens.design.constraints import (
    Constraint,
    Limits,
    active,
    evaluate,
    gap_mm,
    penalty,
    report,
    rows,
)
from codesign.lens.design.hits import (
    paraxial_semi_aperture_mm,
    rim_rays,
    surface_hits,
    traced_semi_aperture_mm,
)
from tests.lens.systems import PLANE, check_gradient, check_lens_gradient, close, efl, glass
from tests.numbers import D, f64, randn64, seeded

CROWN = glass(1.5)


def sag(radius, height):
    """Depth of a sphere, by Pythagoras."""
    return math.copysign(abs(radius) - math.sqrt(radius * radius - height * height), radius)


def lens_of(rows, diameter=8.0):
    """A frozen lens of rows of radius, thickness, medium, semi-aperture; the first is the stop."""
    surfaces = [Surface(*row, is_stop=i == 0) for i, row in enumerate(rows)]
    return GeoLens(surfaces, diameter).freeze()


def doublet():
    """A biconvex lens and a meniscus behind an air gap."""
    return lens_of(
        [
            (40.0, 6.0, CROWN, 12.0),
            (-60.0, 1.0, None, 12.0),
            (-50.0, 3.0, CROWN, 11.0),
            (-90.0, 70.0, None, 11.0),
        ],
        16.0,
    )


def found_in(geo, limits):
    return {c.name: c for c in evaluate(geo, limits)}


ALL = Limits(
    glass_centre_mm=2.0,
    glass_centre_most_mm=8.0,
    glass_edge_mm=1.0,
    air_gap_mm=0.5,
    track_mm=75.0,
    back_focus_mm=72.0,
    steepness=0.25,
)


def test_thicknesses_gaps_and_lengths_by_hand():
    found = found_in(doublet(), ALL)
    truth = {
        "centre of glass between surfaces 1 and 2": 6.0,
        "edge of glass between surfaces 1 and 2": 6 - sag(40, 12) + sag(-60, 12),
        "edge of glass between surfaces 3 and 4": 3 - sag(-50, 11) + sag(-90, 11),
        # surface 3 curves back faster than surface 2: the gap closes towards the edge, the larger
        # of 12 and 11 mm
        "air between surfaces 2 and 3": 1 - sag(-60, 12) + sag(-50, 12),
        "total track": 80.0,
        "back focus": 70.0,
        "steepness of surface 1": 12 / 40,
    }
    assert {name: found[name].value.item() for name in truth} == pytest.approx(truth, abs=1e-13)
    assert {c.name for c in active(found.values())} >= {
        "total track",
        "back focus",
        "steepness of surface 1",
    }
    assert found["total track"].state() == "violated"
    assert found["centre of glass between surfaces 3 and 4"].state() == "free"
    hinges = penalty([found["total track"], found["back focus"]])
    close(hinges, (5 / 0.5) ** 2 + (2 / 0.5) ** 2, 1e-13)
    # residual rows square to the penalty
    total = sum(c.penalty.item() for c in found.values())
    close(rows(found.values()).square().sum(), total, 1e-13)
    assert penalty(evaluate(doublet(), Limits(glass_centre_mm=1.0, track_mm=90.0))).item() == 0.0


def test_the_least_gap_is_found_inside_the_aperture_and_on_the_axis():
    """A plane and r^4 / 1000 - r^2 / 20: the gap 3 - r^2/20 + r^4/1000 is least where r^2 = 25, by
    0.625 below the axis."""
    bowl = Surface(PLANE, 3.0, CROWN, 8.0, asphere=(-0.05, 1e-3))
    flat = Surface(50.0, 3.0, CROWN, 8.0), Surface(PLANE, 3.0, None, 8.0)
    geo = GeoLens([*flat, bowl, Surface(PLANE, 50.0, None, 8.0)], 8.0).freeze()
    found = found_in(geo, Limits(air_gap_mm=0.1))["air between surfaces 2 and 3"].value.item()
    # the nearest of 33 heights, a quarter of a millimetre apart, misses the lowest by at most
    # (1/8)^2 times half the second derivative 0.2
    assert 3 - 0.625 <= found <= 3 - 0.625 + 0.1 / 64
    line = torch.linspace(0, 1, 33, dtype=D)
    truth = [3 - 0.05 * r * r + 1e-3 * r**4 for r in (8 * line).tolist()]
    close(gap_mm(geo, line)[1], truth, atol=1e-13)
    opening = [
        (PLANE, 3.0, CROWN, 8.0),
        (40.0, 0.3, None, 8.0),
        (20.0, 3.0, CROWN, 8.0),
        (PLANE, 50.0, None, 8.0),
    ]
    found = found_in(lens_of(opening), Limits(air_gap_mm=0.1))
    assert found["air between surfaces 2 and 3"].value.item() == 0.3


def test_gradients_of_the_penalty_against_differences():
    limits = dataclasses.replace(ALL, glass_edge_mm=3.0)
    names = "curvature_per_mm thickness_mm"
    check_lens_gradient(
        doublet(), names, lambda geo: penalty(evaluate(geo, limits)), step=1e-5, rel=1e-5
    )


@pytest.mark.parametrize("at_least", [True, False])
def test_the_hinge_is_smooth_where_it_begins_and_zero_where_it_holds(at_least):
    x = torch.tensor([-1e-3, 0.0, 1e-3], dtype=D, requires_grad=True)
    made = [Constraint("x", v, 0.0, at_least, 0.5, "mm") for v in x]
    (slope,) = torch.autograd.grad(penalty(made), x)
    size, rise = torch.zeros(2, 3, dtype=D)
    wrong = 0 if at_least else 2
    size[wrong] = (1e-3 / 0.5) ** 2
    # the slope goes to 0 with the violation
    rise[wrong] = (-1 if at_least else 1) * 2 * 1e-3 / 0.25
    close(torch.stack([c.penalty for c in made]), size, 1e-12)
    close(slope, rise, 1e-12)


def test_the_report_names_what_binds_and_what_is_violated():
    found = evaluate(doublet(), Limits(glass_centre_mm=3.0, track_mm=75.0, back_focus_mm=60.0))
    assert [(c.name, c.state()) for c in active(found)] == [
        ("total track", "violated"),
        ("centre of glass between surfaces 3 and 4", "binds"),
    ]
    lines = report(found).splitlines()
    assert lines[0].split() == ["constraint", "value", "bound", "slack", "unit", "state"]
    assert lines[1].split() == ["total", "track", "80.0000", "≤", "75", "-5.0000", "mm", "violated"]
    assert len(lines) == 1 + len(found)
    assert Constraint("x", torch.tensor(math.nan), 0.0, True, 1.0, "mm").state() == "violated"


def test_the_largest_angle_of_incidence_of_a_rim_ray_is_limited():
    """Angles themselves are those of an independent lens (test_near_objects)."""
    geo = lens.load("cooke-triplet").freeze()
    fields = (0.0, 0.35)
    cosine = surface_hits(geo, *rim_rays(geo, fields)).cosine.amin(1)
    found = found_in(geo, Limits(incidence_deg=40.0, fields_rad=fields))
    values = torch.stack([found[f"incidence on surface {i + 1}"].value for i in range(6)])
    close(values, torch.rad2deg(cosine.acos()), atol=1e-9)
    assert [c.name for c in active(found.values())] == ["incidence on surface 3"]


def test_a_face_between_equal_glasses_is_met_at_its_own_angle():
    """As one between glasses that hardly differ."""

    def buried(step):
        faces = (
            (40.0, 3.0, glass(1.5 + step), 6.0),
            (-12.0, 3.0, CROWN, 6.0),
            (-60.0, 60.0, None, 6.0),
        )
        return lens_of(faces)

    def incidence(geo):
        return found_in(geo, Limits(incidence_deg=30.0, fields_rad=(0.0, 0.2)))[
            "incidence on surface 2"
        ].value

    close(incidence(buried(0.0)), incidence(buried(1e-9)), atol=1e-6)
    check_lens_gradient(buried(0.0), "curvature_per_mm", incidence, step=1e-5, rel=1e-5)


def test_mirrors_reflect_at_the_angle_of_incidence():
    mirror = GeoLens([Surface(-100.0, 50.0, None, 10.0, mirror=True)], 10.0).freeze()
    pupil = f64([[0.0, 0.0], [0.0, 1.0]])
    hits = surface_hits(mirror, *field_rays(mirror, 0.1, pupil))
    # through the vertex the field angle; the normal leans by asin(y / R) the same way as the ray
    truth = [0.1, 0.1 - math.asin(hits.height_mm[0, 1].item() / 100)]
    close(torch.acos(hits.cosine[0]), truth, atol=1e-7)


def test_traced_and_paraxial_apertures():
    # a thin plate at the stop needs the pupil; 30 mm of air before a second one adds the slope of
    # the field
    plates = [
        (PLANE, 1e-9, CROWN, 5.0),
        (PLANE, 30.0, None, 5.0),
        (PLANE, 1e-9, CROWN, 20.0),
        (1e9, 30.0, None, 20.0),
    ]
    geo = lens_of(plates)
    for margin in (0, 0.1):
        expected = [(1 + margin) * v for v in [4.0] * 2 + [4 + 30 * math.tan(0.3)] * 2]
        for found in (
            traced_semi_aperture_mm(geo, (0.3,), margin),
            paraxial_semi_aperture_mm(geo, 0.3, margin),
        ):
            close(found, expected, atol=1e-6)


def test_rays_that_fail_push_back_until_they_pass():
    """A steep first surface loses the rim rays of a wide pupil; following the penalty alone brings
    them back."""
    geo = lens_of([(9.9, 3.0, CROWN, 9.0), (-30.0, 15.0, None, 9.5)], 19.0)
    limits = Limits(rays=True, fields_rad=(0.0, 0.2))
    assert evaluate(geo, limits)[0].state() == "violated"
    c = geo.curvature_per_mm.clone()
    for _ in range(400):
        c.requires_grad_()
        cost = penalty(evaluate(geo.replace(curvature_per_mm=c), limits))
        if float(cost.detach()) == 0:
            break
        (slope,) = torch.autograd.grad(cost, c)
        c = (c - 1e-3 * slope / slope.norm()).detach()
    final = geo.replace(curvature_per_mm=c.detach())
    assert not final.trace(*rim_rays(final, (0.0, 0.2))).status.any()
    # no failed ray is the best there is: it holds, it does not bind
    assert evaluate(final, limits)[0].state() == "free"


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
        close(getattr(geo, name), getattr(reference, name), 1e-13, atol=1e-15)


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
    return (moved - moved.mean(1, keepdim=True)).reshape(-1) / (
        moved.shape[0] * moved.shape[1]
    ) ** 0.5


def test_every_unit_variable_moves_the_rays_by_the_stated_rms_each_in_its_own_way(design):
    jacobian = torch.stack(
        [motion(design, unit) for unit in torch.eye(len(design.basis), dtype=D)], 1
    )
    curvatures = design.reference.curvature_per_mm.abs().mean().expand(5)
    size = torch.cat([curvatures, design.reference.thickness_mm])
    # a tenth of a curvature or thickness is the limit
    held = (design.basis.abs() / size[:, None]).amax(0) >= 0.1 * (1 - 1e-9)
    gram = jacobian.T @ jacobian / 0.01**2
    free = ~held
    # the strong modes: defocus and its kin
    assert free.sum() >= 3
    # differences over a hundredth of a step and those that made the modes bend by some 1e-5 of
    # their motion
    close(gram[free][:, free], torch.eye(int(free.sum()), dtype=D), atol=1e-3)
    assert (gram.diagonal()[held] < 1).all()


def test_gradients_reach_every_variable(design, generator):
    weights = randn64(generator, 2, 812, 2)
    at = 0.1 * randn64(generator, len(design.basis))
    check_gradient(lambda v: (lens.spots(design.lens(v), FIELDS)[0] * weights).sum(), at)


def test_thicknesses_stay_above_their_floors(design):
    crushed = torch.cat([torch.zeros(5, dtype=D), torch.full((6,), -1e4, dtype=D)])
    thickness = design.changed(crushed).thickness_mm
    assert (thickness >= design.floor_mm).all()
    close(thickness, design.floor_mm, 1e-6)
    published = lens.load("cooke-triplet").thickness_mm.detach()
    close(design.floor_mm, 0.6 * published, 1e-14)


def test_a_lens_with_a_zero_gap_makes_a_design_of_finite_steps():
    faces = Surface(50.0, 3.0, CROWN, 5.0), Surface(-50.0, 0.0, Glass.named("F2"), 5.0)
    made = make_design(GeoLens([*faces, Surface(-80.0, 60.0, None, 5.0)], 8.0), [0.0], 0.01)
    # one mode is nothing; three end at a tenth of the mean curvature or of a thickness (which of
    # those that move no ray comes first is for rounding to say), the last where it moves the rays
    # by the stated step
    size = f64([0.0175, 0.0175, 3.0, 60.0])[:, None]
    share = (made.basis[[0, 1, 2, 4]].abs() / size).amax(0)
    close(share[:4].sort().values, [0.0, 0.1, 0.1, 0.1], atol=1e-12)
    last = torch.eye(5, dtype=D)[4]
    ahead, behind = (lens.spots(made.lens(step * last), [0.0])[0] for step in (0.01, -0.01))
    close(((ahead - behind) / 0.02).square().sum(-1).mean().sqrt(), 0.01, 1e-3)
    # a change relative to nothing
    assert not made.basis[3].any()
    assert made.lens(torch.ones(5)).thickness_mm[1] <= 2e-5


# one piece of glass, passed on the way to its mirrored back and on the way from it
MANGIN = [
    Surface(-80.0, 4.0, CROWN, 10.0, is_stop=True),
    Surface(-120.0, 4.0, CROWN, 10.0, mirror=True),
    Surface(80.0, 60.0, None, 10.0),
]


# at the larger semi-aperture 12: two spheres; a paraboloid r^2 / 2R and an r^4 term
@pytest.mark.parametrize(
    ("surfaces", "edge"),
    [
        (BICONVEX, 6 - sag(50.0, 12.0) - sag(40.0, 12.0)),
        (
            [
                Surface(50.0, 6.0, CROWN, 12.0, conic=-1.0),
                Surface(PLANE, 30.0, None, 10.0, asphere=(0.0, 1e-5)),
            ],
            6 - 144 / 100 + 1e-5 * 144**2,
        ),
        (MANGIN, 4 - sag(-80.0, 10.0) + sag(-120.0, 10.0)),
    ],
)
def test_edge_thickness_by_hand(surfaces, edge):
    found = edge_thickness_mm(GeoLens(surfaces, 8.0))
    close(found, [edge] * len(found), atol=1e-13)


def test_penalty_by_hand_and_its_slope():
    geo = GeoLens(BICONVEX, 8.0)
    edge = edge_thickness_mm(geo).item()

    def penalty(floor):
        floors = geo.thickness_mm, f64([floor])
        return LensDesign(geo, 50.0, torch.eye(3, dtype=D), *floors).penalty(geo)

    assert penalty(edge - 0.1).item() == 0
    short = penalty(edge + 0.25)
    # 1 % of 50 mm is 0.5 mm
    close(short, (0.25 / 0.5) ** 2, 1e-12)
    (slope,) = torch.autograd.grad(short, geo.thickness_mm)
    close(slope, [-2 * 0.25 / 0.5**2, 0.0], 1e-12)


@pytest.mark.bits
@pytest.mark.parametrize("seed", [0, 1])
def test_detuning_reaches_its_target_and_keeps_the_other_thicknesses(design, seed):
    geo, again = (detune(design, FIELDS, 0.05, seeded(seed)) for _ in range(2))
    # forty halvings
    close(lens.rms_spot_mm(geo, FIELDS).mean(), 0.05, 1e-9)
    close(efl(geo), design.efl_mm, 1e-12)
    close(geo.thickness_mm[:-1], design.reference.thickness_mm[:-1], 1e-12)
    # every curvature took part
    assert (geo.curvature_per_mm != design.reference.curvature_per_mm).all()
    assert torch.equal(geo.curvature_per_mm, again.curvature_per_mm)
