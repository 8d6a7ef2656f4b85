"""Velocity from flow fields: exact flow of random bodies through windows of a real lens, least
squares written out, outliers."""

from dataclasses import replace

import pytest
import torch

from codesign import lens, pose, render
from codesign.errors import DomainError
from codesign.mount import (
    FREE,
    PLANAR,
    EgoVelocity,
    Mount,
    body_flow,
    ground_depth,
    scene_depth,
    velocity_errors,
)
from codesign.render.charts import glowing
from codesign.types import FlowField
from scenes import worlds
from tests.mount.fields import field_of
from tests.numbers import D, close, f64, rand64, randn64, seeded

INTERVAL_S = 0.01
WINDOWS = ((0, 0), (40, 20), (80, 60))
TWIST_SCALE = f64([0.5, 0.3, 0.2, 0.3, 0.3, 0.5])


@pytest.fixture(scope="module")
def camera():
    film = render.Film(112, 92, 32, 32, 0.3, WINDOWS)
    return render.Camera(lens.load("cooke-triplet").requires_grad_(False), 32, 32, 0.3, 1, 0, film)


@pytest.fixture(scope="module")
def drive(camera):
    """Mount, poses [N, 3, 4, 4] over flat ground, twists [N, 6], and the exact flow from first to
    last."""
    generator = seeded(3)
    mount = Mount((0.2, 0.05, 0.5), (0.1, 0.1, 0.1), pitch_rad=1.0, yaw_rad=0.3)().detach()
    twists = TWIST_SCALE * randn64(generator, 5, 6)
    half = INTERVAL_S / 2 * f64([-1.0, 0.0, 1.0])
    poses = pose.se3_exp(half[:, None] * twists[:, None]) @ mount
    truth = [
        render.truth.true_flow(camera, worlds.smooth_plane(), each, stride=2) for each in poses
    ]
    assert all(bool(valid.all()) for _, valid in truth)
    return mount, poses, twists, torch.cat([flow[0].detach().movedim(0, 1) for flow, _ in truth])


@pytest.mark.parametrize("depth", ["ground", "scene"])
def test_exact_flow_of_free_bodies_through_a_lens(camera, drive, depth):
    mount, poses, twists, flow = drive
    ours = EgoVelocity(FREE, (1e3,) * 6, depth)
    found = ours(field_of(flow, INTERVAL_S), camera, worlds.smooth_plane(), mount, poses)
    # the mid-point rule leaves (w t)^2 / 24 of the flow, and points are read where half their flow
    # leads, whose curvature is of that size: 1e-5 of the flow, in a system that tells turning from
    # shifting ten times less well
    close(found.velocity, twists, atol=2e-4)


@pytest.mark.parametrize("depth", ["ground", "scene", lambda *given: 2 * ground_depth(*given)])
def test_readings_beside_the_truth_are_two_readings(camera, drive, depth):
    mount, poses, _, flow = drive
    ours = EgoVelocity(FREE, (1e3,) * 6, depth)
    given = (field_of(flow, INTERVAL_S), camera, worlds.smooth_plane(), mount, poses)
    read, true = ours.read_beside_truth(*given)
    for found, asked in ((read, ours.read(*given)), (true, ours.read(*given, depth=scene_depth))):
        close(found.rows, asked.rows)
        close(found.depth_m, asked.depth_m)
    again, still = ours.read_beside_truth(*given, depths_m=(read.depth_m, true.depth_m))
    close(again.rows, read.rows)
    close(still.rows, true.rows)


