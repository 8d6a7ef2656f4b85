"""How sure a figure is: intervals of means, of anything that can be resampled, and of
paired errors.

    student(accuracies)                             # mean over seeds, Student's t
    bootstrap(lambda x: x.median(-1).values, errors)    # any statistic of units that can be redrawn
    grouped(logs, textures)                         # mean over cases that share textures
    ratio_of_means(ours, zero_flow)                 # same windows, redrawn together
    log_ratio(ours, theirs).percent()               # "-3.1 % (-5.0 to -1.2 %)": paired cases

Every interval prints as "value (low to high)", with a format of its own: f"{interval:.3f}".
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import scipy
import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError

LEVEL = 0.95
DRAWS = 2000
SIGNS = 20_000


@dataclass(frozen=True)
class Interval:
    """A figure, the ends of its interval, and of how many units it is."""

    value: float
    low: float
    high: float
    count: int

    def __format__(self, spec: str) -> str:
        return f"{self.value:{spec}} ({self.low:{spec}} to {self.high:{spec}})"

    def __str__(self) -> str:
        return f"{self:.3g}"

    def metrics(self, name: str) -> dict[str, float]:
        """What ``Run.record`` takes: <name>, and <name>_low and <name>_high where there are
        ends."""
        found = {name: self.value}
        if math.isfinite(self.low) and math.isfinite(self.high):
            found |= {f"{name}_low": self.low, f"{name}_high": self.high}
        return found

    @property
    def outcome(self) -> str:
        """Of a log ratio of errors: "wins" or "loses" (ours) where the interval leaves out 0,
        "is undecided" otherwise."""
        if self.high < 0:
            return "wins"
        return "loses" if self.low > 0 else "is undecided"

    def ratio(self) -> "Interval":
        """A log ratio as the ratio it is."""
        ends = (math.exp(x) for x in (self.value, self.low, self.high))
        return Interval(*ends, self.count)

    def percent(self) -> str:
        """A log ratio as the change it is: "-3.1 % (-5.0 to -1.2 %)"."""
        value, low, high = (
            f"{100 * math.expm1(x):+.1f}" if x < 700 else "inf"
            for x in (self.value, self.low, self.high)
        )
        return f"{value} % ({low} to {high} %)"


def student(values: Any, level: float = LEVEL) -> Interval:
    """Mean of independent values [N], by Student's t; of a single one the interval is infinite.

    Raises: ShapeError where there is no value.
    """
    values = _units(values)
    count = len(values)
    mean = float(values.mean())
    if count == 1:
        return Interval(mean, -math.inf, math.inf, 1)
    quantile = float(scipy.special.stdtrit(count - 1, (1 + level) / 2))
    half = quantile * float(values.std()) / math.sqrt(count)
    return Interval(mean, mean - half, mean + half, count)


def bootstrap(
    statistic: Callable[..., Tensor],
    *samples: Any,
    level: float = LEVEL,
    draws: int = DRAWS,
    seed: int = 0,
) -> Interval:
    """A statistic of units, and its percentile interval when they are redrawn.

    Args:
      statistic: takes every sample as a float64 tensor and reduces its last dimension; called once
        with the units [..., N] and once with all draws [..., draws, N].
      samples: arrays whose last dimension counts the N units, which are redrawn together (paired).
      level: share of the draws between the ends.
      draws: number of draws.
      seed: of the draws.
    Raises: ShapeError where samples differ in their number of units or have none.
    """
    units = [_units(sample) for sample in samples]
    count = units[0].shape[-1]
    if any(sample.shape[-1] != count for sample in units):
        raise ShapeError(
            f"{', '.join(str(sample.shape[-1]) for sample in units)} units; paired samples have one each "
            "of all."
        )
    picked = torch.randint(count, (draws, count), generator=torch.Generator().manual_seed(seed))
    drawn = statistic(*(sample[..., picked] for sample in units))
    return _percentiles(statistic(*units), drawn, count, level)


def ratio_of_means(ours: Any, theirs: Any, **how: Any) -> Interval:
    """Mean of ours [N] over that of theirs, over the same units; ``how`` as of ``bootstrap``."""
    return bootstrap(lambda a, b: a.mean(-1) / b.mean(-1), ours, theirs, **how)


def median_ratio(ours: Any, theirs: Any, **how: Any) -> Interval:
    """Median of the ratios of ours [N] to theirs, pair by pair; ``how`` as of ``bootstrap``."""
    return bootstrap(lambda a, b: (a / b).quantile(0.5, -1), ours, theirs, **how)


def log_ratios(ours: Sequence[float], theirs: Sequence[float]) -> Tensor:
    """Log ratio of errors > 0, case by case, [N] float64.

    Raises: ShapeError for rows of different lengths or none; DomainError for errors that are not
      above 0.
    """
    if len(ours) != len(theirs) or not len(ours):
        raise ShapeError(f"{len(ours)} and {len(theirs)} errors; pairs need one of each per case.")
    if not all(0 < e < math.inf for e in (*ours, *theirs)):
        raise DomainError("errors must be finite and above 0, since their log ratio is taken.")
    return _units(ours).log() - _units(theirs).log()


def log_ratio(ours: Sequence[float], theirs: Sequence[float]) -> Interval:
    """Mean log ratio of errors on the same cases, by Student's t; below 0 ours are smaller."""
    return student(log_ratios(ours, theirs))


