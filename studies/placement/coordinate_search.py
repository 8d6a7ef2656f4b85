"""Coordinate search in the cube of shares, in a strong form: lines along one number after the other."""

import math
from collections.abc import Generator

import torch
from torch import Tensor

FIRST_STEP = 0.2  # shares
LAST_STEP = 1e-4  # nobody mounts a camera more exactly


def along_axes(start: Tensor, seed: int) -> Generator[Tensor, float, None]:
    """One number after the other, in an order drawn anew for each round, and once along what the round has moved; from a
    random point again when steps have become too short to matter.

    Source: line searches of Davies, Swann and Campey, as in Box, Davies and Swann, Non-linear Optimization Techniques,
      1969: steps are doubled while they help, then the vertex of a parabola is tried. The move after a round is that of
      Hooke and Jeeves, J. ACM 8, 1961.
    """
    random = torch.Generator().manual_seed(seed)
    at = start
    while True:
        yield from _descended(at, random)
        at = torch.rand(start.shape, generator=random, dtype=torch.float64)


def _descended(at, random):
    """From ``at`` downhill, until a round of the shortest steps does not help."""
    error = yield at
    steps = [FIRST_STEP] * len(at)  # towards the side where it was better last time
    helped = True
    while helped or max(map(abs, steps)) > LAST_STEP:
        before = at
        for axis in torch.randperm(len(at), generator=random).tolist():
            along = torch.eye(len(at), dtype=torch.float64)[axis]
            at, error, steps[axis] = yield from _line(at, error, along, steps[axis])
        moved = at - before
        helped = bool(moved.any())
        if int(moved.count_nonzero()) > 1:
            at, error, _ = yield from _line(at, error, moved / moved.norm(), float(moved.norm()))


def _line(at, error, along, step):
    """The best point on a line, its error, and the step to begin with next time."""

    def point(to):
        return (at + to * along).clamp(0, 1)

    walls = (torch.stack([-at, 1 - at]) / along)[:, along != 0]
    low, high = float(walls.amin(0).max()), float(walls.amax(0).min())
    best = 0.0
    known = {best: error}
    for reach in (step, -step):
        while (to := min(max(best + reach, low), high)) not in known:
            known[to] = yield point(to)
            if known[to] >= known[best]:
                break
            best = to
            reach *= 2
        if best:
            break
    vertex = _vertex(known, best)
    if vertex not in known:
        known[vertex] = yield point(vertex)
        best = vertex if known[vertex] < known[best] else best
    length = min(max(abs(best), abs(step) / 4, LAST_STEP), 2 * FIRST_STEP)
    return point(best), known[best], math.copysign(length, best or step)


def _vertex(known, best):
    """Where a parabola through the best of the known places and its two neighbours is lowest; the best itself where it
    has one neighbour, or no parabola is lower by a step that matters."""
    places = sorted(known)
    k = places.index(best)
    if not 0 < k < len(places) - 1:
        return best
    below, above = best - places[k - 1], places[k + 1] - best
    rise_below, rise_above = (known[places[j]] - known[best] for j in (k - 1, k + 1))
    bend = above * rise_below + below * rise_above
    if bend <= 0:
        return best
    shift = (above**2 * rise_below - below**2 * rise_above) / (2 * bend)
    return best + shift if abs(shift) > LAST_STEP / 10 else best
