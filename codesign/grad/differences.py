"""Central differences with common random numbers over a ladder of step sizes, and the plateau on it."""

from dataclasses import dataclass
from itertools import pairwise

import torch


@dataclass(frozen=True)
class Difference:
    """A derivative by differences: its value, the step of the plateau, and the noise floor (how much
    neighbouring rungs disagree)."""

    value: float
    step: float
    noise: float
    ladder: tuple[tuple[float, float], ...]


def central(fn, point, direction, step):
    """(f(x + h d) - f(x - h d)) / 2h for a function of one tensor. fn must use the same random numbers at
    both ends."""
    with torch.no_grad():
        return (float(fn(point + step * direction)) - float(fn(point - step * direction))) / (2 * step)


def plateau(fn, point, direction, steps):
    """Differences over the ladder ``steps``; the plateau is the pair of neighbouring rungs that agree best.

    Too small a step drowns in rounding, too large a one bends; between them neighbouring rungs agree. The
    value is the mean of
    that pair and the noise floor half their distance (with one rung: no floor is known, and it is reported as
    0).
    """
    ladder = tuple((h, central(fn, point, direction, h)) for h in steps)
    if len(ladder) == 1:
        return Difference(ladder[0][1], ladder[0][0], 0.0, ladder)
    gaps = [abs(a[1] - b[1]) for a, b in pairwise(ladder)]
    best = min(range(len(gaps)), key=gaps.__getitem__)
    value = (ladder[best][1] + ladder[best + 1][1]) / 2
    return Difference(value, (ladder[best][0] * ladder[best + 1][0]) ** 0.5, gaps[best] / 2, ladder)
