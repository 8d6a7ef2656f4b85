"""Seidel sums against two public programs, closed forms of mirrors, plates and diffractive lenses, and the
wavefront of traced rays."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Surface, analysis
from codesign.lens.seidel import seidel_sums
from codesign.lens.surface import Phase
from tests.lens.systems import NAMES, PLANE, check_gradient, glass, half_field, reference

D = torch.float64
# sums S_I to S_V at the d line and the published half field (tangent), mm, computed with optiland, whose
# signs are the opposite ones
SUMS = {
    "cooke-triplet": (
        0.00714404257255534,
        -0.0012421319859092213,
        -0.009038348171933528,
        0.02582758981521598,
        -0.0017793089842954334,
    ),
    "double-gauss": (
        0.03030302345308658,
        -0.001829767363193388,
        -0.009508327628045347,
        0.04516700772596889,
        0.07746321091890374,
    ),
    "la1509": (
        0.022022275303298557,
        0.0010168633469865805,
        0.0012072450803430543,
        0.0008067790000802047,
        5.733970796449531e-06,
    ),
}


@pytest.mark.parametrize("name", NAMES)
def test_sums_of_published_lenses(name):
    # both in double precision; sums of parts ten times larger
    found = seidel_sums(lens.load(name), half_field(name)).total.tolist()
    assert found == pytest.approx(SUMS[name], rel=1e-11)


@pytest.mark.parametrize("name", NAMES)
def test_every_surface_of_published_lenses(name, shared):
    truth = reference(name, shared)["seidel_d"]["rayoptics_per_surface"]
    found = seidel_sums(lens.load(name), half_field(name)).per_surface.detach()
    for k, key in enumerate(("S-I", "S-II", "S-III", "S-IV", "S-V")):
        theirs = torch.tensor(truth[key], dtype=D)
        assert float((found[:, k] - theirs[:-1]).abs().max() / theirs.abs().max()) <= 1e-7
        # their chief ray is aimed to about 1e-7
        assert float(found[:, k].sum() / theirs[-1]) == pytest.approx(1, abs=1e-6)


def test_the_petzval_sum_is_that_of_the_curvatures():
    geo = lens.load("double-gauss").freeze()
    n = geo.index()
    bending = float((geo.curvature_per_mm * (1 / n[1:] - 1 / n[:-1])).sum())
    truth = -((33.33 / 2 * math.tan(half_field("double-gauss"))) ** 2) * bending
    assert float(seidel_sums(geo, half_field("double-gauss")).total[3]) == pytest.approx(truth, rel=1e-13)


@pytest.mark.parametrize("conic", [0.0, -1.0, -0.4])
def test_a_mirror_with_the_stop_on_it(conic):
    # y^4 (1 + k) / 4 f^3, y^3 u / 2 f^2, H^2 / f, -H^2 / f, 0 (Schroeder, Astronomical Optics, ch. 5;
    # Welford, ch. 8)
    field = math.radians(0.7)
    y, f, u = 10.0, 100.0, math.tan(field)
    mirror = GeoLens([Surface(-2 * f, f, None, 30.0, conic=conic, is_stop=True, mirror=True)], 2 * y)
    H2 = (y * u) ** 2
    truth = [y**4 * (1 + conic) / (4 * f**3), -(y**3) * u / (2 * f**2), H2 / f, -H2 / f, 0.0]
    check_total(mirror, field, truth, 1e-13)


def test_a_schmidt_camera_has_neither_spherical_aberration_nor_coma_nor_astigmatism():
    # the plate stands at the centre of curvature; (n - 1) a = 1 / 4 R^3 takes away the mirror's spherical
    # aberration (Schmidt)
    n, R = 1.5, 200.0
    figured = Surface(PLANE, R, None, 30.0, asphere=(0.0, 1 / (4 * R**3 * (n - 1))), is_stop=True)
    plate = Surface(PLANE, 1e-9, glass(n), 30.0), figured
    camera = GeoLens([*plate, Surface(-R, R / 2, None, 60.0, mirror=True)], 40.0)
    sums = seidel_sums(camera, math.radians(5.0)).per_surface.detach()
    of_the_sphere = float(sums[2, 0])
    assert of_the_sphere == pytest.approx(20.0**4 / (4 * 100.0**3), rel=1e-12)
    # the plate's thickness, over the radius
    assert float(sums.sum(0)[:3].abs().max()) <= 1e-9 * of_the_sphere


def test_stop_shift_equations():
    # Welford, ch. 8: Q = change of the chief ray height over the marginal height, the same on every surface
    field = math.radians(2.0)
    at_lens = lens.load("la1509")
    before = stopped(15.0, *(replace(s, is_stop=False) for s in at_lens.surfaces), diameter=20.0)
    s1, s2, s3, s4, s5 = seidel_sums(at_lens, field).total.tolist()
    Q = 15.0 * math.tan(field) / 10.0
    distortion = s5 + Q * (3 * s3 + s4) + 3 * Q * Q * s2 + Q**3 * s1
    check_total(before, field, [s1, s2 + Q * s1, s3 + 2 * Q * s2 + Q * Q * s1, s4, distortion], 1e-11)


def test_a_paraboloid_may_be_written_as_an_asphere():
    back = Surface(-80.0, 40.0, None, 9.0)
    conic = stopped(4.0, Surface(50.0, 5.0, glass(1.6), 9.0, conic=-1.0), back)
    asphere = stopped(4.0, Surface(PLANE, 5.0, glass(1.6), 9.0, asphere=(0.01,)), back)
    found, truth = (seidel_sums(geo, 0.1).per_surface for geo in (asphere, conic))
    torch.testing.assert_close(found, truth, rtol=1e-12, atol=1e-16)


@pytest.mark.parametrize("distance", [0.0, 12.0])
def test_a_flat_diffractive_lens(distance):
    # phase r^2 alone, stop on it: S_I = y^4 / f^3, S_II = y^3 u / f^2 in size, S_III = H^2 / f, S_IV = S_V =
    # 0 (Buralli and Morris, Applied Optics 28, 1989)
    f, y, u = 100.0, 5.0, math.tan(0.05)
    phase = Phase((-math.pi / (0.5875618e-3 * f),))
    flat = Surface(PLANE, f, None, 9.0, is_stop=distance == 0, phase=phase)
    geo = stopped(distance, flat, diameter=2 * y) if distance else GeoLens([flat], 2 * y)
    if not distance:
        check_total(geo, 0.05, [y**4 / f**3, -(y**3) * u / f**2, (y * u) ** 2 / f, 0.0, 0.0])
    # a thin lens behind its stop: C_II = C_I times the chief ray's height over the marginal ray's (Welford,
    # ch. 10)
    axial = y * y / f / DIFFRACTIVE_ABBE
    assert colour(geo, 0.05) == pytest.approx([axial, axial * distance * u / y], rel=1e-12, abs=1e-17)


def test_axial_colour_of_a_thin_lens():
    crown = Glass.named("N-BK7")
    surfaces = Surface(80.0, 0.0, crown, 9.0, is_stop=True), Surface(-120.0, 90.0, None, 9.0)
    thin = GeoLens(surfaces, 10.0)
    axial = 25.0 / thin.first_order().efl_mm.item() / crown.abbe_number
    # the stop is on it
    assert colour(thin, 0.1) == pytest.approx([axial, 0.0], rel=1e-12, abs=1e-17)


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
    # on the paraxial focus; aperture and field a and a / 2 so small that Richardson's rule leaves (y / f)^4,
    # 1e-7
    def parts(scale):
        diameter = 4.0 * scale
        field = 0.02 * scale
        geo = GeoLens(everything(), diameter)
        with torch.no_grad():
            geo.thickness_mm[-1] = geo.first_order().bfl_mm
            pupil = torch.tensor([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0]], dtype=D)
            axis, off = (analysis.wavefront(geo, angle, pupil=pupil).opd_mm for angle in (0.0, field))
            s1, s2, s3, s4, _ = seidel_sums(geo, field).total
        spherical = axis[0] / (s1 / 8)
        coma = (off[0] - off[1]) / 2 / (s2 / 2)
        tangential = ((off[0] + off[1]) / 2 - axis[0]) / (s3 / 2 + (s3 + s4) / 4)
        sagittal = (off[2] - axis[2]) / ((s3 + s4) / 4)
        return torch.stack([spherical, coma, tangential, sagittal])

    coarse = parts(1.0)
    fine = parts(0.5)
    assert float((coarse - 1).abs().max()) < 0.05
    torch.testing.assert_close((4 * fine - coarse) / 3, torch.ones(4, dtype=D), rtol=0, atol=2e-5)


def check_total(geo, field, truth, rel=1e-12, atol=1e-17):
    assert seidel_sums(geo, field).total.tolist() == pytest.approx(truth, rel=rel, abs=atol)


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
    weight = torch.tensor([1.0, 0.7, -0.4, 0.3, 0.9], dtype=D)
    names = geo.parameter_names

    def loss(*values):
        return (seidel_sums(geo.replace(**dict(zip(names, values, strict=True))), 0.1).total * weight).sum()

    check_gradient(loss, *(getattr(geo, name) for name in names), step=1e-5)
