"""Velocity without a map: the likelihood against integrals by adaptive quadrature, its maximum
against descents from the truth, errors and claims over bodies, depths and mounts drawn at
random."""

import math

import pytest
import torch
from scipy.integrate import quad

from codesign import lens, render
from codesign.mount import (
    FREE,
    EgoVelocity,
    Mount,
    UnknownDepth,
    body_flow,
    unknown_depth,
)
from codesign.types import FlowField
from tests.mount.fields import field_of
from tests.numbers import D, close, f64, rand64, randn64, seeded

INTERVAL_S = 0.001  # short: the flow of a pixel is that of a point, whatever the depths beside it
NOISE_PX = 0.02
PRIOR = (1.0, 1.0, 1.0, 0.8, 0.8, 0.8)
WINDOWS = tuple((left, top) for top in (0, 114, 228) for left in (0, 157, 314))
CHI2_90 = 10.64  # of six


def points(seed, count=4, many=5, scale=1.0, bounds=(0.1, 3.0)):
    """Rows of any size, and flow of random velocities and depths."""
    random = seeded(seed)

    def normal(*shape):
        return randn64(random, shape)

    far, near = scale * normal(count, many, 2, 6), scale * normal(count, many, 2, 6)
    nearness = bounds[0] + (bounds[1] - bounds[0]) * rand64(random, count, many, 1, 1)
    root = normal(count, many, 2, 2)
    precision = root @ root.mT + 0.3 * torch.eye(2, dtype=D)
    flow = (far + nearness * near) @ normal(count, 1, 6, 1) + 0.3 * normal(count, many, 2, 1)
    weight = 0.2 + rand64(random, count, many)
    prior = torch.diag(f64(PRIOR) ** -2)
    return unknown_depth.Points(
        precision, (precision @ flow)[..., 0], far, near, weight, prior, bounds
    ), flow


def power(rho, f, far, near, p):
    """Logarithm of how likely a flow f is where the nearness is rho, over that of none."""
    miss = f - far - rho * near
    return float(-miss @ p @ miss / 2 + f @ p @ f / 2)


def density(rho, top, *seen):
    return math.exp(power(rho, *seen) - top)


@pytest.mark.parametrize("scale", [1e-4, 0.1, 1.0, 30.0])
def test_the_likelihood_is_the_integral_over_depths(scale):
    seen, flow = points(1, scale=scale)
    velocity = randn64(seeded(2), 4, 6)
    ours = unknown_depth.look(seen, velocity).value
    low, high = seen.bounds
    for body in range(4):
        expected = 0.5 * float(velocity[body] @ seen.prior @ velocity[body])
        for k in range(flow.shape[1]):
            far, near = seen.far[body, k] @ velocity[body], seen.near[body, k] @ velocity[body]
            p, f = seen.precision[body, k], flow[body, k, :, 0]

            bend, tilt = float(near @ p @ near), float(near @ p @ (f - far))
            peak = min(max(tilt / bend, low), high)
            width = 1 / math.sqrt(bend)
            breaks = [
                x for x in (peak + share * width for share in (-5, -1, 0, 1, 5)) if low < x < high
            ]
            top = power(peak, f, far, near, p)
            area = quad(density, low, high, (top, f, far, near, p), points=breaks, limit=400)[0]
            expected -= float(seen.weight[body, k]) * (top + math.log(area / (high - low)))
        assert float(ours[body]) == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_slope_and_curvature_are_those_of_differences():
    seen, _ = points(3)
    velocity = randn64(seeded(4), 4, 6)
    found = unknown_depth.look(seen, velocity)
    step = 1e-4
    for axis in range(6):
        moved = step * torch.eye(6, dtype=D)[axis]
        up, down = (unknown_depth.look(seen, velocity + way) for way in (moved, -moved))
        close((up.value - down.value) / (2 * step), found.slope[:, axis], rtol=1e-5, atol=1e-5)
        close(
            (up.slope - down.slope) / (2 * step), found.curvature[:, :, axis], rtol=1e-4, atol=1e-3
        )


def test_a_curvature_that_is_not_positive_counts_by_its_size():
    """Away from the maximum, where an ellipsoid has no axis along which the density grows."""
    seen, _ = points(3)
    velocity = 5 * randn64(seeded(4), 4, 6)
    values, vectors = torch.linalg.eigh(unknown_depth.look(seen, velocity).curvature)
    assert (values < 0).any()
    expected = vectors @ (vectors.mT / values.abs()[..., None])
    close(unknown_depth.covariance(seen, velocity), expected, rtol=1e-6, atol=1e-9)


@pytest.fixture(scope="module")
def camera():
    film = render.Film(346, 260, 32, 32, 0.0185, WINDOWS)
    return render.Camera(
        lens.load("cooke-triplet").requires_grad_(False).scaled(0.07), 32, 32, 0.0185, 1, 0, film
    )


def by_window(flow):
    """Flow [N windows, 2, 32, 32] of [N, points, 2]."""
    return flow.reshape(-1, 32, 32, 2).movedim(-1, 1)


