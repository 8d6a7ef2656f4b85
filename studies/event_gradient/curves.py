"""Levels written down instead of rendered: ramps, turns, sines, random walks and moving edges, many pixels with random
parameters each, of which one number at a time is moved."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from studies.event_gradient.case import DURATION_S, times

SIDE_PX = 48  # pixels are a square, so that they pool like a picture
BASE = 4.5  # natural logarithm of an intensity in the middle of the scale, where the level is the logarithm
AMPLITUDE_LOG = 0.3  # either way
PHASE = 0.03  # of the duration, either way
SECTIONS = 48  # every pixel has its kinks at other places of the step
OFFSET = 0.1  # either way, behind the first frame
PARAMETERS = ("amplitude", "phase", "offset")


@dataclass(frozen=True)
class Draws:
    """Random numbers of every pixel, [N] each. u, v, w: even in 0 to 1."""

    u: Tensor
    v: Tensor
    w: Tensor
    walk: Tensor  # [knots, N] standard normal


def ramp(t: Tensor, draw: Draws) -> Tensor:
    """Rest, then a ramp."""
    return 1.5 * (draw.u - 0.5).sign() * (t - 0.1 - 0.5 * draw.v).clamp(min=0)


def turn(t: Tensor, draw: Draws) -> Tensor:
    """Up and back down, or down and back up."""
    return (draw.u - 0.5).sign() * (1 - (2 * t - 0.5 - draw.v).abs())


def sine(t: Tensor, draw: Draws) -> Tensor:
    return 0.5 * torch.sin(2 * math.pi * ((1 + 2 * draw.u) * t + draw.v))


def walk(t: Tensor, draw: Draws) -> Tensor:
    """Linear between independent steps, at ten knots from t = -0.5 to 1.5."""
    path = draw.walk.cumsum(0) / 2.5
    place = ((t + 0.5) / 2).clamp(0, 1) * (len(path) - 1)
    below = place.floor().clamp(max=len(path) - 2)
    first, second = (path.gather(0, (below + k).long()) for k in (0, 1))
    return first + (place - below) * (second - first)


def edge(t: Tensor, draw: Draws) -> Tensor:
    """A border between two levels passes, more or less blurred."""
    return 2 * (draw.u - 0.5).sign() * torch.sigmoid((t - 0.2 - 0.6 * draw.v) / (0.02 + 0.1 * draw.w))


KINDS: dict[str, Callable[[Tensor, Draws], Tensor]] = {
    "ramps": ramp,
    "turns": turn,
    "sines": sine,
    "walks": walk,
    "edges": edge,
}


def frames(kind: str, rate_hz: float, parameter: str, s: float, seed: int) -> Tensor:
    """[T, SIDE_PX, SIDE_PX] frames at a place s in [-1, 1] of a parameter, float32; amplitudes from 0.05 to 0.8."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(5, SIDE_PX**2, generator=generator, dtype=torch.float64)
    steps = torch.randn(10, SIDE_PX**2, generator=generator, dtype=torch.float64)
    t = (times(rate_hz) / DURATION_S)[:, None] + (PHASE * s if parameter == "phase" else 0.0)
    amplitude = 0.05 * 16 ** draw[3] * math.exp(AMPLITUDE_LOG * s if parameter == "amplitude" else 0.0)
    level = amplitude * KINDS[kind](t.expand(-1, SIDE_PX**2), Draws(*draw[:3], steps))
    if parameter == "offset":
        level[1:] += OFFSET * s
    return (BASE + level).exp().reshape(-1, SIDE_PX, SIDE_PX).float()


def along(kind: str, rate_hz: float, parameter: str, seed: int) -> Tensor:
    """[SECTIONS + 1, T, SIDE_PX, SIDE_PX] frames at the ends of the sections of a step."""
    return torch.stack(
        [frames(kind, rate_hz, parameter, 2 * k / SECTIONS - 1, seed) for k in range(SECTIONS + 1)]
    )
