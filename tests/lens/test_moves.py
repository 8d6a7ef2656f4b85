"""Removed surfaces and elements against closed forms and invariances; neighbouring glasses against brute force."""

import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.design import (
    elements,
    flattened,
    groups,
    neighbour_glasses,
    with_glass,
    without_element,
    without_surface,
)
from codesign.lens.design.tolerance_errors import Tolerances, errors_of
from codesign.lens.glass import names

FIELDS = (0.0, 0.2)
INF = math.inf
CROWN = Glass.named("N-BK7")
FLINT = Glass.named("F2")


@pytest.fixture(scope="module")
def triplet():
    return lens.load("cooke-triplet").freeze()


@pytest.fixture(scope="module")
def gauss():
    return lens.load("double-gauss").freeze()


def efl(geo):
    return float(geo.first_order().efl_mm.detach())


def test_elements_are_pieces_of_glass_and_groups_what_is_cemented(triplet, gauss):
    assert elements(triplet) == groups(triplet) == ((0, 1), (2, 3), (4, 5))
    assert elements(gauss) == ((0, 1), (2, 3), (3, 4), (6, 7), (7, 8), (9, 10))
    assert groups(gauss) == ((0, 1), (2, 4), (6, 8), (9, 10))


def test_a_plate_taken_out_moves_the_focus_by_what_it_had_moved_it():
    """t (1 - 1/n) along the axis (Smith, Modern Optical Engineering, ch. 4)."""
    thickness = 6.0
    plate = [Surface(INF, thickness, FLINT, 9.0), Surface(INF, 60.0, None, 9.0)]
    front = [Surface(60.0, 5.0, CROWN, 9.0, is_stop=True), Surface(-70.0, 10.0, None, 9.0)]
    geo = GeoLens([*front, *plate], 8.0)
    bare = without_element(geo, 1)
    moved = float((geo.thickness_mm[1:].sum() - bare.thickness_mm[1:].sum()).detach())
    # the defocus of both is the same, so the film moves as the paraxial focus does; rounding of 70 mm
    assert moved == pytest.approx(thickness * (1 - 1 / FLINT.index_d), abs=1e-12)
    assert bare.to_surfaces()[:1] == tuple(front[:1])
    assert float(bare.curvature_per_mm[1].detach()) == pytest.approx(-1 / 70, rel=1e-13)


def test_a_shell_that_does_not_bend_changes_nothing(triplet):
    """A meniscus of index 1 is air."""
    shell = [Surface(-30.0, 2.0, Glass.from_indices(1.0, 1.0, 1.0), 9.0), Surface(-45.0, 3.0, None, 9.0)]
    geo = GeoLens([*shell, *triplet.to_surfaces()], 10.0)
    bare = without_element(geo, 0)
    torch.testing.assert_close(bare.curvature_per_mm, triplet.curvature_per_mm, rtol=1e-13, atol=1e-15)
    torch.testing.assert_close(bare.thickness_mm, triplet.thickness_mm, rtol=1e-13, atol=0)
    assert bare.stop_index == triplet.stop_index
    torch.testing.assert_close(
        lens.spots(bare, FIELDS)[0], lens.spots(geo, FIELDS)[0], rtol=0, atol=1e-12
    )  # rounding of a trace


@pytest.mark.parametrize("element", [0, 1, 2])
def test_a_dialyte_keeps_focal_length_f_number_defocus_and_places(triplet, element):
    left = without_element(triplet, element)
    f, before = left.first_order(), triplet.first_order()
    assert float(f.efl_mm.detach()) == pytest.approx(float(before.efl_mm), rel=1e-12)
    assert float(f.fno.detach()) == pytest.approx(float(before.fno), rel=1e-12)
    assert float((left.thickness_mm[-1] - f.bfl_mm).detach()) == pytest.approx(
        float(triplet.thickness_mm[-1] - before.bfl_mm), abs=1e-12
    )
    assert len(elements(left)) == 2
    # vertices that stay have not moved; the stop on the flint stays as a plane
    kept = [i for i in range(6) if i not in elements(triplet)[element] or i == triplet.stop_index]
    z = torch.cat([triplet.thickness_mm.new_zeros(1), triplet.thickness_mm.cumsum(0)])[:-1][kept]
    torch.testing.assert_close(left.thickness_mm[:-1], z[1:] - z[:-1], rtol=1e-14, atol=0)


