"""Seidel sums against two public programs, closed forms of mirrors, plates and diffractive lenses, and the
wavefront of traced rays."""

import json
import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Surface, analysis
from codesign.lens.seidel import seidel_sums
from codesign.lens.surface import Phase

D = torch.float64
FILES = {"cooke-triplet": "cooke_triplet", "double-gauss": "double_gauss", "la1509": "la1509"}
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


def half_field(name):
    return math.radians(lens.half_field_deg(name))


@pytest.mark.parametrize("name", FILES)
def test_sums_of_published_lenses(name):
    found = seidel_sums(lens.load(name), half_field(name)).total.detach()
    torch.testing.assert_close(
        found, torch.tensor(SUMS[name], dtype=D), rtol=1e-11, atol=0
    )  # both in double precision; sums of parts ten times larger


@pytest.mark.parametrize("name", FILES)
def test_every_surface_of_published_lenses(name, shared):
    truth = json.loads(shared(f"refs/lens/{FILES[name]}.json").read_text())["seidel_d"][
        "rayoptics_per_surface"
    ]
    found = seidel_sums(lens.load(name), half_field(name)).per_surface.detach()
    for k, key in enumerate(("S-I", "S-II", "S-III", "S-IV", "S-V")):
        theirs = torch.tensor(truth[key], dtype=D)
        assert float((found[:, k] - theirs[:-1]).abs().max() / theirs.abs().max()) <= 1e-7
        assert float(found[:, k].sum() / theirs[-1] - 1) == pytest.approx(
            0, abs=1e-6
        )  # their chief ray is aimed to about 1e-7


def test_the_petzval_sum_is_that_of_the_curvatures():
    geo = lens.load("double-gauss")
    n = geo.index().detach()
    c = geo.curvature_per_mm.detach()
    field = half_field("double-gauss")
    truth = -((33.33 / 2 * math.tan(field)) ** 2) * float((c * (1 / n[1:] - 1 / n[:-1])).sum())
    assert float(seidel_sums(geo, field).total[3].detach()) == pytest.approx(truth, rel=1e-13)


def mirror(conic, radius=-200.0, stop_before=0.0):
    surfaces = [Surface(radius, 100.0, None, 30.0, conic=conic, is_stop=stop_before == 0, mirror=True)]
    if stop_before:
        surfaces.insert(0, Surface(math.inf, stop_before, None, 30.0, is_stop=True))
    return GeoLens(surfaces, 20.0)


@pytest.mark.parametrize("conic", [0.0, -1.0, -0.4])
def test_a_mirror_with_the_stop_on_it(conic):
    # y^4 (1 + k) / 4 f^3, y^3 u / 2 f^2, H^2 / f, -H^2 / f, 0 (Schroeder, Astronomical Optics, ch. 5;
    # Welford, ch. 8)
    field = math.radians(0.7)
    y = 10.0
    f = 100.0
    u = math.tan(field)
    truth = [
        y**4 * (1 + conic) / (4 * f**3),
        -(y**3) * u / (2 * f**2),
        (y * u) ** 2 / f,
        -((y * u) ** 2) / f,
        0.0,
    ]
    torch.testing.assert_close(
        seidel_sums(mirror(conic), field).total.detach(), torch.tensor(truth, dtype=D), rtol=1e-13, atol=1e-17
    )


def test_a_schmidt_camera_has_neither_spherical_aberration_nor_coma_nor_astigmatism():
    # the plate stands at the centre of curvature; (n - 1) a = 1 / 4 R^3 takes away the mirror's spherical
    # aberration (Schmidt)
    n = 1.5
    R = 200.0
    strength = 1 / (4 * R**3 * (n - 1))
    plate = [
        Surface(math.inf, 1e-9, Glass.from_indices(n, n, n), 30.0),
        Surface(math.inf, R, None, 30.0, asphere=(0.0, strength), is_stop=True),
    ]
    camera = GeoLens([*plate, Surface(-R, R / 2, None, 60.0, mirror=True)], 40.0)
    sums = seidel_sums(camera, math.radians(5.0)).per_surface.detach()
    assert float(sums[2, 0]) == pytest.approx(20.0**4 / (4 * 100.0**3), rel=1e-12)  # of the sphere
    assert float(sums.sum(0)[:3].abs().max()) <= 1e-9 * float(
        sums[2, 0]
    )  # the plate's thickness, over the radius


def test_stop_shift_equations():
    # Welford, ch. 8: Q = change of the chief ray height over the marginal height, the same on every surface
    field = math.radians(2.0)
    distance = 15.0
    at_lens = lens.load("la1509")
    before = GeoLens(
        [
            Surface(math.inf, distance, None, 12.7, is_stop=True),
            *(Surface(s.radius_mm, s.thickness_mm, s.medium, s.semi_aperture_mm) for s in at_lens.surfaces),
        ],
        20.0,
    )
    s1, s2, s3, s4, s5 = seidel_sums(at_lens, field).total.tolist()
    Q = distance * math.tan(field) / 10.0
    truth = [
        s1,
        s2 + Q * s1,
        s3 + 2 * Q * s2 + Q * Q * s1,
        s4,
        s5 + Q * (3 * s3 + s4) + 3 * Q * Q * s2 + Q**3 * s1,
    ]
    torch.testing.assert_close(
        seidel_sums(before, field).total.detach(), torch.tensor(truth, dtype=D), rtol=1e-11, atol=0
    )


