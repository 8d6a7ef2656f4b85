"""System matrix, cardinal points, paraxial rays and defocus against closed forms."""

import math

import pytest
import torch

from codesign.lens import GeoLens, Glass, Surface, analysis
from codesign.lens.paraxial import (
    cardinal_points,
    first_order,
    system_matrix,
)
from codesign.lens.seidel import seidel_sums
from codesign.lens.surface import Phase
from tests.lens.systems import PLANE, check_gradient, close, glass
from tests.numbers import D, f64


def thick(radius_a=60.0, radius_b=-90.0, thickness=8.0, n=1.6):
    surfaces = (
        Surface(radius_a, thickness, glass(n), 9.0, is_stop=True),
        Surface(radius_b, 50.0, None, 9.0),
    )
    return GeoLens(surfaces, 10.0)


def test_matrix_of_a_thick_lens():
    n = 1.6
    t = 8.0
    a = (n - 1) / 60.0
    b = (1 - n) / -90.0
    # Gullstrand
    truth = f64([[1 - a * t / n, t / n], [-(a + b - a * b * t / n), 1 - b * t / n]])
    close(system_matrix(thick()), truth, 1e-14, atol=1e-16)


def test_cardinal_points_of_a_ball_in_air():
    # both principal and both nodal points of a ball lie in its centre; f = n R / 2 (n - 1)
    R, n = 10.0, 1.5
    points = cardinal_points(thick(R, -R, 2 * R, n))
    found = values(
        points, "front_principal_z_mm front_nodal_z_mm rear_principal_z_mm rear_nodal_z_mm"
    )
    close(found, [R, R, -R, -R], 1e-13)
    close(points.rear_focal_length_mm, n * R / (2 * (n - 1)), 1e-13)


def test_an_eye_has_its_nodal_points_apart_from_its_principal_points():
    # one refracting surface into n': principal points on it, nodal points in its centre, focal
    # lengths R / (n' - 1) and n' R / (n' - 1)
    R, n = 5.55, 4 / 3
    points = cardinal_points(GeoLens([Surface(R, 22.2, glass(n), 3.0, is_stop=True)], 3.0))
    names = "front_principal_z_mm rear_principal_z_mm front_nodal_z_mm rear_nodal_z_mm"
    close(values(points, names), [0, 0, R, R], 1e-12, atol=1e-13)
    found = values(points, "front_focal_length_mm rear_focal_z_mm front_focal_z_mm")
    close(found, [R / (n - 1), n * R / (n - 1), -R / (n - 1)], 1e-13)


@pytest.mark.parametrize("before", [1.0, 4 / 3])
def test_pupils_of_a_stop_between_two_surfaces_by_gauss(before):
    # n' / s' - n / s = power at each surface, s and s' of the stop and its image from the vertex;
    # the image is n s' / (n' s) times as large
    n = 1.6
    after = 1.2
    front, back = 6.0, 9.0
    powers = [(n - before) / 40.0, (after - n) / -25.0]
    entrance = before / (n / front - powers[0])
    exit_z = after / (powers[1] - n / back)
    found = first_order(
        f64([powers[0], 0.0, powers[1]]),
        f64([front, back, 50.0]),
        f64([before, n, n, after]),
        1,
        10.0,
    )
    stop = 5.0 / abs(n * entrance / (before * front))
    close(found.entrance_pupil_z_mm, entrance, 1e-13)
    close(found.stop_semi_aperture_mm, stop, 1e-13)
    close(found.exit_pupil_z_mm, exit_z, 1e-13)
    size = abs(n * exit_z / (after * back))
    close(found.exit_pupil_diameter_mm, 2 * stop * size, 1e-13)


def values(points, names):
    return [getattr(points, name).item() for name in names.split()]


@pytest.mark.parametrize("conic", [0.0, -1.0, -0.4])
def test_a_mirror_with_the_stop_on_it(conic):
    # y^4 (1 + k) / 4 f^3, y^3 u / 2 f^2, H^2 / f, -H^2 / f, 0 (Schroeder, Astronomical Optics, ch.
    # 5; Welford, ch. 8)
    field = math.radians(0.7)
    y, f, u = 10.0, 100.0, math.tan(field)
    mirror = GeoLens(
        [Surface(-2 * f, f, None, 30.0, conic=conic, is_stop=True, mirror=True)], 2 * y
    )
    H2 = (y * u) ** 2
    truth = [y**4 * (1 + conic) / (4 * f**3), -(y**3) * u / (2 * f**2), H2 / f, -H2 / f, 0.0]
    check_total(mirror, field, truth, 1e-13)