def drives(camera, bodies, nearest_m, farthest_m, seed):
    """Mount [4, 4], poses, twists [N, 6] and flow fields where every point read has a depth of its
    own."""
    random = seeded(seed)
    twist = f64(PRIOR) * randn64(random, bodies, 6)
    turned = Mount((0.2, 0.05, 0.4), (0.1, 0.1, 0.1), pitch_rad=0.9, yaw_rad=0.4)().detach()
    pixels = camera.film.pixels()
    low, high = 1 / farthest_m, 1 / nearest_m
    depth = 1 / (low + (high - low) * rand64(random, bodies, len(pixels)))
    rows, _ = body_flow(camera, depth, turned)
    flow = (rows @ twist[:, None, :, None])[..., 0] * INTERVAL_S
    flow = flow + NOISE_PX * randn64(random, flow.shape)
    poses = torch.eye(4, dtype=D).expand(bodies, 3, 4, 4) @ turned
    return turned, poses, twist, field_of(by_window(flow), INTERVAL_S, NOISE_PX)


def estimator(nearest_m, farthest_m, **how):
    depth = UnknownDepth(nearest_m, farthest_m)
    return EgoVelocity(FREE, PRIOR, depth, floor_px=1e-3, every_px=16, **how)


@pytest.mark.parametrize(("nearest_m", "farthest_m"), [(0.3, math.inf), (0.3, 5.0), (0.5, 1.0)])
def test_velocities_over_depths_drawn_at_random(camera, nearest_m, farthest_m):
    mount, poses, twist, field = drives(camera, 60, nearest_m, farthest_m, 7)
    ours = estimator(nearest_m, farthest_m)
    with torch.no_grad():
        found = ours(field, camera, None, mount, poses)
        middle = EgoVelocity(FREE, PRIOR, ours.depth.__call__, floor_px=1e-3, every_px=16)
        flat = middle(field, camera, None, mount, poses)
    missed = found.velocity - twist
    errors, without = missed.abs().median(0).values, (flat.velocity - twist).abs().median(0).values
    assert (errors < 0.5 * without).all()
    squared = (missed[:, None] @ torch.linalg.inv(found.covariance) @ missed[..., None])[:, 0, 0]
    # four points of a window count as three: claims are a little wide
    assert 0.8 <= (squared < CHI2_90).double().mean() <= 0.98
    assert missed.abs().max() < 1.0  # no other maximum


def test_the_maximum_is_the_one_by_the_truth(camera):
    mount, poses, twist, field = drives(camera, 60, 0.3, 5.0, 11)
    ours = estimator(0.3, 5.0, outlier=None)
    with torch.no_grad():
        read = ours.read(field, camera, None, mount, poses)
        seen = ours.points(read, torch.ones_like(read.share))
        found, near = unknown_depth.follow(seen, 0 * twist), unknown_depth.descend(seen, twist, 40)
        values = [unknown_depth.look(seen, each).value for each in (found, near)]
    assert (values[0] > values[1] + 0.01).sum() <= 1


def test_depths_are_found_where_the_body_moves_across(camera):
    mount, poses, _, _ = drives(camera, 1, 0.3, 5.0, 3)
    share = rand64(seeded(1), 1, len(camera.film.pixels()))
    depth = 1 / (0.2 + (1 / 0.3 - 0.2) * share)
    rows, _ = body_flow(camera, depth, mount)
    flow = (rows @ f64([0.8, 0.8, 0.0, 0.0, 0.0, 0.3]))[0] * INTERVAL_S
    with torch.no_grad():
        found = estimator(0.3, 5.0)(
            field_of(by_window(flow), INTERVAL_S, 1e-3), camera, None, mount, poses
        )
    at = depth.reshape(len(WINDOWS), 32, 32)[:, 8::16, 8::16].reshape(1, -1)
    # all depths and the speed may be longer together: that is what the bounds leave open
    ratio = (found.depth_m / at).log()
    assert (ratio - ratio.mean()).abs().median() < 0.02
    assert ratio.mean().abs() < 0.2


def test_a_point_without_a_surface_is_nowhere(camera):
    mount, poses, _, field = drives(camera, 1, 0.3, 5.0, 3)
    ours = estimator(0.3, 5.0)
    with torch.no_grad():
        read = ours.read(field, camera, None, mount, poses)
        read.share[0, 5] = 0.0
        nowhere = ours.solve(read).depth_m[0].isinf()
    assert nowhere.nonzero().tolist() == [[5]]


@pytest.mark.parametrize("outlier", [None, 3.0])
def test_gradient_is_that_of_differences(camera, outlier):
    mount, poses, _, field = drives(camera, 3, 0.3, 5.0, 9)
    ours = estimator(0.3, 5.0, outlier=outlier, steps=12)
    random = seeded(2)
    weight = randn64(random, 3, 6)
    along = 0.02 * randn64(random, field.flow_px.shape)
    covariance = field.covariance_px2.detach()

    def value(flow, spread):
        moved = FlowField(flow, field.valid, INTERVAL_S, field.confidence, spread * covariance)
        found = ours(moved, camera, None, mount, poses)
        return (found.velocity * weight).sum() + 30 * found.covariance.diagonal(
            dim1=1, dim2=2
        ).sum()

    flow, spread = (
        field.flow_px.detach().requires_grad_(),
        torch.ones((), dtype=D, requires_grad=True),
    )
    of_flow, of_spread = torch.autograd.grad(value(flow, spread), (flow, spread))
    step = 1e-3
    with torch.no_grad():
        flows = [value(flow + sign * step * along, spread) for sign in (1, -1)]
        spreads = [value(flow, spread + sign * step) for sign in (1, -1)]
    assert float((of_flow * along).sum()) == pytest.approx(
        float(flows[0] - flows[1]) / (2 * step), rel=0.02
    )
    assert float(of_spread) == pytest.approx(
        float(spreads[0] - spreads[1]) / (2 * step), rel=0.02, abs=1e-4
    )
