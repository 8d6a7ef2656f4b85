"""Curves of an error over the size of a fault, and the size that can be borne, with intervals over cases."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from codesign.errors import DomainError, ShapeError

DRAWS = 1000
FIRM = 1e9  # weight of the first point of a curve, which is no measurement
INTERVAL = (0.025, 0.975)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limit:
    """Size of a fault at which the error has grown by a share: value, low, high (95 %); inf where it has not at any
    size tried."""

    value: float
    low: float
    high: float

    def text(self, last: float) -> str:
        """ "0.61 (0.55 to 0.70)"; ">4" where it lies beyond the last size tried."""
        if self.value == np.inf:
            return f">{last:g}" + ("" if self.low == np.inf else f" (from {self.low:.2g})")
        return f"{self.value:.2g} ({self.low:.2g} to " + (
            f">{last:g})" if self.high == np.inf else f"{self.high:.2g})"
        )


@dataclass(frozen=True)
class Curve:
    """Errors of the same cases at rising sizes of a fault.

    levels: [L] from 0, rising. errors: [L, N] > 0 of N cases.
    Raises: ShapeError, DomainError for other levels or errors.
    """

    levels: Sequence[float]
    errors: Array

    def __post_init__(self) -> None:
        if self.errors.ndim != 2 or len(self.levels) != len(self.errors) or len(self.levels) < 2:
            raise ShapeError(
                f"a curve of {len(self.levels)} levels has errors of shape {self.errors.shape}; [levels, cases] with "
                "at least 2 levels is needed."
            )
        if self.levels[0] != 0 or not (np.diff(self.levels) > 0).all():
            raise DomainError(f"levels {list(self.levels)} must rise from 0.")
        if not (np.isfinite(self.errors).all() and (self.errors > 0).all()):
            raise DomainError(
                "errors of a curve must be finite and above 0; leave out the cases that have none."
            )

    @property
    def ratio(self) -> Array:
        """[L] error over that without the fault: the geometric mean over cases, each case against itself."""
        return np.exp(self._log.mean(1))

    def ratio_interval(self, seed: int) -> Array:
        """[2, L] ends of the 95 % interval of the ratio, bootstrap over cases."""
        return np.quantile(self._draws(seed), INTERVAL, axis=0)

    def limit(self, rise: float, seed: int) -> Limit:
        """Where the rising curve nearest to the ratios, joined by straight lines, exceeds 1 + ``rise``; interval by
        bootstrap over cases. One step that is high by chance is then no limit."""
        value = first_above(self.levels, rising(self.ratio[None]), 1 + rise)[0]
        drawn = first_above(self.levels, rising(self._draws(seed)), 1 + rise)
        low, high = np.quantile(drawn, INTERVAL, method="nearest")  # between infinities there is no mean
        return Limit(float(value), float(low), float(high))

    @property
    def _log(self):
        return np.log(self.errors / self.errors[:1])

    def _draws(self, seed):
        count = self.errors.shape[1]
        picked = np.random.default_rng(seed).integers(0, count, (DRAWS, count))
        share = np.stack([np.bincount(row, minlength=count) for row in picked]) / count
        return np.exp(share @ self._log.T)


def rising(ratios: Array) -> Array:
    """Rising curves [K, L] nearest to curves of ratios [K, L] in the mean square of their logarithms; each begins at 1."""
    weights = np.ones(ratios.shape[1])
    weights[0] = FIRM
    return np.exp([isotonic_regression(row, weights=weights).x for row in np.log(ratios)])


def first_above(levels: Sequence[float], ratios: Array, bound: float) -> Array:
    """First place where curves [K, L] over levels [L], joined by straight lines, exceed a bound: [K], inf where they
    never do."""
    at = np.asarray(levels, dtype=np.float64)
    above = ratios > bound
    after = above.argmax(1)
    rows = np.arange(len(ratios))
    before = np.maximum(after - 1, 0)
    rise = ratios[rows, after] - ratios[rows, before]
    part = np.where(after > 0, (bound - ratios[rows, before]) / np.where(rise > 0, rise, 1), 0.0)
    return np.where(above.any(1), at[before] + part * (at[after] - at[before]), np.inf)
