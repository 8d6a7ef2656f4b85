"""Removed surfaces and elements against closed forms and invariances; neighbouring glasses against
brute force."""

import math

import numpy as np
import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.design import (
    elements,
    flattened,
    groups,
    moved_element,
    neighbour_glasses,
    with_glass,
    without_element,
)
from codesign.lens.design.hits import rim_rays
from codesign.lens.glass import names
from tests.lens.long_double_lens import by_frames
from tests.lens.systems import PLANE, check_gradient, close, efl, glass
from tests.numbers import f64, randn64

FIELDS = (0.0, 0.2)
CROWN = Glass.named("N-BK7")
FLINT = Glass.named("F2")


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
    # the defocus of both is the same, so the film moves as the paraxial focus does; rounding of 70
    # mm
    close(moved, 6.0 * (1 - 1 / FLINT.index_d), atol=1e-12)
    assert bare.to_surfaces()[0] == front[0]
    close(bare.curvature_per_mm[1], -1 / 70, 1e-13)


def test_a_shell_that_does_not_bend_changes_nothing(triplet):
    """A meniscus of index 1 is air."""
    shell = [Surface(-30.0, 2.0, glass(1.0), 9.0), Surface(-45.0, 3.0, None, 9.0)]
    geo = GeoLens([*shell, *triplet.to_surfaces()], 10.0)
    bare = without_element(geo, 0)
    for name in ("curvature_per_mm", "thickness_mm"):
        close(getattr(bare, name), getattr(triplet, name), 1e-13, atol=1e-15)
    assert bare.stop_index == triplet.stop_index
    # rounding of a trace
    close(lens.spots(bare, FIELDS)[0], lens.spots(geo, FIELDS)[0], atol=1e-12)


@pytest.mark.parametrize("element", [0, 1, 2])
def test_a_dialyte_keeps_focal_length_f_number_defocus_and_places(triplet, element):
    left = without_element(triplet, element).freeze()

    def held(geo):
        f = geo.first_order()
        return [float(v) for v in (f.efl_mm, f.fno, geo.thickness_mm[-1] - f.bfl_mm)]

    close(held(left), held(triplet), 1e-12, atol=1e-12)
    assert len(elements(left)) == 2
    # vertices that stay have not moved; the stop on the flint stays as a plane
    kept = [i for i in range(6) if i not in elements(triplet)[element] or i == triplet.stop_index]
    z = torch.cat([triplet.thickness_mm.new_zeros(1), triplet.thickness_mm.cumsum(0)])[:-1][kept]
    close(left.thickness_mm[:-1], z.diff(), 1e-14)


def test_the_stop_stays_in_its_place_when_its_element_goes(triplet):
    left = without_element(triplet, 1)
    stop = left.to_surfaces()[2]
    assert (left.stop_index, stop.radius_mm, stop.medium) == (2, PLANE, None)
    assert left.glass.tolist() == [True, False, False, True, False]
    # the entrance pupil is the image of that plane by the crown in front of it, between its
    # principal planes, from the lens maker's formulae (Smith, ch. 2)
    front, back = triplet.to_surfaces()[:2]
    n, d, r1, r2 = front.medium.index_d, front.thickness_mm, front.radius_mm, back.radius_mm
    f = 1 / ((n - 1) * (1 / r1 - 1 / r2 + (n - 1) * d / (n * r1 * r2)))
    reach = float(triplet.thickness_mm[1:3].sum()) + f * (n - 1) * d / (n * r1)
    pupil = -f * (n - 1) * d / (n * r2) + 1 / (1 / reach - 1 / f)
    close(left.first_order().entrance_pupil_z_mm, pupil, 1e-12)


def test_a_cemented_component_leaves_the_cement_to_its_neighbour():
    """Places in front of a last surface that holds the focal length and so has another
    curvature."""
    cemented = [
        Surface(60.0, 4.0, CROWN, 9.0),
        Surface(-50.0, 2.0, FLINT, 9.0),
        Surface(90.0, 3.0, CROWN, 9.0, is_stop=True),
        Surface(-70.0, 5.0, None, 9.0),
    ]
    geo = GeoLens(
        [*cemented, Surface(80.0, 3.0, CROWN, 9.0), Surface(-200.0, 40.0, None, 9.0)], 8.0
    )
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
        close(efl(bare), efl(geo), 1e-12)
        assert rows(bare)[:-1] == front


def test_the_path_ends_in_a_plate_and_has_gradients(triplet, doublet):
    for share, kept in ((0.5, 0.5), (1.0, 0.0)):
        wanted = triplet.curvature_per_mm * f64([1, 1, kept, kept, 1, 1])
        close(flattened(triplet, 1, share).curvature_per_mm, wanted, 1e-15)
    c = triplet.curvature_per_mm.clone().requires_grad_()
    part = flattened(triplet.replace(curvature_per_mm=c), 1, 0.25).curvature_per_mm
    assert torch.autograd.grad(part.sum(), c)[0].tolist() == [1, 1, 0.75, 0.75, 1, 1]
    # cemented: a shell of equal curvatures, which is what stays of it
    ends = [flattened(doublet, k, 1.0).curvature_per_mm.tolist() for k in (0, 1)]
    assert ends == [
        pytest.approx([-1 / 30, -1 / 30, -1 / 120]),
        pytest.approx([1 / 40, -1 / 30, -1 / 30]),
    ]


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
    close([away(g) for g in found], truth, 1e-12)
    assert given.name not in [g.name for g in found]
    few = neighbour_glasses(name, 9, apart=0.0, among=("N-BK7", "F5", "SF6"))
    assert [g.name for g in few] == sorted(
        ("N-BK7", "F5", "SF6"), key=lambda n: away(Glass.named(n))
    )


