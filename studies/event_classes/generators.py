"""What makes events of moved pictures: the physical sensor, the emulators of it, and the voxels of either.

A generator is a function ``generate(frames, t_s, generator)`` of frames [T, N, H, W] of N pictures, their
times and a torch.Generator. It returns an EventStream of the pictures stacked on one tall sensor, [N H, W],
or counts [T-1, 2, N, H, W] where it knows no times within an interval.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch

from codesign import events
from codesign.types import EventStream
from studies.event_classes.saccades import frame_times, frames

# v2e's noisy preset with unequal thresholds and a dead time: what an ideal sensor lacks, all at once
SENSOR = replace(events.PRESETS["noisy"], theta_on=0.18, theta_off=0.22, refractory_s=1e-3)
NOMINAL_THETA = 0.2  # mean of the sensor's own
THETAS = (0.05, 0.07, 0.1, NOMINAL_THETA, 0.3, 0.45)
PICTURES_AT_ONCE = 50


@dataclass(frozen=True)
class Source:
    """A generator as the study lists it. key: in metrics.json. label: on the page. make: the generator; with
    ``searched`` instead a function from a threshold to one. rate: "video" or "sensor", which frames it sees.
    """

    key: str
    label: str
    make: Callable[..., Any]
    rate: str = "video"
    searched: bool = False


def stacked(simulate):
    """Generator out of a function (frames [T, H, W], t_s, generator) that treats every pixel for itself."""
    return lambda pictures, t_s, generator: simulate(pictures.flatten(1, 2), t_s, generator)


def of_sensor(sensor):
    """Events of a sensor on frames as they are, log level linear in time between them."""
    return stacked(lambda tall, t_s, generator: events.simulate(tall, t_s, sensor, generator))


def of_ideal(theta):
    """ESIM: the ideal sensor with one threshold."""
    return of_sensor(events.SensorModel(theta, theta))


def of_naive(theta):
    """At most one event per pixel and frame, from the difference of consecutive frames."""
    return stacked(lambda tall, t_s, generator: events.naive(tall, t_s, theta))


PHYSICAL = Source("physical", "physical sensor (upper bound)", of_sensor(SENSOR), rate="sensor")
SOURCES = (
    Source("naive", "naive, θ 0.2", of_naive(NOMINAL_THETA)),
    Source("naive_best", "naive, best θ", of_naive, searched=True),
    Source("esim", "ESIM, θ 0.2", of_ideal(NOMINAL_THETA)),
    Source("esim_best", "ESIM, best θ", of_ideal, searched=True),
    Source(
        "esim_shots",
        "ESIM, θ 0.2, with shot noise",
        of_sensor(events.SensorModel(NOMINAL_THETA, NOMINAL_THETA, shot_rate_hz=SENSOR.shot_rate_hz)),
    ),
    Source("sensor_on_video", "physical sensor's model on video", of_sensor(SENSOR)),
    Source("v2e", "v2e, default sensor", of_sensor(replace(events.PRESETS["default"], timing="v2e"))),
)


def voxels_of(made, t_s, bins, height_px):
    """Voxels [N, 2, bins, H, W] of what a generator returned; every event is in them once.

    Args: made: EventStream of stacked pictures, or counts [T-1, 2, N, H, W]. t_s: [T] seconds, from 0.
      height_px: H.
    """
    if isinstance(made, EventStream):
        tall = events.from_stream(made, round(float(t_s[0]) * 1e6), round(float(t_s[-1]) * 1e6), bins).counts[
            0
        ]
        return tall.unflatten(2, (-1, height_px)).permute(2, 0, 1, 3, 4).contiguous()
    return events.from_counts(made, t_s, bins).counts


def record(tiles, make, rate_hz, bins, seed, progress=lambda: None):
    """Move pictures, let a generator look at them, and sort its events into voxels.

    Args: tiles: [N, 64, 64]. make: generator. rate_hz: of the frames it sees. seed: of its noise. progress:
      called after each part.
    Returns: [N, 2, bins, 32, 32] float32.
    """
    t_s = frame_times(rate_hz)
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for part in tiles.split(PICTURES_AT_ONCE):
        seen = frames(part, t_s)
        parts.append(voxels_of(make(seen, t_s, generator), t_s, bins, seen.shape[-2]))
        progress()
    return torch.cat(parts)


def noise_alone(tiles, rate_hz, seed):
    """Events per picture of the physical sensor while nothing moves."""
    t_s = frame_times(rate_hz)
    still = frames(tiles, torch.zeros(1)).expand(len(t_s), -1, -1, -1)
    return len(PHYSICAL.make(still, t_s, torch.Generator().manual_seed(seed))) / len(tiles)
