"""Limits of a lens against geometry worked by hand, a plain ray trace, and differences."""

import dataclasses
import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.analysis import field_rays
from codesign.lens.design import glass_map
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

D = torch.float64
GLASS = Glass.from_indices(1.5, 1.5, 1.5)
INF = math.inf


def sag(radius, height):
    """Depth of a sphere, by Pythagoras."""
    return math.copysign(abs(radius) - math.sqrt(radius * radius - height * height), radius)


def doublet(gap=1.0):
    """A biconvex lens and a meniscus behind an air gap."""
    return GeoLens(
        [
            Surface(40.0, 6.0, GLASS, 12.0, is_stop=True),
            Surface(-60.0, gap, None, 12.0),
            Surface(-50.0, 3.0, GLASS, 11.0),
            Surface(-90.0, 70.0, None, 11.0),
        ],
        16.0,
    )


def named(found):
    return {c.name: c for c in found}


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
    found = named(evaluate(doublet(), ALL))

    def value(name):
        return float(found[name].value.detach())

    assert value("centre of glass between surfaces 1 and 2") == 6.0
    assert value("edge of glass between surfaces 1 and 2") == pytest.approx(
        6 - sag(40, 12) + sag(-60, 12), abs=1e-13
    )
    assert value("edge of glass between surfaces 3 and 4") == pytest.approx(
        3 - sag(-50, 11) + sag(-90, 11), abs=1e-13
    )
    # surface 3 curves back faster than surface 2, so the gap closes towards the edge, the larger of 12 and 11
    # mm
    assert value("air between surfaces 2 and 3") == pytest.approx(1 - sag(-60, 12) + sag(-50, 12), abs=1e-13)
    assert value("total track") == 80.0
    assert value("back focus") == 70.0
    assert value("steepness of surface 1") == pytest.approx(12 / 40, rel=1e-14)
    assert {c.name for c in active(found.values())} >= {"total track", "back focus", "steepness of surface 1"}
    assert found["total track"].state() == "violated"
    assert found["centre of glass between surfaces 3 and 4"].state() == "free"
    assert float(penalty([found["total track"], found["back focus"]]).detach()) == pytest.approx(
        (5 / 0.5) ** 2 + (2 / 0.5) ** 2, rel=1e-13
    )


def test_the_least_gap_is_found_inside_the_aperture():
    """A plane after r^4 / 1000 - r^2 / 20: the gap 3 - r^2/20 + r^4/1000... is least where r^2 = 25, by 0.625
    below the axis."""
    geo = GeoLens(
        [
            Surface(50.0, 3.0, GLASS, 8.0),
            Surface(INF, 3.0, None, 8.0),
            Surface(INF, 3.0, GLASS, 8.0, asphere=(-0.05, 1e-3)),
            Surface(INF, 50.0, None, 8.0),
        ],
        8.0,
    )
    found = named(evaluate(geo, Limits(air_gap_mm=0.1)))["air between surfaces 2 and 3"]
    line = torch.linspace(0, 1, 33, dtype=D)
    # the nearest of 33 heights, a quarter of a millimetre apart, misses the lowest by at most (1/8)^2 times
    # half the second derivative 0.2
    assert 3 - 0.625 <= float(found.value.detach()) <= 3 - 0.625 + 0.1 / 64
    assert gap_mm(geo, line)[1].detach().tolist() == pytest.approx(
        [3 - 0.05 * r * r + 1e-3 * r**4 for r in (8 * line).tolist()], abs=1e-13
    )


def test_the_centre_counts_as_part_of_the_gap():
    geo = GeoLens(
        [
            Surface(INF, 3.0, GLASS, 8.0),
            Surface(40.0, 0.3, None, 8.0),
            Surface(20.0, 3.0, GLASS, 8.0),
            Surface(INF, 50.0, None, 8.0),
        ],
        8.0,
    )
    assert (
        float(named(evaluate(geo, Limits(air_gap_mm=0.1)))["air between surfaces 2 and 3"].value.detach())
        == 0.3
    )


def test_gradients_of_the_penalty_against_differences():
    geo = doublet()
    limits = dataclasses.replace(ALL, glass_edge_mm=3.0)
    tensors = {"curvature_per_mm": 1e-6, "thickness_mm": 1e-4}
    found = torch.autograd.grad(penalty(evaluate(geo, limits)), [getattr(geo, name) for name in tensors])
    for (name, size), slope in zip(tensors.items(), found, strict=True):
        base = getattr(geo, name).detach()
        for i in range(4):
            step = size * torch.eye(4, dtype=D)[i]
            ahead, behind = (
                float(penalty(evaluate(geo.replace(**{name: base + s * step}), limits)).detach())
                for s in (1, -1)
            )
            truth = (ahead - behind) / (2 * size)
            assert abs(float(slope[i]) - truth) <= 1e-5 * max(
                1.0, float(slope.abs().max())
            )  # penalties of some 1e2 known to 1e-14 over 1e-6


