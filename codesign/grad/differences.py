"""Central differences with common random numbers over a ladder of step sizes, and what they are
worth.

A difference over a step h is wrong by truncation, which falls with h^2, and by rounding, which
grows with 1/h. ``Ladder`` weighs both: rounding is measured (``rounding_noise``), truncation read
off the rungs by extrapolation.
"""

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch

from codesign.errors import NonFiniteError

Scalar = Callable[[torch.Tensor], torch.Tensor]
EPS = torch.finfo(torch.float64).eps
POINTS = 16  # roundings of a parameter between points where noise is measured
# of their spacing; differences of fourth to sixth order of what is smooth then fall
SHRINK = 10**0.5
SMOOTH = (20.0, 1e4)  # by 1e2 to 1e3, more or less: noise does not
FIRM = 1 / 30  # of their noise: three rungs that agree so well are no noise, whatever made it
# standard deviations by which neighbouring rungs may differ before it counts against them
NEIGHBOURS = 5.0


@dataclass(frozen=True)
class Difference:
    """A derivative by differences.

    value: the derivative. step: the (smaller) rung it was taken from. noise: its standard
      deviation. ladder: (step, difference) of every rung, large to small.
    left_out: steps where the function was not finite, or its argument did not move.
    """

    value: float
    step: float
    noise: float
    ladder: tuple[tuple[float, float], ...]
    left_out: tuple[float, ...] = ()


def rounding_noise(
    fn: Scalar, point: torch.Tensor, direction: torch.Tensor, step: float, spacings: int = 4
) -> float:
    """Standard deviation of f's rounding errors: nine points on a line, ``step`` apart, and the
    differences of fourth to sixth order between them, from which anything smooth has gone. 0 where
    f is not finite there.

    What falls by powers of the spacing is f itself, too quick for it, and the points are taken
    closer; errors stay alike, or are gone at once where all points lie on one stair. The largest of
    ``spacings`` that stay alike counts. No closer at first than some roundings of the parameter,
    where points would repeat each other.
    Source: Moré and Wild, Estimating computational noise, SIAM J. Sci. Comput. 33(3), 2011.
    """
    unit = direction.double()
    step = max(
        step, POINTS * torch.finfo(point.dtype).eps * float(point.double().norm() / unit.norm())
    )
    found = [_nine(fn, point, step * unit)]
    alike = 1
    while alike < spacings:
        step /= SHRINK
        found.append(_nine(fn, point, step * unit))
        falls = found[-1] > 0 and SMOOTH[0] < found[-2] / found[-1] < SMOOTH[1]
        alike = 1 if falls else alike + 1
    return max(found[-spacings:])


def _nine(fn, point, unit):
    """Noise in nine points that lie ``unit`` apart."""
    start = point.double()
    values = [_value(fn, (start + k * unit).to(point.dtype)) for k in range(-4, 5)]
    if not all(map(math.isfinite, values)):
        return 0.0
    table = torch.tensor(values, dtype=torch.float64).diff(n=3)
    found = []
    for order in (4, 5, 6):
        table = table.diff()
        gain = math.comb(2 * order, order)  # variance of an order-th difference of unit noise
        found.append(float((table.square().mean() / gain).sqrt()))
    return statistics.median(found)


def stair(values: Sequence[float]) -> float:
    """Half the spacing of stairs on which all these values stand, as those of coarser formats do in
    double; 0 where they stand on none. Of one value alone, that of single precision."""
    found = torch.tensor([v for v in values if math.isfinite(v)], dtype=torch.float64).unique()
    gaps = found.diff()
    largest = max(found.abs().tolist(), default=0.0)
    gaps = gaps[gaps > 4 * EPS * largest]
    if not len(gaps):
        return _rounding(largest, torch.finfo(torch.float32).eps)
    steps = (found - found[0]) / gaps.min()
    return float(gaps.min()) / 2 if bool(((steps - steps.round()).abs() < 0.01).all()) else 0.0


