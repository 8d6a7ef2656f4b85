"""Gradients of every event layer against the account that its docstring gives of itself, written
out for one pixel of the worst clip (black, saturated, beyond the film, at the joint of the front
end, still); those to the sensor against differences of hard counts; the two smooth baselines
against closed forms and means."""

import math

import pytest
import torch
from torch.autograd.functional import jacobian

from codesign.events import LAYERS, SensorModel, expected, layer, memory, naive, sensor_counts
from tests.event_streams import rows
from tests.events.slopes import cosine_and_scale
from tests.events.test_memory import plain_loop
from tests.numbers import D, close, f64, rand64, randn64, seeded

CLIP = (0.0, 255.0, 0.0, 1e4, 1e-6, 20.0, 20.0, 300.0)
# for the layer of one event per step, which after those jumps only hurries after the level
SLOWER_CLIP = (100.0, 255.0, 300.0, 255.0, 1e-6, 20.0, 20.0, 300.0)
STEP_S = 1e-3
DEAD_S = 1e-4  # short beside the frames: taken as local
SPREAD = 0.15


def filtered(frames, cutoff_hz):
    """Lin-log level behind the photoreceptor's low-pass, exact for levels that are linear between
    frames."""
    level = torch.where(frames <= 20, frames * math.log(20) / 20, frames.clamp(min=20).log())
    seen = [level[0]]
    for k in range(1, len(frames)):
        a = 2 * math.pi * cutoff_hz * (0.5 * (frames[k] + frames[k - 1]) + 20) / 275 * STEP_S
        rise = level[k] - level[k - 1]
        seen.append(
            level[k] + (seen[-1] - level[k - 1]) * torch.exp(-a) - rise * (1 - torch.exp(-a)) / a
        )
    return torch.stack(seen)


def by_steps(of_pair):
    """The account of a layer that looks at the two frames of a step alone."""
    return lambda seen, on, off: torch.stack(
        [of_pair(seen.diff() / on), of_pair(-seen.diff() / off)], 1
    )


def by_memory(step):
    """The account of a layer that memorises a level: step(way, thetas) gives two counts and the
    level's move."""

    def account(seen, on, off):
        memorised = seen[0]
        found = []
        for now in seen[1:]:
            pair, moved = step(now - memorised, (on, off))
            memorised = memorised + moved
            found.append(torch.stack(pair))
        return torch.stack(found)

    return account


def dense_step(way, thetas):
    units = [way / thetas[0] - 1, -way / thetas[1] - 1]
    slopes = [(5 / (1 + 5 * u.abs()) ** 2).detach() for u in units]
    fired = [
        (u >= 0).to(u) + slope * (u - u.detach()) for u, slope in zip(units, slopes, strict=True)
    ]
    return fired, (fired[0] + fired[1]) * way


def expected_step(way, thetas):
    """Sums over the k-th events of pixels whose thresholds scatter log-normally."""
    k = torch.arange(1, 401, dtype=D)
    pair, moved = [], 0.0
    for sign, theta in zip((1, -1), thetas, strict=True):
        place = (((sign * way).clamp(min=1e-300) / theta).log() - k.log()) / SPREAD
        pair.append(torch.special.ndtr(place).sum())
        if sign * way > 0:
            moved = (
                sign * theta * math.exp(SPREAD**2 / 2) * torch.special.ndtr(place - SPREAD).sum()
            )
    return pair, moved


def physical(seen, on, off):
    """Of the memory layer's counts the dead time lets one in r T + 1/2 pass."""
    step = seen.diff()
    rate_hz = step.abs() / torch.where(step > 0, on, off) / STEP_S
    return plain_loop(seen, on, off)[0] / (rate_hz * DEAD_S + 0.5).clamp(min=1)[:, None]


def srm(seen, on, off):
    """The slopes of the memory layer for a level that leaves its play by a threshold per step at
    most; of equal thresholds."""
    half = (on + off) / 4
    centre = seen[0]
    held = [seen[0]]
    for now in seen[1:]:
        rise = (now - centre - half).clamp(min=0)
        fall = (centre - half - now).clamp(min=0)
        late = bool((rise > on) | (fall > off))
        centre = centre + torch.minimum(rise, on) - torch.minimum(fall, off)
        held.append((centre + half if rise > 0 else centre - half) if late else now)
    return plain_loop(torch.stack(held), on, off)[0]


