"""Conic and aspheric surfaces against closed forms, differences and symmetries."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Surface
from codesign.lens.trace import trace
from tests.lens.systems import PLANE, check_gradient, efl, glass

N = 1.5
GLASS = glass(N)


def f64(rows):
    return torch.tensor(rows, dtype=torch.float64)


def axial_beam(heights_mm, z_mm=-5.0):
    """Parallel rays at polar points (radius, turned a little further each)."""
    points = [(h * math.cos(0.7 * i), h * math.sin(0.7 * i), z_mm) for i, h in enumerate(heights_mm)]
    return f64(points), f64([(0.0, 0.0, 1.0)] * len(points))


def random_rays(count, generator, radius_mm=6.0, slope=0.2):
    across, tilt = 2 * torch.rand(2, count, 2, generator=generator, dtype=torch.float64) - 1
    origin = torch.nn.functional.pad(across * radius_mm, (0, 1), value=-5.0)
    direction = torch.nn.functional.pad(tilt * slope, (0, 1), value=1.0)
    return origin, torch.nn.functional.normalize(direction, dim=1)


# ---- stigmatic conics (Born and Wolf, Principles of Optics, 4.2): all axial rays meet in one point, whatever
# their height


def test_a_sphere_has_the_aplanatic_points_of_weierstrass():
    # rays towards the point n R behind the centre (in air) meet at R / n behind it (in glass)
    R = 30.0
    origin = f64([(3.0, 1.0, -20.0), (-8.0, 5.0, -20.0), (0.0, 14.0, -20.0)])
    direction = torch.nn.functional.normalize(f64([0.0, 0.0, R + N * R]) - origin, dim=1)
    out = GeoLens([Surface(R, R + R / N, GLASS, 25.0)], 10.0).trace(origin, direction)
    assert float(out.position_mm.detach().abs().max()) <= 1e-12


# ---- even aspheres


def conic_series(curvature, conic, terms):
    """Coefficients of r^2, r^4, ... of a conic: c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2))."""
    return tuple(
        math.comb(2 * m, m) / (m + 1) * curvature ** (2 * m + 1) * (1 + conic) ** m / 2 ** (2 * m + 1)
        for m in range(terms)
    )


@pytest.mark.parametrize("conic", [0.0, 0.8, -0.5])
def test_an_asphere_made_of_the_series_of_a_conic_is_that_conic(conic, generator):
    back = Surface(-60.0, 50.0, None, 12.0)
    exact = Surface(40.0, 6.0, GLASS, 12.0, conic=conic)
    series = Surface(PLANE, 6.0, GLASS, 12.0, asphere=conic_series(1 / 40.0, conic, 12))
    rays = random_rays(40, generator, radius_mm=4.0, slope=0.2)
    a, b = (GeoLens([front, back], 10.0).trace(*rays) for front in (exact, series))
    # first term left out, (1 + k)^12 c^25 r^26 / 2^12 or so: 1e-13 mm at 6 mm; sensitivities to the sag stay
    # below ten
    for name in ("position_mm", "direction", "optical_path_mm"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=1e-11)


def test_the_r2_term_counts_as_curvature_in_first_order_and_near_the_axis():
    back = Surface(-60.0, 50.0, None, 12.0)
    curved = GeoLens([Surface(40.0, 6.0, GLASS, 12.0, is_stop=True), back], 10.0)
    flat = GeoLens([Surface(PLANE, 6.0, GLASS, 12.0, asphere=(1 / 80,), is_stop=True), back], 10.0)
    for a, b in zip(vars(curved.first_order()).values(), vars(flat.first_order()).values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-14, atol=0)
    near = flat.trace(*axial_beam([1e-4]))
    slope = (near.direction[0, 0] / near.direction[0, 2]).item()
    # spherical aberration at 1e-4 mm: 1e-11
    assert -1e-4 / slope == pytest.approx(efl(flat), rel=1e-9)


def test_conic_and_asphere_together_against_a_plain_newton_trace(generator):
    # independent: intersection by bisection of the sag in python floats, Snell in the plane of the two
    # vectors
    c = 1 / 35.0
    k = -0.7
    a = (2e-4, -3e-6, 4e-8)

    def sag(r2):
        return c * r2 / (1 + math.sqrt(1 - (1 + k) * c * c * r2)) + sum(
            v * r2 ** (i + 1) for i, v in enumerate(a)
        )

    geo = GeoLens([Surface(1 / c, 7.0, GLASS, 12.0, conic=k, asphere=a)], 10.0)
    origin, direction = random_rays(12, generator)
    out = geo.trace(origin, direction)
    for o, d, found in zip(origin.tolist(), direction.tolist(), out.position_mm.tolist(), strict=True):
        low = 0.0
        high = 20.0
        for _ in range(70):
            t = (low + high) / 2
            p = [o[i] + t * d[i] for i in range(3)]
            low, high = (t, high) if p[2] < sag(p[0] ** 2 + p[1] ** 2) else (low, t)
        h = 1e-4
        r = math.hypot(p[0], p[1])
        slope = (sag((r + h) ** 2) - sag((r - h) ** 2)) / (2 * h)
        norm = math.hypot(1, slope)
        normal = [-slope * p[0] / r / norm, -slope * p[1] / r / norm, 1 / norm]
        cosine = sum(x * y for x, y in zip(d, normal, strict=True))
        bent = [
            x / N + (math.sqrt(1 - (1 - cosine**2) / N**2) - cosine / N) * y
            for x, y in zip(d, normal, strict=True)
        ]
        s = (7.0 - p[2]) / bent[2]
        truth = [p[0] + s * bent[0], p[1] + s * bent[1]]
        # the slope by differences is good to 1e-11 or so, times 7 mm
        assert math.dist(truth, found[:2]) <= 1e-9


# ---- derivatives against central differences


# ---- symmetries


def test_a_reversed_trace_brings_rays_back(generator):
    first, *rest = lens.load("cooke-triplet").to_surfaces()
    geo = GeoLens([replace(first, conic=0.3, asphere=(1e-5, -2e-7)), *rest], 10.0)
    origin, direction = random_rays(50, generator, radius_mm=3.0, slope=0.15)
    out = geo.trace(origin, direction)
    assert not out.status.any()
    # relative to the last vertex, seen from behind; the way back, with the axis turned round
    start = out.position_mm - f64([0, 0, 1]) * geo.thickness_mm[-1]
    turned = f64([-1, -1, 1])
    back = trace(geo.prescription().reversed(f64(5.0)), start, out.direction * turned)
    assert not back.status.any()
    torch.testing.assert_close(back.position_mm[:, :2], origin[:, :2], rtol=0, atol=1e-11)
    torch.testing.assert_close(back.direction * turned, direction, rtol=0, atol=1e-12)
    torch.testing.assert_close(back.optical_path_mm, out.optical_path_mm, rtol=0, atol=1e-11)


@pytest.mark.parametrize("factor", [0.1, 7.3])
def test_a_scaled_lens_scales_everything(factor, generator):
    geo = GeoLens(
        [
            Surface(30.0, 5.0, GLASS, 12.0, conic=-0.6, asphere=(1e-4, -2e-6, 3e-8), is_stop=True),
            Surface(-50.0, 40.0, None, 12.0),
        ],
        8.0,
    )
    big = geo.scaled(factor)
    origin, direction = random_rays(20, generator)
    a = geo.trace(origin, direction)
    b = big.trace(origin * factor, direction)
    torch.testing.assert_close(b.position_mm, a.position_mm * factor, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(b.direction, a.direction, rtol=0, atol=1e-13)
    torch.testing.assert_close(b.optical_path_mm, a.optical_path_mm * factor, rtol=1e-13, atol=0)
    torch.testing.assert_close(b.weight, a.weight, rtol=0, atol=1e-12)  # the soft edge scales along
    for name, value in vars(geo.first_order()).items():
        expected = value if name == "fno" else value * factor
        torch.testing.assert_close(getattr(big.first_order(), name), expected, rtol=1e-13, atol=0)


def test_index_offsets_survive_into_surfaces_and_scaled_lenses():
    geo = GeoLens([Surface(30.0, 5.0, GLASS, 12.0), Surface(-50.0, 40.0, None, 12.0)], 8.0)
    shifted = geo.replace(index_offset=f64([0.013, 0.0]))
    medium = shifted.to_surfaces()[0].medium
    assert medium is not None
    assert abs(medium.index(0.55) - 1.513) <= 1e-14
    assert shifted.to_surfaces()[1].medium is None
    torch.testing.assert_close(
        shifted.scaled(2.0).first_order().efl_mm, 2 * shifted.first_order().efl_mm, rtol=1e-14, atol=0
    )


# stigmatic conics (Born and Wolf, Principles of Optics, 4.2): all axial rays meet in one point, whatever
# their height, by equal paths (Fermat): a hyperboloid k = -n^2 out of glass with radius -f (n - 1); an
# ellipsoid k = -1/n^2 into glass, f = n R / (n - 1); a sphere misses by 2 mm at the edge
@pytest.mark.parametrize(
    ("surfaces", "path"),
    [
        (
            [Surface(PLANE, 10.0, GLASS, 15.0), Surface(-20.0, 40.0, None, 15.0, conic=-(N**2))],
            5 + 10 * N + 40.0,
        ),
        ([Surface(20.0, 60.0, GLASS, 18.0, conic=-1 / N**2)], 5 + N * 60.0),
    ],
)
def test_stigmatic_conics_focus_an_axial_beam(surfaces, path):
    out = GeoLens(surfaces, 10.0).trace(*axial_beam([0.0, 1.0, 4.0, 8.0, 14.0]))
    # rounding of some 40 mm
    assert float(out.position_mm.detach().abs().max()) <= 1e-12
    assert out.optical_path_mm.tolist() == pytest.approx([path] * 5, rel=1e-14)


@pytest.mark.parametrize("radius", [30.0, PLANE])
def test_derivatives_to_curvature_conic_and_asphere(radius, generator):
    """Of planes across zero too."""
    front = Surface(radius, 5.0, GLASS, 12.0, conic=-0.6, asphere=(1e-4, -2e-6, 3e-8))
    geo = GeoLens([front, Surface(-50.0, 40.0, None, 12.0, conic=0.4, asphere=(0.0, 1e-6))], 10.0)
    if radius == PLANE:
        geo = GeoLens([Surface(PLANE, 5.0, GLASS, 12.0), Surface(PLANE, 40.0, None, 12.0)], 10.0)
    rays = random_rays(8, generator)
    weights = torch.randn(8, 3, generator=generator, dtype=torch.float64)

    def loss(c, k, a):
        out = geo.replace(curvature_per_mm=c, conic=k, asphere=a).trace(*rays)
        return ((out.position_mm + out.direction) * weights).sum() + out.optical_path_mm.sum()

    if radius == PLANE:
        check_gradient(lambda c: loss(c, geo.conic, geo.asphere), geo.curvature_per_mm, step=1e-5, rel=1e-7)
    else:
        check_gradient(loss, geo.curvature_per_mm, geo.conic, geo.asphere)
