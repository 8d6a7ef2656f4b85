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
    """How far beyond each value the flow designer gets at the rival's error there.

    Args: values: [K] from loose to tight. rival, flow: [K, cases] log errors of the same cases. logarithmic: whether
      the gain is that of the logarithm of the value (a share), or of the value itself.
    Returns: K Intervals, positive towards tight; bounded by the values that were looked at.
    """
    places = [math.log(v) if logarithmic else float(v) for v in values]
    sign = 1.0 if places[-1] > places[0] else -1.0
    picks = torch.randint(rival.shape[1], (DRAWS, rival.shape[1]), generator=generator)
    found = []
    for k, place in enumerate(places):
        value = sign * (reach(places, flow.mean(1).tolist(), float(rival[k].mean())) - place)
        draws = [
            sign * (reach(places, row, wanted) - place)
            for row, wanted in zip(
                flow[:, picks].mean(2).T.tolist(), rival[k][picks].mean(1).tolist(), strict=True
            )
        ]
        found.append(_interval(value, torch.tensor(draws)))
    return found


def reach(places: Sequence[float], errors: Sequence[float], wanted: float) -> float:
    """The tightest place (the last of them first) whose error is at most ``wanted``, linear between places; the loosest
    where none is."""
    for k in range(len(places) - 1, -1, -1):
        if errors[k] <= wanted:
            if k == len(places) - 1:
                return places[k]
            share = (wanted - errors[k]) / (errors[k + 1] - errors[k])
            return places[k] + share * (places[k + 1] - places[k])
    return places[0]


def _interval(value, draws):
    low, high = torch.quantile(draws.double(), torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return Interval(value, low, high)
