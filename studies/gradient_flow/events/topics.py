"""The event layers beside the hard sensor: every layer with equal thresholds, the physical layer,
and when events come from few frames.

A camera passes a textured plane behind a thin lens. What a layer gives is pooled over blocks,
quarters of the time and polarity; one direction each changes the contrast of the scene, the focus
of the lens, or a component of the camera's pose, by enough to move log levels by about a threshold.
The derivative of every pooled number along the direction, averaged over the step, is set beside the
difference of the hard sensor's over the step.
"""

import warnings
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from codesign import events
from studies.gradient_flow.events import compare
from studies.gradient_flow.events.case import (
    DIRECTIONS,
    DURATION_S,
    FEW,
    SHIFT_X,
    Case,
    Direction,
    times,
)
from studies.gradient_flow.events.compare import Judge
from studies.gradient_flow.topic import Topic, pointing

THETA = 0.15
IDEAL = events.SensorModel(THETA, THETA)


@cache
def case_of(seed: int) -> Case:
    """The textures and path of a seed, whose frames are rendered once."""
    return Case(seed)


def cases_of(config) -> list[Case]:
    """As many cases as are asked for."""
    return [case_of(config.seed + number) for number in range(config.scenes)]


def direction_of(name: str) -> Direction:
    """A direction by its name."""
    return next(each for each in DIRECTIONS if each.name == name)


# ---- every layer with equal thresholds

FAST = ("sigmoid", "memory")
EVERY = {
    "sigmoid": lambda frames, t_s: events.soft(frames, THETA),
    "dense": lambda frames, t_s: events.dense(frames, THETA, THETA)[0],
    "expected": lambda frames, t_s: events.expected(frames, THETA, THETA, 0.15)[0],
    "memory": lambda frames, t_s: events.memory(frames, THETA, THETA)[0],
}
SLOW_HZ = 240  # up to which the others, loops of torch over frames, are compared, in few directions


def layer_jobs(quick):
    return [
        (layer, rate_hz, direction.name)
        for rate_hz in ((60, 240) if quick else (60, 240, 1000))
        for direction in (FEW if quick else DIRECTIONS)
        for layer in (EVERY if rate_hz <= SLOW_HZ and direction in FEW and not quick else FAST)
    ]


def measure_layer(config, layer, rate_hz, name):
    maps = compare.of_layer(EVERY[layer]), compare.of_judge(Judge(IDEAL))
    found = compare.pairs(cases_of(config), rate_hz, direction_of(name), *maps)
    yield compare.row((layer, name, f"{rate_hz}fps"), found)


LAYERS = Topic(
    "Every event layer with equal thresholds",
    "Contrast of the scene, focus of the lens, and the six components of the camera's pose, one by one: "
    + "; ".join(f"{d.name}: {d.noun}" for d in DIRECTIONS)
    + ".",
    ("layer", "direction", "frames per second"),
    layer_jobs,
    measure_layer,
    lambda row: pointing(0.98, 0.9, 1.1) if row.names[0] == "memory" else None,
)

# ---- the physical layer

PHYSICAL = {
    "bandwidth 30 Hz": replace(IDEAL, cutoff_hz=30.0),
    "bandwidth 100 Hz": replace(IDEAL, cutoff_hz=100.0),
    "bandwidth 300 Hz": replace(IDEAL, cutoff_hz=300.0),
    "leak 5 Hz": replace(IDEAL, leak_rate_hz=5.0),
    "spread 0.03": replace(IDEAL, theta_sigma=0.03),
    "dead time 5 ms": replace(IDEAL, refractory_s=0.005),
    "dead time 20 ms": replace(IDEAL, refractory_s=0.020),
}
LEARNT = ("theta_on", "theta_off", "theta_sigma", "cutoff_hz", "refractory_s")
STEP = 0.2  # relative, either way, of a field of the sensor
SECTIONS = 6  # counts depend on these smoothly
PHYSICAL_HZ = 240


def physical_maps(sensor, **design):
    """Derivative and truth of the counts of a sensor, whose thresholds are drawn alike for both."""

    def layer(frames, t_s):
        generator = torch.Generator().manual_seed(0)
        return events.sensor_counts(frames, t_s, sensor, generator=generator, **design)[0]

    return compare.of_layer(layer), compare.of_judge(Judge(sensor))


def measure_sensor(config, name):
    sensor = PHYSICAL[name]
    cases = cases_of(config)
    with warnings.catch_warnings():
        # of a rate beyond what is measured: here it is
        warnings.filterwarnings("ignore", "rate x dead time")
        for direction in FEW:
            found = compare.pairs(cases, PHYSICAL_HZ, direction, *physical_maps(sensor))
            yield compare.row((name, direction.name), found)
        for field in LEARNT:
            if (getattr(sensor, field) or 0) > 0:
                yield compare.row((name, field), [of_field(cases[0], sensor, field)])