def test_the_stop_stays_in_its_place_when_its_element_goes(triplet):
    left = without_element(triplet, 1)
    stop = left.to_surfaces()[2]
    assert (left.stop_index, stop.radius_mm, stop.medium) == (2, INF, None)
    assert left.glass.tolist() == [True, False, False, True, False]
    # the entrance pupil is the image of that plane by the crown in front of it
    front = GeoLens(triplet.to_surfaces()[:2], 10.0).first_order()
    reach = stop_distance(triplet) - float(
        (front.bfl_mm - front.efl_mm).detach()
    )  # from the rear principal plane
    image = 1 / (1 / reach - 1 / float(front.efl_mm.detach()))
    pupil = front_principal_mm(triplet.to_surfaces()[:2]) + image
    assert float(left.first_order().entrance_pupil_z_mm.detach()) == pytest.approx(pupil, rel=1e-12)


def stop_distance(triplet):
    """From the back of the front crown to the back of the flint, where the published stop is."""
    return float(triplet.thickness_mm[1] + triplet.thickness_mm[2])


def front_principal_mm(surfaces):
    """Front principal plane behind the first vertex, from the lens maker's formulae (Smith, ch. 2)."""
    n = surfaces[0].medium.index_d
    r1, r2 = (s.radius_mm for s in surfaces)
    d = surfaces[0].thickness_mm
    f = 1 / ((n - 1) * (1 / r1 - 1 / r2 + (n - 1) * d / (n * r1 * r2)))
    return -f * (n - 1) * d / (n * r2)


def test_a_cemented_component_leaves_the_cement_to_its_neighbour():
    """Places in front of a last surface that holds the focal length and so has another curvature."""
    outer = [
        Surface(60.0, 4.0, CROWN, 9.0),
        Surface(-50.0, 2.0, FLINT, 9.0),
        Surface(90.0, 3.0, CROWN, 9.0, is_stop=True),
        Surface(-70.0, 5.0, None, 9.0),
    ]
    geo = GeoLens([*outer, Surface(80.0, 3.0, CROWN, 9.0), Surface(-200.0, 40.0, None, 9.0)], 8.0)

    def left(element):
        bare = without_element(geo, element)
        rows = [
            (s.radius_mm, s.thickness_mm, s.medium and s.medium.name, s.is_stop) for s in bare.to_surfaces()
        ]
        assert efl(bare) == pytest.approx(efl(geo), rel=1e-12)
        return rows[:-1]  # the last holds the focal length

    crown, flint = "N-BK7", "F2"
    tail = [(80.0, 3.0, crown, False)]
    # in front: the face in front of the cement goes
    assert left(0) == [(-50.0, 2.0, flint, False), (90.0, 3.0, crown, True), (-70.0, 5.0, None, False), *tail]
    # in the middle: one face remains between its neighbours, the front one growing
    assert left(1) == [(60.0, 6.0, crown, False), (90.0, 3.0, crown, True), (-70.0, 5.0, None, False), *tail]
    # at the back: the cement becomes the flint's back, and the air behind it grows
    assert left(2) == [(60.0, 4.0, crown, False), (-50.0, 2.0, flint, False), (90.0, 8.0, None, True), *tail]


def test_a_dummy_taken_out_changes_no_ray(gauss):
    surfaces = list(gauss.to_surfaces())
    last = surfaces[-1].thickness_mm
    surfaces[-1] = Surface(surfaces[-1].radius_mm, 10.0, None, 22.0)
    geo = GeoLens([*surfaces, Surface(INF, last - 10.0, None, 22.0)], 33.33)
    for at in (-1, 11):
        bare = without_surface(geo, at)
        torch.testing.assert_close(
            lens.spots(bare, FIELDS)[0], lens.spots(gauss, FIELDS)[0], rtol=0, atol=1e-11
        )
        assert len(bare.surfaces) == 11
    # its stop in air goes to the nearer neighbour, 13.7 mm behind and not 16.4 mm in front
    moved = without_surface(gauss, 5)
    assert moved.stop_index == 5
    assert moved.to_surfaces()[4].thickness_mm == pytest.approx(16.369445 + 13.747957, rel=1e-14)
    assert efl(moved) == pytest.approx(efl(gauss), rel=1e-12)


