"""Rays that fail: what they report, that their gradients stay finite, and that they never touch the
others."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Status, Surface
from codesign.lens.surface import Phase
from codesign.lens.trace import trace
from tests.lens.systems import close, f64
from tests.numbers import D, rand64

INF = float("inf")
GLASS = Glass.from_indices(1.5, 1.5, 1.5)


def unit(rows):
    return torch.nn.functional.normalize(f64(rows), dim=1)


def everything(out):
    return torch.cat(
        [
            out.position_mm,
            out.direction,
            out.optical_path_mm[:, None],
            out.weight[:, None],
            out.deficit[:, None],
        ],
        1,
    )


def learned(geo):
    return [t for t in (*geo.parameters(), *geo.buffers()) if t.requires_grad and t.numel()]


def gradients(geo, loss):
    tensors = learned(geo)
    return torch.cat(
        [
            g.reshape(-1)
            for g in torch.autograd.grad(loss, tensors, allow_unused=True)
            if g is not None
        ]
    )


def faces(front, back, diameter=4.0):
    return GeoLens([Surface(*front), Surface(*back)], diameter)


BALL = faces((10.0, 5.0, GLASS, 9.0), (INF, 10.0, None, 9.0))
AHEAD = f64([[0, 0, 1.0]])
# name -> (lens, height of a ray along its axis that fails, its status, the surface where, its
# deficit by hand)
CASES = {
    # 20 mm off the axis of a sphere of 10 mm radius: radicand 1 - (20/10)^2
    "miss": (BALL, 20.0, Status.MISS, 0, 3.0),
    # sin = 0.8 > 1/1.5 inside the glass: radicand 1 - 1.5^2 * 0.64
    "total reflection": (
        faces((INF, 5.0, GLASS, 99.0), (-10.0, 10.0, None, 9.9)),
        8.0,
        Status.TOTAL_REFLECTION,
        1,
        1.5**2 * 0.64 - 1,
    ),
    # exactly tangent to the sphere: radicand 0, counted as a miss
    "grazing": (BALL, 10.0, Status.MISS, 0, 1e-8),
    # a conic that ends at 10 / sqrt(1 + 3) = 5 mm: 1 - (1 + k) c^2 r^2 at 8 mm
    "ellipsoid": (
        faces((10.0, 5.0, GLASS, 4.0, 3.0), (INF, 10.0, None, 9.0)),
        8.0,
        Status.MISS,
        0,
        4 * 0.64 - 1,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_failed_ray_says_what_where_and_by_how_much(name):
    geo, height, status, surface, deficit = CASES[name]
    out = geo.trace(f64([[height, 0.0, -5.0]]), AHEAD)
    assert (out.status.item(), out.failed_surface.item(), out.weight.item()) == (
        status,
        surface,
        0.0,
    )
    # radicands are measured from the grazing limit of 1e-8
    assert abs(out.deficit.item() - deficit) <= 1e-7


@pytest.mark.parametrize("name", ["miss", "total reflection", "ellipsoid"])
def test_the_deficit_falls_when_its_gradient_is_followed(name):
    geo, height, *_ = CASES[name]
    x = f64([[height, 0.0, -5.0]]).requires_grad_()
    deficit = geo.trace(x, AHEAD).deficit
    (slope,) = torch.autograd.grad(deficit.sum(), x)
    step = 1e-6
    nearer = geo.trace((x - step * slope / slope.norm()).detach(), AHEAD).deficit
    drop = step * float(slope.norm())
    # bends by the step over 10 mm; rounding 1e-16 over 1e-6
    assert abs(deficit.item() - nearer.item() - drop) <= 1e-5 * drop


def mixed_lenses():
    triplet = lens.load("cooke-triplet")
    surfaces = list(triplet.to_surfaces())
    surfaces[0] = Surface(
        22.01359,
        3.25896,
        surfaces[0].medium,
        9.5,
        conic=0.4,
        asphere=(0.0, -1e-6, 2e-8, -1e-10, 1e-12, 1e-14, 1e-16, 1e-18),
    )
    glass = surfaces[0].medium
    special = GeoLens(
        [
            Surface(60.0, 4.0, glass, 9.0, decentre_mm=(0.1, 0.2), tilt_deg=(1.0, -1.0)),
            Surface(INF, 5.0, None, 9.0, phase=Phase((-0.05, 1e-4))),
            Surface(-90.0, 5.0, None, 9.0, conic=-1.0, mirror=True, inner_semi_aperture_mm=0.5),
            Surface(40.0, 3.0, glass, 6.0),
            Surface(-25.0, 10.0, None, 6.0),
        ],
        10.0,
    )
    special.decentre_mm.requires_grad_()
    special.tilt_rad.requires_grad_()
    return {"spheres": triplet, "asphere": GeoLens(surfaces, 10.0), "special": special}


BAD_RAYS = [
    ((40.0, 0.0, -5.0), (0, 0, 1.0)),
    ((0.0, 21.5, -5.0), (0, 0, 1.0)),
    ((9.0, 0.0, -5.0), (0.9, 0, 1.0)),
    ((0.0, 3.0, -5.0), (0, 1, 1e-9)),
    ((2.0, 3.0, -5.0), (0, 0.1, -1.0)),
    ((1e4, 0, -5.0), (0, 0, 1.0)),
]


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("kind", ["spheres", "asphere", "special"])
def test_bad_rays_have_finite_values_gradients_and_positive_deficits(kind, dtype):
    geo = mixed_lenses()[kind].to(dtype)
    origin = f64([o for o, _ in BAD_RAYS]).to(dtype).requires_grad_()
    direction = unit([d for _, d in BAD_RAYS]).to(dtype).requires_grad_()
    out = geo.trace(origin, direction)
    assert (out.status != Status.OK).all()
    assert (out.weight == 0).all()
    assert (out.deficit > 0).all()
    values = everything(out)
    tensors = [origin, direction, *learned(geo)]
    for column in values.unbind(1):
        grads = torch.autograd.grad(column.sum(), tensors, retain_graph=True, allow_unused=True)
        assert all(bool(g.isfinite().all()) for g in grads if g is not None)
    assert bool(values.isfinite().all())


@pytest.mark.parametrize("kind", ["spheres", "asphere", "special"])
def test_bad_rays_leave_the_gradients_of_good_ones_alone(kind, generator):
    geo = mixed_lenses()[kind]
    good = torch.cat([4 * rand64(generator, 40, 2) - 2, torch.full((40, 1), -5.0, dtype=D)], 1)
    ahead = unit([(0.0, 0.1, 1.0)] * 40)

    def weighted(origin, direction):
        out = geo.trace(origin, direction)
        return (out.weight * out.position_mm.square().sum(1)).sum(), out

    alone, out = weighted(good, ahead)
    assert not out.status.any()
    crowd, _ = weighted(
        torch.cat([good, f64([o for o, _ in BAD_RAYS])]),
        torch.cat([ahead, unit([d for _, d in BAD_RAYS])]),
    )
    # weight 0 times anything finite adds exactly 0; sums over lanes may run in another order
    a = gradients(geo, alone)
    b = gradients(geo, crowd)
    close(b, a, 1e-13, atol=1e-14 * float(a.abs().max()))
    close(alone, crowd, 1e-14)


@pytest.mark.parametrize("conic", [3.0, 0.5, 0.0, -0.5])
def test_the_far_half_of_an_ellipsoid_is_not_a_surface(conic):
    """Half axes: R / (1 + k) along the axis, where its middle lies too, and R / sqrt(1 + k) across.
    A ray that crosses the axis 1.3 half axes behind the vertex, nearly at right angles, meets the
    far half only."""
    radius = 10.0
    deep = radius / (1 + conic)
    wide = radius / math.sqrt(1 + conic)
    geo = GeoLens(
        [Surface(radius, 5.0, GLASS, 4.0, conic=conic), Surface(INF, 10.0, None, 4.0)], 4.0
    )
    start = f64([[3 * wide, 0.0, 1.3 * deep - 0.02 * 3 * wide]])
    out = geo.trace(start, unit([(-1.0, 0.0, 0.02)]))
    assert (out.status.item(), out.failed_surface.item()) == (Status.MISS, 0)
    assert out.deficit.item() > 0.1


@pytest.mark.parametrize("conic", [3.0, 0.5, -0.5, -1.0, -2.0])
def test_deep_conics_are_met_at_their_sag(conic):
    """Rays parallel to the axis, to 0.99 of the rim of an ellipsoid and to two radii on a
    paraboloid or hyperboloid; r^2 = 2 R z - (1 + k) z^2 at the point that is met."""
    radius = 10.0
    reach = 0.99 * radius / math.sqrt(1 + conic) if conic > -1 else 2 * radius
    surface = GeoLens([Surface(radius, 5.0, GLASS, 4.0, conic=conic)], 4.0).prescription().until(0)
    heights = [share * reach for share in (0.1, 0.4, 0.7, 1.0)]
    out = trace(surface, f64([(0.0, r, -5.0) for r in heights]), f64([(0, 0, 1.0)] * len(heights)))
    assert out.status.tolist() == [Status.OK] * len(heights)
    for r, z in zip(heights, out.position_mm[:, 2].tolist(), strict=True):
        close(2 * radius * z - (1 + conic) * z * z, r * r, 1e-12)
        # the half that holds the vertex
        assert z < (radius / (1 + conic) if conic > -1 else math.inf)


@pytest.mark.parametrize("distance", [1e-3, 1e-5, 1e-7])
def test_grazing_rays_have_the_steep_but_true_derivatives_of_the_closed_form(distance):
    """A ray parallel to the axis at R - e meets the sphere at depth R - sqrt(R^2 - h^2), whose
    slope in h is h / sqrt(R^2 - h^2)."""
    radius = 10.0
    height = radius - distance
    ball = GeoLens([Surface(radius, 20.0, GLASS, 9.999)], 4.0).prescription().until(0)
    origin = f64([(0.0, height, -5.0)]).requires_grad_()
    out = trace(ball, origin, f64([(0, 0, 1.0)]))
    depth = radius - math.sqrt((radius - height) * (radius + height))
    close(out.position_mm[0, 2], depth, atol=1e-11)
    (slope,) = torch.autograd.grad(out.position_mm[0, 2], origin)
    # R^2 - h^2 is a difference of nearly equal numbers: rounding 1e-16 relative to 2 e / R, and
    # half of that in the root
    close(
        slope[0, 1],
        height / math.sqrt((radius - height) * (radius + height)),
        1e-15 * radius / distance + 1e-12,
    )


def test_the_soft_edge_is_a_cubic_step_in_the_square_of_the_radius():
    """3 u^2 - 2 u^3 with u = 1/2 at the aperture, u falling by r / (edge x aperture) per radius:
    flat where it begins and where it ends, so that gradients have no jump."""
    semi = 9.5
    edge = 0.4
    geo = GeoLens([Surface(INF, 10.0, None, semi)], 4.0, soft_edge_mm=edge)
    share = f64([0.0, 0.1, 0.25, 0.6, 0.9, 1.0])
    radius = (semi**2 - (2 * share - 1) * edge * semi).sqrt().requires_grad_()
    origin = torch.stack([0 * radius, radius, 0 * radius], 1)
    weight = geo.trace(origin, f64([(0, 0, 1.0)] * len(share))).weight
    close(weight, 3 * share**2 - 2 * share**3, atol=1e-12)
    (slope,) = torch.autograd.grad(weight.sum(), radius)
    truth = -6 * share * (1 - share) * radius.detach() / (edge * semi)
    close(slope, truth, 1e-11, atol=1e-11)


def test_a_ray_that_meets_the_vertex_plane_but_not_the_asphere_has_deficit_one():
    # z = r^2 from (20, 0, -1) along (0.1, 0, 1): s - 1 = (20 + 0.1 s)^2 has no root (its
    # discriminant is 9 - 16.04)
    bowl = GeoLens(
        [Surface(INF, 5.0, GLASS, 4.0, asphere=(1.0,)), Surface(INF, 10.0, None, 9.0)], 4.0
    )
    out = bowl.trace(f64([(20.0, 0.0, -1.0)]), unit([(0.1, 0.0, 1.0)]))
    assert (out.status.item(), out.failed_surface.item()) == (Status.MISS, 0)
    assert out.deficit.item() == 1.0


@pytest.mark.parametrize("fourth", [2e-3, -2e-3, 1e-2])
def test_steep_aspheres_are_met_far_from_their_vertex_plane(fourth):
    """z = a r^4, some millimetres deep: the point that is met solves it, found here by bisection in
    plain numbers."""
    surface = (
        GeoLens([Surface(INF, 5.0, GLASS, 4.0, asphere=(0.0, fourth))], 4.0).prescription().until(0)
    )
    origin = (0.3, 5.5, -5.0)
    direction = unit([(0.05, -0.25, 1.0)])

    def above(s):
        x, y, z = (o + s * d for o, d in zip(origin, direction[0].tolist(), strict=True))
        return z - fourth * (x * x + y * y) ** 2

    low = 0.0
    high = 20.0
    assert above(low) < 0 < above(high)
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if above(middle) < 0 else (low, middle)
    out = trace(surface, f64([origin]), direction)
    assert out.status.item() == Status.OK
    close(out.optical_path_mm, low, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_when_all_rays_are_blocked_the_loss_is_zero_and_so_are_its_gradients(dtype):
    """Weights of blocked rays are exactly 0, the hard mask says so, and the merit of what arrives
    has the gradient 0, not NaN."""
    geo = lens.load("cooke-triplet", dtype)
    origin = f64([(0.0, 9.9, -5.0), (9.8, 0.0, -5.0)]).to(dtype)
    direction = f64([(0, 0, 1.0)] * 2).to(dtype)
    out = geo.trace(origin, direction)
    assert not out.inside.any()
    assert out.weight.tolist() == [0.0, 0.0]
    loss = (out.weight * out.position_mm.square().sum(1)).sum()
    assert loss.item() == 0
    assert gradients(geo, loss).abs().max().item() == 0


def test_the_hard_mask_is_half_the_soft_edge():
    """9.4 and 9.6 mm at an aperture of 9.5 mm with an edge of 0.4 mm: both within the soft edge,
    one inside."""
    geo = GeoLens([Surface(INF, 10.0, None, 9.5)], 4.0, soft_edge_mm=0.4)
    out = geo.trace(
        f64([(0.0, 9.4, 0.0), (0.0, 9.5 + 1e-9, 0.0), (0.0, 9.6, 0.0), (0.0, 9.1, 0.0)]),
        f64([(0, 0, 1.0)] * 4),
    )
    assert out.inside.tolist() == [True, False, False, True]
    close(out.weight[1], 0.5, atol=1e-8)
    assert 0.5 < out.weight[0].item() < 1
    assert 0 < out.weight[2].item() < 0.5
    assert out.weight[3].item() == 1.0
