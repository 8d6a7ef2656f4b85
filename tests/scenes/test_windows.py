"""Windows made on the fly, of every kind: their flow against the pictures themselves, their events
against what was asked for."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from codesign.flow.warp import pixel_grid, read_at
from scenes.windows import (
    SETS,
    Draws,
    PacketWindows,
    RenderedWindows,
    Sensors,
    SensorWindows,
    WorldWindows,
    planes,
    textures,
)
from scenes.windows.rendered import LEAD
from scenes.windows.sets import EVERYDAY
from tests import refusals
from tests.numbers import close

NOISELESS = (1e-12, 1e-12)
QUIET = Sensors(
    duration_s=(1e-3, 1e-3),
    mismatch=(1e-3, 2e-3),
    cutoff_hz=(1e6, 1e7),
    shot_rate_hz=(1e-6, 1e-5),
    leak_rate_hz=(1e-6, 1e-5),
    refractory_s=(1e-9, 1e-8),
    hot_share=0.0,
    pace=0.0,
)
"""Next to ideal sensors."""


@functools.cache
def worlds():
    return WorldWindows(
        ("room", "tabletop"), seed=4, size_px=48, intervals=16, flow_px=(2.0, 3.0), samples=4
    )


def warped(layers):
    draws = replace(Draws("mixed", "warps", layers, (3.0, 6.0)), contrast=(1.0, 1.0))
    return RenderedWindows(draws, seed=3, height_px=72, width_px=96)


BLURRED = Draws("fine", layers=(0, 0), flow_px=(2.0, 5.0), scale=(0.7, 0.9), blur_px=(1.3, 1.3))
# kind -> source, and by how much the end frame read along the flow may miss the first one: mean
# over all pixels, median; means over the change in place. They count what gets hidden, and the
# bilinear lookup of sharp edges.
SOURCES = {
    "layers": (
        lambda: RenderedWindows(
            Draws(layers=(2, 2), flow_px=(3.0, 6.0)), seed=3, height_px=48, width_px=64
        ),
        0.35,
        0.05,
    ),
    "warped plane": (lambda: warped((0, 0)), 0.1, 0.05),
    "warped layers": (lambda: warped((2, 3)), 0.6, 0.05),
    "bent plane": (lambda: SensorWindows(BLURRED, replace(QUIET, bend=0.4), seed=3), 0.1, 0.1),
    "world": (worlds, 0.5, 0.5),
}


@pytest.mark.parametrize("kind", SOURCES)
def test_the_flow_leads_to_the_same_radiance(kind):
    """Where a point stays in sight, the end frame at q + flow(q) shows what the first frame shows
    at q; in place, or along the reversed flow, it does not."""
    make, mean_share, median_share = SOURCES[kind]
    windows = make().batch(range(2))
    assert windows.frames is not None
    first, last = windows.frames.clamp_min(1e-3 if kind != "world" else 1.0).log().unbind(1)

    def misses(factor):
        flow_px = factor * windows.truth.flow_px
        at = pixel_grid(*last.shape[1:], last) + flow_px
        both = torch.stack([last, torch.ones_like(last)], 1)
        brought, inside = read_at(both, at, "zeros").unbind(1)
        return [
            miss[here] for miss, here in zip((brought - first).abs(), inside > 0.999, strict=True)
        ]

    for right, still, wrong in zip(misses(1), misses(0), misses(-1), strict=True):
        assert right.mean() < mean_share * still.mean()
        assert right.median() < median_share * still.mean()
        assert right.mean() < wrong.mean()


@pytest.mark.bits
@pytest.mark.parametrize("kind", ["layers", "bent plane", "world"])
def test_a_sample_is_the_same_in_any_batch(kind):
    source = SOURCES[kind][0]()
    together = source.batch([3, 4])
    alone = source.batch([4])
    assert torch.equal(together.truth.flow_px[1:], alone.truth.flow_px)
    assert torch.equal(together.frames[1:], alone.frames)
    # a volume is a matrix product: sums of at most 32 terms >= 0, each rounded twice by half an eps
    eps = torch.finfo(torch.float32).eps
    close(together.volume.counts[1:], alone.volume.counts, rtol=2 * 32 * eps, atol=1e-6)
    assert not torch.equal(together.volume.counts[0], together.volume.counts[1])


def test_every_pixel_has_the_flow_of_the_layer_it_shows():
    """Layers looked up pixel by pixel with scipy: where the nearest that covers a pixel leads
    it."""
    source = RenderedWindows(
        Draws(layers=(1, 3), distortion=(0.0, 0.0)), seed=6, height_px=40, width_px=56
    )
    y, x = np.mgrid[:40, :56]
    points = np.stack([(x - 27.5).ravel(), (y - 19.5).ravel(), np.ones(x.size)])
    for index in range(4):
        expected = np.zeros((2, points.shape[1]))
        sure = np.ones(points.shape[1], bool)
        for layer in source._draw(index, source.t).layers:
            size = layer.crop.shape[-1]
            # row, column
            on_texture = ((layer.place.double().numpy() @ points)[1::-1] * size + size - 1) / 2
            cover = map_coordinates(
                layer.crop[1].double().numpy(), on_texture, order=1, mode="reflect"
            )
            end = layer.motion.homographies[-1].double().numpy() @ points
            expected = np.where(cover > 0.5, end[:2] / end[2] - points[:2], expected)
            sure &= abs(cover - 0.5) > 1e-3  # where rounding does not choose the layer
        found = source.batch([index]).truth.flow_px[0].flatten(1).double().numpy()
        np.testing.assert_allclose(found[:, sure], expected[:, sure], atol=1e-3)
        assert sure.mean() > 0.98


@pytest.mark.parametrize("ratio", [1.0, 4.0])
def test_events_are_the_log_change_over_the_threshold(ratio):
    """Without mismatch and noise, theta_on ON - theta_off OFF follows the change of log radiance to
    within a threshold at either end."""
    draws = replace(planes(theta=0.1, noise=NOISELESS), mismatch=0.0, on_over_off=(ratio, ratio))
    windows = RenderedWindows(draws, seed=2).batch(range(3))
    on, off = windows.volume.counts.sum(2).unbind(1)
    assert windows.frames is not None
    change = windows.frames[:, 1].log() - windows.frames[:, 0].log()
    theta_on, theta_off = 0.1 * ratio**0.5, 0.1 / ratio**0.5
    assert (theta_on * on - theta_off * off - change).abs().max() <= theta_on + theta_off + 1e-4
    if ratio > 1:
        assert off.sum() / on.sum() > 2.5


def test_noise_is_as_frequent_as_asked():
    """A still sensor before a uniform wall: only noise. 1 % per pixel, polarity and eighth gives
    0.08 per pixel and polarity; Poisson within 5 sigma."""
    draws = replace(planes(noise=(0.01, 0.01)), contrast=(1e-6, 1e-6))
    counts = RenderedWindows(draws, seed=1).batch(range(8)).volume.counts
    expected = 0.08 * 64 * 64 * 8
    for polarity in range(2):
        assert abs(counts[:, polarity].sum() - expected) < 5 * expected**0.5


def test_packets_hold_the_events_asked_for():
    """Without noise: the number asked for within the events of a few frame intervals, unless the
    whole motion holds fewer; twice the events take longer."""
    draws = replace(EVERYDAY, motion="camera", layers=(0, 2), noise=NOISELESS, textures="fine")
    lengths = []
    for density in (0.1, 0.2, 1.0):
        source = PacketWindows(draws, density, seed=8, height_px=48, width_px=48)
        windows = source.batch(range(4))
        held = windows.volume.counts.sum((1, 2, 3, 4)).numpy() / 48**2
        whole = np.array([source._times(k)[-1] for k in range(4)]) == 1.0
        assert not whole.all()
        np.testing.assert_allclose(held[~whole], density, rtol=0.1)
        assert (held[whole] <= 1.1 * density).all()
        lengths.append(float(windows.truth.flow_px[3].norm(dim=0).mean()))
    assert 1.5 < lengths[1] / lengths[0] < 2.6


@pytest.mark.parametrize(("asked", "expected"), [(0.4, 0.4**2 / 2), (3.0, 3.0 - 0.5)])
def test_memorised_levels_start_as_after_a_long_time(asked, expected):
    """All pixels brighten by ``asked`` thresholds. From a triangular start D between the
    thresholds, the mean of floor(asked + D) is asked^2 / 2 below one threshold and asked - 1/2 from
    one on. Standard error of 16,384 pixels: 0.002 and 0.004."""
    source = SensorWindows(
        Draws("fine"), replace(QUIET, density=(asked, asked), imbalance=(1.0, 1.0 + 1e-9))
    )
    ramp = torch.linspace(0, 1, source.intervals + 1)
    frames = torch.cat([torch.zeros(LEAD), ramp]).mul(2.0).exp()[:, None, None].expand(-1, 128, 128)
    counts = source._events(np.random.default_rng(4), frames)
    assert float(counts[:, 0].sum()) / 128**2 == pytest.approx(expected, abs=0.015)
    assert not bool(counts[:, 1].any())


def test_noise_of_a_sensor_is_a_share_of_the_scene_at_most():
    """Still scenes with the noisiest sensors: no more events than half of what contrast was set
    for, plus leaks and hot pixels."""
    sensors = Sensors(
        density=(0.2, 0.2),
        shot_rate_hz=(1e3, 1e3),
        leak_rate_hz=(1e-3, 2e-3),
        hot_share=0.0,
        pace=0.0,
    )
    draws = Draws("fine", "similarity", (0, 0), (0.0, 0.0))
    counts = SensorWindows(draws, sensors, seed=6).batch(range(8)).volume.counts
    assert 0.01 < counts.sum() / (8 * 64 * 64) < 0.5 * 0.2 * 1.1


def test_windows_of_worlds_last_until_the_flow_is_as_long_as_asked_and_count_whole_events():
    """The speed is measured at the start of the window and changes little within it."""
    windows = worlds().batch([0, 1])
    for flow, seen in zip(windows.truth.flow_px, windows.truth.valid, strict=True):
        assert 1.5 < flow.square().sum(0)[seen].mean().sqrt() < 3.8
    whole = windows.volume.counts.sum((1, 2, 3, 4))
    # shares of an event add up to one
    close(whole, whole.round(), rtol=1e-5)
    assert abs(windows.volume.collected_s.sum() - 1.0) < 1e-12


@pytest.mark.parametrize("name", ["planes_0.05", "layers_3", "warped", "vibration", "rotation"])
def test_sets_give_windows_of_their_own_for_every_seed(name):
    one, other = (SETS[name](seed, 4).batch([0]) for seed in (1, 2))
    assert one.volume.counts.shape[:3] == (1, 2, 4)
    assert one.truth.flow_px.norm(dim=1).mean() > 0.01
    assert not torch.equal(one.truth.flow_px, other.truth.flow_px)


@refusals.table(__file__, "windows")
def test_what_is_unfit_is_refused(row):
    row.holds(globals() | {"textures": textures})
