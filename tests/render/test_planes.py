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

D = torch.float64
FOCAL_MM = 6.0
PITCH_MM = 0.05
WIDTH = 24
HEIGHT = 16


def tilted_plane(dtype=D, seed=3):
    T = se3_exp(torch.tensor([0.2, -0.1, 0.4, 0.3, -0.2, 0.7], dtype=D))
    return TexturedPlane(*textures.waves(seed), mean=80.0, T_world_plane=T, dtype=dtype)


def poses():
    base = look_at((0.4, -0.5, 2.6), (0.1, 0.1, 0.3), down=(0.2, 1.0, 0.1))
    steps = torch.tensor(
        [[0, 0, 0, 0, 0, 0], [0.05, -0.03, 0.08, 0.02, -0.03, 0.05], [0.1, 0.0, 0.1, -0.02, 0.03, 0.1]],
        dtype=D,
    )
    return base @ se3_exp(steps)


def homography(pose, plane):
    """Pixel (x, y, 1) -> plane coordinates (X, Y, 1) up to scale: the inverse of K [r1 r2 t] (Hartley and
    Zisserman, 8.1)."""
    K = np.array(
        [[FOCAL_MM / PITCH_MM, 0, (WIDTH - 1) / 2], [0, FOCAL_MM / PITCH_MM, (HEIGHT - 1) / 2], [0, 0, 1]]
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
    # float64: rounding times the phase gradient (2 pi 20 per metre at 3 m); float32: the same with 1e-7
    # instead of 1e-16
    plane = tilted_plane(dtype)
    found = render.frames(
        Camera(lens.Pinhole(FOCAL_MM), WIDTH, HEIGHT, PITCH_MM, samples, seed=5), plane, poses()
    )
    assert found.dtype == dtype
    offsets = film_pupil_pattern(samples, 5)[0].numpy()
    for image, pose in zip(found.double(), poses(), strict=True):
        truth = np.mean(
            [radiance(plane, plane_points(pose, plane, pixel_grid() + offset)) for offset in offsets], 0
        )
        np.testing.assert_allclose(image.numpy().ravel(), truth, rtol=tolerance)


def test_the_sample_pattern_covers_the_pixel_and_the_pupil_evenly():
    offset, pupil = film_pupil_pattern(1024, 3)
    assert bool((offset >= -0.5).all())
    assert bool((offset < 0.5).all())
    assert float(pupil.square().sum(1).max()) <= 1
    # moments of a unit square and a unit disc; 1024 low-discrepancy points are good to about 1/1024 times
    # some logarithms
    torch.testing.assert_close(offset.mean(0), torch.zeros(2, dtype=D), rtol=0, atol=2e-3)
    torch.testing.assert_close(offset.T @ offset / 1024, torch.eye(2, dtype=D) / 12, rtol=0, atol=2e-3)
    torch.testing.assert_close(pupil.mean(0), torch.zeros(2, dtype=D), rtol=0, atol=5e-3)
    torch.testing.assert_close(pupil.T @ pupil / 1024, torch.eye(2, dtype=D) / 4, rtol=0, atol=5e-3)
    radius = pupil.square().sum(1)  # uniform on [0, 1] for an area-preserving map
    torch.testing.assert_close(
        radius.sort().values, (torch.arange(1024, dtype=D) + 0.5) / 1024, rtol=0, atol=1e-2
    )
    assert torch.equal(film_pupil_pattern(16, 3)[1], film_pupil_pattern(16, 3)[1])


def test_the_plane_is_seen_from_both_sides_and_its_back_is_the_mirrored_front():
    plane = TexturedPlane(*textures.waves(1), dtype=D)
    camera = Camera(lens.Pinhole(FOCAL_MM), WIDTH, HEIGHT, PITCH_MM, 1)
    above = look_at((0, 0, 2.0), (0, 0, 0), down=(0, 1, 0))
    below = look_at((0, 0, -2.0), (0, 0, 0), down=(0, 1, 0))
    front, back = render.frames(camera, plane, torch.stack([above, below]))
    torch.testing.assert_close(back, front.flip(1), rtol=1e-12, atol=0)


def test_rays_beside_the_plane_see_its_mean():
    plane = TexturedPlane(*textures.waves(1), mean=70.0, dtype=D)
    camera = Camera(lens.Pinhole(FOCAL_MM), WIDTH, HEIGHT, PITCH_MM, 1)
    away = look_at((0, 0, 2.0), (0, 0.01, 5.0), down=(0, 1, 0))
    assert render.frames(camera, plane, away[None]).unique().tolist() == [70.0]


def test_waves_stay_inside_their_band():
    frequency, amplitude, _ = textures.waves(
        7, count=200, finest_period_m=0.02, coarsest_period_m=0.3, log_contrast=0.5
    )
    period = 1 / frequency.norm(dim=1)
    assert 0.02 <= float(period.min()) < 0.022
    assert 0.27 < float(period.max()) <= 0.3
    assert float(amplitude.square().sum() / 2) == pytest.approx(
        0.25, rel=1e-12
    )  # variance of the log radiance is contrast squared
    assert isinstance(worlds.smooth_plane(2, finest_period_m=0.1), TexturedPlane)


def test_mitsuba_renders_the_same_picture():
    """The plane in closed form against the same pattern as a bitmap of 2048 texels under Mitsuba: bilinear
    interpolation errs by (2 pi / (texels per wave))^2 / 8 of the pattern's log amplitude, 1e-5 here; float32
    rays at 2 m move the pattern by 1e-7 m."""
    import numpy as np

    from codesign import backend, lens, pose, render

    half = 1.5
    texels = 2048
    frequency = ((0.9, 0.3), (-0.4, 1.1))
    amplitude = (0.4, 0.3)
    phase = (0.3, 1.1)
    at = ((np.arange(texels) + 0.5) / texels * 2 - 1) * half
    wave = sum(
        a * np.cos(2 * np.pi * (fx * at[None, :] + fy * at[:, None]) + p)
        for (fx, fy), a, p in zip(frequency, amplitude, phase, strict=True)
    )
    mi = backend.mitsuba()
    light = {
        "type": "area",
        "radiance": {
            "type": "bitmap",
            "bitmap": mi.Bitmap((100 * np.exp(wave))[..., None].astype(np.float32)),
            "raw": True,
        },
    }
    card = render.MitsubaScene(
        {"card": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(half), "emitter": light}}
    )
    plane = render.TexturedPlane(frequency, amplitude, phase)
    camera = render.Camera(lens.load("cooke-triplet").scaled(0.22).freeze(), 32, 24, 0.2, 16)
    path = pose.look_at((0.1, 0.05, 2.0), (0.0, 0.1, 0.0), down=(0.0, -1.0, 0.0))[None]
    ours = render.frames(camera, plane, path)
    theirs = render.frames(camera, card, path)
    assert float(ours.std()) > 10
    torch.testing.assert_close(theirs.double(), ours, rtol=2e-5, atol=0)
