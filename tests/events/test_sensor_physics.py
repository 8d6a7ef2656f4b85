"""Low-pass, leak, noise events, hot pixels and dead time of the interpolated sensor against
differential equations and the laws of their randomness."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from codesign import backend
from codesign.errors import CodesignError
from codesign.events import (
    SensorModel,
    SensorState,
    concatenate,
    dense_counts,
    draw_shot_counts,
    draw_thresholds,
    lin_log,
    low_pass,
    one_pole,
    simulate,
    to_counts,
)
from codesign.events.low_pass import coefficients
from codesign.events.sensor.crossing import hashed, normal_pair, uniform
from tests.event_streams import same
from tests.events.test_layers import PHYSICAL
from tests.numbers import D, close, rand64, seeded

EVERYTHING = replace(PHYSICAL, hot_pixel_share=0.05, hot_pixel_rate_hz=80.0)
NOISY = SensorModel(0.2, 0.2, 0.02, 50.0, shot_rate_hz=2.0, photoreceptor_noise=True)


def clip(frames=30, dtype=torch.float32):
    drift = torch.randn(frames, 9, 8, generator=seeded(1), dtype=dtype).cumsum(0) * 0.1
    steps_s = 2e-3 * (rand64(seeded(1), frames) + 0.2)
    return (4 + drift).exp(), steps_s.cumsum(0)


@pytest.mark.parametrize("cutoff_hz", [0.01, 30.0, 2000.0])
def test_the_low_pass_of_sensor_and_layers_solves_its_differential_equation(cutoff_hz):
    frames, t_s = clip(dtype=D)
    state = SensorState()
    simulate(frames, t_s, SensorModel(cutoff_hz=cutoff_hz), state=state)
    by_function = low_pass(lin_log(frames), frames, t_s.diff(), cutoff_hz)[-1]
    close(by_function, state.level, atol=1e-12)
    intensity = frames[:, 3, 4].numpy()
    level = np.log(intensity)
    filtered = level[0]
    for k, step_s in enumerate(t_s.diff().tolist()):
        pace = 2 * math.pi * cutoff_hz * (0.5 * (intensity[k] + intensity[k + 1]) + 20) / 275
        piece = (lambda s, v, a, b, r: r * (a + b * s - v)), (0, step_s), [filtered]
        rates = (level[k], (level[k + 1] - level[k]) / step_s, pace)
        filtered = solve_ivp(*piece, args=rates, method="Radau", rtol=1e-10, atol=1e-12).y[0, -1]
    assert float(state.level[3, 4]) == pytest.approx(filtered, abs=1e-8)


@pytest.mark.parametrize("cutoff_hz", [40.0, 1e-4])  # the second is in the series for small paces
def test_gradients_of_the_low_pass_are_differences_and_a_ramp_lags_by_its_time_constant(cutoff_hz):
    frames, t_s = clip(5, dtype=D)
    inputs = (
        frames[:, 0, :2].clone().requires_grad_(),
        torch.tensor(cutoff_hz, dtype=D, requires_grad=True),
    )
    assert torch.autograd.gradcheck(
        lambda f, c: low_pass(f.log(), f, t_s.diff(), c), inputs, atol=1e-7
    )
    tau_s = 0.007
    ramp = one_pole(3 * t_s[:, None], t_s.diff()[:, None] / tau_s, 3 * t_s[:1])[:, 0]
    truth = 3 * (t_s - tau_s * (1 - torch.exp((t_s[0] - t_s) / tau_s)))
    close(ramp, truth, atol=1e-12)


@pytest.mark.parametrize("pace", [0.0, 1e-9, 0.01, 0.0499, 0.0501, 2.0])
def test_the_mean_of_the_fading_and_its_slope_are_those_of_their_power_series(pace):
    """(1 - e^-a) / a = sum of (-a)^k / (k + 1)!, free of the cancellation of small a."""
    a = torch.tensor(pace, dtype=D, requires_grad=True)
    _, mean = coefficients(a, torch.exp, torch.where)
    (slope,) = torch.autograd.grad(mean, a)
    truth = sum((-pace) ** k / math.factorial(k + 1) for k in range(40))
    by_pace = sum(-k * (-pace) ** (k - 1) / math.factorial(k + 1) for k in range(1, 40))
    # below 0.05 the term a^5 / 720 is left out: 4e-10 of the value, 4e-8 of the slope
    assert mean.item() == pytest.approx(truth, rel=5e-10)
    assert slope.item() == pytest.approx(by_pace, rel=1e-7)


@pytest.mark.bits
@pytest.mark.parametrize("timing", ["interpolated", "v2e"])
@pytest.mark.parametrize("physics", [EVERYTHING, NOISY])
def test_any_chunking_gives_the_events_of_the_whole_and_dense_counts_are_theirs(timing, physics):
    frames, t_s = clip()
    sensor = replace(physics, timing=timing)
    whole = simulate(frames, t_s, sensor, seeded(5))
    assert len(whole) > 100
    assert not same(whole, simulate(frames, t_s, sensor, seeded(6)))
    for cuts in ([2, 3], [9, 10, 29], list(range(2, 30))):
        state = SensorState(generator=seeded(5))
        ends = zip([0, *cuts], [*cuts, 30], strict=True)
        parts = [simulate(frames[a:b], t_s[a:b], sensor, state=state) for a, b in ends]
        assert same(whole, concatenate(parts))
    if timing == "interpolated":
        for shape in ((9, 8), (3, 3, 8)):
            counts = dense_counts(frames.reshape(30, *shape), t_s, sensor, seeded(5))
            assert torch.equal(counts.reshape(29, 2, 9, 8), to_counts(whole, t_s))


# what is wrong, from which chunk on, and what is said
REFUSED = [
    (lambda frames, t_s: (frames, t_s - 1), 1, "go on increasing"),
    (lambda frames, t_s: (frames, t_s[-1].expand(30)), 0, "increase"),
    (lambda frames, t_s: (frames.index_fill(0, torch.tensor([20]), math.nan), t_s), 0, "NaN"),
    (lambda frames, t_s: (frames - 300, t_s), 0, "frames must be >= 0"),
    (lambda frames, t_s: (frames[:, :2], t_s), 1, "keep their size"),
]
TOO_LONG = (lambda frames, t_s: (frames, t_s * 1e15), 0, "exceed 64-bit")


@pytest.mark.parametrize(
    ("timing", "change", "earliest", "words"),
    [
        *((timing, *row) for timing in ("interpolated", "v2e") for row in REFUSED),
        ("interpolated", *TOO_LONG),
    ],
)
def test_refused_frames_leave_a_stream_and_its_noise_as_they_were(timing, change, earliest, words):
    frames, t_s = clip()
    sensor = replace(EVERYTHING, timing=timing)
    streams = []
    for refused in (False, True):
        state = SensorState(generator=seeded(5))
        for chunk in range(2):
            if refused and chunk >= earliest:
                with pytest.raises(CodesignError, match=words):
                    simulate(*change(frames, t_s + chunk), sensor, state=state)
            streams.append(simulate(frames, t_s + chunk, sensor, state=state))
    assert len(streams[1]) > 100
    assert same(streams[0], streams[2])
    assert same(streams[1], streams[3])


def test_thresholds_follow_a_clamped_normal_distribution():
    sensor = SensorModel(0.2, 0.1, theta_sigma=0.05)
    on, off = (theta.double() for theta in draw_thresholds(sensor, (500, 400), seeded(3)))
    # 200000 draws: standard error of the mean 1.1e-4, of the deviation 8e-5; five of them allowed
    assert abs(on.mean() - 0.2) < 5.6e-4
    assert abs(on.std() - 0.05) < 4e-4
    below = 0.5 * math.erfc((0.1 - 0.01) / 0.05 / math.sqrt(2))  # share clamped at 0.01: 3.6 %
    share = float((off == off.min()).double().mean())
    assert abs(share - below) < 5 * math.sqrt(below / 200_000)
    assert float(off.min()) == pytest.approx(0.01)
    together = float(((on - on.mean()) * (off - off.mean())).mean())
    assert abs(together) < 5 * 0.05**2 / math.sqrt(200_000)
    assert torch.equal(draw_thresholds(sensor, (500, 400), seeded(3))[0].double(), on)


def test_drawn_shot_counts_are_poisson_per_pixel_and_polarity():
    interval_s = torch.tensor([0.01, 0.03, 0.05])
    sensor = SensorModel(shot_rate_hz=40.0)
    counts = draw_shot_counts(sensor, (200, 250), interval_s, seeded(4), dtype=D)
    for k, expected in enumerate((0.2, 0.6, 1.0)):  # 20 Hz per polarity
        for found in counts[k]:
            assert abs(found.mean() - expected) < 5 * math.sqrt(expected / 50_000)
            # variance of the sample variance of a Poisson count: (m + 2 m^2)/n
            spread = expected + 2 * expected**2
            assert abs(found.var() - expected) < 5 * math.sqrt(spread / 50_000)


@pytest.mark.parametrize("fps", [20, 1000])
def test_noise_events_are_a_poisson_process_at_every_frame_rate(fps):
    # (I + 20)/275 = 0.4 at I = 90: 40 Hz * (1 - 0.3) = 28 Hz
    still = torch.full((fps + 1, 25, 80), 90.0)
    t_s = torch.arange(fps + 1, dtype=D) / fps
    events = simulate(still, t_s, SensorModel(shot_rate_hz=40.0), seeded(4))
    expected = 28 * 2000
    assert abs(len(events) - expected) < 4 * math.sqrt(expected)
    assert abs(int(events.p.sum())) < 4 * math.sqrt(len(events))
    histogram = torch.histc(events.t_us.double(), bins=20, min=0, max=1e6)
    # chi-squared, 19 degrees: passed once in a thousand
    assert ((histogram - len(events) / 20) ** 2 / (len(events) / 20)).sum() < 45
    per_pixel = torch.bincount(events.y * 80 + events.x, minlength=2000).double()
    # Poisson: variance = mean
    ratio = float(per_pixel.var() / per_pixel.mean())
    assert ratio == pytest.approx(1, abs=4 * math.sqrt(2 / 2000))
    rank = np.lexsort((events.t_us, events.x, events.y))
    gap_s = np.diff(events.t_us.numpy()[rank]) * 1e-6
    gap_s = gap_s[np.diff((events.y * 80 + events.x).numpy()[rank]) == 0]
    # waiting times; the window of 1 s cuts a few long ones
    assert np.mean(gap_s < 0.01) == pytest.approx(1 - math.exp(-0.28), abs=0.01)


def test_noise_events_scale_with_thresholds_and_reset_the_memorised_level():
    state = SensorState()
    t_s = torch.arange(101, dtype=D) / 50
    sensor = SensorModel(theta_sigma=0.05, shot_rate_hz=30.0)
    events = simulate(torch.full((101, 100, 100), 90.0), t_s, sensor, seeded(2), state)
    on = torch.bincount((events.y * 100 + events.x)[events.p > 0], minlength=10_000).double()
    expected = 15 * 0.7 * 2 * 0.2 / state.theta_on.double().flatten()  # per pixel, 2 s
    split = state.theta_on.flatten() < 0.2
    for half in (split, ~split):
        total = float(expected[half].sum())
        assert abs(on[half].sum() - total) < 4 * math.sqrt(total)
    # a drift below every threshold: each noise event sets the memorised level to the level seen
    state = SensorState()
    noisy = SensorModel(shot_rate_hz=1e3)
    simulate(ramps(60, 0.19), [0.0, 1.0], noisy, seeded(2), state, log_input=True)
    rate_hz = 1e3 * (1 - 0.75 * (0.5 * (math.exp(4) + math.exp(4.19)) + 20) / 275)
    # the last noise event lies 1/rate back on average, an exponential law: 1.7 % standard error of
    # 3600 pixels
    assert float((state.level - state.reference).mean()) == pytest.approx(0.19 / rate_hz, rel=0.06)


def ramps(side, rise):
    return (4 + rise * torch.arange(2.0)[:, None, None]).expand(2, side, side)


def of_pixels(events):
    """Times and polarities of every pixel with events."""
    pixel = events.y * events.width_px + events.x
    order = torch.argsort(pixel, stable=True)
    sizes = pixel.unique(return_counts=True)[1].tolist()
    return zip(events.t_us[order].split(sizes), events.p[order].split(sizes), strict=True)


@pytest.mark.parametrize("sign", [1, -1])
def test_noise_events_and_crossings_come_in_order_of_time(sign):
    """Level 4 +- 1 per second: a threshold of 0.2 is crossed 0.2 s after the start, the last
    crossing or the last noise event, which set the memorised level; so no pixel waits longer, and
    what comes earlier is noise."""
    rate_hz = 2.0
    sensor = SensorModel(shot_rate_hz=rate_hz)
    events = simulate(ramps(60, sign), [0.0, 1.0], sensor, seeded(6), log_input=True)
    noise = 0
    for t_us, p in of_pixels(events):
        gap_us = torch.diff(t_us, prepend=t_us.new_zeros(1))
        assert max(int(gap_us.max()), 1_000_000 - int(t_us[-1])) <= 200_001
        crossing = (gap_us - 200_000).abs() <= 1
        noise += int((~crossing).sum())
        assert (p[crossing] == sign).all()
    light = (0.5 * (math.exp(4) + math.exp(4 + sign)) + 20) / 275
    expected = 3600 * rate_hz * (1 - 0.75 * light)
    assert abs(noise - expected) < 4 * math.sqrt(expected)
    # half of the noise: crossings have the ramp's own polarity
    against = int((events.p == -sign).sum())
    assert abs(against - noise / 2) < 4 * math.sqrt(noise / 4)


def test_noise_events_start_no_dead_time():
    """Level 4 + 1 per second and a dead time of 0.3 s: the first crossing comes 0.2 s after the
    start or after the noise event that set the memorised level, and no crossing came before it."""
    sensor = SensorModel(shot_rate_hz=3.0, refractory_s=0.3)
    events = simulate(ramps(80, 1), [0.0, 1.0], sensor, seeded(6), log_input=True)
    seen = 0
    for t_us, _ in of_pixels(events):
        # a noise event; the crossing behind it is due, unless another one comes first
        if int(t_us[0]) < 199_000:
            following = int(t_us[1]) - int(t_us[0]) if len(t_us) > 1 else 10**6
            assert following <= 200_001
            seen += abs(following - 200_000) <= 1
    assert seen > 200


@pytest.mark.parametrize("timing", ["interpolated", "v2e"])
def test_photoreceptor_noise_grows_to_its_strength_and_fades_as_the_photoreceptor(timing):
    """A first-order process from 0: of the variance ``noise_level`` squared, 1 - q^2k is there
    after k frames, and q = exp(-2 pi f dt) of the noise is left after one, for v2e the first two
    terms of its series. 40,000 pixels: 0.35 % standard error of a deviation."""
    sensor = SensorModel(cutoff_hz=60.0, shot_rate_hz=5.0, photoreceptor_noise=True, timing=timing)
    state = SensorState(generator=seeded(1))
    pace = 2 * math.pi * 60.0 * 2e-3
    q = math.exp(-pace) if timing == "interpolated" else 1 - pace
    noise = []
    for first, end in ((0, 2), (2, 5), (5, 6)):
        t_s = torch.arange(first, end, dtype=D) * 2e-3
        simulate(torch.full((end - first, 200, 200), 90.0, dtype=D), t_s, sensor, state=state)
        noise.append(state.noise.double().clone())
        strength = sensor.noise_level() * math.sqrt(1 - q ** (2 * (end - 1)))
        assert float(noise[-1].std()) == pytest.approx(strength, rel=0.015)
    together = float((noise[1] * noise[2]).mean()) / float((noise[1] ** 2).mean())
    assert together == pytest.approx(q, abs=0.02)


@pytest.mark.parametrize("thetas", [(0.2, 0.2), (0.3, 0.1)])
def test_photoreceptor_noise_is_as_strong_as_the_mean_of_the_smaller_threshold_asks(thetas):
    # E min(a, b) of two normal numbers by integration over their tails
    x = torch.linspace(-0.2, 0.8, 200_001, dtype=D)
    above = [0.5 * torch.special.erfc((x - theta) / (0.03 * math.sqrt(2))) for theta in thetas]
    smaller = -0.2 + float((above[0] * above[1]).sum()) * 1.0 / 200_000
    noise = {"cutoff_hz": 60.0, "shot_rate_hz": 5.0, "photoreceptor_noise": True}
    found, sharp = (SensorModel(*thetas, sigma, **noise).noise_level() for sigma in (0.03, 0.0))
    assert found / sharp == pytest.approx(smaller / min(thetas), rel=1e-4)


def test_hot_pixels_fire_on_at_their_rate_and_others_are_silent():
    sensor = SensorModel(hot_pixel_share=0.1, hot_pixel_rate_hz=50.0)
    still = torch.full((21, 100, 100), 60.0)
    events = simulate(still, torch.arange(21, dtype=D) / 20, sensor, seeded())
    per_pixel = torch.bincount(events.y * 100 + events.x, minlength=10_000)
    hot = per_pixel > 0
    assert abs(int(hot.sum()) - 1000) < 4 * math.sqrt(900)
    assert set(per_pixel[hot].tolist()) <= {49, 50}
    assert (events.p == 1).all()
    gaps = events.t_us[(events.y * 100 + events.x) == int(hot.nonzero()[0])].diff()
    assert (gaps - 20_000).abs().max() <= 2


def test_normal_numbers_follow_their_law_and_neighbours_are_uncorrelated():
    """Even and exponential ones are those of the noise events."""
    import drjit as dr

    count = 1 << 20
    arr = backend.arrays("cpu", torch.float32)
    even = uniform(arr, hashed(dr.arange(arr.UInt32, count))).torch().double()
    pair = normal_pair(dr, arr, dr.arange(arr.UInt32, count))
    normals = [value.torch().double() for value in pair]
    error = 4 / math.sqrt(count)
    assert 0 < even.min() < even.max() < 1
    for normal in normals:
        for power, moment, spread in ((1, 0, 1), (2, 1, 2), (4, 3, 96)):
            found = float((normal**power).mean())
            assert found == pytest.approx(moment, abs=error * math.sqrt(spread))
    flat = even - even.mean()
    for lag in (1, 2, 16, 346):
        assert abs((flat[lag:] * flat[:-lag]).mean() / flat.var()) < error
    assert abs((normals[0] * normals[1]).mean()) < error
