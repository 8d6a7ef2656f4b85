"""Sequences to learn from and to be judged on: frames, their times, and the hard events of a physical sensor,
rendered."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from codesign import events, render
from codesign.events import SensorModel
from scenes.dataset_motion import LEAD_S, motion
from scenes.stages import make_world
from studies.make_dataset import __main__ as make_dataset

RATE_HZ = 500.0
SIZE_PX = 64
RENDERED_TOGETHER = 40
# what an ideal sensor lacks, all at once: unequal thresholds that scatter, bandwidth, leak, noise, dead time
SENSOR = SensorModel(
    0.18,
    0.22,
    theta_sigma=0.03,
    cutoff_hz=60.0,
    leak_rate_hz=0.1,
    leak_jitter=0.1,
    rate_cov_decades=0.1,
    shot_rate_hz=0.5,
    refractory_s=1e-3,
)
TRAINING = [
    (world, family, 10 + k)
    for world in ("room", "corridor", "checkerboard")
    for k, family in enumerate(("driving", "orbital", "flying", "vertical"))
]
UNSEEN_MOTION = [("room", "flying", 50), ("corridor", "driving", 51), ("room", "radial", 52)]
UNSEEN_WORLD = [
    ("outdoor", "flying", 60),
    ("outdoor", "driving", 61),
    ("tabletop", "flying", 62),
    ("tabletop", "orbital", 63),
]


@dataclass(frozen=True)
class Sequence:
    """frames: [T, H, W], 0-255 scale. t_s: [T] float64. counts: [T-1, 2, H, W] of the physical sensor. again:
    the same with another draw of thresholds and noise, None for a recording. name: world and motion."""

    name: str
    frames: Tensor
    t_s: Tensor
    counts: Tensor
    again: Tensor | None = None

    @property
    def dt_s(self):
        return float(self.t_s[-1] - self.t_s[0]) / (len(self.t_s) - 1)


def rendered(world, family, seed, frames, sensor: SensorModel = SENSOR):
    """A rendered sequence of ``frames`` frames at RATE_HZ. seed: of motion and sensor."""
    config = make_dataset.Config(size=SIZE_PX, samples=8, level="thin")
    scene, stage = make_world(world)
    camera = make_dataset.make_camera(config)
    t_s = torch.arange(frames, dtype=torch.float64) / RATE_HZ
    path = motion(family, stage, scene, camera, float(t_s[-1]), torch.Generator().manual_seed(seed))
    with torch.no_grad():
        poses = path(LEAD_S + t_s).detach().split(RENDERED_TOGETHER)
        pictures = torch.cat([render.frames(camera, scene, some) for some in poses])
    return Sequence(
        f"{world} {family}", pictures, t_s, *(hard(pictures, t_s, sensor, 1000 * k + seed) for k in (1, 2))
    )


def hard(frames, t_s, sensor, seed):
    """One draw of the physical sensor, [T-1, 2, ...]."""
    return events.dense_counts(frames, t_s, sensor, torch.Generator().manual_seed(seed))


def part(sequence, first, last):
    """Intervals ``first`` to ``last`` - 1 of a sequence."""
    again = None if sequence.again is None else sequence.again[first:last]
    return replace(
        sequence,
        frames=sequence.frames[first : last + 1],
        t_s=sequence.t_s[first : last + 1],
        counts=sequence.counts[first:last],
        again=again,
    )


def tiles(sequence, rows=4, columns=4):
    """The picture cut into equal parts, what is left over at the far edges left out: list of Sequences."""
    height, width = (
        side // number for side, number in zip(sequence.frames.shape[1:], (rows, columns), strict=True)
    )
    windows = [
        (..., slice(y * height, (y + 1) * height), slice(x * width, (x + 1) * width))
        for y in range(rows)
        for x in range(columns)
    ]
    return [
        replace(sequence, frames=sequence.frames[window], counts=sequence.counts[window])
        for window in windows
    ]