def _units(values) -> Tensor:
    tensor = torch.as_tensor(values, dtype=torch.float64)
    if not tensor.ndim or not tensor.shape[-1]:
        raise ShapeError(f"values of shape {list(tensor.shape)}; give a row of at least one.")
    return tensor


def _percentiles(value, drawn, count, level=LEVEL) -> Interval:
    """A value, and the ends of ``level`` of what was drawn."""
    ends = torch.tensor([(1 - level) / 2, (1 + level) / 2], dtype=torch.float64)
    return Interval(float(value), *torch.quantile(drawn.double(), ends).tolist(), count)


def crossed(*tables: Any) -> Interval:
    """Median over seeds of the mean over worlds of paired log ratios [seeds, worlds], of several
    tables the mean of theirs, and its interval when seeds and worlds are redrawn, each by itself."""
    generator = torch.Generator().manual_seed(0)
    value, drawn, count = torch.zeros(()), torch.zeros(DRAWS), 0
    for logs in map(_units, tables):
        rows, columns = (torch.randint(n, (DRAWS, n), generator=generator) for n in logs.shape)
        again = logs[rows[:, :, None], columns[:, None, :]].mean(2).quantile(0.5, dim=1)
        value = value + logs.mean(1).quantile(0.5) / len(tables)
        drawn = drawn + again / len(tables)
        count += len(logs)
    return _percentiles(value, drawn, count)


def grouped(values: Any, groups: Sequence[Any]) -> Interval:
    """Mean of values [N] that share groups, such as cases their textures, and its percentile
    interval when groups are redrawn, and the values of each."""
    values = _units(values)
    generator = torch.Generator().manual_seed(0)
    of = [values[[name == own for name in groups]] for own in dict.fromkeys(groups)]
    total, count = torch.zeros(2, DRAWS, dtype=torch.float64)
    for row in torch.randint(len(of), (len(of), DRAWS), generator=generator):
        for number, mine in enumerate(of):
            at = row == number
            again = torch.randint(len(mine), (int(at.sum()), len(mine)), generator=generator)
            total[at] += mine[again].sum(1)
            count[at] += len(mine)
    return _percentiles(values.mean(), total / count, len(of))


def sign_flip(differences: Any) -> float:
    """Two-sided p of paired differences [N] under random signs of their mean; every sign there is
    up to N = 14, the signs that were found among 20,000 that are drawn beyond."""
    found = _units(differences)
    count = len(found)
    if count <= 14:
        signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * count)
        signs = signs.reshape(-1, count)
    else:
        generator = torch.Generator().manual_seed(0)
        shape = (SIGNS, count)
        signs = 1 - 2.0 * torch.randint(2, shape, generator=generator, dtype=torch.float64)
        signs[0] = 1
    flipped = (signs * found).mean(1).abs()
    # of NaN, which decides nothing, 1
    return float((~(flipped < found.mean().abs() * (1 - 1e-12))).double().mean())


def holm(p: Sequence[float]) -> list[float]:
    """p of several tests, adjusted by Holm's steps (Scandinavian Journal of Statistics 6, 1979)."""
    found = [0.0] * len(p)
    largest = 0.0
    for rank, k in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        largest = max(largest, min(1.0, (len(p) - rank) * p[k]))
        found[k] = largest
    return found
