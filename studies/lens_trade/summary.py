"""How much cheaper the flow designer gets the same error, out of the raw table of a trade."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

DRAWS = 2000


@dataclass(frozen=True)
class Interval:
    """A figure and the ends of its 95 % bootstrap interval over cases."""

    value: float
    low: float
    high: float


def gains(
    values: Sequence[float],
    rival: Tensor,
    flow: Tensor,
    generator: torch.Generator,
    logarithmic: bool = True,
) -> list[Interval]:
    """How much further towards tight the flow designer gets than the rival, at the rival's error at each value.

    Where an error falls towards tight (light gained by a larger aperture), the rival gets further than the value
    himself: both are asked how far they reach.
    Args: values: [K] from loose to tight. rival, flow: [K, cases] log errors of the same cases. logarithmic: whether
      the gain is that of the logarithm of the value (a share), or of the value itself.
    Returns: K Intervals, positive towards tight; bounded by the values that were looked at.
    """
    places = [math.log(v) if logarithmic else float(v) for v in values]
    sign = 1.0 if places[-1] > places[0] else -1.0

    def further(by_flow, by_rival, k):
        return sign * (reach(places, by_flow, by_rival[k]) - reach(places, by_rival, by_rival[k]))

    picks = torch.randint(rival.shape[1], (DRAWS, rival.shape[1]), generator=generator)
    drawn = [errors[:, picks].mean(2).T.tolist() for errors in (flow, rival)]
    means = [errors.mean(1).tolist() for errors in (flow, rival)]
    found = []
    for k in range(len(places)):
        draws = [further(*pair, k) for pair in zip(*drawn, strict=True)]
        found.append(_interval(further(*means, k), torch.tensor(draws)))
    return found


def reach(places: Sequence[float], errors: Sequence[float], wanted: float) -> float:
    """The tightest place (the last of them first) whose error is at most ``wanted``, linear between places; that of
    the least error where none is."""
    for k in range(len(places) - 1, -1, -1):
        if errors[k] <= wanted:
            if k == len(places) - 1:
                return places[k]
            share = (wanted - errors[k]) / (errors[k + 1] - errors[k])
            return places[k] + share * (places[k + 1] - places[k])
    return places[errors.index(min(errors))]


def _interval(value, draws):
    low, high = torch.quantile(draws.double(), torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return Interval(value, low, high)