def test_a_paraboloid_may_be_written_as_an_asphere():
    glass = Glass.from_indices(1.6, 1.6, 1.6)
    conic = GeoLens(
        [
            Surface(math.inf, 4.0, None, 9.0, is_stop=True),
            Surface(50.0, 5.0, glass, 9.0, conic=-1.0),
            Surface(-80.0, 40.0, None, 9.0),
        ],
        10.0,
    )
    asphere = GeoLens(
        [
            Surface(math.inf, 4.0, None, 9.0, is_stop=True),
            Surface(math.inf, 5.0, glass, 9.0, asphere=(0.01,)),
            Surface(-80.0, 40.0, None, 9.0),
        ],
        10.0,
    )
    torch.testing.assert_close(
        seidel_sums(asphere, 0.1).per_surface, seidel_sums(conic, 0.1).per_surface, rtol=1e-12, atol=1e-16
    )


def test_a_flat_diffractive_lens():
    # phase r^2 alone, stop on it: S_I = y^4 / f^3, S_II = y^3 u / f^2 in size, S_III = H^2 / f, S_IV = S_V =
    # 0 (Buralli and Morris, Applied Optics 28, 1989)
    f = 100.0
    w = 0.5875618e-3
    y = 5.0
    u = math.tan(0.05)
    flat = GeoLens([Surface(math.inf, f, None, 9.0, is_stop=True, phase=Phase((-math.pi / (w * f),)))], 2 * y)
    sums = seidel_sums(flat, 0.05)
    torch.testing.assert_close(
        sums.total.detach(),
        torch.tensor([y**4 / f**3, -(y**3) * u / f**2, (y * u) ** 2 / f, 0.0, 0.0], dtype=D),
        rtol=1e-12,
        atol=1e-18,
    )
    # its Abbe number is d / (F - C) = -3.452: power grows with the wavelength
    abbe = 0.5875618 / (0.4861327 - 0.6562725)
    assert float(sums.axial_colour.sum().detach()) == pytest.approx(y * y / f / abbe, rel=1e-12)


def test_lateral_colour_of_a_diffractive_lens_behind_its_stop():
    # a thin lens: C_II = C_I times the chief ray's height over the marginal ray's (Welford, ch. 10)
    f = 100.0
    distance = 12.0
    y = 5.0
    u = math.tan(0.05)
    flat = Surface(math.inf, f, None, 9.0, phase=Phase((-math.pi / (0.5875618e-3 * f),)))
    geo = GeoLens([Surface(math.inf, distance, None, 9.0, is_stop=True), flat], 2 * y)
    sums = seidel_sums(geo, 0.05)
    abbe = 0.5875618 / (0.4861327 - 0.6562725)
    assert float(sums.axial_colour.sum().detach()) == pytest.approx(y * y / f / abbe, rel=1e-12)
    assert float(sums.lateral_colour.sum().detach()) == pytest.approx(y * distance * u / f / abbe, rel=1e-12)


def test_axial_colour_of_a_thin_lens():
    glass = Glass.named("N-BK7")
    n = glass.index(0.5875618)
    abbe = (n - 1) / (glass.index(0.4861327) - glass.index(0.6562725))
    thin = GeoLens([Surface(80.0, 0.0, glass, 9.0, is_stop=True), Surface(-120.0, 90.0, None, 9.0)], 10.0)
    power = float(1 / thin.first_order().efl_mm.detach())
    found = seidel_sums(thin, 0.1)
    assert float(found.axial_colour.sum().detach()) == pytest.approx(25.0 * power / abbe, rel=1e-12)
    assert float(found.lateral_colour.sum().detach()) == pytest.approx(0, abs=1e-17)  # the stop is on it


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


def test_gradient_against_differences():
    geo = GeoLens(everything(), 8.0)
    weight = torch.tensor([1.0, 0.7, -0.4, 0.3, 0.9], dtype=D)

    def loss(**tensors):
        return (seidel_sums(geo.replace(**tensors), 0.1).total * weight).sum()

    for name in ("curvature_per_mm", "thickness_mm", "conic", "asphere", "index_offset", "phase"):
        value = getattr(geo, name).detach()
        leaf = value.clone().requires_grad_()
        (found,) = torch.autograd.grad(loss(**{name: leaf}), leaf)
        direction = torch.linspace(0.3, 1.0, value.numel(), dtype=D).reshape(
            value.shape
        ) * value.abs().clamp_min(1e-6)
        step = 1e-5
        truth = float(
            (loss(**{name: value + step * direction}) - loss(**{name: value - step * direction})).detach()
        ) / (2 * step)
        assert float((found * direction).sum()) == pytest.approx(truth, rel=1e-6), name
