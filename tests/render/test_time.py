"""Exposures against closed-form blur, adaptive times against dense flow and exact crossings, chunks against
the whole."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import iv

from codesign import backend, lens, render
from codesign.pose import look_at, se3_exp
from codesign.render import (
    Camera,
    MitsubaScene,
    MovingScene,
    TexturedPlane,
    adaptive_times,
    crossing_error_px,
    exposed_frames,
    frame_chunks,
)
from codesign.render.film import coarse_pixels
from codesign.render.time import gauss_legendre, midpoints
from scenes import trajectories, worlds
from tests.render.differences import assert_gradients

D = torch.float64
FOCAL_MM = 8.0
PITCH_MM = 0.1
HEIGHT_M = 2.0
PX_M = PITCH_MM / FOCAL_MM * HEIGHT_M  # a pixel on the plane


def above():
    return look_at((0, 0, HEIGHT_M), (0, 0, 0), down=(0, 1, 0))


def sliding(speed_px_s):
    """A camera over the plane that moves along its image's rows."""
    return lambda t_s: trajectories.translation(above(), (speed_px_s * PX_M, 0.0, 0.0), t_s)


def grating(period_px, contrast=0.8):
    """Radiance 100 exp(contrast cos(2 pi x / period)), x along the image's rows."""
    along = float(above()[0, 0])  # the world's x in the image
    return TexturedPlane([[along / (period_px * PX_M), 0.0]], [contrast], [0.3])


def camera(width=24, height=1, samples=1, optics=None):
    return Camera(optics or lens.Pinhole(FOCAL_MM), width, height, PITCH_MM, samples)


# ---- exposures


@pytest.mark.parametrize(
    ("rule", "samples", "tolerance"), [(gauss_legendre, 12, 1e-12), (midpoints, 64, 4e-4)]
)
def test_a_moving_grating_is_blurred_as_its_harmonics_are(rule, samples, tolerance):
    # exp(a cos u) = I0(a) + 2 sum I_k(a) cos(k u) (Abramowitz and Stegun 9.6.34); a motion by d during the
    # exposure takes each by sinc(k d / period).
    # Midpoints miss by h^2/24 of the change of slope over the exposure: (1/64)^2 / 24 of 2 pi x 0.5 x (1 + a)
    # e^a x 2 = 2e-4 or so
    # half a period
    period = 9.0
    speed = 300.0
    exposure = 0.015
    contrast = 0.8
    t_s = torch.tensor([0.0, 0.004, 0.011], dtype=D)
    found = exposed_frames(camera(), grating(period, contrast), sliding(speed), t_s, exposure, samples, rule)
    x = torch.arange(24, dtype=D) - 11.5 + speed * t_s[:, None]
    phase = (2 * math.pi * x / period + 0.3).numpy()
    shares = [
        2 * iv(k, contrast) * np.sinc(k * speed * exposure / period) * np.cos(k * phase) for k in range(1, 16)
    ]
    np.testing.assert_allclose(found[:, 0].numpy(), 100 * (iv(0, contrast) + sum(shares)), rtol=tolerance)


def test_a_moving_edge_blurs_to_a_ramp_of_the_length_of_its_motion():
    # a bright card before the dark: the share of the exposure that a pixel's ray meets the card; midpoints
    # step, by at most half a sample
    mi = backend.mitsuba()
    samples = 20
    bitmap = mi.Bitmap(np.full((2, 2, 1), 200.0, dtype=np.float32))
    card = MitsubaScene(
        {
            "card": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale([1, 1, 1]),
                "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True}},
            }
        }
    )
    # 12 px
    along = float(above()[0, 0])
    speed = 400.0
    exposure = 0.03

    def scene(t_s):
        poses = torch.eye(4, dtype=D).repeat(t_s.numel(), 1, 1)
        poses[:, 0, 3] = along * (
            speed * PX_M * t_s - 1.0
        )  # the card's leading edge passes the middle at 0 s
        return MovingScene(
            TexturedPlane([[1.0, 0.0]], [0.0], [0.0], mean=20.0, T_world_plane=_lower()),
            {"card": (card, poses)},
        )

    def still(t_s):
        return above().repeat(t_s.numel(), 1, 1)

    t_s = torch.tensor([0.0, 0.005], dtype=D)
    found = exposed_frames(camera(40), scene, still, t_s, exposure, samples)[:, 0].double()
    x = torch.arange(40, dtype=D) - 19.5
    share = ((t_s[:, None] + exposure / 2 - x / speed) / exposure).clamp(0, 1)
    assert float((found - (20 + 180 * share)).abs().max()) <= 180 / (2 * samples) + 1e-3
    assert int(((found > 21) & (found < 199)).sum()) >= 20  # 12 px of ramp in both
    sharp = exposed_frames(camera(40), scene, still, t_s, 0.0, 1)
    assert set(sharp.reshape(-1).round().tolist()) == {20.0, 200.0}


