"""Removed surfaces and elements against closed forms and invariances; neighbouring glasses against brute
force."""

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
)
from codesign.lens.design.tolerance import Tolerances, errors_of
from codesign.lens.glass import names
from tests.lens.systems import PLANE, efl, glass

FIELDS = (0.0, 0.2)
CROWN = Glass.named("N-BK7")
FLINT = Glass.named("F2")


@pytest.fixture(scope="module")
def triplet():
    return lens.load("cooke-triplet").freeze()


@pytest.fixture(scope="module")
def gauss():
    return lens.load("double-gauss").freeze()


def test_elements_are_pieces_of_glass_and_groups_what_is_cemented(triplet, gauss):
    assert elements(triplet) == groups(triplet) == ((0, 1), (2, 3), (4, 5))
    assert elements(gauss) == ((0, 1), (2, 3), (3, 4), (6, 7), (7, 8), (9, 10))
    assert groups(gauss) == ((0, 1), (2, 4), (6, 8), (9, 10))


def test_a_plate_taken_out_moves_the_focus_by_what_it_had_moved_it():
    """t (1 - 1/n) along the axis (Smith, Modern Optical Engineering, ch. 4)."""
    plate = [Surface(PLANE, 6.0, FLINT, 9.0), Surface(PLANE, 60.0, None, 9.0)]
    front = [Surface(60.0, 5.0, CROWN, 9.0, is_stop=True), Surface(-70.0, 10.0, None, 9.0)]
    geo = GeoLens([*front, *plate], 8.0).freeze()
    bare = without_element(geo, 1).freeze()
    moved = float(geo.thickness_mm[1:].sum() - bare.thickness_mm[1:].sum())
    # the defocus of both is the same, so the film moves as the paraxial focus does; rounding of 70 mm
    assert moved == pytest.approx(6.0 * (1 - 1 / FLINT.index_d), abs=1e-12)
    assert bare.to_surfaces()[0] == front[0]
    assert float(bare.curvature_per_mm[1]) == pytest.approx(-1 / 70, rel=1e-13)