ACCOUNTS = {
    "sigmoid": by_steps(lambda units: torch.sigmoid(5 * (units - 1))),
    "counts": by_steps(lambda units: units.clamp(min=0)),
    "dense": by_memory(dense_step),
    "memory": lambda seen, on, off: plain_loop(seen, on, off)[0],
    "expected": by_memory(expected_step),
    "srm": srm,
    "physical": physical,
}


@pytest.mark.parametrize("kind", LAYERS)
def test_values_and_gradients_of_every_layer_on_the_worst_clip_are_those_of_its_account(
    kind, generator
):
    clip = f64(SLOWER_CLIP if kind == "srm" else CLIP)
    theta_off = 0.2 if kind == "srm" else 0.25
    sensor = SensorModel(
        0.2, theta_off, cutoff_hz=50.0, refractory_s=DEAD_S if kind == "physical" else 0.0
    )
    names = ("theta_on", "theta_off", "cutoff_hz")
    learnt = layer(kind, sensor, learn=names)
    frames = clip[:, None, None].expand(-1, 2, 3).clone().requires_grad_()
    weights = randn64(generator, len(clip) - 1, 2)
    found = learnt(frames, torch.arange(len(clip), dtype=D) * STEP_S)
    variables = [learnt.learnt.raw[name] for name in names]
    by_frames, *by_variables = torch.autograd.grad(
        (found * weights[..., None, None]).sum(), [frames, *variables]
    )
    pixel = clip.clone().requires_grad_()
    values = [torch.tensor(getattr(sensor, name), dtype=D, requires_grad=True) for name in names]
    pair = ACCOUNTS[kind](filtered(pixel, values[2]), values[0], values[1])
    if kind not in ("srm", "physical"):  # whose accounts are of slopes alone
        torch.testing.assert_close(found, pair[..., None, None].expand_as(found))
    truth, *by_values = torch.autograd.grad(
        (pair * weights).sum(), [pixel, *values], allow_unused=True
    )
    # the low-pass leaves a^5 / 720 out of a series for paces a below 0.05: 4e-8 of a step in the
    # derivative
    expanded = truth[:, None, None].expand_as(by_frames)
    close(by_frames, expanded, rtol=1e-6, atol=1e-9 * float(truth.abs().max()))
    for mine, slope, value in zip(by_variables, by_values, values, strict=True):
        # six pixels; a unit of a variable is a tenth of the value's logarithm
        assert float(mine) == pytest.approx(6 * 0.1 * value.item() * slope.item(), rel=1e-6)


def moving_pattern(fps=240, size=36):
    """Sum of plane waves drifting over the sensor: log levels [T, size, size]."""
    generator = seeded()
    wave = randn64(generator, 12, 2) * 0.25
    phase = rand64(generator, 12) * 2 * math.pi
    strength = rand64(generator, 12) * 0.3 + 0.1
    t_s = torch.arange(0, 0.25, 1 / fps, dtype=D)
    place = torch.arange(size, dtype=D)
    t, y, x = torch.meshgrid(t_s, place, place, indexing="ij")
    waves = [
        s * (w[0] * (x + 60 * t) + w[1] * (y + 25 * t) + p).cos()
        for s, w, p in zip(strength, wave, phase, strict=True)
    ]
    return 4.2 + sum(waves), t_s


# cosine and scale of the gradient of pooled counts against differences of the hard sensor's: the
# bounds leave room for another seed, not for a missing term (a threshold gradient without memory
# has scale below 0.5)
@pytest.mark.parametrize(
    ("name", "sensor", "step", "cosine", "scales"),
    [
        ("theta_on", SensorModel(0.2, 0.2, 0.03), 0.1, 0.95, (0.9, 1.1)),
        ("theta_off", SensorModel(0.2, 0.25), 0.1, 0.95, (0.8, 1.1)),
        ("theta_sigma", SensorModel(0.2, 0.2, 0.03), 0.9, 0.9, (0.55, 1.1)),
        ("cutoff_hz", SensorModel(0.1, 0.1, cutoff_hz=20.0), 0.2, 0.87, (0.65, 1.1)),
    ],
)
def test_gradients_to_the_sensor_follow_differences_of_hard_counts(
    name, sensor, step, cosine, scales
):
    level, t_s = moving_pattern()
    before = getattr(sensor, name)

    def pooled(value):
        options = {"generator": seeded(1), "log_input": True, name: value}
        counts, _ = sensor_counts(level, t_s, sensor, **options)
        return counts[:56].reshape(4, 14, 2, 3, 12, 3, 12).sum((1, 4, 6)).flatten()

    slope = jacobian(pooled, f64(before))
    ends = [pooled(f64(before * (1 + sign * step))) for sign in (1, -1)]
    difference = (ends[0] - ends[1]) / (2 * step * before)
    found_cosine, scale = cosine_and_scale(slope, difference)
    assert found_cosine > cosine
    assert scales[0] < scale < scales[1]


