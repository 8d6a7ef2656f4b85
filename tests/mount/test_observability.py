"""Velocity from flow against flow of motions carried out exactly, and against closed forms of simple
mounts."""

import math

import pytest
import torch

from codesign import lens, pose, render
from codesign.mount import FREE, PLANAR, Mount, body_flow, information, velocity_from_flow
from codesign.render.truth import world_points
from scenes import worlds

D = torch.float64
HEIGHT = 0.4
# yaw, pitch, roll, position
MOUNTS = [
    (0.0, math.pi / 2, 0.0, (0.0, 0.0, HEIGHT)),
    (0.0, 1.0, 0.0, (0.25, 0.05, HEIGHT)),
    (2.0, 0.7, -0.4, (-0.2, 0.1, 0.6)),
    (-1.2, 0.2, 2.0, (0.1, -0.2, 0.3)),  # part of the view is sky
]
VELOCITIES = torch.tensor([[0.7, -0.2, 0.5], [-0.1, 0.0, -1.3], [0.0, 0.3, 0.0]], dtype=D)


@pytest.fixture(scope="module")
def camera():
    return render.Camera(lens.Pinhole(3.4), 24, 16, 0.2, 1)


@pytest.fixture(scope="module")
def triplet():
    """Cooke triplet scaled to a small sensor: chief rays with distortion and a pupil of its own."""
    return render.Camera(lens.load("cooke-triplet"), 24, 16, 1.2, 1)


def mount_of(yaw, pitch, roll, position):
    return Mount(position, (0.05, 0.05, 0.05), yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll)().detach()


def body_at(velocity, t_s):
    """T_world_body of a body that leaves the origin with constant velocity: planar [3], or a twist [6]."""
    twist = torch.zeros(6, dtype=D)
    twist[list(PLANAR if len(velocity) == 3 else FREE)] = velocity
    return pose.se3_exp(t_s * twist)


def ground(camera, T_body_cam):
    """World points on z = 0 under the pixels, depth (NaN where there is none) and a mask: by the renderer's
    ground truth."""
    points, depth, valid = world_points(
        camera.chief_rays(camera.film.pixels()), worlds.smooth_plane(), T_body_cam
    )
    return points, torch.where(valid, depth, torch.nan), valid


def exact_flow(camera, T_body_cam, velocity, dt_s=1e-3):
    """Image velocity [1, 2, H, W] of static ground: points are projected before and after, by an eighth-order
    central difference in time."""
    points, depth, valid = ground(camera, T_body_cam)
    safe = torch.where(valid[:, None], points, points[valid][0])
    total = torch.zeros(len(points), 2, dtype=D)
    for step, share in enumerate((4 / 5, -1 / 5, 4 / 105, -1 / 280), start=1):
        for sign in (1, -1):
            camera_pose = body_at(velocity, sign * step * dt_s) @ T_body_cam
            total += sign * share * render.project(camera, pose.apply(pose.inverse(camera_pose), safe)) / dt_s
    return torch.where(valid[:, None], total, 0).T.reshape(1, 2, *camera.film.shape), depth


@pytest.mark.parametrize("placed", MOUNTS)
@pytest.mark.parametrize("velocity", VELOCITIES)
def test_exact_flow_gives_back_the_velocity(camera, placed, velocity):
    T_body_cam = mount_of(*placed)
    flow, depth = exact_flow(camera, T_body_cam, velocity)
    # projection is good to 1e-13 px relative to 10 px, over 1e-3 s: 1e-9 px/s against tens of px/s per m/s,
    # averaged over hundreds of pixels
    found = velocity_from_flow(flow, camera, depth, T_body_cam)
    torch.testing.assert_close(found[0], velocity, rtol=0, atol=1e-9)


@pytest.mark.parametrize("placed", MOUNTS)
def test_all_six_velocities_of_a_free_body(camera, placed, generator):
    T_body_cam = mount_of(*placed)
    twist = torch.randn(6, generator=generator, dtype=D)
    flow, depth = exact_flow(camera, T_body_cam, twist)
    found = velocity_from_flow(flow, camera, depth, T_body_cam, axes=FREE)
    # as above, in a system that tells turning from shifting ten to a hundred times less well
    torch.testing.assert_close(found[0], twist, rtol=0, atol=1e-7)


def test_mounts_and_pixels_together_as_one_by_one(camera, generator):
    mounts = torch.stack([mount_of(*placed) for placed in MOUNTS])
    pixels = 16 * torch.rand(len(MOUNTS), 5, 2, generator=generator, dtype=D)
    depth = 1 + torch.rand(len(MOUNTS), 5, generator=generator, dtype=D)
    together, _ = body_flow(camera, depth, mounts, pixels)
    alone = [body_flow(camera, *each)[0] for each in zip(depth, mounts, pixels, strict=True)]
    torch.testing.assert_close(together, torch.stack(alone), rtol=1e-12, atol=1e-12)