def test_a_cement_taken_out_leaves_the_glass_in_front():
    geo = GeoLens(
        [Surface(40.0, 6.0, CROWN, 8.0), Surface(-40.0, 2.0, FLINT, 8.0), Surface(-120.0, 80.0, None, 8.0)],
        8.0,
    )
    left = without_surface(geo, 1)
    assert [s.medium and s.medium.name for s in left.to_surfaces()] == ["N-BK7", None]
    assert float(left.thickness_mm[0].detach()) == 8.0
    assert efl(left) == pytest.approx(efl(geo), rel=1e-13)


def test_the_path_ends_in_a_plate_and_has_gradients(triplet):
    half = flattened(triplet, 1, 0.5)
    wanted = triplet.curvature_per_mm * torch.tensor([1, 1, 0.5, 0.5, 1, 1], dtype=torch.float64)
    torch.testing.assert_close(half.curvature_per_mm, wanted, rtol=1e-15, atol=0)
    assert flattened(triplet, 1, 1.0).curvature_per_mm[2:4].tolist() == [0.0, 0.0]
    c = triplet.curvature_per_mm.clone().requires_grad_()
    (slope,) = torch.autograd.grad(
        flattened(triplet.replace(curvature_per_mm=c), 1, 0.25).curvature_per_mm.sum(), c
    )
    assert slope.tolist() == [1, 1, 0.75, 0.75, 1, 1]
    # cemented: a shell of equal curvatures, which is what stays of it
    doublet = GeoLens(
        [Surface(40.0, 6.0, CROWN, 8.0), Surface(-30.0, 2.0, FLINT, 8.0), Surface(-120.0, 80.0, None, 8.0)],
        8.0,
    )
    ends = [[c if c else 0 for c in flattened(doublet, k, 1.0).curvature_per_mm.tolist()] for k in (0, 1)]
    assert ends == [pytest.approx([-1 / 30, -1 / 30, -1 / 120]), pytest.approx([1 / 40, -1 / 30, -1 / 30])]


@pytest.mark.parametrize("name", ["F2", "N-SK16", "SF6"])
def test_neighbours_are_the_nearest_of_all(name):
    given = Glass.named(name)

    def away(other):
        return math.hypot(
            other.index_d - given.index_d,
            ((other.index_d - 1) / (other.index_F - other.index_C) - given.abbe_number) / 100,
        )

    everything = [Glass.named(n) for n in names() if n != "air"]
    inside = [g for g in everything if g.range_um[0] < 0.4861 and g.range_um[1] > 0.6563]
    truth = sorted(away(g) for g in inside if away(g) >= 2e-3)[:6]
    found = neighbour_glasses(given, 6)
    assert [away(g) for g in found] == pytest.approx(truth, rel=1e-12)
    assert given.name not in [g.name for g in found]
    few = neighbour_glasses(name, 9, apart=0.0, among=("N-BK7", "F5", "SF6"))
    assert [g.name for g in few] == sorted(("N-BK7", "F5", "SF6"), key=lambda n: away(Glass.named(n)))


def test_an_exchanged_glass_keeps_focal_length_and_defocus(triplet):
    other = with_glass(triplet, 2, "SF1")
    assert efl(other) == pytest.approx(efl(triplet), rel=1e-12)
    assert [s.medium and s.medium.name for s in other.to_surfaces()][2] == "SF1"
    assert torch.equal(other.curvature_per_mm[:5], triplet.curvature_per_mm[:5])
    same = with_glass(triplet, 2, triplet.to_surfaces()[2].medium)
    torch.testing.assert_close(same.thickness_mm, triplet.thickness_mm, rtol=1e-13, atol=0)