@pytest.mark.parametrize("distance", [0.0, 12.0])
def test_a_flat_diffractive_lens(distance):
    # phase r^2 alone, stop on it: S_I = y^4 / f^3, S_II = y^3 u / f^2 in size, S_III = H^2 / f,
    # S_IV = S_V = 0 (Buralli and Morris, Applied Optics 28, 1989)
    f, y, u = 100.0, 5.0, math.tan(0.05)
    phase = Phase((-math.pi / (0.5875618e-3 * f),))
    flat = Surface(PLANE, f, None, 9.0, is_stop=distance == 0, phase=phase)
    geo = stopped(distance, flat, diameter=2 * y) if distance else GeoLens([flat], 2 * y)
    if not distance:
        check_total(geo, 0.05, [y**4 / f**3, -(y**3) * u / f**2, (y * u) ** 2 / f, 0.0, 0.0])
    # a thin lens behind its stop: C_II = C_I times the chief ray's height over the marginal ray's
    # (Welford, ch. 10)
    axial = y * y / f / DIFFRACTIVE_ABBE
    close(colour(geo, 0.05), [axial, axial * distance * u / y], 1e-12, atol=1e-17)


def test_axial_colour_of_a_thin_lens():
    crown = Glass.named("N-BK7")
    surfaces = Surface(80.0, 0.0, crown, 9.0, is_stop=True), Surface(-120.0, 90.0, None, 9.0)
    thin = GeoLens(surfaces, 10.0)
    axial = 25.0 / thin.first_order().efl_mm.item() / crown.abbe_number
    # the stop is on it
    close(colour(thin, 0.1), [axial, 0.0], 1e-12, atol=1e-17)


def everything():
    """A stop in front, a conic asphere, a diffractive curved surface, and a mirror."""
    glass = Glass.named("N-BK7")
    return [
        Surface(math.inf, 12.0, None, 9.0, is_stop=True),
        Surface(90.0, 4.0, glass, 9.0, conic=-0.7, asphere=(0.0003, 2e-7)),
        Surface(-300.0, 30.0, None, 9.0, phase=Phase((-2.0, 4e-4))),
        Surface(-400.0, 40.0, None, 20.0, conic=-1.5, asphere=(0.0, 1e-8), mirror=True),
    ]


def test_sums_are_the_leading_terms_of_the_traced_wavefront():
    # on the paraxial focus; aperture and field a and a / 2 so small that Richardson's rule leaves
    # (y / f)^4, 1e-7
    def parts(scale):
        diameter = 4.0 * scale
        field = 0.02 * scale
        geo = GeoLens(everything(), diameter)
        with torch.no_grad():
            geo.thickness_mm[-1] = geo.first_order().bfl_mm
            pupil = f64([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0]])
            axis, off = (
                analysis.wavefront(geo, angle, pupil=pupil).opd_mm for angle in (0.0, field)
            )
            s1, s2, s3, s4, _ = seidel_sums(geo, field).total
        spherical = axis[0] / (s1 / 8)
        coma = (off[0] - off[1]) / 2 / (s2 / 2)
        tangential = ((off[0] + off[1]) / 2 - axis[0]) / (s3 / 2 + (s3 + s4) / 4)
        sagittal = (off[2] - axis[2]) / ((s3 + s4) / 4)
        return torch.stack([spherical, coma, tangential, sagittal])

    coarse = parts(1.0)
    fine = parts(0.5)
    assert (coarse - 1).abs().max() < 0.05
    close((4 * fine - coarse) / 3, torch.ones(4, dtype=D), atol=2e-5)


def check_total(geo, field, truth, rel=1e-12, atol=1e-17):
    close(seidel_sums(geo, field).total, truth, rel, atol=atol)


def stopped(distance_mm, *surfaces, diameter=10.0):
    """Surfaces behind a stop in air."""
    return GeoLens([Surface(PLANE, distance_mm, None, 12.7, is_stop=True), *surfaces], diameter)


# its Abbe number is d / (F - C) = -3.452: power grows with the wavelength
DIFFRACTIVE_ABBE = 0.5875618 / (0.4861327 - 0.6562725)


def colour(geo, field):
    sums = seidel_sums(geo, field)
    return [sums.axial_colour.sum().item(), sums.lateral_colour.sum().item()]


def test_gradients_against_differences():
    geo = GeoLens(everything(), 8.0)
    weight = f64([1.0, 0.7, -0.4, 0.3, 0.9])
    names = geo.parameter_names

    def loss(*values):
        return (
            seidel_sums(geo.replace(**dict(zip(names, values, strict=True))), 0.1).total * weight
        ).sum()

    check_gradient(loss, *(getattr(geo, name) for name in names), step=1e-5)
