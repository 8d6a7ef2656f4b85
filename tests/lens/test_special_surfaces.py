"""Mirrors, diffractive phases, decentred and tilted surfaces, obstructions: closed forms, symmetry, and
differences."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.surface import Phase, scaled
from codesign.lens.trace import Status, trace

F64 = torch.float64
GLASS = Glass.from_indices(1.6, 1.6, 1.6)


def number(tensor):
    return tensor.detach().item()


def parallel_rays(points, z=-1.0, angle=0.0):
    across = torch.tensor(points, dtype=F64)
    origin = torch.cat([across, torch.full_like(across[:, :1], z)], 1)
    return origin, torch.tensor([[0.0, math.sin(angle), math.cos(angle)]], dtype=F64).expand_as(
        origin
    ).contiguous()


RING = [(0.5, 0.0), (0.0, 9.0), (-4.0, 7.0), (12.0, -3.0)]


def test_a_paraboloid_focuses_every_ray_at_equal_path():
    mirror = GeoLens([Surface(-200.0, 100.0, None, 20.0, conic=-1.0, mirror=True)], 30.0)
    origin, direction = parallel_rays(RING)
    out = mirror.trace(origin, direction)
    torch.testing.assert_close(out.position_mm, torch.zeros_like(origin), rtol=0, atol=1e-13)
    torch.testing.assert_close(out.optical_path_mm, torch.full((4,), 101.0, dtype=F64), rtol=0, atol=1e-12)
    assert number(mirror.first_order().efl_mm) == pytest.approx(100.0, rel=1e-14)


def test_a_spherical_mirror_has_the_closed_form_focus():
    """A ray at height h crosses the axis R (1 - 1 / (2 cos a)) from the vertex, sin a = h / R."""
    radius = 200.0
    height = 60.0
    mirror = GeoLens([Surface(-radius, 100.0, None, 80.0, mirror=True)], 30.0)
    origin, direction = parallel_rays([(0.0, height)])
    out = mirror.trace(origin, direction)
    slope = out.direction[0, 1] / out.direction[0, 2]
    crossing = 100.0 - number(out.position_mm[0, 1] / slope)
    assert crossing == pytest.approx(radius * (1 - 1 / (2 * math.cos(math.asin(height / radius)))), rel=1e-13)


def test_a_cassegrain_has_its_closed_form_focus_and_no_spherical_aberration():
    """Paraboloid f1 = 100 and hyperboloid secondary that relays its focus 3x: k = -((m + 1) / (m - 1))^2,
    unfolded signs."""
    f1 = 100.0
    m = 3.0
    gap = 75.0
    p = f1 - gap
    radius = 2 * p * m / (m - 1)
    cassegrain = GeoLens(
        [
            Surface(-2 * f1, gap, None, 30.0, conic=-1.0, mirror=True),
            Surface(radius, p * m, None, 10.0, conic=-(((m + 1) / (m - 1)) ** 2), mirror=True),
        ],
        40.0,
    )
    assert number(cassegrain.first_order().efl_mm) == pytest.approx(m * f1, rel=1e-13)
    origin, direction = parallel_rays(RING)
    out = cassegrain.trace(origin, direction)
    torch.testing.assert_close(out.position_mm, torch.zeros_like(origin), rtol=0, atol=1e-12)
    torch.testing.assert_close(out.optical_path_mm, out.optical_path_mm[:1].expand(4), rtol=0, atol=1e-12)


def mangin():
    return GeoLens(
        [
            Surface(-150.0, 6.0, GLASS, 25.0),
            Surface(-230.0, 6.0, GLASS, 25.0, mirror=True),
            Surface(150.0, 120.0, None, 25.0),
        ],
        30.0,
    )


def odd_lens():
    return GeoLens(
        [
            Surface(
                60.0,
                5.0,
                GLASS,
                15.0,
                conic=-0.4,
                asphere=(0.0, 1e-6),
                decentre_mm=(0.2, -0.1),
                tilt_deg=(1.0, -2.0),
            ),
            Surface(-90.0, 2.0, None, 15.0),
            Surface(math.inf, 3.0, GLASS, 15.0, phase=Phase((-0.2, 1e-4))),
            Surface(-300.0, 70.0, None, 15.0, tilt_deg=(-0.5, 0.7)),
        ],
        20.0,
    )


@pytest.mark.parametrize("make", [mangin, odd_lens])
def test_light_goes_back_the_way_it_came(make):
    geo = make()
    origin, direction = parallel_rays([(0.5, 0.0), (0.0, 6.0), (-4.0, 5.0)], angle=0.05)
    out = geo.trace(origin, direction)
    assert out.status.tolist() == [0, 0, 0]
    back = geo.prescription().reversed(torch.ones((), dtype=F64))
    flip = torch.tensor([1.0, 1.0, -1.0], dtype=F64)
    start = out.position_mm - torch.tensor([0.0, 0.0, 1.0], dtype=F64) * geo.thickness_mm[-1]
    found = trace(back, start.detach(), (-out.direction * flip).detach())
    assert found.status.tolist() == [0, 0, 0]
    torch.testing.assert_close(found.position_mm[:, :2], origin[:, :2], rtol=0, atol=1e-12)
    torch.testing.assert_close(-found.direction * flip, direction, rtol=0, atol=1e-13)
    torch.testing.assert_close(found.optical_path_mm, out.optical_path_mm, rtol=0, atol=1e-11)


def test_rays_that_end_on_a_diffractive_surface_are_not_bent_by_it():
    """As when the stop carries the phase: ``until`` stops on the surface, with the geometric path alone."""
    plate = GeoLens(
        [Surface(math.inf, 4.0, GLASS, 9.0), Surface(math.inf, 30.0, None, 9.0, phase=Phase((-40.0, 0.3)))],
        6.0,
    )
    origin, direction = parallel_rays([(1.0, 3.0), (-2.0, 0.5)], angle=0.2)
    out = trace(plate.prescription().until(1), origin, direction)
    sine = math.sin(0.2) / 1.6
    cosine = math.sqrt(1 - sine**2)
    truth = torch.tensor([0.0, sine, cosine], dtype=F64).expand(2, 3)
    torch.testing.assert_close(out.direction, truth, rtol=0, atol=1e-15)
    path = 1 / math.cos(0.2) + 1.6 * 4 / cosine
    torch.testing.assert_close(out.optical_path_mm, torch.full((2,), path, dtype=F64), rtol=1e-14, atol=0)


def test_the_path_back_out_of_glass_is_the_path_in():
    """A film in glass: the reversed lens begins in it, and light takes the same path both ways (Fermat)."""
    eye = GeoLens(
        [Surface(20.0, 4.0, GLASS, 9.0), Surface(35.0, 30.0, Glass.from_indices(1.4, 1.4, 1.4), 9.0)], 6.0
    )
    origin, direction = parallel_rays([(0.5, 0.0), (0.0, 3.0), (-2.0, 2.5)], angle=0.05)
    out = eye.trace(origin, direction)
    back = eye.prescription().reversed(torch.ones((), dtype=F64))
    flip = torch.tensor([1.0, 1.0, -1.0], dtype=F64)
    start = out.position_mm - torch.tensor([0.0, 0.0, 1.0], dtype=F64) * eye.thickness_mm[-1]
    found = trace(back, start.detach(), (-out.direction * flip).detach())
    torch.testing.assert_close(found.position_mm[:, :2], origin[:, :2], rtol=0, atol=1e-12)
    torch.testing.assert_close(found.optical_path_mm, out.optical_path_mm, rtol=0, atol=1e-11)


def test_the_grating_equation_on_a_plane():
    """sin(out) = sin(in) + m w dphi/dr / (2 pi), and the optical path gains m w phi / (2 pi)."""
    coefficients = (-30.0, 0.04)
    order = 2
    wavelength_um = 0.65
    angle = 0.1
    height = 3.0
    plate = GeoLens([Surface(math.inf, 10.0, None, 8.0, phase=Phase(coefficients, order))], 6.0)
    origin, direction = parallel_rays([(0.0, height)], z=0.0, angle=angle)
    out = plate.trace(origin, direction, wavelength_um)
    turn = order * wavelength_um * 1e-3 / (2 * math.pi)
    sine = math.sin(angle) + turn * (2 * coefficients[0] * height + 4 * coefficients[1] * height**3)
    assert number(out.direction[0, 1]) == pytest.approx(sine, abs=1e-15)
    path = turn * (coefficients[0] * height**2 + coefficients[1] * height**4) + 10 / math.sqrt(1 - sine**2)
    assert number(out.optical_path_mm[0]) == pytest.approx(path, rel=1e-14)


def test_a_diffractive_lens_has_its_focal_length_and_disperses_by_wavelength():
    """phi = -pi r^2 / (w0 f) focuses w0 at f, and w at f w0 / w: the Abbe number of diffraction is -3.45."""
    blaze = 0.55
    focal = 80.0
    flat = GeoLens(
        [Surface(math.inf, focal, None, 5.0, phase=Phase((-math.pi / (blaze * 1e-3 * focal),), 1, blaze))],
        6.0,
    )
    for wavelength_um in (0.45, 0.55, 0.65):
        assert number(flat.first_order(wavelength_um).efl_mm) == pytest.approx(
            focal * blaze / wavelength_um, rel=1e-13
        )
    origin, direction = parallel_rays([(0.0, 1e-4)], z=0.0)
    out = flat.trace(origin, direction, blaze)
    assert number(out.position_mm[0, 1]) == pytest.approx(0.0, abs=1e-15)
    assert number(out.weight[0]) == 1.0
    x = math.pi * (blaze / 0.65 - 1)
    assert number(flat.trace(origin, direction, 0.65).weight[0]) == pytest.approx(
        (math.sin(x) / x) ** 2, rel=1e-14
    )


def test_an_evanescent_order_is_total_reflection():
    grating = GeoLens([Surface(math.inf, 10.0, None, 50.0, phase=Phase((-3000.0,)))], 6.0)
    origin, direction = parallel_rays([(0.0, 0.5), (0.0, 40.0)], z=0.0)
    out = grating.trace(origin, direction)
    assert out.status.tolist() == [Status.OK, Status.TOTAL_REFLECTION]
    assert number(out.deficit[1]) > 0
    assert number(out.weight[1]) == 0


def test_a_tilted_plate_displaces_the_ray_by_its_closed_form():
    """A plate turned by a about x displaces the axial ray by t sin(a) (1 - cos(a) / sqrt(n^2 - sin^2 a)),
    along +y or -y with the sense of the turn."""
    a = 30.0
    thick = 5.0
    n = 1.6
    sine = math.sin(math.radians(a))
    cosine = math.cos(math.radians(a))
    # both faces turn about their own vertices; the distance between the parallel planes is then t cos(a)
    plate = GeoLens(
        [
            Surface(math.inf, thick, GLASS, 10.0, tilt_deg=(a, 0.0)),
            Surface(math.inf, 20.0, None, 10.0, tilt_deg=(a, 0.0)),
        ],
        4.0,
    )
    origin, direction = parallel_rays([(0.0, 0.0)])
    out = plate.trace(origin, direction)
    torch.testing.assert_close(out.direction, direction, rtol=0, atol=1e-15)
    expected = thick * cosine * sine * (1 - cosine / math.sqrt(n**2 - sine**2))
    assert abs(number(out.position_mm[0, 1])) == pytest.approx(expected, rel=1e-13)
    # the normal of a face turned by +a about x is (0, -sin a, cos a): the ray is bent towards it, hence
    # towards -y
    assert number(out.position_mm[0, 1]) < 0
    other = GeoLens([replace(s, tilt_deg=(0.0, a)) for s in plate.surfaces], 4.0).trace(origin, direction)
    assert number(other.position_mm[0, 0]) == pytest.approx(
        expected, rel=1e-13
    )  # about y the normal turns to +x


def test_a_decentred_lens_is_a_centred_one_seen_from_aside():
    surfaces = [Surface(40.0, 4.0, GLASS, 12.0, conic=0.3), Surface(-70.0, 50.0, None, 12.0)]
    centred = GeoLens(surfaces, 10.0)
    shifted = GeoLens([replace(s, decentre_mm=(0.7, -0.4)) for s in surfaces], 10.0)
    origin, direction = parallel_rays(RING[:3], angle=0.03)
    move = torch.tensor([0.7, -0.4, 0.0], dtype=F64)
    torch.testing.assert_close(
        shifted.trace(origin + move, direction).position_mm,
        centred.trace(origin, direction).position_mm + move,
        rtol=0,
        atol=1e-13,
    )


def test_turning_a_sphere_about_its_centre_changes_nothing():
    """A tilt a of a sphere of radius R about its vertex, with the decentre that returns its centre to the
    axis, leaves the rays where they were."""
    radius = 500.0
    a = 0.4
    shift = radius * math.sin(math.radians(a))
    sink = radius * (1 - math.cos(math.radians(a)))
    plain = GeoLens([Surface(radius, 6.0, GLASS, 40.0), Surface(-80.0, 60.0, None, 40.0)], 10.0)
    turned = GeoLens(
        [
            Surface(radius, 6.0 - sink, GLASS, 40.0, tilt_deg=(a, 0.0), decentre_mm=(0.0, shift)),
            Surface(-80.0, 60.0, None, 40.0),
        ],
        10.0,
    )
    origin, direction = parallel_rays(RING[:3], angle=0.02)
    moved = origin - torch.tensor([0.0, 0.0, sink], dtype=F64)
    torch.testing.assert_close(
        turned.trace(moved, direction).position_mm,
        plain.trace(origin, direction).position_mm,
        rtol=0,
        atol=1e-12,
    )


def test_an_obstruction_blocks_the_middle_with_a_soft_edge():
    ring = GeoLens(
        [Surface(-200.0, 100.0, None, 20.0, conic=-1.0, mirror=True, inner_semi_aperture_mm=5.0)],
        30.0,
        soft_edge_mm=0.2,
    )
    origin, direction = parallel_rays([(0.0, 0.0), (0.0, 4.85), (0.0, 5.0), (0.0, 5.15), (0.0, 12.0)])
    weight = ring.trace(origin, direction).weight
    assert weight.tolist() == [0.0, 0.0, pytest.approx(0.5, abs=1e-12), 1.0, 1.0]


@pytest.mark.parametrize(
    "name", ["decentre_mm", "tilt_rad", "phase", "curvature_per_mm", "thickness_mm", "conic"]
)
def test_gradients_agree_with_differences(name):
    """Central differences of step h err by h^2 times the third derivative: 1e-8 relative at these sizes."""
    geo = odd_lens()
    origin, direction = parallel_rays([(0.5, 0.3), (0.2, 6.0), (-4.0, 5.0)], angle=0.05)
    value = getattr(geo, name).detach().clone().requires_grad_(True)
    probe = torch.linspace(0.3, 1.7, 9, dtype=F64).reshape(3, 3)

    def merit(v):
        out = geo.replace(**{name: v}).trace(origin, direction)
        return (
            (out.position_mm * probe).sum()
            + (out.direction * probe.flip(0)).sum()
            + out.optical_path_mm.sum()
        )

    (gradient,) = torch.autograd.grad(merit(value), value)
    step = 1e-4 if name in ("decentre_mm", "thickness_mm", "phase") else 1e-5
    with torch.no_grad():
        for at in range(value.numel()):
            shift = torch.zeros_like(value).reshape(-1)
            shift[at] = step
            difference = (
                merit(value + shift.reshape(value.shape)) - merit(value - shift.reshape(value.shape))
            ) / (2 * step)
            assert number(gradient.reshape(-1)[at]) == pytest.approx(
                difference.item(), rel=2e-6, abs=2e-6 * gradient.abs().max().item()
            )


def test_mirrors_take_the_index_before_them_and_scale():
    geo = mangin()
    assert geo.index().tolist() == [1.0, 1.6, 1.6, 1.0]
    assert number(geo.scaled(0.5).first_order().efl_mm) == pytest.approx(
        0.5 * number(geo.first_order().efl_mm), rel=1e-13
    )
    flat = GeoLens([scaled(Surface(math.inf, 80.0, None, 5.0, phase=Phase((-3.0, 0.1))), 2.0)], 6.0)
    assert flat.phase.tolist() == [[-0.75, 0.1 / 16]]


@pytest.mark.parametrize(
    ("surface", "sentence"),
    [
        (Surface(50.0, 5.0, None, 5.0, inner_semi_aperture_mm=6.0), "central obstruction of 6.0 mm"),
        (Surface(50.0, 5.0, None, 5.0, tilt_deg=(95.0, 0.0)), "must stay below 90"),
        (Surface(50.0, 5.0, None, 5.0, phase=Phase(())), "needs finite coefficients"),
        (Surface(50.0, 5.0, None, 5.0, phase=Phase((1.0,), 1, -0.5)), "blaze wavelength -0.5"),
        (Surface(50.0, 5.0, None, 5.0, mirror=True, phase=Phase((1.0,))), "phase on a mirror is not traced"),
        (Surface(50.0, 5.0, None, 5.0, decentre_mm=(math.nan, 0.0)), "must be finite"),
    ],
)
def test_surfaces_that_cannot_be_are_refused(surface, sentence):
    with pytest.raises(DomainError, match=sentence):
        lens.GeoLens([surface], 4.0)