@pytest.mark.parametrize("at_least", [True, False])
def test_the_hinge_is_smooth_where_it_begins_and_zero_where_it_holds(at_least):
    x = torch.tensor([-1e-3, 0.0, 1e-3], dtype=D, requires_grad=True)
    made = [Constraint("x", v, 0.0, at_least, 0.5, "mm") for v in x]
    (slope,) = torch.autograd.grad(penalty(made), x)
    wrong = 0 if at_least else 2
    for k in range(3):
        assert float(made[k].penalty.detach()) == (
            pytest.approx((1e-3 / 0.5) ** 2, rel=1e-12) if k == wrong else 0.0
        )
        assert float(slope[k]) == (
            pytest.approx((-1 if at_least else 1) * 2 * 1e-3 / 0.25, rel=1e-12) if k == wrong else 0.0
        )  # slope goes to 0 with the violation


def test_rows_square_to_the_penalty_and_hold_zero_when_free():
    free = Limits(glass_centre_mm=1.0, track_mm=90.0)
    assert float(penalty(evaluate(doublet(), free)).detach()) == 0.0
    found = evaluate(doublet(), ALL)
    assert float(rows(found).square().sum().detach()) == pytest.approx(
        sum(float(c.penalty.detach()) for c in found), rel=1e-13
    )
    with pytest.raises(DomainError, match="no constraints"):
        rows([])


def test_the_report_names_what_binds_and_what_is_violated():
    touching = Limits(glass_centre_mm=3.0, track_mm=75.0, back_focus_mm=60.0)
    found = evaluate(doublet(), touching)
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
    import numpy as np

    o = np.array(origin)
    d = np.array(direction)
    z = 0.0
    heights = []
    angles = []
    index = geo.index().tolist()
    for i, s in enumerate(geo.to_surfaces()):
        c = s.curvature_per_mm
        t = 0.0
        for _ in range(60):
            p = o + t * d - np.array([0, 0, z])
            value = p[2] - c / 2 * (p @ p)
            slope = d[2] - c * (p @ d)
            t -= value / slope
        o = o + t * d
        p = o - np.array([0, 0, z])
        normal = np.array([-c * p[0], -c * p[1], 1 - c * p[2]])
        cosine = normal @ d
        ratio = index[i] / index[i + 1]
        heights.append(math.hypot(p[0], p[1]))
        angles.append(math.degrees(math.acos(min(1.0, abs(cosine)))))
        d = ratio * d + (math.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine) * normal
        z += s.thickness_mm
    return heights, angles


def test_heights_and_angles_of_incidence_against_a_plain_trace():
    geo = lens.load("cooke-triplet").freeze()
    origin, direction = rim_rays(geo, (0.0, 0.35), count=8)
    hits = surface_hits(geo, origin, direction)
    assert bool(hits.passed.all())
    for k in range(origin.shape[0]):
        heights, angles = snell(geo, origin[k].tolist(), direction[k].tolist())
        assert hits.height_mm[:, k].tolist() == pytest.approx(
            heights, abs=1e-11
        )  # rounding of a trace over 60 mm
        assert torch.rad2deg(torch.acos(hits.cosine[:, k].clamp_max(1))).tolist() == pytest.approx(
            angles, abs=1e-5
        )  # acos near 1: root of 1e-15, in degrees
    found = named(evaluate(geo, Limits(incidence_deg=40.0, fields_rad=(0.0, 0.35))))
    worst = [
        max(column)
        for column in zip(
            *(
                snell(geo, o, d)[1]
                for o, d in zip(*(v.tolist() for v in rim_rays(geo, (0.0, 0.35))), strict=True)
            ),
            strict=True,
        )
    ]
    assert [float(found[f"incidence on surface {i + 1}"].value) for i in range(6)] == pytest.approx(
        worst, abs=1e-9
    )
    assert [c.name for c in active(found.values())] == ["incidence on surface 3"]