def of_field(one, sensor, field):
    """Derivative over a step of a field of the sensor beside the difference of the counts."""
    frames = one.frames(PHYSICAL_HZ).float()
    t_s = times(PHYSICAL_HZ)
    start = getattr(sensor, field)
    slope = 0
    for k in range(SECTIONS):
        place = start * (1 + STEP * ((2 * k + 1) / SECTIONS - 1))
        value = torch.tensor(place, dtype=frames.dtype, requires_grad=True)
        layer, _ = physical_maps(
            replace(sensor, **{field: float(value.detach())}), **{field: value}
        )
        slope = slope + of_number(layer(frames, t_s), value) * start * STEP / SECTIONS
    low, high = (
        physical_maps(replace(sensor, **{field: start * (1 + STEP * s)}))[1](frames, t_s)
        for s in (-1, 1)
    )
    return compare.Pair(slope.double(), compare.blocks(high - low).double() / 2)


def of_number(found: Tensor, value: Tensor) -> Tensor:
    """[K, blocks] derivative of maps [K, H, W] to one number that all pixels share: a backward pass
    for each."""
    pooled = compare.blocks(found)
    grads = [torch.autograd.grad(one, value, retain_graph=True)[0] for one in pooled.flatten()]
    return torch.stack(grads).reshape(pooled.shape)


def asked_of_sensor(row):
    """Of dead times, over the step."""
    return pointing(0.97, 0.9, 1.1) if row.names[0].startswith("dead") else None


SENSORS = Topic(
    "Physical layer",
    f"Bandwidth of the photoreceptor, leak, spread of the thresholds, dead time, {PHYSICAL_HZ} frames per "
    f"second: directions of the case, and fields of the sensor, moved by {STEP:.0%} either way (one scene).",
    ("sensor", "direction"),
    lambda quick: [(name,) for name in list(PHYSICAL)[-1 if quick else 0 :]],
    measure_sensor,
    asked_of_sensor,
)

# ---- when events come

BINS = 5
TRUTH_HZ = 10_000
INTERVALS = (5, 8, 12, 16, 32)
TIMED_SECTIONS = 12
LOSSES = {"counts": slice(0, 2), "volume": slice(2, None)}
LAYER = events.layer("memory", IDEAL, learn=())


def observed(counts: Tensor, t_s: Tensor) -> Tensor:
    """Maps [2 + 2 BINS, ...] of counts [T-1, 2, ...]: their sums, and the volume."""
    flat = counts.flatten(2)[:, :, None]
    volume = events.from_counts(flat, t_s, BINS).counts[0].flatten(0, 1)
    return torch.cat((flat.sum(0), volume)).reshape(-1, *counts.shape[2:])


@cache
def stream_change(one: Case, name: str) -> Tensor:
    """Change of the maps over half the step of a direction, summed over blocks: the mean over
    beginnings of the stream at TRUTH_HZ."""
    judge = Judge(IDEAL)
    t_s = times(TRUTH_HZ)
    low, high = (
        judge.mean(
            one.frames(TRUTH_HZ, direction_of(name), s).float(),
            t_s,
            lambda counts: observed(counts, t_s),
        )
        for s in (-1.0, 1.0)
    )
    return compare.blocks(high - low).double() / 2


def measure_timing(config, intervals, name):
    t_s = times(intervals / DURATION_S)
    # as ``EventLayer.volume``
    finest_s = DURATION_S / (BINS - 1) / 4
    found = {loss: [] for loss in LOSSES}
    for one in cases_of(config):
        ends = one.along(intervals / DURATION_S, direction_of(name), TIMED_SECTIONS)
        slope = compare.slope(
            ends, t_s, lambda frames, t: observed(*LAYER.finely(frames, t, finest_s))
        )
        change = stream_change(one, name)
        for loss, rows in LOSSES.items():
            found[loss].append(compare.Pair(slope[rows], change[rows]))
    for loss, pairs in found.items():
        yield compare.row((f"{intervals} intervals", loss, name), pairs)


def timing_jobs(quick):
    if quick:
        return [(8, SHIFT_X.name)]
    return [(n, d.name) for n in INTERVALS for d in (DIRECTIONS if n == 8 else FEW)]


def asked_of_timing(row):
    return None if int(row.names[0].split()[0]) < 8 else pointing(0.97, 0.9, 1.1)


TIMING = Topic(
    "When events come, from few frames",
    "5 to 32 intervals between frames, against the stream at 10 kHz: counts of the whole time, and a "
    "volume of 5 bins.",
    ("intervals", "loss", "direction"),
    timing_jobs,
    measure_timing,
    asked_of_timing,
)
