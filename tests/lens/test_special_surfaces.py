"""Mirrors, diffractive phases, decentred and tilted surfaces, obstructions: closed forms, symmetry, and
differences."""

import math
from dataclasses import replace

import pytest
import torch

from codesign.lens import GeoLens, Surface
from codesign.lens.surface import Phase, scaled
from codesign.lens.trace import Status, trace
from tests.lens.systems import PLANE, check_gradient, efl, glass

D = torch.float64
GLASS = glass(1.6)
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
        Surface(60.0, 5.0, GLASS, 15.0, -0.4, (0.0, 1e-6), decentre_mm=(0.2, -0.1), tilt_deg=(1.0, -2.0)),
        Surface(-90.0, 2.0, None, 15.0),
        Surface(PLANE, 3.0, GLASS, 15.0, phase=Phase((-0.2, 1e-4))),
        Surface(-300.0, 70.0, None, 15.0, tilt_deg=(-0.5, 0.7)),
    ],
    20.0,
)
# a film in glass: the reversed lens begins in it
EYE = GeoLens([Surface(20.0, 4.0, GLASS, 9.0), Surface(35.0, 30.0, glass(1.4), 9.0)], 6.0)


def parallel_rays(points, z=-1.0, angle=0.0):
    across = torch.tensor(points, dtype=D)
    origin = torch.cat([across, torch.full_like(across[:, :1], z)], 1)
    return origin, torch.tensor([[0.0, math.sin(angle), math.cos(angle)]] * len(points), dtype=D)


RING = [(0.5, 0.0), (0.0, 9.0), (-4.0, 7.0), (12.0, -3.0)]


def test_a_paraboloid_focuses_every_ray_at_equal_path():
    mirror = GeoLens([Surface(-200.0, 100.0, None, 20.0, conic=-1.0, mirror=True)], 30.0)
    out = mirror.trace(*parallel_rays(RING))
    close(out.position_mm, 0.0, 1e-13)
    close(out.optical_path_mm, 101.0, 1e-12)
    assert efl(mirror) == pytest.approx(100.0, rel=1e-14)


def test_a_spherical_mirror_has_the_closed_form_focus():
    """A ray at height h crosses the axis R (1 - 1 / (2 cos a)) from the vertex, sin a = h / R."""
    radius, height = 200.0, 60.0
    out = GeoLens([Surface(-radius, 100.0, None, 80.0, mirror=True)], 30.0).trace(
        *parallel_rays([(0.0, height)])
    )
    crossing = 100.0 - (out.position_mm[0, 1] * out.direction[0, 2] / out.direction[0, 1]).item()
    assert crossing == pytest.approx(radius * (1 - 1 / (2 * math.cos(math.asin(height / radius)))), rel=1e-13)


def test_a_cassegrain_has_its_closed_form_focus_and_no_spherical_aberration():
    """Paraboloid f1 = 100 and hyperboloid secondary that relays its focus 3x: k = -((m + 1) / (m - 1))^2,
    unfolded signs."""
    f1, m, gap = 100.0, 3.0, 75.0
    p = f1 - gap
    conic = -(((m + 1) / (m - 1)) ** 2)
    primary = Surface(-2 * f1, gap, None, 30.0, conic=-1.0, mirror=True)
    geo = GeoLens([primary, Surface(2 * p * m / (m - 1), p * m, None, 10.0, conic, mirror=True)], 40.0)
    assert efl(geo) == pytest.approx(m * f1, rel=1e-13)
    out = geo.trace(*parallel_rays(RING))
    close(out.position_mm, 0.0, 1e-12)
    close(out.optical_path_mm, out.optical_path_mm[0].detach(), 1e-12)


@pytest.mark.parametrize("geo", [MANGIN, ODD, EYE])
@torch.no_grad()
def test_light_goes_back_the_way_it_came(geo):
    """By the same path (Fermat)."""
    origin, direction = parallel_rays([(0.5, 0.0), (0.0, 3.0), (-2.0, 2.5)], angle=0.05)
    out = geo.trace(origin, direction)
    flip = torch.tensor([1.0, 1.0, -1.0], dtype=D)
    start = out.position_mm - torch.tensor([0.0, 0.0, 1.0], dtype=D) * geo.thickness_mm[-1]
    back = trace(geo.prescription().reversed(torch.ones((), dtype=D)), start, -out.direction * flip)
    assert not out.status.any()
    assert not back.status.any()
    close(back.position_mm[:, :2], origin[:, :2], 1e-12)
    close(-back.direction * flip, direction, 1e-13)
    close(back.optical_path_mm, out.optical_path_mm, 1e-11)


