"""When events come, from few frames: counts, volumes, centroids and time surfaces of a layer that sees 5 to 32
intervals, against the hard sensor at 10 kHz."""

import itertools
import math
from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from codesign import events
from studies.event_gradient import compare
from studies.event_gradient.case import DIRECTIONS, DURATION_S, FEW, SHIFT_X, Case, times
from studies.event_gradient.judge import Judge
from studies.event_gradient.topic import Asked, Topic

THETA = 0.15
SENSOR = events.SensorModel(THETA, THETA)
BINS = 5
TAU_S = 0.03
TRUTH_HZ = 10_000
INTERVALS = (5, 8, 12, 16, 32)
SECTIONS = 12  # of a step, each with its own derivative
FINEST_S = DURATION_S / (BINS - 1) / 4  # as ``EventLayer.volume``
LOSSES = {"counts": slice(0, 2), "volume": slice(2, 2 + 2 * BINS), "surface": slice(2 + 2 * BINS, None)}
ASKED = Asked(0.97, (0.9, 1.1))
LAYER = events.layer("memory", SENSOR, learn=())


def middles(frames, t_s):
    """Events at the middles of the intervals between frames."""
    return LAYER(frames, t_s), t_s


def straight(frames, t_s):
    """The log level straight between frames."""
    level = events.lin_log(frames)
    many = math.ceil(DURATION_S / (len(t_s) - 1) / FINEST_S - 1e-9)
    share = torch.arange(1, many + 1, dtype=level.dtype) / many
    between = torch.lerp(level[:-1, None], level[1:, None], share.reshape(-1, 1, 1))
    fine = torch.cat((level[:1], between.flatten(0, 1)))
    fine_s = torch.linspace(float(t_s[0]), float(t_s[-1]), len(fine), dtype=torch.float64)
    return events.memory(fine, THETA, THETA, log_input=True)[0], fine_s


def cubic(frames, t_s):
    """The layer's own way: ``EventLayer.finely``."""
    return LAYER.finely(frames, t_s, FINEST_S)


def flow(frames, t_s):
    """Frames between along their optical flow, a quarter of a pixel apart."""
    fine, fine_s = events.upsample(frames, t_s, max_displacement_px=0.25)
    return events.memory(fine, THETA, THETA)[0], fine_s


WAYS = {"middles": middles, "straight": straight, "cubic": cubic, "flow": flow}


def observed(counts: Tensor, t_s: Tensor, surface: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Maps [2 + 2 BINS + 2, ...] of counts [T-1, 2, ...]: their sums, the volume, and the surface at the end."""
    flat = counts.flatten(2)[:, :, None]
    volume = events.from_counts(flat, t_s, BINS).counts[0].flatten(0, 1)
    return torch.cat((flat.sum(0), volume, surface(flat, t_s))).reshape(-1, *counts.shape[2:])


def layers_surface(counts: Tensor, t_s: Tensor) -> Tensor:
    """As users take it, [2, ...]."""
    return events.surface_from_hard_counts(counts, t_s, t_s[-1:], TAU_S)[0]


def hard_surface(counts: Tensor, t_s: Tensor) -> Tensor:
    """From the time of the last event, in the middle of its tenth of a millisecond."""
    order = torch.arange(1, len(counts) + 1, dtype=torch.int16).reshape(-1, 1, 1, 1)
    last = ((counts > 0) * order).amax(0).long()
    age_s = t_s[-1] - torch.cat((t_s[:1], (t_s[1:] + t_s[:-1]) / 2))[last]
    return torch.where(last > 0, torch.exp(-age_s / TAU_S), 0).to(counts)


@cache
def truth(case: Case, name: str) -> tuple[Tensor, Tensor]:
    """Maps over blocks at both ends of the step of a direction, the mean over beginnings."""
    direction = next(d for d in DIRECTIONS if d.name == name)
    judge = Judge(SENSOR)
    t_s = times(TRUTH_HZ)
    low, high = (
        compare.blocks(
            judge.mean(
                case.frames(TRUTH_HZ, direction, s).float(),
                t_s,
                lambda counts: observed(counts, t_s, hard_surface),
            )
        ).double()
        for s in (-1.0, 1.0)
    )
    return low, high


def centroid(volume: Tensor) -> Tensor:
    """Mean time of the events of either polarity in every block, seconds, from a volume [2 BINS, blocks]."""
    node_s = torch.linspace(0, DURATION_S, BINS, dtype=volume.dtype)
    volume = volume.unflatten(0, (2, BINS))
    return (volume * node_s[:, None]).sum(1) / volume.sum(1)


def measure(cases, way, intervals, name):
    direction = next(d for d in DIRECTIONS if d.name == name)
    t_s = times(intervals / DURATION_S)
    found = {loss: [] for loss in (*LOSSES, "centroid")}
    for case in cases:
        low, high = truth(case, name)
        ends = case.along(intervals / DURATION_S, direction, SECTIONS)
        slopes = [
            compare.derivative(
                lambda x, t: observed(*WAYS[way](x, t), layers_surface), (a + b) / 2, b - a, t_s
            )
            for a, b in itertools.pairwise(ends)
        ]
        slope = torch.stack(slopes).sum(0).double() / 2
        for loss, rows in LOSSES.items():
            found[loss].append(compare.Pair(slope[rows], (high - low)[rows] / 2))
        volume = LOSSES["volume"]
        # a quotient of sums: its slopes to them at the judge's own sums, for those of a single beginning are
        # off by a per cent in the first bin, and the two terms of a quotient nearly cancel
        places = [low[volume] + (high - low)[volume] * (k + 0.5) / len(slopes) for k in range(len(slopes))]
        moved = sum(
            torch.func.jvp(centroid, (place,), (one[volume].double(),))[1]
            for place, one in zip(places, slopes, strict=True)
        )
        found["centroid"].append(
            compare.Pair(moved / 2, (centroid(high[volume]) - centroid(low[volume])) / 2)
        )
    for loss, pairs in found.items():
        yield compare.row((way, f"{intervals} intervals", loss, name), pairs)


def jobs(quick):
    if quick:
        return [("cubic", 8, SHIFT_X.name)]
    fine = [("cubic", n, d.name) for n in INTERVALS for d in (DIRECTIONS if n == 8 else FEW)]
    return fine + [(way, 8, d.name) for way in ("middles", "straight", "flow") for d in FEW]


def asked(row):
    way, intervals, loss, _ = row.names
    few = int(intervals.split()[0]) < 8
    return None if way != "cubic" or few or loss == "surface" else ASKED


TOPIC = Topic(
    "When events come, from few frames",
    "5 to 32 intervals between frames, against the stream at 10 kHz: counts of the whole time, a volume of 5 bins, the "
    "mean time of events in a block (centroid), and the time surface at the end (tau 30 ms). *middles*: events "
    "in the middle of their interval. *straight*: at their own times where the log level runs straight between frames. "
    "*cubic*: the layer's own way. *flow*: frames between along their optical flow.",
    ("way", "intervals", "loss", "direction"),
    jobs,
    measure,
    asked,
    "timing",
)
