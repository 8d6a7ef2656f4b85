"""Conic and aspheric surfaces against closed forms, differences and symmetries."""

import math

import pytest
import torch

from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.trace import trace

INF = float("inf")
N = 1.5
GLASS = Glass.from_indices(N, N, N)


def f64(rows):
    return torch.tensor(rows, dtype=torch.float64)


def axial_beam(heights_mm, z_mm=-5.0):
    """Parallel rays at polar points (radius, turned a little further each)."""
    points = [(h * math.cos(0.7 * i), h * math.sin(0.7 * i), z_mm) for i, h in enumerate(heights_mm)]
    return f64(points), f64([(0.0, 0.0, 1.0)] * len(points))


def random_rays(count, generator, radius_mm=6.0, slope=0.2):
    origin = torch.cat(
        [
            (2 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1) * radius_mm,
            torch.full((count, 1), -5.0, dtype=torch.float64),
        ],
        1,
    )
    direction = torch.cat(
        [
            (2 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1) * slope,
            torch.ones(count, 1, dtype=torch.float64),
        ],
        1,
    )
    return origin, torch.nn.functional.normalize(direction, dim=1)


# ---- stigmatic conics (Born and Wolf, Principles of Optics, 4.2): all axial rays meet in one point, whatever
# their height


def test_hyperboloid_out_of_glass_focuses_an_axial_beam():
    # plane, glass, then k = -n^2 with radius -f (n - 1)
    f = 40.0
    geo = GeoLens(
        [Surface(INF, 10.0, GLASS, 15.0), Surface(-f * (N - 1), f, None, 15.0, conic=-(N**2))], 10.0
    )
    out = geo.trace(*axial_beam([0.0, 1.0, 4.0, 8.0, 14.0]))
    assert (
        float(out.position_mm.detach().abs().max()) <= 1e-12
    )  # rounding of some 40 mm; a sphere misses by 2 mm at the edge
    path = out.optical_path_mm.detach()
    torch.testing.assert_close(
        path, torch.full_like(path, 5 + 10 * N + f), rtol=1e-14, atol=0
    )  # Fermat: equal paths to a focus


def test_ellipsoid_into_glass_focuses_an_axial_beam():
    # k = -1/n^2, focus inside the glass at f = n R / (n - 1)
    R = 20.0
    f = N * R / (N - 1)
    geo = GeoLens([Surface(R, f, GLASS, 18.0, conic=-1 / N**2)], 10.0)
    out = geo.trace(*axial_beam([0.0, 1.0, 5.0, 12.0, 17.0]))
    assert float(out.position_mm.detach().abs().max()) <= 1e-12
    path = out.optical_path_mm.detach()
    torch.testing.assert_close(path, torch.full_like(path, 5 + N * f), rtol=1e-14, atol=0)


def test_a_sphere_has_the_aplanatic_points_of_weierstrass():
    # rays towards the point n R behind the centre (in air) meet at R / n behind it (in glass)
    R = 30.0
    target = R + N * R
    image = R + R / N
    heights = [(3.0, 1.0), (-8.0, 5.0), (0.0, 14.0)]
    origin = f64([(x, y, -20.0) for x, y in heights])
    direction = torch.nn.functional.normalize(f64([0.0, 0.0, target]) - origin, dim=1)
    out = GeoLens([Surface(R, image, GLASS, 25.0)], 10.0).trace(origin, direction)
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
    R = 40.0
    reach = 6.0
    terms = 12
    exact = GeoLens([Surface(R, 6.0, GLASS, 12.0, conic=conic), Surface(-60.0, 50.0, None, 12.0)], 10.0)
    series = GeoLens(
        [
            Surface(INF, 6.0, GLASS, 12.0, asphere=conic_series(1 / R, conic, terms)),
            Surface(-60.0, 50.0, None, 12.0),
        ],
        10.0,
    )
    rays = random_rays(40, generator, radius_mm=reach / 1.5, slope=0.2)
    a = exact.trace(*rays)
    b = series.trace(*rays)
    # first term left out, (1 + k)^12 c^25 r^26 / 2^12 or so: 1e-13 mm at 6 mm; sensitivities to the sag stay
    # below ten
    assert float((a.position_mm - b.position_mm).detach().abs().max()) <= 1e-11
    torch.testing.assert_close(a.direction, b.direction, rtol=0, atol=1e-12)
    torch.testing.assert_close(a.optical_path_mm, b.optical_path_mm, rtol=0, atol=1e-11)