def _lower():
    T = torch.eye(4, dtype=D)
    T[2, 3] = -0.5
    return T


# ---- adaptive times


def dense_displacement_px(cam, scene: Any, trajectory, times):
    """Largest motion of any pixel between successive times, forwards and backwards, over all pixels."""
    found = []
    for a, b in itertools.pairwise(times):
        for pair in (torch.stack([a, b]), torch.stack([b, a])):
            shown: Any = scene(pair) if callable(scene) else scene
            with torch.no_grad():
                flow, valid = render.true_flow(cam, shown, trajectory(pair))
            found.append(float(flow.norm(dim=1)[valid].max()))
    return torch.tensor(found).reshape(-1, 2).amax(1)


@pytest.mark.parametrize("optics", ["pinhole", "cooke-triplet"])
def test_no_pixel_moves_further_than_asked_in_a_room_with_crates(optics):
    cam = camera(40, 30, 1, lens.Pinhole(3.0) if optics == "pinhole" else lens.load(optics).scaled(0.08))
    room = worlds.room()
    base = look_at((0.2, -1.2, 1.2), (0.0, 1.0, 0.5))

    def path(t):
        return base @ se3_exp(
            torch.stack(
                [0.3 * (7 * t).sin(), 0 * t, 0.2 * t, 0 * t, 0.3 * (4 * t).cos() - 0.3, 0.4 * t * t], -1
            )
        )

    times = adaptive_times(cam, room, path, 0.1, 0.9 if optics == "pinhole" else 0.3, 2.0)
    moved = dense_displacement_px(cam, room, path, times)
    assert float(moved.max()) <= 2.0
    assert float(moved[3:-1].median()) >= 1.6  # and not much less: frames are not wasted
    steps = times.diff()[3:-1]
    assert float(steps.max() / steps.min()) > (
        1.5 if optics == "pinhole" else 1.05
    )  # the speed changes, so do the steps


def test_moving_objects_shorten_the_steps():
    def still(t):
        return above().repeat(t.numel(), 1, 1)

    mi = backend.mitsuba()
    bitmap = mi.Bitmap(np.full((2, 2, 1), 200.0, dtype=np.float32))
    ball = MitsubaScene(
        {
            "ball": {
                "type": "sphere",
                "radius": 0.2,
                "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True}},
            }
        }
    )

    def scene(t_s):
        poses = torch.eye(4, dtype=D).repeat(t_s.numel(), 1, 1)
        poses[:, 0, 3] = 0.2 * torch.sin(2 * math.pi * 3 * t_s)
        return MovingScene(TexturedPlane([[1.0, 0.0]], [0.0], [0.0]), {"ball": (ball, poses)})

    cam = camera(32, 24)
    times = adaptive_times(cam, scene, still, 0.0, 1 / 3, 1.0)
    moved = dense_displacement_px(cam, scene, still, times)
    assert float(moved.max()) <= 1.0
    # the ball's top is 1.8 m away: it runs 4 x 0.2 m, 0.0225 m to the pixel
    assert 0.8 / (PITCH_MM / FOCAL_MM * 1.8) <= len(times) <= 1.6 * 0.8 / (PITCH_MM / FOCAL_MM * 1.8)


def test_a_world_at_rest_needs_few_times():
    times = adaptive_times(camera(), grating(9.0), lambda t: above().repeat(t.numel(), 1, 1), 0.0, 2.0, 0.5)
    assert len(times) == 8  # 1/64 of the interval, doubled until the end


@pytest.mark.parametrize("largest_px", [0.25, 0.5, 1.0])
def test_crossings_between_adaptive_frames_are_timed_within_the_bound(largest_px):
    # log radiance of the grating is a cosine of the time at every pixel: crossings of levels in closed form,
    # against chords between the frames
    period = 8.0
    speed = 120.0
    contrast = 0.8
    cam = camera(16)
    times = adaptive_times(cam, grating(period, contrast), sliding(speed), 0.0, 0.4, largest_px)
    level = (
        render.frames(cam, grating(period, contrast), sliding(speed)(times))[:, 0] / 100
    ).log() / contrast  # cosine of the phase
    x = torch.arange(16, dtype=D) - 7.5
    wave = 2 * math.pi / period
    phase = wave * (x + speed * times[:, None]) + 0.3
    torch.testing.assert_close(level, phase.cos(), rtol=0, atol=1e-12)
    found = 0
    worst = 0.0
    steep = 1.0
    for threshold in (-0.8, -0.4, 0.0, 0.3, 0.7):
        for k in range(len(times) - 1):
            crossed = (level[k] - threshold) * (level[k + 1] - threshold) < 0
            share = (threshold - level[k]) / (level[k + 1] - level[k])
            guess = times[k] + share * (times[k + 1] - times[k])
            for p in torch.nonzero(crossed)[:, 0].tolist():
                turns = (
                    torch.arange(-40, 60, dtype=D)[:, None] * 2 * math.pi
                    + math.acos(threshold) * torch.tensor([1.0, -1.0], dtype=D)
                ).reshape(-1)
                exact = ((turns - 0.3) / wave - x[p]) / speed
                worst = max(worst, float((exact - guess[p]).abs().min()) * speed)
                steep = min(steep, float(phase[k : k + 2, p].sin().abs().min()))
                found += 1
    assert found > 200
    # the smallest slope within any of the steps that hold a crossing bounds them all
    assert worst <= crossing_error_px(largest_px, period, steep)
    # and the bound is of the right size: at thresholds' own slopes (0.6 at least) it is missed by less than
    # an order of magnitude
    assert worst >= 0.1 * crossing_error_px(largest_px, period, 0.6)


