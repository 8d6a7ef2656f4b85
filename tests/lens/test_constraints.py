"""Limits of a lens against geometry worked by hand, a plain ray trace, and differences."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.analysis import field_rays
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
from tests.lens.systems import PLANE, check_gradient, glass

D = torch.float64
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
        # surface 3 curves back faster than surface 2: the gap closes towards the edge, the larger of 12 and
        # 11 mm
        "air between surfaces 2 and 3": 1 - sag(-60, 12) + sag(-50, 12),
        "total track": 80.0,
        "back focus": 70.0,
        "steepness of surface 1": 12 / 40,
    }
    assert {name: found[name].value.item() for name in truth} == pytest.approx(truth, abs=1e-13)
    assert {c.name for c in active(found.values())} >= {"total track", "back focus", "steepness of surface 1"}
    assert found["total track"].state() == "violated"
    assert found["centre of glass between surfaces 3 and 4"].state() == "free"
    hinges = penalty([found["total track"], found["back focus"]]).item()
    assert hinges == pytest.approx((5 / 0.5) ** 2 + (2 / 0.5) ** 2, rel=1e-13)
    # residual rows square to the penalty
    total = sum(c.penalty.item() for c in found.values())
    assert rows(found.values()).square().sum().item() == pytest.approx(total, rel=1e-13)
    assert penalty(evaluate(doublet(), Limits(glass_centre_mm=1.0, track_mm=90.0))).item() == 0.0


def test_the_least_gap_is_found_inside_the_aperture_and_on_the_axis():
    """A plane and r^4 / 1000 - r^2 / 20: the gap 3 - r^2/20 + r^4/1000 is least where r^2 = 25, by 0.625
    below the axis."""
    bowl = Surface(PLANE, 3.0, CROWN, 8.0, asphere=(-0.05, 1e-3))
    flat = Surface(50.0, 3.0, CROWN, 8.0), Surface(PLANE, 3.0, None, 8.0)
    geo = GeoLens([*flat, bowl, Surface(PLANE, 50.0, None, 8.0)], 8.0).freeze()
    found = found_in(geo, Limits(air_gap_mm=0.1))["air between surfaces 2 and 3"].value.item()
    # the nearest of 33 heights, a quarter of a millimetre apart, misses the lowest by at most (1/8)^2 times
    # half the second derivative 0.2
    assert 3 - 0.625 <= found <= 3 - 0.625 + 0.1 / 64
    line = torch.linspace(0, 1, 33, dtype=D)
    truth = [3 - 0.05 * r * r + 1e-3 * r**4 for r in (8 * line).tolist()]
    assert gap_mm(geo, line)[1].tolist() == pytest.approx(truth, abs=1e-13)
    opening = [
        (PLANE, 3.0, CROWN, 8.0),
        (40.0, 0.3, None, 8.0),
        (20.0, 3.0, CROWN, 8.0),
        (PLANE, 50.0, None, 8.0),
    ]
    found = found_in(lens_of(opening), Limits(air_gap_mm=0.1))
    assert found["air between surfaces 2 and 3"].value.item() == 0.3


@pytest.mark.parametrize(
    ("geo", "limits"),
    [
        (doublet(), dataclasses.replace(ALL, glass_edge_mm=3.0)),
        (lens.load("cooke-triplet").freeze(), Limits(incidence_deg=35.0, fields_rad=(0.35,))),
    ],
)
def test_gradients_of_the_penalty_against_differences(geo, limits):
    check_gradient(
        lambda c, t: penalty(evaluate(geo.replace(curvature_per_mm=c, thickness_mm=t), limits)),
        geo.curvature_per_mm,
        geo.thickness_mm,
        step=1e-5,
        rel=1e-5,
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
    torch.testing.assert_close(torch.stack([c.penalty for c in made]).detach(), size, rtol=1e-12, atol=0)
    torch.testing.assert_close(slope, rise, rtol=1e-12, atol=0)


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


def snell(geo, origin, direction):
    """Heights and angles of incidence of one ray through spheres, in plain floats: intersection by Newton,
    Snell in vector form."""
    o, d, vertex = np.array(origin), np.array(direction), np.zeros(3)
    heights, angles = [], []
    index = geo.index().tolist()
    for i, s in enumerate(geo.to_surfaces()):
        c = s.curvature_per_mm
        t = 0.0
        for _ in range(60):
            p = o + t * d - vertex
            t -= (p[2] - c / 2 * (p @ p)) / (d[2] - c * (p @ d))
        o = o + t * d
        p = o - vertex
        normal = np.array([0, 0, 1]) - c * p
        cosine = normal @ d
        ratio = index[i] / index[i + 1]
        heights.append(math.hypot(p[0], p[1]))
        angles.append(math.degrees(math.acos(min(1.0, abs(cosine)))))
        d = ratio * d + (math.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine) * normal
        vertex = vertex + [0, 0, s.thickness_mm]
    return heights, angles


def steepest(geo, fields):
    """The largest angle of incidence of a rim ray at every surface."""
    rays = zip(*(v.tolist() for v in rim_rays(geo, fields)), strict=True)
    return np.max([snell(geo, *ray)[1] for ray in rays], 0)


def test_heights_and_angles_of_incidence_against_a_plain_trace():
    geo = lens.load("cooke-triplet").freeze()
    origin, direction = rim_rays(geo, (0.0, 0.35), count=8)
    hits = surface_hits(geo, origin, direction)
    assert bool(hits.passed.all())
    for k in range(origin.shape[0]):
        heights, angles = snell(geo, origin[k].tolist(), direction[k].tolist())
        # rounding of a trace over 60 mm
        assert hits.height_mm[:, k].tolist() == pytest.approx(heights, abs=1e-11)
        # acos near 1: root of 1e-15, in degrees
        found = torch.rad2deg(torch.acos(hits.cosine[:, k].clamp_max(1))).tolist()
        assert found == pytest.approx(angles, abs=1e-5)
    found = found_in(geo, Limits(incidence_deg=40.0, fields_rad=(0.0, 0.35)))
    values = [found[f"incidence on surface {i + 1}"].value.item() for i in range(6)]
    assert values == pytest.approx(steepest(geo, (0.0, 0.35)), abs=1e-9)
    assert [c.name for c in active(found.values())] == ["incidence on surface 3"]


def test_a_face_between_equal_glasses_is_met_at_its_own_angle():
    crown = Glass.named("N-BK7")
    geo = lens_of([(40.0, 3.0, crown, 6.0), (-12.0, 3.0, crown, 6.0), (-60.0, 60.0, None, 6.0)])
    fields = (0.0, 0.2)

    def incidence(c):
        found = found_in(geo.replace(curvature_per_mm=c), Limits(incidence_deg=30.0, fields_rad=fields))
        return found["incidence on surface 2"].value

    assert incidence(geo.curvature_per_mm).item() == pytest.approx(steepest(geo, fields)[1], abs=1e-9)
    check_gradient(incidence, geo.curvature_per_mm, step=1e-5, rel=1e-5)


def test_a_stop_in_air_has_no_angle_of_incidence():
    geo = lens_of([(PLANE, 5.0, None, 5.0), (40.0, 3.0, CROWN, 6.0), (-40.0, 38.0, None, 6.0)], 4.0)
    cosine = surface_hits(geo, *rim_rays(geo, (0.2,))).cosine
    assert bool((cosine[0] == 1).all())
    assert bool((cosine[1] < 1).all())


def test_mirrors_reflect_at_the_angle_of_incidence():
    mirror = GeoLens([Surface(-100.0, 50.0, None, 10.0, mirror=True)], 10.0).freeze()
    pupil = torch.tensor([[0.0, 0.0], [0.0, 1.0]], dtype=D)
    hits = surface_hits(mirror, *field_rays(mirror, 0.1, pupil))
    # through the vertex the field angle; the normal leans by asin(y / R) the same way as the ray
    truth = [0.1, 0.1 - math.asin(hits.height_mm[0, 1].item() / 100)]
    assert torch.acos(hits.cosine[0]).tolist() == pytest.approx(truth, abs=1e-7)


def test_traced_and_paraxial_apertures():
    # a thin plate at the stop needs the pupil; 30 mm of air before a second one adds the slope of the field
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
            assert found.tolist() == pytest.approx(expected, abs=1e-6)


def test_rays_that_fail_push_back_until_they_pass():
    """A steep first surface loses the rim rays of a wide pupil; following the penalty alone brings them
    back."""
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