@pytest.mark.parametrize(
    ("move", "said"),
    [
        (lambda t: without_element(t, 3), "there is no element 3; it has 0 to 2"),
        (lambda t: without_element(lens.load("la1509"), 0), "its only one"),
        (lambda t: without_surface(t, 7), "there is no surface 7; it has 0 to 5"),
        (lambda t: without_surface(t, 1), "between glass and air.*without_element"),
        (lambda t: with_glass(t, 1, FLINT), "no glass behind surface 1 to exchange; there is behind 0, 2, 4"),
        (lambda t: with_glass(t, 0, "air"), "air is no glass; .*without_element"),
        (lambda t: with_glass(t, 0, None), "None is no glass"),
        (lambda t: with_glass(t, 0, 1.5), "float is no medium"),
        (lambda t: without_element(t, 0.5), "there is no element 0.5"),
        (lambda t: without_element(t, "a"), "there is no element a"),
        (lambda t: neighbour_glasses("N-BK77"), "'N-BK77' is not in the catalogue; the nearest names are"),
        (lambda t: neighbour_glasses(Glass.from_indices(1.5, 1.5, 1.5)), "no dispersion"),
        (lambda t: neighbour_glasses("F2", 0), "at least 1"),
    ],
)
def test_wrong_moves_are_refused(triplet, move, said):
    with pytest.raises(DomainError, match=said):
        move(triplet)


def test_mirrors_stay():
    mangin = GeoLens(
        [
            Surface(-80.0, 4.0, CROWN, 10.0, is_stop=True),
            Surface(-120.0, 4.0, CROWN, 10.0, mirror=True),
            Surface(80.0, 60.0, None, 10.0),
        ],
        10.0,
    )
    with pytest.raises(DomainError, match="surface 2 is a mirror"):
        without_surface(mangin, 1)
    with pytest.raises(DomainError, match="touches a mirror"):
        without_element(mangin, 0)


def test_glass_on_both_ways_of_a_mirror_stays():
    """A crown plate in front of a mangin mirror, passed on the way there and back."""
    there = [Surface(-60.0, 3.0, FLINT, 10.0, is_stop=True), Surface(-90.0, 5.0, None, 10.0)]
    mangin = [Surface(-80.0, 4.0, CROWN, 10.0), Surface(-120.0, 4.0, CROWN, 10.0, mirror=True)]
    back = [Surface(80.0, 5.0, None, 10.0), Surface(90.0, 3.0, FLINT, 10.0), Surface(60.0, 60.0, None, 10.0)]
    geo = GeoLens([*there, *mangin, *back], 10.0)
    first, last = 0, len(elements(geo)) - 1
    for element in (first, last):
        with pytest.raises(DomainError, match=r"the light passes element \d again behind surface"):
            without_element(geo, element)
    for surface in (0, 5):
        with pytest.raises(DomainError, match="the light passes the glass behind it again behind surface"):
            with_glass(geo, surface, "SF1")
        with pytest.raises(DomainError, match="the light passes the glass behind it again behind surface"):
            geo.replace_glass(surface, "SF1")
    both = geo.replace_glass(2, "SF1").index()  # glass on the mirror is one gap for both ways
    assert both[3] == both[4] == Glass.named("SF1").index(0.5875618)
    for errors in (Tolerances(element_decentre_mm=0.1), Tolerances(element_tilt_deg=0.1)):
        with pytest.raises(DomainError, match="element 1-2 holds a mirror or is passed twice"):
            errors_of(geo, errors)
        with pytest.raises(DomainError, match="element 1-2 holds a mirror or is passed twice"):
            errors_of(GeoLens([*mangin, back[0]], 10.0), errors)


def test_a_rest_that_images_inside_itself_is_refused(gauss):
    """The last radius of the double Gauss would have to hold its focal length against the flint that went."""
    with pytest.raises(DomainError, match=r"the image lies 28\.6 mm before the last surface; flatten"):
        without_element(gauss, 2)
