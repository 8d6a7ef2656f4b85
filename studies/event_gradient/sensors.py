"""The physical layer: bandwidth of the photoreceptor, leak, spread of the thresholds."""

from dataclasses import replace

import torch

from codesign import events
from studies.event_gradient import compare
from studies.event_gradient.case import FEW, times
from studies.event_gradient.judge import Judge
from studies.event_gradient.topic import Topic

RATE_HZ = 240
IDEAL = events.SensorModel(0.15, 0.15)
SENSORS = {
    "bandwidth 30 Hz": replace(IDEAL, cutoff_hz=30.0),
    "bandwidth 100 Hz": replace(IDEAL, cutoff_hz=100.0),
    "bandwidth 300 Hz": replace(IDEAL, cutoff_hz=300.0),
    "leak 5 Hz": replace(IDEAL, leak_rate_hz=5.0),
    "spread 0.01": replace(IDEAL, theta_sigma=0.01),
    "spread 0.03": replace(IDEAL, theta_sigma=0.03),
}
STEP = 0.2  # relative, either way, of what is learnt
SECTIONS = 6  # counts depend on these smoothly


def maps(sensor, **design):
    """Derivative and truth of the counts of a sensor, whose thresholds are drawn alike for both."""

    def layer(frames, t_s):
        generator = torch.Generator().manual_seed(0)
        return events.sensor_counts(frames, t_s, sensor, generator=generator, **design)[0]

    return compare.of_layer(layer), compare.of_judge(Judge(sensor))


def learnt(sensor):
    """Fields of the sensor whose gradient is asked for."""
    names = ("theta_on", "theta_off", "theta_sigma", "cutoff_hz")
    return [name for name in names if getattr(sensor, name) > 0]


def jobs(quick):
    return [(name,) for name in list(SENSORS)[-1 if quick else 0 :]]


def measure(cases, name):
    sensor = SENSORS[name]
    for direction in FEW:
        yield compare.row((name, direction.name), compare.pairs(cases, RATE_HZ, direction, *maps(sensor)))
    for field in learnt(sensor):
        yield compare.row((name, field), [of_field(case, sensor, field) for case in cases[:1]])


def of_field(case, sensor, field, sections=SECTIONS):
    """Derivative over a step of a field of the sensor beside the difference of the counts."""
    frames = case.frames(RATE_HZ).float()
    t_s = times(RATE_HZ)
    start = getattr(sensor, field)
    slope = 0
    for k in range(sections):
        value = torch.tensor(
            start * (1 + STEP * ((2 * k + 1) / sections - 1)), dtype=frames.dtype, requires_grad=True
        )
        layer, _ = maps(replace(sensor, **{field: float(value.detach())}), **{field: value})
        slope = slope + of_number(layer(frames, t_s), value) * start * STEP / sections
    low, high = (maps(replace(sensor, **{field: start * (1 + STEP * s)}))[1](frames, t_s) for s in (-1, 1))
    return compare.Pair(slope.double(), compare.blocks(high - low).double() / 2)


def of_number(found, value):
    """[K, blocks] derivative of maps [K, H, W] to one number that all pixels share: a backward pass for each."""
    pooled = compare.blocks(found)
    grads = [torch.autograd.grad(one, value, retain_graph=True)[0] for one in pooled.flatten()]
    return torch.stack(grads).reshape(pooled.shape)


TOPIC = Topic(
    "Bandwidth, leak and spread of thresholds",
    f"The physical layer, {RATE_HZ} frames per second: directions of the case, and fields of the sensor, moved by "
    f"{STEP:.0%} either way.",
    ("sensor", "direction"),
    jobs,
    measure,
    prefix="sensors",
)