def test_the_r2_term_counts_as_curvature_in_first_order_and_near_the_axis():
    curved = GeoLens([Surface(40.0, 6.0, GLASS, 12.0, is_stop=True), Surface(-60.0, 50.0, None, 12.0)], 10.0)
    flat = GeoLens(
        [Surface(INF, 6.0, GLASS, 12.0, asphere=(1 / 80,), is_stop=True), Surface(-60.0, 50.0, None, 12.0)],
        10.0,
    )
    for a, b in zip(vars(curved.first_order()).values(), vars(flat.first_order()).values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-14, atol=0)
    near = flat.trace(*axial_beam([1e-4]))
    slope = float((near.direction[0, 0] / near.direction[0, 2]).detach())
    assert (
        abs(-1e-4 / slope / float(flat.first_order().efl_mm.detach()) - 1) <= 1e-9
    )  # spherical aberration at 1e-4 mm: 1e-11


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
        assert (
            math.dist(truth, found[:2]) <= 1e-9
        )  # the slope by differences is good to 1e-11 or so, times 7 mm


# ---- derivatives against central differences


def test_derivatives_to_conic_and_asphere_terms(generator):
    surfaces = [
        Surface(30.0, 5.0, GLASS, 12.0, conic=-0.6, asphere=(1e-4, -2e-6, 3e-8)),
        Surface(-50.0, 40.0, None, 12.0, conic=0.4, asphere=(0.0, 1e-6)),
    ]
    geo = GeoLens(surfaces, 10.0)
    rays = random_rays(8, generator)
    weights = torch.randn(8, 6, generator=generator, dtype=torch.float64)

    def loss(**tensors):
        out = geo.replace(**tensors).trace(*rays)
        return (
            torch.cat([out.position_mm[:, :2], out.direction, out.optical_path_mm[:, None]], 1) * weights
        ).sum()

    steps = {
        "conic": (1e-4, 1e-4, 1e-4),
        "asphere": (1e-7, 1e-9, 1e-11),
    }  # each moves the sag at 8 mm by some 5e-6 mm
    for name, sizes in steps.items():
        value = getattr(geo, name).detach()
        (found,) = torch.autograd.grad(loss(), getattr(geo, name))
        for at in (
            torch.cartesian_prod(*[torch.arange(n) for n in value.shape]).reshape(-1, value.ndim).tolist()
        ):
            step = torch.zeros_like(value)
            step[tuple(at)] = sizes[at[-1] if name == "asphere" else 0]
            size = float(step.max())
            truth = (
                float(loss(**{name: value + step}).detach()) - float(loss(**{name: value - step}).detach())
            ) / (2 * size)
            # rounding of a sum of 40 mm (1e-14) over a change of 1e-5 mm; the cubic error is below 1e-10
            assert abs(float(found[tuple(at)]) - truth) <= 1e-7 * abs(truth) + 1e-14 * 40 / size


def test_derivative_to_the_curvature_of_a_plane_by_differences_across_zero(generator):
    rays = random_rays(6, generator)
    geo = GeoLens([Surface(INF, 5.0, GLASS, 12.0), Surface(INF, 40.0, None, 12.0)], 10.0)

    def loss(g):
        return g.trace(*rays).position_mm.square().sum()

    (found,) = torch.autograd.grad(loss(geo), geo.curvature_per_mm)
    for i in range(2):
        step = torch.zeros(2, dtype=torch.float64)
        step[i] = 1e-5  # radius 100 m: differences bend by (1e-5 * 10 mm * 40 mm)^2, 1e-9 relative
        truth = (loss(geo.replace(curvature_per_mm=step)) - loss(geo.replace(curvature_per_mm=-step))) / 2e-5
        assert abs(float(found[i] / truth.detach()) - 1) <= 1e-7


# ---- symmetries


@pytest.mark.parametrize("asphere", [(), (1e-5, -2e-7)])
def test_a_reversed_trace_brings_rays_back(asphere, generator):
    from codesign.lens import load

    surfaces = list(load("cooke-triplet").to_surfaces())
    first = surfaces[0]
    surfaces[0] = Surface(
        first.radius_mm,
        first.thickness_mm,
        first.medium,
        first.semi_aperture_mm,
        conic=0.3 if asphere else 0.0,
        asphere=asphere,
    )
    geo = GeoLens(surfaces, 10.0)
    origin, direction = random_rays(50, generator, radius_mm=3.0, slope=0.15)
    out = geo.trace(origin, direction)
    assert not out.status.any()
    start = (
        out.position_mm - f64([0, 0, 1]) * geo.thickness_mm[-1]
    )  # relative to the last vertex, seen from behind
    turned = f64([-1, -1, 1])  # the way back, with the axis turned round
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