@pytest.mark.parametrize("spread", [0.05, 0.4])
def test_expected_counts_are_means_over_thresholds(spread):
    # hard counts of one step, 200,000 drawn thresholds each: standard error below 0.4 % of the
    # spread
    steps = f64([0.0, 0.05, 0.1, 0.19, 0.21, 0.5, 1.5, 3.0, -0.3, -2.0])
    level = torch.stack((torch.zeros_like(steps), steps))
    drawn = torch.exp(spread * randn64(seeded(2), 200_000, 1))
    counts, reference = expected(level, 0.2, 0.25, spread, log_input=True)
    hard, after = memory(
        level[:, None].expand(2, 200_000, 10), 0.2 * drawn, 0.25 * drawn, log_input=True
    )
    for found, sample in ((counts[0], hard[0]), (reference, after[0])):
        error = 4 * sample.std(-2) / math.sqrt(200_000) + 1e-5
        assert ((found - sample.mean(-2)).abs() <= error).all()


@pytest.mark.parametrize("spread", [0.15, 0.17, 0.3, 0.5, 1.0])
def test_expected_counts_are_the_sums_that_define_them(spread):
    # before, at and beyond the ends of both ways to shorten a sum; 7.5 deviations: 1e-12 is left out
    many = torch.tensor([0.3, 1.19, 1.21, 2.4, 7.99, 8.01, 20.0, 60.0], dtype=D)
    events = torch.arange(1, math.ceil(60 * math.exp(7.5 * spread)), dtype=D)[:, None]
    place = (many.log() - events.log()) / spread
    lift = math.exp(spread**2 / 2)
    counts, reference = expected(
        torch.stack((0 * many, 0.2 * many)), 0.2, 0.2, spread, log_input=True
    )
    for found, truth in (
        (counts[0, 0], torch.special.ndtr(place).sum(0)),
        (reference, 0.2 * lift * torch.special.ndtr(place - spread).sum(0)),
    ):
        torch.testing.assert_close(found, truth, rtol=0, atol=4e-7)


def test_expected_counts_stay_smooth_through_the_series_end():
    # the sum over events is left for its integral at 1.2/spread events
    around = 0.2 * 1.2 / 0.15 * f64([1 - 1e-9, 1 + 1e-9])
    level = torch.stack((torch.zeros(2, dtype=D), around))
    counts, reference = expected(level, 0.2, 0.2, 0.15, log_input=True)
    assert counts[0, 0].diff().abs() < 1e-7
    assert reference.diff().abs() < 1e-7
    thetas = [torch.tensor(value, dtype=D, requires_grad=True) for value in (0.07, 0.09, 0.2)]
    frames = 50 + 30 * torch.rand(4, 2, generator=seeded(1), dtype=D)
    frames.requires_grad_()
    assert torch.autograd.gradcheck(lambda *a: expected(*a), (frames, *thetas))
    # of which the sum is cut, and the rest integrated
    wide = torch.tensor(0.9, dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(lambda *a: expected(*a), (frames, *thetas[:2], wide))


def test_frame_difference_caps_at_one_and_forgets():
    # per pixel: a slow ramp (never seen), one step of 1.1 (one event), exactly -theta, below -theta
    level = f64([[0.0, 0, 0, 0], [0.15, 1.1, -0.25, -0.24], [0.3, 1.1, -0.5, -0.48]])
    found = naive(level[:, None], [0.0, 0.01, 0.02], 0.25, log_input=True)
    assert (found.height_px, found.width_px) == (1, 4)
    assert rows(found) == [(10_000, 1, 0, 1), (10_000, 2, 0, -1), (20_000, 2, 0, -1)]