@pytest.mark.parametrize(("every_px", "independent"), [(8, 3 / 16), (32, 1.0)])
def test_least_squares_written_out_with_covariance_and_confidence(
    camera, drive, every_px, independent
):
    """Points of a window count as three, a lone one as itself."""
    mount, poses, _, flow = drive
    generator = seeded(5)
    noisy = flow + 0.1 * randn64(generator, flow.shape)
    xx, yy = 0.01 + rand64(generator, 2, *flow[:, 0].shape)
    xy = 0.3 * (xx * yy).sqrt()
    confidence = rand64(generator, flow[:, 0].shape)
    field = FlowField(noisy, confidence > 0, INTERVAL_S, confidence, torch.stack([xx, xy, yy], 1))
    prior = (1.0, 0.5, 2.0)
    ours = EgoVelocity(PLANAR, prior, every_px=every_px, floor_px=0.05, outlier=None)
    found = ours(field, camera, None, mount, poses)
    body = 2
    normal = torch.diag(f64(prior) ** -2)
    right = torch.zeros(3, dtype=D)
    for window, (left, top) in enumerate(WINDOWS):
        sample = body * len(WINDOWS) + window
        for row in range(every_px // 2, 32, every_px):
            for column in range(every_px // 2, 32, every_px):
                seen = noisy[sample, :, row, column]
                at = f64([left + column, top + row]) + seen / 2
                depth = ground_depth(camera, at[None, None], poses[body : body + 1, 1])
                rows, _ = body_flow(camera, depth[0], mount, at[None])
                j = rows[0][:, list(PLANAR)] * INTERVAL_S
                here = sample, row, column
                spread = torch.stack([xx[here], xy[here], xy[here], yy[here]]).reshape(2, 2)
                precision = independent * torch.linalg.inv(spread + 0.05**2 * torch.eye(2, dtype=D))
                normal += confidence[here] * j.T @ precision @ j
                right += j.T @ precision @ seen
    close(found.velocity[body], torch.linalg.solve(normal, right), rtol=1e-9, atol=1e-12)
    close(found.covariance[body], torch.linalg.inv(normal), rtol=1e-9, atol=1e-15)


def test_windows_that_are_lost_do_not_lead_it_away(camera, drive):
    mount, poses, twists, flow = drive
    lost = flow.unflatten(0, (5, 3)).clone()
    lost[:, 0] = 5.0 - lost[:, 0]
    field = field_of(lost.flatten(0, 1), INTERVAL_S)
    errors = [
        (EgoVelocity(PLANAR, (1.0,) * 3, **how)(field, camera, None, mount, poses).velocity)
        - twists[:, list(PLANAR)]
        for how in ({"steps": 12}, {"outlier": None})
    ]
    assert errors[0].abs().mean() < 0.5 * errors[1].abs().mean()


def test_unseen_flow_says_nothing(camera, drive):
    mount, poses, _, flow = drive
    ours = EgoVelocity(FREE, (1e3,) * 6)
    found = ours(
        field_of(0 * flow, INTERVAL_S, deviation_px=8.0, confidence=0.0), camera, None, mount, poses
    )
    assert found.velocity.abs().max() == 0
    torch.testing.assert_close(found.covariance, 1e6 * torch.eye(6, dtype=D).expand(5, 6, 6))


def test_what_is_not_valid_means_nothing_and_nan_that_is_valid_is_refused(camera, drive):
    """NaN under a pixel that is not valid gives the same velocity as any number there; where the
    field claims to know, it is refused."""
    mount, poses, _, flow = drive
    field = field_of(flow, INTERVAL_S)
    field.valid[:, 3:9] = False
    field = replace(field, confidence=field.valid.double())
    ours = EgoVelocity(FREE, (1e3,) * 6)

    def solved(value, where):
        given = replace(field, flow_px=torch.where(where[:, None], value, field.flow_px))
        return ours(given, camera, None, mount, poses).velocity

    close(solved(torch.nan, ~field.valid), solved(1e3, ~field.valid))
    # whatever confidence is claimed there
    sure = replace(field, confidence=torch.ones_like(field.confidence))
    said = ours(sure, camera, None, mount, poses).velocity
    field = sure
    close(solved(1e3, ~field.valid), said)
    with pytest.raises(DomainError, match=r"flow of valid pixels must be finite, got NaN"):
        solved(torch.nan, field.valid)


def test_gradient_to_the_mount_and_to_the_flow(camera, drive):
    mount, poses, _, flow = drive
    body = poses[:1] @ torch.linalg.inv(mount)
    ours = EgoVelocity(PLANAR, (1.0,) * 3, steps=2)

    noise = randn64(seeded(6), flow[:3].shape)

    def velocity(shift, more):
        turned = mount @ pose.se3_exp(shift)
        field = field_of(flow[:3] + more * noise, INTERVAL_S)
        return ours(field, camera, None, turned, body @ turned).velocity[0]

    still = torch.zeros(6, dtype=D, requires_grad=True), f64(0.1).requires_grad_()
    # rounding 1e-12 over the step, truncation step^2
    assert torch.autograd.gradcheck(velocity, still, eps=1e-6, rtol=1e-5, atol=1e-6)


def test_scores_by_hand():
    twist = torch.zeros(4, 6, dtype=D)
    twist[:, 0] = torch.tensor([0.0, 1.0, 2.0, 4.0])
    off = f64([[0.05, 0.0, 0.0], [0.0, -0.15, 0.0], [0.0, 0.0, 0.3], [9.0, 9.0, 9.0]])
    errors = velocity_errors(twist[:, [0, 1, 5]] + off, twist, PLANAR)
    torch.testing.assert_close(errors.squared()[:3], f64([1 / 3, 1 / 3, 4 / 3]))
    assert float(errors.bounded()[3]) == pytest.approx(1.0, abs=1e-3)
    assert errors.table()["left"]["bias_m_s"] == pytest.approx((9 - 0.15) / 4)
    assert errors.table()["yaw"]["p50_rad_s"] == pytest.approx(0.15)


def test_a_plate_on_the_camera_has_no_depth_whenever_the_interval_ends(camera):
    """It moves with the camera, and covers the same pixels in every frame."""
    corners = f64([[-1, -1, 5], [1, -1, 5], [1, 1, 5], [-1, 1, 5]]) * 0.04
    plate = glowing(corners[torch.tensor([[0, 1, 2], [0, 2, 3]])])
    t_s = torch.linspace(0, 0.04, 9, dtype=D)
    start = pose.look_at((0, 0, 1.0), (0, 0.001, 0.0))
    step = f64([2.0, 0, 0, 0, 0, 0])
    path = start @ pose.se3_exp(t_s[:, None] * step)
    scene = render.MovingScene(worlds.smooth_plane(), {"plate": (plate, path)})
    flow = torch.zeros(1, 2, *camera.film.shape)
    covered = []
    for interval_s in (0.04, 0.02):
        field = replace(field_of(flow, INTERVAL_S), interval_s=interval_s)
        read = EgoVelocity(depth="ground").read(field, camera, scene, torch.eye(4), path[None], t_s)
        covered.append(read.depth_m.isinf())
    assert torch.equal(*covered)
    assert 0.2 < covered[0].double().mean() < 0.8


def test_ground_has_no_depth_from_below_it():
    camera = render.Camera(lens.Pinhole(8.0), 20, 15, 0.4)
    below = pose.look_at((0, 0, -1.0), (5, 0, -2.0))[None]
    assert ground_depth(camera, f64([[[9.5, 7.0], [9.5, 14.0]]]), below).isinf().all()
