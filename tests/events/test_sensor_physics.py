"""Low-pass, leak, noise events, hot pixels and dead time of the interpolated sensor against differential
equations and the laws of their randomness."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from codesign.errors import DomainError
from codesign.events import SensorModel, SensorState, concatenate, dense_counts, simulate, to_counts
from tests.event_streams import same

EVERYTHING = SensorModel(
    0.15, 0.2, 0.03, cutoff_hz=60.0, leak_rate_hz=3.0, leak_jitter=0.2, rate_cov_decades=0.2, shot_rate_hz=20.0, refractory_s=2e-3, hot_pixel_share=0.05, hot_pixel_rate_hz=80.0
)  # fmt: skip


def clip(frames=30, dtype=torch.float32):
    generator = torch.Generator().manual_seed(1)
    drift = torch.randn(frames, 9, 8, generator=generator, dtype=dtype).cumsum(0) * 0.1
    return (4 + drift).exp(), torch.rand(frames, generator=generator, dtype=torch.float64).add(0.2).cumsum(
        0
    ) * 2e-3


@pytest.mark.parametrize("cutoff_hz", [0.01, 3.0, 30.0, 2000.0])
def test_the_low_pass_solves_its_differential_equation(cutoff_hz):
    frames, t_s = clip(dtype=torch.float64)
    state = SensorState()
    simulate(frames, t_s, SensorModel(cutoff_hz=cutoff_hz), state=state)
    intensity = frames[:, 3, 4].numpy()
    level = frames[:, 3, 4].log().numpy()
    t = t_s.numpy()
    filtered = level[0]
    for k in range(1, len(t)):
        pace = 2 * math.pi * cutoff_hz * (0.5 * (intensity[k - 1] + intensity[k]) + 20) / 275
        slope = (level[k] - level[k - 1]) / (t[k] - t[k - 1])

        def right(s, v, k=k, pace=pace, slope=slope):
            return pace * (level[k - 1] + slope * s - v)

        filtered = solve_ivp(
            right, (0, t[k] - t[k - 1]), [filtered], method="Radau", rtol=1e-10, atol=1e-12
        ).y[0, -1]
    assert float(state.level[3, 4]) == pytest.approx(filtered, abs=1e-8)


@pytest.mark.bits
@pytest.mark.parametrize("timing", ["interpolated", "v2e"])
def test_any_chunking_gives_the_events_of_the_whole_with_everything_on(timing):
    frames, t_s = clip()
    everything = SensorModel(**{**EVERYTHING.__dict__, "timing": timing})
    for sensor in (
        everything,
        SensorModel(
            theta_sigma=0.02, cutoff_hz=50.0, shot_rate_hz=2.0, photoreceptor_noise=True, timing=timing
        ),
    ):
        whole = simulate(frames, t_s, sensor, torch.Generator().manual_seed(5))
        assert len(whole) > 100
        for cuts in ([2, 3], [9, 10, 29], list(range(2, 30))):
            state = SensorState(generator=torch.Generator().manual_seed(5))
            parts = [
                simulate(frames[a:b], t_s[a:b], sensor, state=state)
                for a, b in zip([0, *cuts], [*cuts, 30], strict=True)
            ]
            assert same(whole, concatenate(parts))
        assert not same(whole, simulate(frames, t_s, sensor, torch.Generator().manual_seed(6)))


@pytest.mark.bits
def test_dense_counts_are_the_counts_of_the_events():
    frames, t_s = clip()
    events = simulate(frames, t_s, EVERYTHING, torch.Generator().manual_seed(5))
    assert torch.equal(
        dense_counts(frames, t_s, EVERYTHING, torch.Generator().manual_seed(5)), to_counts(events, t_s)
    )
    batch = frames.reshape(30, 3, 3, 8)
    assert torch.equal(
        dense_counts(batch, t_s, EVERYTHING, torch.Generator().manual_seed(5)).reshape(29, 2, 9, 8),
        to_counts(events, t_s),
    )
    with pytest.raises(DomainError, match="interpolated"):
        dense_counts(frames, t_s, SensorModel(timing="v2e"))


@pytest.mark.parametrize("fps", [20, 1000])
def test_noise_events_are_a_poisson_process_at_every_frame_rate(fps):
    # (I + 20)/275 = 0.4 at I = 90: 40 Hz * (1 - 0.3) = 28 Hz
    still = torch.full((fps + 1, 50, 80), 90.0)
    events = simulate(
        still,
        torch.arange(fps + 1, dtype=torch.float64) / fps,
        SensorModel(shot_rate_hz=40.0),
        torch.Generator().manual_seed(4),
    )
    expected = 28 * 4000
    assert abs(len(events) - expected) < 4 * math.sqrt(expected)
    assert (
        abs(int((events.p > 0).sum()) - expected / 2)
        < 4 * math.sqrt(expected / 4) + 4 * math.sqrt(expected) / 2
    )
    histogram = torch.histc(events.t_us.double(), bins=20, min=0, max=1e6)
    assert (
        float(((histogram - len(events) / 20) ** 2 / (len(events) / 20)).sum()) < 45
    )  # chi-squared, 19 degrees: passed once in a thousand
    per_pixel = torch.bincount(events.y * 80 + events.x, minlength=4000).double()
    assert float(per_pixel.var() / per_pixel.mean()) == pytest.approx(
        1, abs=4 * math.sqrt(2 / 4000)
    )  # Poisson: variance = mean
    rank = np.lexsort((events.t_us, events.x, events.y))
    gap = np.diff(events.t_us.numpy()[rank])
    gap = gap[np.diff(events.y.numpy()[rank] * 80 + events.x.numpy()[rank]) == 0] * 1e-6
    assert np.mean(gap < 0.01) == pytest.approx(
        1 - math.exp(-0.28), abs=0.01
    )  # waiting times; the window of 1 s cuts a few long ones


def test_noise_events_scale_with_thresholds_and_reset_the_memorised_level():
    still = torch.full((101, 100, 100), 90.0)
    state = SensorState()
    t_s = torch.arange(101, dtype=torch.float64) / 50
    events = simulate(
        still, t_s, SensorModel(theta_sigma=0.05, shot_rate_hz=30.0), torch.Generator().manual_seed(2), state
    )
    on = torch.bincount((events.y * 100 + events.x)[events.p > 0], minlength=10_000).double()
    expected = 15 * 0.7 * 2 * 0.2 / state.theta_on.double().flatten()  # per pixel, 2 s
    split = state.theta_on.flatten() < 0.2
    for half in (split, ~split):
        assert abs(on[half].sum() - expected[half].sum()) < 4 * math.sqrt(float(expected[half].sum()))
    # a drift below every threshold: each noise event sets the memorised level to the level seen
    ramp = (4 + 0.19 * torch.arange(2) + torch.zeros(60, 60, 2)).permute(2, 0, 1)
    state = SensorState()
    simulate(
        ramp,
        [0.0, 1.0],
        SensorModel(shot_rate_hz=1e3),
        torch.Generator().manual_seed(2),
        state,
        log_input=True,
    )
    rate_hz = 1e3 * (1 - 0.75 * (0.5 * (math.exp(4) + math.exp(4.19)) + 20) / 275)
    # the last noise event lies 1/rate back on average, an exponential law: 1.7 % standard error of 3600
    # pixels
    assert float((state.level - state.reference).mean()) == pytest.approx(0.19 / rate_hz, rel=0.06)


@pytest.mark.parametrize("sign", [1, -1])
def test_noise_events_and_crossings_come_in_order_of_time(sign):
    """Level 4 +- 1 per second: a threshold of 0.2 is crossed 0.2 s after the start, the last crossing or the
    last noise event, which set the memorised level; so no pixel waits longer, and what comes earlier is
    noise."""
    level = (4 + sign * torch.arange(2) + torch.zeros(60, 60, 2)).permute(2, 0, 1)
    rate_hz = 2.0
    events = simulate(
        level, [0.0, 1.0], SensorModel(shot_rate_hz=rate_hz), torch.Generator().manual_seed(6), log_input=True
    )
    noise = 0
    for pixel in (events.y * 60 + events.x).unique():
        mine = events.y * 60 + events.x == pixel
        gap_us = torch.diff(events.t_us[mine], prepend=torch.zeros(1, dtype=torch.int64))
        assert int(gap_us.max()) <= 200_001
        assert 1_000_000 - int(events.t_us[mine][-1]) <= 200_001
        crossing = (gap_us - 200_000).abs() <= 1
        noise += int((~crossing).sum())
        assert bool((events.p[mine][crossing] == sign).all())
    light = (0.5 * (math.exp(4) + math.exp(4 + sign)) + 20) / 275
    expected = 3600 * rate_hz * (1 - 0.75 * light)
    assert abs(noise - expected) < 4 * math.sqrt(expected)
    against = int((events.p == -sign).sum())  # half of the noise: crossings have the ramp's own polarity
    assert abs(against - noise / 2) < 4 * math.sqrt(noise / 4)


def test_noise_events_start_no_dead_time():
    """Level 4 + 1 per second and a dead time of 0.3 s: the first crossing comes 0.2 s after the start or
    after the noise event that set the memorised level, and no crossing came before it."""
    level = (4 + torch.arange(2) + torch.zeros(80, 80, 2)).permute(2, 0, 1)
    sensor = SensorModel(shot_rate_hz=3.0, refractory_s=0.3)
    events = simulate(level, [0.0, 1.0], sensor, torch.Generator().manual_seed(6), log_input=True)
    seen = 0
    for pixel in (events.y * 80 + events.x).unique():
        t_us = events.t_us[events.y * 80 + events.x == pixel]
        if (
            int(t_us[0]) < 199_000
        ):  # a noise event; the crossing behind it is due, unless another one comes first
            following = int(t_us[1]) - int(t_us[0]) if len(t_us) > 1 else 10**6
            assert following <= 200_001
            seen += abs(following - 200_000) <= 1
    assert seen > 200


def test_photoreceptor_noise_grows_to_its_strength_and_fades_as_the_photoreceptor():
    """A first-order process from 0: of the variance ``noise_level`` squared, 1 - q^2k is there after k
    frames, and q = exp(-2 pi f dt) of the noise is left after one. 40,000 pixels: 0.35 % standard error of a
    deviation."""
    sensor = SensorModel(cutoff_hz=60.0, shot_rate_hz=5.0, photoreceptor_noise=True)
    step_s = 2e-3
    still = torch.full((6, 200, 200), 90.0, dtype=torch.float64)
    t_s = torch.arange(6, dtype=torch.float64) * step_s
    state = SensorState(generator=torch.Generator().manual_seed(1))
    q = math.exp(-2 * math.pi * 60.0 * step_s)
    noise = []
    for chunk in (slice(0, 2), slice(2, 5), slice(5, 6)):
        simulate(still[chunk], t_s[chunk], sensor, state=state)
        assert state.noise is not None
        noise.append(state.noise.double().flatten().clone())
        k = chunk.stop - 1
        assert float(noise[-1].std()) == pytest.approx(
            sensor.noise_level() * math.sqrt(1 - q ** (2 * k)), rel=0.015
        )
    together = float((noise[1] * noise[2]).mean()) / float((noise[1] ** 2).mean())
    assert together == pytest.approx(q, abs=0.02)


@pytest.mark.parametrize("thetas", [(0.2, 0.2), (0.15, 0.25), (0.3, 0.1)])
def test_photoreceptor_noise_is_as_strong_as_the_mean_of_the_smaller_threshold_asks(thetas):
    # E min(a, b) of two normal numbers by integration over their tails
    sigma = 0.03
    x = np.linspace(-0.2, 0.8, 200_001)
    above = [0.5 * np.vectorize(math.erfc)((x - theta) / (sigma * math.sqrt(2))) for theta in thetas]
    smaller = -0.2 + np.sum(above[0] * above[1]) * (x[1] - x[0])
    found, sharp = (
        SensorModel(
            thetas[0], thetas[1], spread, cutoff_hz=60.0, shot_rate_hz=5.0, photoreceptor_noise=True
        ).noise_level()
        for spread in (sigma, 0.0)
    )
    assert found / sharp == pytest.approx(smaller / min(thetas), rel=1e-4)


def test_hot_pixels_fire_on_at_their_rate_and_others_are_silent():
    sensor = SensorModel(hot_pixel_share=0.1, hot_pixel_rate_hz=50.0)
    events = simulate(
        torch.full((21, 100, 100), 60.0),
        torch.arange(21, dtype=torch.float64) / 20,
        sensor,
        torch.Generator().manual_seed(0),
    )
    per_pixel = torch.bincount(events.y * 100 + events.x, minlength=10_000)
    hot = per_pixel > 0
    assert abs(int(hot.sum()) - 1000) < 4 * math.sqrt(900)
    assert set(per_pixel[hot].tolist()) <= {49, 50}
    assert bool((events.p == 1).all())
    gaps = events.t_us[(events.y * 100 + events.x) == int(hot.nonzero()[0])].diff()
    assert (gaps - 20_000).abs().max() <= 2


def test_bad_frames_in_a_later_chunk_leave_the_state_as_it_was():
    frames, t_s = clip()
    state = SensorState()
    simulate(frames[:5], t_s[:5], EVERYTHING, state=state)
    before = {name: tensor.clone() for name, tensor in state.tensors().items()}
    frames[20, 3, 3] = math.nan
    with pytest.raises(DomainError, match="NaN"):
        simulate(frames[5:], t_s[5:], EVERYTHING, state=state)
    assert state.time_s == float(t_s[4])
    assert all(torch.equal(tensor, before[name]) for name, tensor in state.tensors().items())
