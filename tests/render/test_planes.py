"""The analytic plane through a pinhole against an independent homography, and what it refuses."""

import math

import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.pose import look_at, se3_exp
from codesign.render import Camera, TexturedPlane
from codesign.render.film import film_pupil_pattern
from scenes import textures, worlds
from tests.numbers import D, close, f64

FOCAL_MM = 6.0
PITCH_MM = 0.05
WIDTH = 24
HEIGHT = 16


def tilted_plane(dtype=D, seed=3):
    T = se3_exp(f64([0.2, -0.1, 0.4, 0.3, -0.2, 0.7]))
    return TexturedPlane(*textures.waves(seed), mean=80.0, T_world_plane=T, dtype=dtype)


def poses():
    base = look_at((0.4, -0.5, 2.6), (0.1, 0.1, 0.3), down=(0.2, 1.0, 0.1))
    moved = base @ se3_exp(f64([0.05, -0.03, 0.08, 0.02, -0.03, 0.05]))
    # from below the plane shows its front, mirrored
    return torch.stack(
        [base, moved, look_at((0.1, 0.2, -2.6), (0.1, 0.1, 0.3), down=(0.2, 1.0, 0.1))]
    )


def homography(pose, plane):
    """Pixel (x, y, 1) -> plane coordinates (X, Y, 1) up to scale: the inverse of K [r1 r2 t]
    (Hartley and Zisserman, 8.1)."""
    K = np.array(
        [
            [FOCAL_MM / PITCH_MM, 0, (WIDTH - 1) / 2],
            [0, FOCAL_MM / PITCH_MM, (HEIGHT - 1) / 2],
            [0, 0, 1],
        ]
    )
    T = np.linalg.inv(pose.numpy()) @ plane.T_world_plane.numpy()
    return np.linalg.inv(K @ T[:3, [0, 1, 3]])


def plane_points(pose, plane, pixels):
    h = np.concatenate([pixels, np.ones_like(pixels[:, :1])], 1) @ homography(pose, plane).T
    return h[:, :2] / h[:, 2:]


def radiance(plane, points):
    phase = 2 * math.pi * points @ plane.frequency.numpy().T + plane.phase.numpy()
    return plane.mean * np.exp(np.cos(phase) @ plane.amplitude.numpy())


def pixel_grid():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([x.ravel(), y.ravel()], 1).astype(float)


@pytest.mark.parametrize("samples", [1, 8])
@pytest.mark.parametrize(("dtype", "tolerance"), [(D, 1e-11), (torch.float32, 2e-4)])
def test_frames_equal_the_texture_through_the_homography(samples, dtype, tolerance):
    # float64: rounding times the phase gradient (2 pi 20 per metre at 3 m); float32: the same with
    # 1e-7 instead of 1e-16
    plane = tilted_plane(dtype)
    found = render.frames(
        Camera(lens.Pinhole(FOCAL_MM), WIDTH, HEIGHT, PITCH_MM, samples, seed=5), plane, poses()
    )
    assert found.dtype == dtype
    offsets = film_pupil_pattern(samples, 5)[0].numpy()
    for image, pose in zip(found.double(), poses(), strict=True):
        truth = np.mean(
            [
                radiance(plane, plane_points(pose, plane, pixel_grid() + offset))
                for offset in offsets
            ],
            0,
        )
        np.testing.assert_allclose(image.numpy().ravel(), truth, rtol=tolerance)


def test_the_sample_pattern_covers_the_pixel_and_the_pupil_evenly():
    offset, pupil = film_pupil_pattern(1024, 3)
    assert (offset >= -0.5).all()
    assert (offset < 0.5).all()
    assert pupil.square().sum(1).max() <= 1
    # moments of a unit square and a unit disc; 1024 low-discrepancy points are good to about 1/1024
    # times some logarithms
    close(offset.mean(0), torch.zeros(2, dtype=D), atol=2e-3)
    close(offset.T @ offset / 1024, torch.eye(2, dtype=D) / 12, atol=2e-3)
    close(pupil.mean(0), torch.zeros(2, dtype=D), atol=5e-3)
    close(pupil.T @ pupil / 1024, torch.eye(2, dtype=D) / 4, atol=5e-3)
    radius = pupil.square().sum(1)  # uniform on [0, 1] for an area-preserving map
    close(radius.sort().values, (torch.arange(1024, dtype=D) + 0.5) / 1024, atol=1e-2)
    assert torch.equal(film_pupil_pattern(16, 3)[1], film_pupil_pattern(16, 3)[1])


def test_waves_stay_inside_their_band():
    frequency, amplitude, _ = textures.waves(
        7, count=200, finest_period_m=0.02, coarsest_period_m=0.3, log_contrast=0.5
    )
    period = 1 / frequency.norm(dim=1)
    assert 0.02 <= period.min() < 0.022
    assert 0.27 < period.max() <= 0.3
    # variance of the log radiance is contrast squared
    assert float(amplitude.square().sum() / 2) == pytest.approx(0.25, rel=1e-12)
    assert isinstance(worlds.smooth_plane(2, finest_period_m=0.1), TexturedPlane)