def test_incidence_is_differentiable():
    geo = lens.load("cooke-triplet").freeze()
    limits = Limits(incidence_deg=35.0, fields_rad=(0.35,))

    def cost(c):
        return penalty(evaluate(geo.replace(curvature_per_mm=c), limits))

    c = geo.curvature_per_mm.clone().requires_grad_()
    (slope,) = torch.autograd.grad(cost(c), c)
    assert float(slope.abs().max()) > 0
    for i in range(6):
        step = 1e-6 * torch.eye(6, dtype=D)[i]
        truth = float(cost(geo.curvature_per_mm + step) - cost(geo.curvature_per_mm - step)) / 2e-6
        assert abs(float(slope[i]) - truth) <= 1e-5 * float(slope.abs().max())


def test_a_face_between_equal_glasses_is_met_at_its_own_angle():
    crown = Glass.named("N-BK7")
    doublet = GeoLens(
        [Surface(40.0, 3.0, crown, 6.0), Surface(-12.0, 3.0, crown, 6.0), Surface(-60.0, 60.0, None, 6.0)],
        8.0,
    ).freeze()
    limits = Limits(incidence_deg=30.0, fields_rad=(0.0, 0.2))

    def incidence(c):
        found = named(evaluate(doublet.replace(curvature_per_mm=c), limits))
        return found["incidence on surface 2"].value

    truth = max(
        snell(doublet, o, d)[1][1]
        for o, d in zip(*(v.tolist() for v in rim_rays(doublet, (0.0, 0.2))), strict=True)
    )
    assert truth > 20
    c = doublet.curvature_per_mm.clone().requires_grad_()
    found = incidence(c)
    assert found.item() == pytest.approx(truth, abs=1e-9)
    (slope,) = torch.autograd.grad(found, c)
    step = 1e-6 * torch.eye(3, dtype=D)
    differences = torch.stack([incidence(c.detach() + by) - incidence(c.detach() - by) for by in step]) / 2e-6
    torch.testing.assert_close(slope, differences, rtol=0, atol=1e-5 * float(differences.abs().max()))


def test_a_stop_in_air_has_no_angle_of_incidence():
    geo = GeoLens(
        [
            Surface(INF, 5.0, None, 5.0, is_stop=True),
            Surface(40.0, 3.0, GLASS, 6.0),
            Surface(-40.0, 38.0, None, 6.0),
        ],
        4.0,
    ).freeze()
    hits = surface_hits(geo, *rim_rays(geo, (0.2,)))
    assert bool((hits.cosine[0] == 1).all())
    assert bool((hits.cosine[1] < 1).all())


def test_mirrors_reflect_at_the_angle_of_incidence():
    mirror = GeoLens([Surface(-100.0, 50.0, None, 10.0, mirror=True)], 10.0).freeze()
    origin, direction = field_rays(mirror, 0.1, torch.tensor([[0.0, 0.0], [0.0, 1.0]], dtype=D))
    hits = surface_hits(mirror, origin, direction)
    assert float(torch.acos(hits.cosine[0, 0])) == pytest.approx(
        0.1, abs=1e-7
    )  # through the vertex: the field angle
    y = float(hits.height_mm[0, 1])
    assert float(torch.acos(hits.cosine[0, 1])) == pytest.approx(
        0.1 - math.asin(y / 100), abs=1e-7
    )  # the normal leans by asin(y / R) the same way as the ray


def test_traced_and_paraxial_apertures():
    # a thin plate at the stop needs the pupil; 30 mm of air before a second one adds the slope of the field
    plate = [
        Surface(INF, 1e-9, GLASS, 5.0, is_stop=True),
        Surface(INF, 30.0, None, 5.0),
        Surface(INF, 1e-9, GLASS, 20.0),
        Surface(1e9, 30.0, None, 20.0),
    ]
    geo = GeoLens(plate, 8.0).freeze()
    expected = [4.0, 4.0, 4 + 30 * math.tan(0.3), 4 + 30 * math.tan(0.3)]
    assert traced_semi_aperture_mm(geo, (0.3,), margin=0).tolist() == pytest.approx(expected, abs=1e-6)
    assert paraxial_semi_aperture_mm(geo, 0.3, margin=0).tolist() == pytest.approx(expected, abs=1e-6)
    assert paraxial_semi_aperture_mm(geo, 0.3, margin=0.1).tolist() == pytest.approx(
        [1.1 * v for v in expected], abs=1e-6
    )