class Ladder:
    """Central differences along one direction, rung by rung, each with what rounding may do to
    it."""

    def __init__(
        self,
        fn: Scalar,
        point: torch.Tensor,
        direction: torch.Tensor,
        noise: float = 0.0,
        eps: float = EPS,
        grad: torch.Tensor | None = None,
    ):
        """Args:
        fn: function of one tensor -> scalar tensor. point, direction: tensors of one shape.
        noise: standard deviation of f's own errors, measured.
        eps: of f's number format, whose rounding counts on top.
        grad: gradient that is asked about; how far rounding of the parameter, aside of the line,
          may move f.
        """
        self.fn = fn
        self.point = point
        self.direction = direction
        self.noise = noise
        self.eps = eps
        self.grad = None if grad is None else grad.double()
        # step, difference, standard deviation by rounding
        self.rungs: list[tuple[float, float, float]] = []
        self.left_out: list[float] = []

    def take(self, steps: Sequence[float]) -> None:
        """Evaluate the function at both ends of every step; what is not finite, or does not move
        the point in its number format, is left out."""
        start = self.point.double()
        unit = self.direction.double()
        length = float(unit.square().sum())
        for step in steps:
            ahead = (start + step * unit).to(self.point.dtype)
            behind = (start - step * unit).to(self.point.dtype)
            # twice the step that is left after rounding of the parameter itself
            moved = ahead.double() - behind.double()
            width = float((moved * unit).sum()) / length
            high = _value(self.fn, ahead)
            low = _value(self.fn, behind)
            if width > 0 and math.isfinite(high) and math.isfinite(low):
                error = math.hypot(self.noise, _rounding(max(abs(high), abs(low)), self.eps))
                aside = (
                    0.0 if self.grad is None else float((self.grad * (moved - width * unit)).norm())
                )
                self.rungs.append(
                    (step, (high - low) / width, math.hypot(2**0.5 * error, aside) / width)
                )
            else:
                self.left_out.append(step)

    def difference(self) -> Difference:
        """The derivative, from the pair of neighbouring rungs that can be trusted most.

        Rungs h1 > h2 give (h1^2 D2 - h2^2 D1) / (h1^2 - h2^2), free of h^2; by how much that moves
        D2 stands for what truncation is left. The pair with the smallest sum of that and of
        rounding wins; one that the next two contradict beyond rounding pays for that too.

        Raises: NonFiniteError when no rung is left.
        Source: Ridders, Accurate computation of F'(x) and F'(x)F''(x), Adv. Eng. Softw. 4(2), 1982.
        """
        if not self.rungs:
            raise NonFiniteError(
                "the function is not finite, or its argument does not move, at any step from "
                f"{max(self.left_out):g} down to {min(self.left_out):g}; give other scales, or a point "
                "inside its domain."
            )
        rungs = sorted(self.rungs, reverse=True)
        values = [rungs[0][1]]
        sigmas = [rungs[0][2]]
        for (h1, d1, sigma1), (h2, d2, sigma2) in pairwise(rungs):
            ratio = (h1 / h2) ** 2
            values.append((ratio * d2 - d1) / (ratio - 1))
            sigmas.append(math.hypot(ratio * sigma2, sigma1) / (ratio - 1))
        bends = [abs(value - rung[1]) for value, rung in zip(values, rungs, strict=True)]
        if len(rungs) > 1:
            bends[0] = abs(values[1] - values[0])
        firm = [
            k > 1
            and rungs[k][1] != 0
            and all(abs(rungs[j][1] - rungs[j - 1][1]) < FIRM * rungs[j][2] for j in (k - 1, k))
            for k in range(len(rungs))
        ]
        spreads = []
        for k in range(len(rungs)):
            contradicted = 0.0
            for other in range(k + 1, len(rungs)) or range(max(k - 1, 0), k):
                unsure = math.hypot(sigmas[k], 0.0 if firm[other] else sigmas[other])
                contradicted = max(
                    contradicted, abs(values[k] - values[other]) - NEIGHBOURS * unsure
                )
            spreads.append(math.hypot(sigmas[k], bends[k], contradicted))
        best = min(range(len(rungs)), key=spreads.__getitem__)
        return Difference(
            values[best],
            rungs[best][0],
            spreads[best],
            tuple((h, d) for h, d, _ in rungs),
            tuple(self.left_out),
        )


def _rounding(value, eps):
    """Largest error of rounding once to the number format: half the spacing of its numbers."""
    return math.ldexp(eps, math.frexp(value)[1] - 1) / 2 if value else 0.0


def _value(fn, point):
    with torch.no_grad():
        return float(fn(point))
