"""The flow that a body's velocities make, against motions carried out exactly and closed forms of
simple mounts."""

import math
from types import SimpleNamespace

import pytest
import torch

from codesign import lens, pose, render
from codesign.mount import Mount, body_flow
from codesign.render.film import some_pixels
from scenes import worlds
from tests.numbers import D, close, f64, rand64, randn64

HEIGHT = 0.4
# yaw, pitch, roll, position
MOUNTS = [
    (0.0, math.pi / 2, 0.0, (0.0, 0.0, HEIGHT)),
    (0.0, 1.0, 0.0, (0.25, 0.05, HEIGHT)),
    (2.0, 0.7, -0.4, (-0.2, 0.1, 0.6)),
    (-1.2, 0.2, 2.0, (0.1, -0.2, 0.3)),  # part of the view is sky
]
PINHOLE = render.Camera(lens.Pinhole(3.4), 24, 16, 0.2, 1)
# chief rays with distortion and a pupil of its own
TRIPLET = render.Camera(lens.load("cooke-triplet"), 24, 16, 1.2, 1)


def mount_of(yaw, pitch, roll, position):
    return Mount(
        position, (0.05, 0.05, 0.05), yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll
    )().detach()


def ground(camera, T_body_cam):
    """World points on z = 0 under the pixels, depth (NaN where there is none) and a mask: by the
    renderer's ground truth."""
    seen = render.view(camera, worlds.smooth_plane(), T_body_cam[None], 0)
    depth = torch.where(seen.valid, seen.depth_m, torch.nan)
    return seen.points_world_m.flatten(0, 1), depth.flatten(), seen.valid.flatten()


def exact_flow(camera, T_body_cam, twist, dt_s=1e-3):
    """Image velocity [P, 2] of static ground, its depth [P] and where there is any: points are
    projected before and after, by an eighth-order central difference in time."""
    points, depth, valid = ground(camera, T_body_cam)
    safe = torch.where(valid[:, None], points, points[valid][0])
    total = torch.zeros(len(points), 2, dtype=D)
    for step, share in enumerate((4 / 5, -1 / 5, 4 / 105, -1 / 280), start=1):
        for sign in (1, -1):
            camera_pose = pose.se3_exp(sign * step * dt_s * twist) @ T_body_cam
            total += (
                sign
                * share
                * render.project(camera, pose.apply(pose.inverse(camera_pose), safe))
                / dt_s
            )
    return torch.where(valid[:, None], total, 0), depth, valid


# projection is good to 1e-13 px relative to 10 px, over 1e-3 s: 1e-9 px/s; differences of chief rays
# over 2e-3 px to 1e-9 of flows of 100 px/s, and through a lens, whose trace rounds by 1e-13 mm, to
# 1e-7
@pytest.mark.parametrize(
    ("optics", "placed", "rtol", "atol"),
    [*((PINHOLE, placed, 1e-9, 1e-7) for placed in MOUNTS), (TRIPLET, MOUNTS[1], 1e-6, 1e-5)],
)
def test_flow_of_every_velocity_is_that_of_the_motion_carried_out(optics, placed, rtol, atol):
    T_body_cam = mount_of(*placed)
    for axis, twist in enumerate(torch.eye(6, dtype=D)):
        expected, depth, valid = exact_flow(optics, T_body_cam, twist)
        rows, seen = body_flow(optics, depth, T_body_cam)
        assert torch.equal(seen, valid)
        close(rows[..., axis], expected, rtol=rtol, atol=atol)


def test_mounts_and_pixels_together_as_one_by_one(generator):
    mounts = torch.stack([mount_of(*placed) for placed in MOUNTS])
    pixels = 16 * rand64(generator, len(MOUNTS), 5, 2)
    depth = 1 + rand64(generator, len(MOUNTS), 5)
    together, _ = body_flow(PINHOLE, depth, mounts, pixels)
    alone = [body_flow(PINHOLE, *each)[0] for each in zip(depth, mounts, pixels, strict=True)]
    close(together, torch.stack(alone), rtol=1e-12, atol=1e-12)


def test_gradient_to_depth_mount_and_focal_length(generator):
    mount = mount_of(*MOUNTS[1])
    _, depth, _ = ground(PINHOLE, mount)
    weight = randn64(generator, 24 * 16, 2, 6)

    def along(scale, shift, focal_mm):
        optics = render.Camera(lens.Pinhole(focal_mm), 24, 16, 0.2, 1)
        rows, _ = body_flow(optics, scale * depth, mount @ pose.se3_exp(shift))
        return (rows * weight).sum()

    at = (torch.ones(1, dtype=D), torch.zeros(6, dtype=D), f64(3.4))
    # rows are differences of chief rays, good to 1e-9 over steps of 1e-5
    assert torch.autograd.gradcheck(
        along, [v.requires_grad_() for v in at], eps=1e-5, atol=1e-3, rtol=1e-5
    )


@pytest.mark.parametrize("shape", [(64, 64), (48, 60), (3, 20, 64)])
def test_some_pixels_lie_all_over_a_film(shape):
    """Equal steps over 64 x 64 pixels would be one row and one column each: one diagonal."""
    rows, columns = math.prod(shape[:-1]), shape[-1]
    found = some_pixels(SimpleNamespace(shape=shape), 64)
    row, column = found // columns, found % columns
    assert len(found) >= 60
    assert abs(torch.corrcoef(torch.stack([row, column]).double())[0, 1]) < 0.15
    for place, size in ((row, rows), (column, columns)):
        # of each eighth an eighth
        counts = torch.bincount(8 * place // size, minlength=8)
        assert counts.min() >= 5
        assert counts.max() <= 11
    assert torch.equal(
        some_pixels(SimpleNamespace(shape=shape), 10**6), torch.arange(rows * columns)
    )