def test_rays_that_fail_push_back_until_they_pass():
    """A steep first surface loses the rim rays of a wide pupil; following the penalty alone brings them
    back."""
    geo = GeoLens(
        [Surface(9.9, 3.0, GLASS, 9.0, is_stop=True), Surface(-30.0, 15.0, None, 9.5)], 19.0
    ).freeze()
    limits = Limits(rays=True, fields_rad=(0.0, 0.2))
    c = geo.curvature_per_mm.clone()
    first = evaluate(geo, limits)[0]
    assert first.state() == "violated"
    for _ in range(400):
        c.requires_grad_()
        cost = penalty(evaluate(geo.replace(curvature_per_mm=c), limits))
        if float(cost.detach()) == 0:
            break
        (slope,) = torch.autograd.grad(cost, c)
        c = (c - 1e-3 * slope / slope.norm()).detach()
    final = geo.replace(curvature_per_mm=c.detach())
    assert bool((final.trace(*rim_rays(final, (0.0, 0.2))).status == 0).all())
    assert (
        evaluate(final, limits)[0].state() == "free"
    )  # no failed ray is the best there is: it holds, it does not bind
    with pytest.raises(DomainError, match="rim rays fail"):
        traced_semi_aperture_mm(geo, (0.0, 0.2))


def test_glasses_against_their_definitions():
    geo = GeoLens(
        [
            Surface(50.0, 5.0, Glass.named("N-BK7"), 10.0),
            Surface(-50.0, 5.0, Glass.named("F2"), 10.0),
            Surface(INF, 90.0, None, 10.0),
        ],
        10.0,
    )
    found = {i: (float(nd.detach()), float(vd.detach())) for i, (nd, vd) in glass_map.places(geo).items()}
    for i, name in ((0, "N-BK7"), (1, "F2")):
        glass = Glass.named(name)
        assert found[i] == (
            pytest.approx(glass.index_d, rel=1e-14),
            pytest.approx(glass.abbe_number, rel=1e-11),
        )
    shifted = glass_map.places(geo.replace(index_offset=torch.tensor([0.02, 0.0, 0.0], dtype=D)))[0]
    assert float(shifted[1]) == pytest.approx(
        found[0][1] * (found[0][0] + 0.02 - 1) / (found[0][0] - 1), rel=1e-11
    )
    square = ((1.5, 30.0), (1.5, 70.0), (1.6, 70.0), (1.6, 30.0))
    limits = named(evaluate(geo, Limits(glass_polygon=square, index_range=(1.4, 1.61))))
    assert float(limits["glass behind surface 1 in the glass map"].value.detach()) == pytest.approx(
        min(found[0][0] - 1.5, 0.0583), abs=1e-3
    )
    outside = limits["glass behind surface 2 in the glass map"]
    assert float(outside.value.detach()) == pytest.approx(1.6 - found[1][0], rel=1e-12)
    assert outside.state() == "violated"
    (slope,) = torch.autograd.grad(outside.penalty, geo.index_offset)
    assert slope.tolist() == pytest.approx([0.0, 2 * (found[1][0] - 1.6) / 0.01**2, 0.0], rel=1e-9)
    assert limits["index of glass behind surface 2"].slack.item() == pytest.approx(
        1.61 - found[1][0], rel=1e-12
    )


@pytest.mark.parametrize(
    "corners",
    [
        ((1.5, 50.0), (1.6, 60.0)),
        ((1.5, 30.0), (1.6, 70.0), (1.5, 70.0), (1.6, 30.0)),
        ((1.5, 50.0), (1.55, 50.0), (1.6, 50.0)),
    ],
)
def test_a_region_that_is_not_convex_is_refused(corners):
    with pytest.raises(DomainError, match="convex"):
        glass_map.inside(torch.tensor(1.5, dtype=D), torch.tensor(50.0, dtype=D), corners)


def test_distance_inside_a_triangle_by_hand():
    nd = torch.tensor(1.55, dtype=D)
    vd = torch.tensor(50.0, dtype=D)
    triangle = ((1.5, 40.0), (1.7, 40.0), (1.5, 60.0))
    assert float(glass_map.inside(nd, vd, triangle)) == pytest.approx(
        0.05 / math.sqrt(2), rel=1e-12
    )  # the slanted side is nd + Vd / 100 = 2.1
    assert float(glass_map.inside(nd, vd, triangle[::-1])) == pytest.approx(0.05 / math.sqrt(2), rel=1e-12)


def test_limits_without_fields_are_refused():
    with pytest.raises(DomainError, match="fields_rad"):
        Limits(incidence_deg=50.0)
    with pytest.raises(DomainError, match="fields_rad"):
        Limits(rays=True)
    with pytest.raises(DomainError, match="positive"):
        Limits(scale_mm=0.0)