def test_rays_that_end_on_a_diffractive_surface_are_not_bent_by_it():
    """As when the stop carries the phase: ``until`` stops on the surface, with the geometric path alone."""
    ruled = Surface(PLANE, 30.0, None, 9.0, phase=Phase((-40.0, 0.3)))
    plate = GeoLens([Surface(PLANE, 4.0, GLASS, 9.0), ruled], 6.0)
    out = trace(plate.prescription().until(1), *parallel_rays([(1.0, 3.0), (-2.0, 0.5)], angle=0.2))
    sine = math.sin(0.2) / 1.6
    cosine = math.sqrt(1 - sine**2)
    close(out.direction, [0.0, sine, cosine], 1e-15)
    close(out.optical_path_mm, 1 / math.cos(0.2) + 1.6 * 4 / cosine, 1e-13)


def test_the_grating_equation_on_a_plane():
    """sin(out) = sin(in) + m w dphi/dr / (2 pi), and the optical path gains m w phi / (2 pi)."""
    a, b = -30.0, 0.04
    order, wavelength_um, angle, y = 2, 0.65, 0.1, 3.0
    plate = GeoLens([Surface(PLANE, 10.0, None, 8.0, phase=Phase((a, b), order))], 6.0)
    out = plate.trace(*parallel_rays([(0.0, y)], z=0.0, angle=angle), wavelength_um)
    turn = order * wavelength_um * 1e-3 / (2 * math.pi)
    sine = math.sin(angle) + turn * (2 * a * y + 4 * b * y**3)
    assert out.direction[0, 1].item() == pytest.approx(sine, abs=1e-15)
    path = turn * (a * y**2 + b * y**4) + 10 / math.sqrt(1 - sine**2)
    assert out.optical_path_mm[0].item() == pytest.approx(path, rel=1e-14)


def test_a_diffractive_lens_has_its_focal_length_and_disperses_by_wavelength():
    """phi = -pi r^2 / (w0 f) focuses w0 at f, and w at f w0 / w: the Abbe number of diffraction is -3.45."""
    blaze, focal = 0.55, 80.0
    phase = Phase((-math.pi / (blaze * 1e-3 * focal),), 1, blaze)
    flat = GeoLens([Surface(PLANE, focal, None, 5.0, phase=phase)], 6.0)
    for wavelength_um in (0.45, 0.55, 0.65):
        found = flat.first_order(wavelength_um).efl_mm.item()
        assert found == pytest.approx(focal * blaze / wavelength_um, rel=1e-13)
    rays = parallel_rays([(0.0, 1e-4)], z=0.0)
    out = flat.trace(*rays, blaze)
    assert out.position_mm[0, 1].item() == pytest.approx(0.0, abs=1e-15)
    assert out.weight.item() == 1.0
    x = math.pi * (blaze / 0.65 - 1)
    assert flat.trace(*rays, 0.65).weight.item() == pytest.approx((math.sin(x) / x) ** 2, rel=1e-14)


def test_an_evanescent_order_is_total_reflection():
    grating = GeoLens([Surface(PLANE, 10.0, None, 50.0, phase=Phase((-3000.0,)))], 6.0)
    out = grating.trace(*parallel_rays([(0.0, 0.5), (0.0, 40.0)], z=0.0))
    assert out.status.tolist() == [Status.OK, Status.TOTAL_REFLECTION]
    assert out.deficit[1].item() > 0
    assert out.weight[1].item() == 0


