"""Surfaces of every kind against closed forms and symmetries: conics, aspheres, mirrors, diffractive
phases, decentres, tilts, obstructions. Their gradients: `studies.stability.coincidences`."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Phase, Status, Surface
from codesign.lens.diffraction import ZernikePlate, with_plate
from codesign.lens.trace import _active, trace
from tests.lens.systems import PLANE, close, efl, glass
from tests.numbers import f64

N = 1.6
GLASS = glass(N)
MANGIN = GeoLens(
    [
        Surface(-150.0, 6.0, GLASS, 25.0),
        Surface(-230.0, 6.0, GLASS, 25.0, mirror=True),
        Surface(150.0, 120.0, None, 25.0),
    ],
    30.0,
)
ODD = GeoLens(
    [
        Surface(
            60.0, 5.0, GLASS, 15.0, -0.4, (0.0, 1e-6), decentre_mm=(0.2, -0.1), tilt_deg=(1.0, -2.0)
        ),
        Surface(-90.0, 2.0, None, 15.0),
        Surface(PLANE, 3.0, GLASS, 15.0, phase=Phase((-0.2, 1e-4))),
        Surface(-300.0, 70.0, None, 15.0, tilt_deg=(-0.5, 0.7)),
    ],
    20.0,
)
# a film in glass: the reversed lens begins in it
EYE = GeoLens([Surface(20.0, 4.0, GLASS, 9.0), Surface(35.0, 30.0, glass(1.4), 9.0)], 6.0)


# an asphere with a conic, and one that hides in glass
ASPHERIC = GeoLens(
    [
        Surface(30.0, 5.0, GLASS, 12.0, conic=-0.6, asphere=(1e-4, -2e-6, 3e-8), is_stop=True),
        Surface(-50.0, 40.0, None, 12.0, conic=0.4, asphere=(0.0, 1e-6)),
    ],
    8.0,
)


def parallel_rays(points, z=-1.0, angle=0.0):
    across = f64(points)
    origin = torch.cat([across, torch.full_like(across[:, :1], z)], 1)
    return origin, f64([[0.0, math.sin(angle), math.cos(angle)]] * len(points))


RING = [(0.5, 0.0), (0.0, 9.0), (-4.0, 7.0), (12.0, -3.0)]


def test_a_cassegrain_has_its_closed_form_focus_and_no_spherical_aberration():
    """Paraboloid f1 = 100 and hyperboloid secondary that relays its focus 3x: k = -((m + 1) /
    (m - 1))^2, unfolded signs."""
    f1, m, gap = 100.0, 3.0, 75.0
    p = f1 - gap
    conic = -(((m + 1) / (m - 1)) ** 2)
    primary = Surface(-2 * f1, gap, None, 30.0, conic=-1.0, mirror=True)
    geo = GeoLens(
        [primary, Surface(2 * p * m / (m - 1), p * m, None, 10.0, conic, mirror=True)], 40.0
    )
    close(efl(geo), m * f1, 1e-13)
    out = geo.trace(*parallel_rays(RING))
    close(out.position_mm, 0.0, atol=1e-12)
    close(out.optical_path_mm, out.optical_path_mm[0], atol=1e-12)


def test_rays_that_end_on_a_diffractive_surface_are_not_bent_by_it():
    """As when the stop carries the phase: ``until`` stops on the surface, with the geometric path
    alone."""
    ruled = Surface(PLANE, 30.0, None, 9.0, phase=Phase((-40.0, 0.3)))
    plate = GeoLens([Surface(PLANE, 4.0, GLASS, 9.0), ruled], 6.0)
    out = trace(plate.prescription().until(1), *parallel_rays([(1.0, 3.0), (-2.0, 0.5)], angle=0.2))
    sine = math.sin(0.2) / 1.6
    cosine = math.sqrt(1 - sine**2)
    close(out.direction, [0.0, sine, cosine], atol=1e-15)
    close(out.optical_path_mm, 1 / math.cos(0.2) + 1.6 * 4 / cosine, atol=1e-13)


def test_the_grating_equation_on_a_plane():
    """sin(out) = sin(in) + m w dphi/dr / (2 pi), and the optical path gains m w phi / (2 pi)."""
    a, b = -30.0, 0.04
    order, wavelength_um, angle, y = 2, 0.65, 0.1, 3.0
    plate = GeoLens([Surface(PLANE, 10.0, None, 8.0, phase=Phase((a, b), order))], 6.0)
    out = plate.trace(*parallel_rays([(0.0, y)], z=0.0, angle=angle), wavelength_um)
    turn = order * wavelength_um * 1e-3 / (2 * math.pi)
    sine = math.sin(angle) + turn * (2 * a * y + 4 * b * y**3)
    close(out.direction[0, 1], sine, atol=1e-15)
    path = turn * (a * y**2 + b * y**4) + 10 / math.sqrt(1 - sine**2)
    close(out.optical_path_mm[0], path, 1e-14)


def test_a_diffractive_lens_has_its_focal_length_and_disperses_by_wavelength():
    """phi = -pi r^2 / (w0 f) focuses w0 at f, and w at f w0 / w: the Abbe number of diffraction is
    -3.45."""
    blaze, focal = 0.55, 80.0
    phase = Phase((-math.pi / (blaze * 1e-3 * focal),), 1, blaze)
    flat = GeoLens([Surface(PLANE, focal, None, 5.0, phase=phase)], 6.0)
    for wavelength_um in (0.45, 0.55, 0.65):
        found = flat.first_order(wavelength_um).efl_mm
        close(found, focal * blaze / wavelength_um, 1e-13)
    rays = parallel_rays([(0.0, 1e-4)], z=0.0)
    out = flat.trace(*rays, blaze)
    close(out.position_mm[0, 1], 0.0, atol=1e-15)
    assert out.weight.item() == 1.0
    x = math.pi * (blaze / 0.65 - 1)
    close(flat.trace(*rays, 0.65).weight, (math.sin(x) / x) ** 2, 1e-14)


def test_an_evanescent_order_is_total_reflection():
    grating = GeoLens([Surface(PLANE, 10.0, None, 50.0, phase=Phase((-3000.0,)))], 6.0)
    out = grating.trace(*parallel_rays([(0.0, 0.5), (0.0, 40.0)], z=0.0))
    assert out.status.tolist() == [Status.OK, Status.TOTAL_REFLECTION]
    assert out.deficit[1].item() > 0
    assert out.weight[1].item() == 0


# the normal of a face turned by +a about x is (0, -sin a, cos a): the ray is bent towards it, hence
# towards -y; about y the normal turns to +x
@pytest.mark.parametrize(("tilt_deg", "axis", "sign"), [((30.0, 0.0), 1, -1), ((0.0, 30.0), 0, 1)])
def test_a_tilted_plate_displaces_the_ray_by_its_closed_form(tilt_deg, axis, sign):
    """A plate turned by a displaces the axial ray by t sin(a) (1 - cos(a) /
    sqrt(n^2 - sin^2 a))."""
    sine, cosine = math.sin(math.radians(30)), math.cos(math.radians(30))
    faces = (
        Surface(PLANE, gap, medium, 10.0, tilt_deg=tilt_deg)
        for gap, medium in ((5.0, GLASS), (20.0, None))
    )
    rays = parallel_rays([(0.0, 0.0)])
    out = GeoLens(faces, 4.0).trace(*rays)
    close(out.direction, rays[1], atol=1e-15)
    # both faces turn about their own vertices; the distance between the parallel planes is then t
    # cos(a)
    expected = 5.0 * cosine * sine * (1 - cosine / math.sqrt(1.6**2 - sine**2))
    close(out.position_mm[0, axis], sign * expected, 1e-13)


def test_an_obstruction_blocks_the_middle_with_a_soft_edge():
    ring = Surface(-200.0, 100.0, None, 20.0, conic=-1.0, mirror=True, inner_semi_aperture_mm=5.0)
    rays = parallel_rays([(0.0, y) for y in (0.0, 4.85, 5.0, 5.15, 12.0)])
    weight = GeoLens([ring], 30.0, soft_edge_mm=0.2).trace(*rays).weight.tolist()
    assert weight == [0.0, 0.0, pytest.approx(0.5, abs=1e-12), 1.0, 1.0]


def test_mirrors_take_the_index_before_them_and_scale():
    assert MANGIN.index().tolist() == [1.0, 1.6, 1.6, 1.0]
    close(efl(MANGIN.scaled(0.5)), 0.5 * efl(MANGIN), 1e-13)


def test_a_diffractive_lens_scales_as_a_whole():
    """In the same light: a surface alone, with powers 1/f of -2 a w / (2 pi), and every ray."""
    plain = [
        Surface(50.0, 4.0, GLASS, 9.0),
        Surface(PLANE, 80.0, None, 9.0, phase=Phase((-3, 0.1))),
    ]
    small = GeoLens(plain, 6.0)
    large = small.scaled(2.0)
    assert large.phase.tolist()[1] == [-1.5, 0.0125]
    close(efl(large), 2 * efl(small), 1e-13)
    origin, direction = parallel_rays([(0.0, 1.0), (2.0, 1.5)], angle=0.1)
    found, wanted = large.trace(2 * origin, direction), small.trace(origin, direction)
    close(found.position_mm, 2 * wanted.position_mm, atol=1e-12)


def test_a_plate_before_a_diffractive_lens_takes_nothing_of_its_efficiency():
    faces = [
        Surface(PLANE, 2.0, None, 4.0, is_stop=True),
        Surface(60.0, 4.0, GLASS, 6.0, phase=Phase((-3.0,), 1, 0.55)),
        Surface(-60.0, 45.0, None, 6.0),
    ]
    first = with_plate(GeoLens(faces, 6.0), ZernikePlate({4: 0.0}, 4.0), z_mm=-1.0)
    x = math.pi * (0.55 / 0.7 - 1)
    weight = first.trace(*parallel_rays([(0.0, 0.0)], z=-5.0), 0.7).weight
    close(weight, (math.sin(x) / x) ** 2, 1e-14)


@pytest.mark.parametrize("geo", [MANGIN, ODD, EYE, ASPHERIC, lens.load("double-gauss")])
@torch.no_grad()
def test_light_goes_back_the_way_it_came_by_the_same_path(geo):
    origin, direction = parallel_rays([(0.5, 0.0), (0.0, 3.0), (-2.0, 2.5)], angle=0.05)
    out = geo.trace(origin, direction)
    flip = f64([1.0, 1.0, -1.0])
    start = out.position_mm - f64([0.0, 0.0, 1.0]) * geo.thickness_mm[-1]
    back = trace(geo.prescription().reversed(f64(1.0)), start, -out.direction * flip)
    assert not torch.cat([out.status, back.status]).any()
    close(back.position_mm[:, :2], origin[:, :2], atol=1e-12)
    close(-back.direction * flip, direction, atol=1e-13)
    close(back.optical_path_mm, out.optical_path_mm, atol=1e-11)


def test_terms_are_computed_up_to_the_last_that_is_not_zero_or_all_for_their_gradient():
    table = f64([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, 1e-5, 0.0]])
    assert _active(table) == [0, 1, 2]
    assert _active(table.requires_grad_()) == [3, 3, 3]


@pytest.mark.parametrize("factor", [0.1, 7.3])
def test_a_scaled_lens_scales_everything(factor):
    geo = ASPHERIC.replace(index_offset=f64([0.013, 0.0]))
    close(geo.to_surfaces()[0].medium.index(0.55), N + 0.013, 1e-14)
    big = geo.scaled(factor)
    origin, direction = parallel_rays([(0.5, 3.0), (-2.0, 2.5), (0.0, 11.9)], angle=0.1)
    found, truth = big.trace(origin * factor, direction), geo.trace(origin, direction)
    close(found.position_mm, truth.position_mm * factor, 1e-11, atol=1e-12)
    close(found.direction, truth.direction, atol=1e-13)
    close(found.optical_path_mm, truth.optical_path_mm * factor, 1e-13)
    # the soft edge scales along
    close(found.weight, truth.weight, atol=1e-12)
    for name, value in vars(geo.first_order()).items():
        close(getattr(big.first_order(), name), value if name == "fno" else value * factor, 1e-13)