def test_a_shell_that_does_not_bend_changes_nothing(triplet):
    """A meniscus of index 1 is air."""
    shell = [Surface(-30.0, 2.0, glass(1.0), 9.0), Surface(-45.0, 3.0, None, 9.0)]
    geo = GeoLens([*shell, *triplet.to_surfaces()], 10.0)
    bare = without_element(geo, 0)
    for name in ("curvature_per_mm", "thickness_mm"):
        torch.testing.assert_close(getattr(bare, name), getattr(triplet, name), rtol=1e-13, atol=1e-15)
    assert bare.stop_index == triplet.stop_index
    # rounding of a trace
    torch.testing.assert_close(lens.spots(bare, FIELDS)[0], lens.spots(geo, FIELDS)[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("element", [0, 1, 2])
def test_a_dialyte_keeps_focal_length_f_number_defocus_and_places(triplet, element):
    left = without_element(triplet, element).freeze()

    def held(geo):
        f = geo.first_order()
        return [float(v) for v in (f.efl_mm, f.fno, geo.thickness_mm[-1] - f.bfl_mm)]

    assert held(left) == pytest.approx(held(triplet), rel=1e-12, abs=1e-12)
    assert len(elements(left)) == 2
    # vertices that stay have not moved; the stop on the flint stays as a plane
    kept = [i for i in range(6) if i not in elements(triplet)[element] or i == triplet.stop_index]
    z = torch.cat([triplet.thickness_mm.new_zeros(1), triplet.thickness_mm.cumsum(0)])[:-1][kept]
    torch.testing.assert_close(left.thickness_mm[:-1], z.diff(), rtol=1e-14, atol=0)


def test_the_stop_stays_in_its_place_when_its_element_goes(triplet):
    left = without_element(triplet, 1)
    stop = left.to_surfaces()[2]
    assert (left.stop_index, stop.radius_mm, stop.medium) == (2, PLANE, None)
    assert left.glass.tolist() == [True, False, False, True, False]
    # the entrance pupil is the image of that plane by the crown in front of it, between its principal
    # planes, from the lens maker's formulae (Smith, ch. 2)
    front, back = triplet.to_surfaces()[:2]
    n, d, r1, r2 = front.medium.index_d, front.thickness_mm, front.radius_mm, back.radius_mm
    f = 1 / ((n - 1) * (1 / r1 - 1 / r2 + (n - 1) * d / (n * r1 * r2)))
    reach = float(triplet.thickness_mm[1:3].sum()) + f * (n - 1) * d / (n * r1)
    pupil = -f * (n - 1) * d / (n * r2) + 1 / (1 / reach - 1 / f)
    assert left.first_order().entrance_pupil_z_mm.item() == pytest.approx(pupil, rel=1e-12)


def test_a_cemented_component_leaves_the_cement_to_its_neighbour():
    """Places in front of a last surface that holds the focal length and so has another curvature."""
    cemented = [
        Surface(60.0, 4.0, CROWN, 9.0),
        Surface(-50.0, 2.0, FLINT, 9.0),
        Surface(90.0, 3.0, CROWN, 9.0, is_stop=True),
        Surface(-70.0, 5.0, None, 9.0),
    ]
    geo = GeoLens([*cemented, Surface(80.0, 3.0, CROWN, 9.0), Surface(-200.0, 40.0, None, 9.0)], 8.0)
    crown, flint, last = "N-BK7", "F2", (80.0, 3.0, "N-BK7", False)
    for element, front in enumerate(
        (
            # the face in front of the cement goes
            [(-50.0, 2.0, flint, False), (90.0, 3.0, crown, True), (-70.0, 5.0, None, False), last],
            # one face remains between its neighbours, the front one growing
            [(60.0, 6.0, crown, False), (90.0, 3.0, crown, True), (-70.0, 5.0, None, False), last],
            # the cement becomes the flint's back, and the air behind it grows
            [(60.0, 4.0, crown, False), (-50.0, 2.0, flint, False), (90.0, 8.0, None, True), last],
        )
    ):
        bare = without_element(geo, element)
        assert efl(bare) == pytest.approx(efl(geo), rel=1e-12)
        assert rows(bare)[:-1] == front


def test_the_path_ends_in_a_plate_and_has_gradients(triplet, doublet):
    for share, kept in ((0.5, 0.5), (1.0, 0.0)):
        wanted = triplet.curvature_per_mm * torch.tensor([1, 1, kept, kept, 1, 1], dtype=torch.float64)
        torch.testing.assert_close(flattened(triplet, 1, share).curvature_per_mm, wanted, rtol=1e-15, atol=0)
    c = triplet.curvature_per_mm.clone().requires_grad_()
    part = flattened(triplet.replace(curvature_per_mm=c), 1, 0.25).curvature_per_mm
    assert torch.autograd.grad(part.sum(), c)[0].tolist() == [1, 1, 0.75, 0.75, 1, 1]
    # cemented: a shell of equal curvatures, which is what stays of it
    ends = [flattened(doublet, k, 1.0).curvature_per_mm.tolist() for k in (0, 1)]
    assert ends == [pytest.approx([-1 / 30, -1 / 30, -1 / 120]), pytest.approx([1 / 40, -1 / 30, -1 / 30])]


@pytest.mark.parametrize("name", ["F2", "N-SK16", "SF6"])
def test_neighbours_are_the_nearest_of_all(name):
    given = Glass.named(name)

    def away(other):
        abbe = (other.index_d - 1) / (other.index_F - other.index_C)
        return math.hypot(other.index_d - given.index_d, (abbe - given.abbe_number) / 100)

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


def test_glass_on_both_ways_of_a_mirror_stays():
    """A crown plate in front of a mangin mirror, passed on the way there and back."""
    there = [Surface(-60.0, 3.0, FLINT, 10.0, is_stop=True), Surface(-90.0, 5.0, None, 10.0)]
    mangin = [Surface(-80.0, 4.0, CROWN, 10.0), Surface(-120.0, 4.0, CROWN, 10.0, mirror=True)]
    back = [Surface(80.0, 5.0, None, 10.0), Surface(90.0, 3.0, FLINT, 10.0), Surface(60.0, 60.0, None, 10.0)]
    geo = GeoLens([*there, *mangin, *back], 10.0)
    again = "the light passes the glass behind it again behind surface"
    for call, said in (
        (lambda: without_element(geo, 0), r"the light passes element \d again behind surface"),
        (lambda: without_element(geo, -1), r"the light passes element \d again behind surface"),
        (lambda: with_glass(geo, 0, "SF1"), again),
        (lambda: with_glass(geo, 5, "SF1"), again),
        (lambda: geo.replace_glass(0, "SF1"), again),
        (
            lambda: errors_of(geo, Tolerances(element_tilt_deg=0.1)),
            "element 1-2 holds a mirror or is passed twice",
        ),
    ):
        with pytest.raises(DomainError, match=said):
            call()
    # glass on the mirror is one gap for both ways
    both = geo.replace_glass(2, "SF1").index()
    assert both[3] == both[4] == Glass.named("SF1").index(0.5875618)


@pytest.fixture(scope="module")
def doublet():
    """A cemented crown and flint."""
    faces = Surface(40.0, 6.0, CROWN, 8.0), Surface(-30.0, 2.0, FLINT, 8.0), Surface(-120.0, 80.0, None, 8.0)
    return GeoLens(faces, 8.0).freeze()


def rows(geo):
    return [(s.radius_mm, s.thickness_mm, s.medium and s.medium.name, s.is_stop) for s in geo.to_surfaces()]