def test_the_coarse_grid_spans_every_window():
    grid = coarse_pixels(render.Film(40, 30, 12, 9, 0.1, ((0, 0), (20, 11))), 4)
    assert grid[0].tolist() == [0, 0]
    assert grid.amax(0).tolist() == [31, 19]
    assert grid.shape == (2 * 3 * 4, 2)
    assert torch.equal(coarse_pixels(render.Film(7, 5, 7, 5, 0.1), 1), render.Film(7, 5, 7, 5, 0.1).pixels())


# ---- chunks


@pytest.mark.bits
@pytest.mark.parametrize("kind", ["room", "plane", "moving"])
@pytest.mark.parametrize("size", [1, 3, 7, 20])
def test_chunks_joined_are_the_sequence_bit_for_bit(kind, size):
    cam = camera(13, 9, 4, lens.load("cooke-triplet").scaled(0.1))
    t_s = trajectories.times(7, 100.0)
    start = look_at((0.5, -1.2, 1.4), (0, 1, 0.8))
    poses = trajectories.translation(start, (1.0, 0.3, 0.5), t_s)
    card = trajectories.translation(look_at((0.0, 0.5, 1.0), (0.5, -1.2, 1.4)), (-1.0, 0.5, 0.2), t_s)
    scene = {
        "room": lambda: worlds.room(),
        "plane": lambda: worlds.smooth_plane(3),
        "moving": lambda: MovingScene(worlds.room(), {"card": (worlds.smooth_plane(1), card)}),
    }[kind]()
    chunks = list(frame_chunks(cam, scene, poses, size))
    assert [len(c) for c in chunks] == [min(size, 7 - k) for k in range(0, 7, size)]
    assert torch.equal(torch.cat(chunks), render.frames(cam, scene, poses))


def test_the_lens_is_traced_once_and_its_gradient_is_the_sum_over_chunks(monkeypatch):
    geo = lens.load("cooke-triplet").scaled(0.1)
    cam = camera(9, 6, 4, geo)
    scene = worlds.smooth_plane(3)
    poses = sliding(50.0)(trajectories.times(5, 100.0))
    (truth,) = torch.autograd.grad(render.frames(cam, scene, poses).square().sum(), geo.curvature_per_mm)
    traced = []
    rays = cam.rays
    monkeypatch.setattr(cam, "rays", lambda: traced.append(1) or rays())
    total = torch.zeros_like(truth)
    for chunk in frame_chunks(cam, scene, poses, 2):
        total += torch.autograd.grad(chunk.square().sum(), geo.curvature_per_mm, retain_graph=True)[0]
    assert len(traced) == 1
    torch.testing.assert_close(total, truth, rtol=1e-12, atol=0)  # the same terms, summed in another order


def test_no_exposure_is_the_frame_and_the_lens_keeps_its_gradient(generator):
    geo = lens.load("cooke-triplet").scaled(0.16)
    cam = camera(12, 8, 4, geo)
    scene = worlds.smooth_plane(3)
    t_s = torch.tensor([0.0, 0.01], dtype=D)
    still = exposed_frames(cam, scene, sliding(100.0), t_s, 0.0, 3)
    torch.testing.assert_close(still, render.frames(cam, scene, sliding(100.0)(t_s)), rtol=1e-13, atol=0)
    weights = torch.randn(2, 8, 12, generator=generator, dtype=D)

    def loss(speed, curvature):
        changed = cam.with_lens(geo.replace(curvature_per_mm=geo.curvature_per_mm.detach() * (1 + curvature)))

        def path(t):
            return above() @ se3_exp(t[:, None] * torch.cat([speed, torch.zeros(3, dtype=D)]))

        return (exposed_frames(changed, scene, path, t_s, 0.02, 4, gauss_legendre) * weights).sum()

    speed = torch.tensor([0.5, -0.3, 0.2], dtype=D)
    # as in test_gradients: smooth textures
    assert_gradients(loss, (speed, torch.zeros(6, dtype=D)), (1e-5, 1e-6), 1e-7)