def test_flow_through_a_real_lens(triplet):
    T_body_cam = mount_of(*MOUNTS[1])
    flow, depth = exact_flow(triplet, T_body_cam, VELOCITIES[0])
    found = velocity_from_flow(flow, triplet, depth, T_body_cam)
    # differences of chief rays over 2e-3 px: rounding of the trace (1e-13 mm over 1e-3 px) leaves 1e-7 of a
    # slope
    torch.testing.assert_close(found[0], VELOCITIES[0], rtol=0, atol=1e-6)


def test_straight_down_is_the_textbook_case(camera):
    """Camera axis down at height h through the body's origin: velocity = flow h / f, and turning is a
    rotation about the image's middle."""
    T_body_cam = mount_of(*MOUNTS[0])
    depth = torch.full((24 * 16,), HEIGHT, dtype=D)
    rows, seen = body_flow(camera, depth, T_body_cam)
    rows = rows[..., PLANAR]
    focal_px = 3.4 / 0.2
    from_middle = camera.film.pixels() - camera.film.middle_px
    assert bool(seen.all())
    expected = torch.zeros(24 * 16, 2, 3, dtype=D)
    expected[:, 1, 0] = focal_px / HEIGHT  # forward: the ground moves down in the image
    expected[:, 0, 1] = focal_px / HEIGHT  # to the left: it moves right
    # body left turn seen from above: the image turns right
    expected[:, 0, 2], expected[:, 1, 2] = (
        -from_middle[:, 1],
        from_middle[:, 0],
    )
    # differences of positions of 10 px over 1e-3 px: 1e-12 relative
    torch.testing.assert_close(rows, expected, rtol=0, atol=1e-9)
    pixels = 24 * 16
    radius_2 = from_middle.square().sum()
    closed = torch.diag(
        torch.stack([torch.tensor(pixels * (focal_px / HEIGHT) ** 2, dtype=D)] * 2 + [radius_2])
    )
    torch.testing.assert_close(
        information(camera, depth, T_body_cam, 2 * torch.ones(24 * 16, dtype=D)),
        2 * closed,
        rtol=1e-9,
        atol=1e-6,
    )


@pytest.mark.parametrize("placed", MOUNTS[1:])
def test_information_is_the_covariance_of_noisy_estimates(camera, placed, generator):
    """Estimates from flow with unit noise scatter with the inverse information."""
    T_body_cam = mount_of(*placed)
    _, depth = exact_flow(camera, T_body_cam, VELOCITIES[0])
    draws = 4000
    noise = torch.randn(draws, 2, *camera.film.shape, generator=generator, dtype=D)
    found = velocity_from_flow(noise, camera, depth, T_body_cam)
    whitened = torch.linalg.cholesky(information(camera, depth, T_body_cam)).mT @ found.T
    # entries of a sample covariance of unit variates have standard deviation <= sqrt(2 / draws) = 0.022; five
    # of them
    torch.testing.assert_close(whitened @ whitened.T / draws, torch.eye(3, dtype=D), rtol=0, atol=0.11)


def test_gradients_of_velocity_and_information(camera, generator):
    T_body_cam = mount_of(*MOUNTS[1])
    flow, depth = exact_flow(camera, T_body_cam, VELOCITIES[0])
    weight = torch.rand(depth.shape, generator=generator, dtype=D) + 0.1
    tensors = [t.clone().requires_grad_() for t in (flow, depth, T_body_cam, weight)]

    def along(scale):
        f, d, m, w = (t + scale * k for t, k in zip(tensors, directions, strict=True))
        return velocity_from_flow(f, camera, d, m, w).sum() + information(camera, d, m, w).logdet()

    directions = [torch.randn(t.shape, generator=generator, dtype=D) * t.detach().abs() for t in tensors]
    grads = torch.autograd.grad(along(0.0), tensors)
    analytic = sum(float((g * k).sum()) for g, k in zip(grads, directions, strict=True))
    with torch.no_grad():
        step = 1e-5
        difference = float(along(step) - along(-step)) / (2 * step)
    # truncation (1e-5)^2 times moderate third derivatives
    assert analytic == pytest.approx(difference, rel=1e-6)


def test_a_prior_keeps_what_is_not_seen_at_zero(camera):
    sky = torch.full((24 * 16,), torch.inf, dtype=D)
    T_body_cam = mount_of(0.0, -1.0, 0.0, (0.0, 0.0, HEIGHT))
    found = velocity_from_flow(torch.ones(1, 2, 16, 24), camera, sky, T_body_cam, prior=(1.0, 1.0, 1.0))
    assert found.tolist() == [[0.0, 0.0, 0.0]]