def test_an_exchanged_glass_keeps_focal_length_and_defocus(triplet):
    other = with_glass(triplet, 2, "SF1")
    close(efl(other), efl(triplet), 1e-12)
    assert [s.medium and s.medium.name for s in other.to_surfaces()][2] == "SF1"
    assert torch.equal(other.curvature_per_mm[:5], triplet.curvature_per_mm[:5])
    same = with_glass(triplet, 2, triplet.to_surfaces()[2].medium)
    close(same.thickness_mm, triplet.thickness_mm, 1e-13)


def test_glass_on_a_mirror_is_one_gap_for_both_ways():
    faces = Surface(-80.0, 4.0, CROWN, 10.0), Surface(-120.0, 4.0, CROWN, 10.0, mirror=True)
    mangin = GeoLens([*faces, Surface(80.0, 5.0, None, 10.0)], 10.0)
    assert (
        mangin.replace_glass(0, "SF1").index()[1:3].tolist()
        == [Glass.named("SF1").index(0.5875618)] * 2
    )
    # so its index and the mirrored back, one row each, may vary
    back = mangin.variables("curvature", "index", mask={"curvature": [False, True, False]})
    assert [len(v) for v in back] == [1, 1]


def in_frames(geo, errors):
    """Rows of ``by_frames`` of a lens whose elements (first and last face) have a decentre, a tilt
    and a wedge [3, 2]: the last face is turned about its vertex, the body about its first vertex,
    and shifted."""
    media = geo.index().tolist()[1:]
    thickness = geo.thickness_mm.tolist()
    rows = list(zip(media, thickness, geo.curvature_per_mm.tolist(), strict=True))
    for (first, last), moved in reversed(errors.items()):
        shift, tilt, wedge = moved.tolist()
        tilt, wedge = np.degrees(tilt), np.degrees(wedge)
        length = sum(thickness[first:last])
        medium, gap, curvature = rows[last]
        rows[last : last + 1] = [
            ("break", 0.0, 0.0, 0.0, *wedge, 0.0, 0),
            (medium, 0.0, curvature),
            ("break", -length, 0.0, 0.0, *-wedge, 0.0, 1),
            ("break", length + gap, -shift[0], -shift[1], *-tilt, 0.0, 1),
        ]
        rows.insert(first, ("break", 0.0, *shift, *tilt, 0.0, 0))
    return rows


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
def test_moved_elements_are_rigid_bodies(name, generator):
    """Three elements one after another, with errors a hundred times those of a workshop."""
    geo = lens.load(name).freeze()
    size = f64([[0.3], [0.03], [0.02]])
    errors = {
        faces: torch.randn(3, 2, generator=generator).double() * size for faces in groups(geo)[:3]
    }
    moved = geo
    for faces, error in errors.items():
        moved = moved_element(moved, faces, *error)
    starts = f64([(0.0, 0.0, -5.0), (2.5, -1.5, -5.0), (-1.0, 3.0, -5.0)])
    towards = torch.nn.functional.normalize(f64([[0.02, 0.1, 1.0]] * 3), dim=1)
    out = moved.trace(starts, towards)
    rows = in_frames(geo, errors)
    truth = np.array(
        [by_frames(rows, *ray) for ray in zip(starts.numpy(), towards.numpy(), strict=True)]
    )
    # both programs agree to some 1e-13 mm on the lens at rest
    close(out.position_mm[:, :2], truth[:, 0, :2].astype(float), atol=2e-12)
    close(out.direction, truth[:, 1].astype(float), atol=2e-14)
    assert (out.position_mm - geo.trace(starts, towards).position_mm).abs().max() > 0.05


@pytest.mark.parametrize("size", [0.01, 0.0])
def test_errors_of_an_element_have_gradients(size, triplet, generator):
    """At rest too, where the kernel would leave decentres out."""
    rays = rim_rays(triplet, (0.1,), count=5)
    weights = randn64(generator, 6, 3)
    start = size * randn64(generator, 3, 2)

    def loss(errors):
        return (moved_element(triplet, (2, 3), *errors).trace(*rays).position_mm * weights).sum()

    check_gradient(loss, start, step=1e-4 if size == 0 else 1e-3)


@pytest.fixture(scope="module")
def doublet():
    """A cemented crown and flint."""
    faces = (
        Surface(40.0, 6.0, CROWN, 8.0),
        Surface(-30.0, 2.0, FLINT, 8.0),
        Surface(-120.0, 80.0, None, 8.0),
    )
    return GeoLens(faces, 8.0).freeze()


def rows(geo):
    return [
        (s.radius_mm, s.thickness_mm, s.medium and s.medium.name, s.is_stop)
        for s in geo.to_surfaces()
    ]
