"""The physical layer with dead times: of which sizes its gradient holds, and what it misses."""

import warnings
from dataclasses import replace

from codesign import events
from codesign.events.layers import dead_time
from studies.event_gradient import compare, sensors
from studies.event_gradient.case import FEW, SECTIONS, SHIFT_X, times
from studies.event_gradient.judge import Judge
from studies.event_gradient.topic import Asked, Topic

DEAD_MS = (5, 20, 60)  # the last is beyond what is asked
OTHER_RATES_HZ = (60, 1000)  # with 20 ms
FIELDS = ("theta_on", "theta_off", "refractory_s")
OTHER_SECTIONS = (8, 48, 96)  # of a shift, with 20 ms
PLACE = "1 place"
NEAR = (0.01, 0.1)  # half of the steps around one place
MANY = 256  # beginnings: a small step moves few counts


def jobs(quick):
    if quick:
        return [(20, 240, "contrast", 8)]
    directions = [direction.name for direction in FEW]
    return [
        *((20, 240, name, SECTIONS) for name in directions),
        *((20, 240, name, PLACE) for name in directions),
        *((20, 240, SHIFT_X.name, sections) for sections in OTHER_SECTIONS),
        *((dead_ms, 240, name, sensors.SECTIONS) for dead_ms in DEAD_MS[:2] for name in FIELDS),
        *((20, rate_hz, name, SECTIONS) for rate_hz in OTHER_RATES_HZ for name in directions),
        *((dead_ms, 240, name, SECTIONS) for dead_ms in DEAD_MS[::2] for name in directions),
    ]


def measure(cases, dead_ms, rate_hz, name, where):
    sensor = replace(sensors.IDEAL, refractory_s=dead_ms * 1e-3)
    t_s = times(rate_hz)
    levels = events.lin_log(cases[0].frames(rate_hz))
    load = dead_time.load(levels, (sensor.theta_on, sensor.theta_off), t_s.diff(), sensor.refractory_s)
    names = (f"{dead_ms} ms", f"{rate_hz}fps", name, f"{load:.1f}")
    with warnings.catch_warnings():  # of a rate beyond what is measured: here it is
        warnings.filterwarnings("ignore", "rate x dead time")
        if name in FIELDS:
            pair = sensors.of_field(cases[0], sensor, name)
            yield compare.row((*names, f"{where} sections"), [pair])
            return
        direction = next(d for d in FEW if d.name == name)
        if where == PLACE:
            for near in NEAR:
                found = [at_place(case, sensor, direction, s, near) for case in cases for s in (-0.5, 0.5)]
                yield compare.row((*names, f"{PLACE} 1/{1 / near:.0f}"), found)
            return
        found = compare.pairs(cases, rate_hz, direction, *sensors.maps(sensor), where)
        yield compare.row((*names, f"{where} sections"), found)


def at_place(case, sensor, direction, s, near):
    """Derivative at a place of a direction, beside the difference of the counts over a small step around it."""
    t_s = times(sensors.RATE_HZ)
    before, here, after = (case.frames(sensors.RATE_HZ, direction, s + near * k) for k in (-1, 0, 1))
    truth = compare.of_judge(Judge(sensor, MANY))
    slope = compare.derivative(sensors.maps(sensor)[0], here, after - before, t_s)
    return compare.Pair(slope, compare.blocks(truth(after, t_s) - truth(before, t_s)))


def asked(row):
    """Of dead times to 20 ms, over the step."""
    if row.names[0] == "60 ms" or row.names[-1].startswith(PLACE):
        return None
    return Asked(0.97, (0.9, 1.1))


TOPIC = Topic(
    "Dead time",
    f"The physical layer with dead times. Rate x T: dead time by the rate of the average event, without it. Fields of "
    f"the sensor are moved by {sensors.STEP:.0%} either way (one scene). The derivative is averaged over so many sections "
    f"of the step; at one place it is set beside the difference over a small part of the step, of {MANY} beginnings.",
    ("dead time", "frames per second", "direction", "rate x T", "derivative at"),
    jobs,
    measure,
    asked,
    "dead",
)