# the normal of a face turned by +a about x is (0, -sin a, cos a): the ray is bent towards it, hence towards
# -y; about y the normal turns to +x
@pytest.mark.parametrize(("tilt_deg", "axis", "sign"), [((30.0, 0.0), 1, -1), ((0.0, 30.0), 0, 1)])
def test_a_tilted_plate_displaces_the_ray_by_its_closed_form(tilt_deg, axis, sign):
    """A plate turned by a displaces the axial ray by t sin(a) (1 - cos(a) / sqrt(n^2 - sin^2 a))."""
    sine, cosine = math.sin(math.radians(30)), math.cos(math.radians(30))
    faces = (
        Surface(PLANE, gap, medium, 10.0, tilt_deg=tilt_deg) for gap, medium in ((5.0, GLASS), (20.0, None))
    )
    rays = parallel_rays([(0.0, 0.0)])
    out = GeoLens(faces, 4.0).trace(*rays)
    close(out.direction, rays[1], 1e-15)
    # both faces turn about their own vertices; the distance between the parallel planes is then t cos(a)
    expected = 5.0 * cosine * sine * (1 - cosine / math.sqrt(1.6**2 - sine**2))
    assert out.position_mm[0, axis].item() == pytest.approx(sign * expected, rel=1e-13)


def test_a_decentred_lens_is_a_centred_one_seen_from_aside():
    surfaces = [Surface(40.0, 4.0, GLASS, 12.0, conic=0.3), Surface(-70.0, 50.0, None, 12.0)]
    shifted = GeoLens([replace(s, decentre_mm=(0.7, -0.4)) for s in surfaces], 10.0)
    origin, direction = parallel_rays(RING[:3], angle=0.03)
    move = torch.tensor([0.7, -0.4, 0.0], dtype=D)
    truth = GeoLens(surfaces, 10.0).trace(origin, direction).position_mm + move
    close(shifted.trace(origin + move, direction).position_mm, truth.detach(), 1e-13)


def test_turning_a_sphere_about_its_centre_changes_nothing():
    """A tilt a of a sphere of radius R about its vertex, with the decentre that returns its centre to the
    axis, leaves the rays where they were."""
    radius, a = 500.0, 0.4
    back = Surface(-80.0, 60.0, None, 40.0)
    shift, sink = radius * math.sin(math.radians(a)), radius * (1 - math.cos(math.radians(a)))
    tilted = Surface(radius, 6.0 - sink, GLASS, 40.0, tilt_deg=(a, 0.0), decentre_mm=(0.0, shift))
    origin, direction = parallel_rays(RING[:3], angle=0.02)
    plain = GeoLens([Surface(radius, 6.0, GLASS, 40.0), back], 10.0).trace(origin, direction)
    moved = origin - torch.tensor([0.0, 0.0, sink], dtype=D)
    close(
        GeoLens([tilted, back], 10.0).trace(moved, direction).position_mm, plain.position_mm.detach(), 1e-12
    )


def test_an_obstruction_blocks_the_middle_with_a_soft_edge():
    ring = Surface(-200.0, 100.0, None, 20.0, conic=-1.0, mirror=True, inner_semi_aperture_mm=5.0)
    rays = parallel_rays([(0.0, y) for y in (0.0, 4.85, 5.0, 5.15, 12.0)])
    weight = GeoLens([ring], 30.0, soft_edge_mm=0.2).trace(*rays).weight.tolist()
    assert weight == [0.0, 0.0, pytest.approx(0.5, abs=1e-12), 1.0, 1.0]


def test_gradients_agree_with_differences():
    names = ["decentre_mm", "tilt_rad", "phase", "curvature_per_mm", "thickness_mm", "conic"]
    rays = parallel_rays([(0.5, 0.3), (0.2, 6.0), (-4.0, 5.0)], angle=0.05)
    probe = torch.linspace(0.3, 1.7, 9, dtype=D).reshape(3, 3)

    def merit(*values):
        out = ODD.replace(**dict(zip(names, values, strict=True))).trace(*rays)
        return (out.position_mm * probe + out.direction * probe.flip(0)).sum() + out.optical_path_mm.sum()

    check_gradient(merit, *(getattr(ODD, name) for name in names), step=1e-3)


def test_mirrors_take_the_index_before_them_and_scale():
    assert MANGIN.index().tolist() == [1.0, 1.6, 1.6, 1.0]
    assert efl(MANGIN.scaled(0.5)) == pytest.approx(0.5 * efl(MANGIN), rel=1e-13)
    flat = GeoLens([scaled(Surface(PLANE, 80.0, None, 5.0, phase=Phase((-3.0, 0.1))), 2.0)], 6.0)
    assert flat.phase.tolist() == [[-0.75, 0.1 / 16]]


def close(found, truth, atol):
    torch.testing.assert_close(
        found.detach(), torch.as_tensor(truth, dtype=D).expand_as(found), rtol=0, atol=atol
    )
