"""Damped least squares (Levenberg-Marquardt) on any function of variables to residuals, resumable,
with bounds.

Each step solves (J^T J + damping D^2) step = -J^T r with D the largest column norms of J seen so
far, so the units of the variables do not matter. The gain ratio (what the sum of squares lost over
what the linear model promised) multiplies the damping down after a good step and up after a bad
one. Constraints beyond bounds are residual rows of their own, such as weight * max(0, shortfall).

A variable the residuals hardly see (a null mode) has a column about 0, hence a D about 0 and a step
of any
length: the linear model holds nowhere along it, and the damping that would hold it also holds all
others. Its own column cannot tell it from a variable in small units, so D follows Marquardt as long
as steps succeed.
After ``REJECTED`` failures in a row, when some D lies below ``FLOOR`` of the largest, D is raised
to that floor for the rest of the run, and the damping goes back to what it was before them.
Problems whose steps succeed keep their independence of units to the last bit; the others keep it
within 1 / FLOOR.
Source: Marquardt, SIAM J. Appl. Math. 11 (1963); Nielsen, Damping parameter in Marquardt's method,
  IMM-REP-1999-05 (update of the damping);
More, The Levenberg-Marquardt algorithm, LNM 630 (1978) (scaling).
"""

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any, Self

import torch
from torch import Tensor

from codesign.checks import check, check_finite, check_positive
from codesign.errors import DomainError, ShapeError
from codesign.grad.jacobian import Jacobian, by_autograd, finite

__all__ = ["DampedLeastSquares", "StopRules"]

# of the largest D: a variable 1000 times weaker than the strongest is damped like one that is not
FLOOR = 1e-3
# failures in a row raise the damping 64-fold, which a step of the right shape does not need
REJECTED = 3


@dataclass(frozen=True)
class StopRules:
    """When a run ends by itself; each is checked after every step.

    steps: most steps of a run. gradient: largest cosine between a column of J and r
      (0 at a minimum).
    step: length of a step over that of the variables, both in units of D. loss: relative decrease
      by an accepted step.
    damping: largest damping, reached when no step of any size helps. stall: share that the last
      ``trials`` steps together gained of what the linear model promised for them, below which they
      lead nowhere.
    """

    steps: int = 100
    gradient: float = 1e-10
    step: float = 1e-12
    loss: float = 1e-12
    damping: float = 1e16
    stall: float = 1e-3
    trials: int = 30


@dataclass(frozen=True)
class Entry:
    """One step: the loss before it, the norm of its gradient, the length of the trial step,
    damping, whether it was accepted."""

    loss: float
    gradient: float
    step: float
    damping: float
    accepted: bool


class DampedLeastSquares:
    """Minimises loss = sum of squares / 2 of ``residuals(variables [V]) -> [M]``.

    Args:
      residuals: pure function; a value that is not finite counts as a failed step.
      start: [V], a point where the residuals are finite.
      jacobian: function of (residuals, variables, value there) to [M, V]: ``by_autograd``
        (the default), ``by_differences(...)`` or your own.
      lower, upper: [V] bounds, or None. A variable on a bound that wants to leave is held; steps
        are cut at bounds.
      damping: first damping, relative to D^2.
    variables, loss: where it stands. history: list of Entry. stopped: why the last run ended: a
      name of StopRules ("stall": it did not converge), "" while it has not.
    Raises: ShapeError, DomainError for a start that is not finite, outside its bounds, or has
      residuals that are not finite.

    >>> start = torch.tensor([-1.2, 1.0], dtype=torch.float64)
    >>> solver = DampedLeastSquares(lambda x: torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]]), start)
    >>> solver.run().round(decimals=6).tolist()  # Rosenbrock's valley
    [1.0, 1.0]
    """

    def __init__(
        self,
        residuals: Callable[[Tensor], Tensor],
        start: Tensor,
        jacobian: Jacobian = by_autograd,
        lower: Tensor | None = None,
        upper: Tensor | None = None,
        damping: float = 1e-3,
        stop: StopRules | None = None,
    ) -> None:
        self.residuals = residuals
        self.jacobian = jacobian
        self.stop = stop or StopRules()
        self.variables = check(start.detach().clone(), "V", "start", finite=True)
        self.lower, self.upper = _bounds(self.variables, lower, upper)
        check_positive(damping, "damping", remedy="1e-3 suits most starts")
        self.damping = float(damping)
        self.growth = 2.0
        self.floor = 0.0
        self.scale = torch.zeros_like(self.variables)
        self.promises: list[tuple[float, float]] = []
        self.history: list[Entry] = []
        self.stopped = ""
        self._value = check_finite(
            self._residuals(self.variables), "residuals at the start", "start where they are finite"
        )
        self._slopes: Tensor | None = None

    @property
    def loss(self) -> float:
        """Half the sum of squares at the variables."""
        return float(self._value.square().sum()) / 2

    def step(self) -> Entry:
        """One trial step, accepted or not. Returns its Entry; ``stopped`` says whether a rule ended
        the run."""
        J = self._slopes = self._jacobian() if self._slopes is None else self._slopes
        r = self._value
        x = self.variables
        gradient = J.T @ r
        free = ~(((x <= self.lower) & (gradient > 0)) | ((x >= self.upper) & (gradient < 0)))
        self.scale = torch.maximum(self.scale, torch.linalg.vector_norm(J, dim=0))
        D = torch.where(self.scale > 0, self.scale, 1.0).clamp_min(
            self.floor * float(self.scale.max())
        )
        step = torch.zeros_like(x)
        step[free] = _solve(J[:, free], r, self.damping**0.5 * D[free])
        trial = torch.minimum(torch.maximum(x + step, self.lower), self.upper)
        step = trial - x
        value = self._residuals(trial)
        before = self.loss
        after = float(value.square().sum()) / 2
        # the model's decrease, as a product: the difference of two sums of squares drowns in
        # rounding near a minimum
        promised = -float(gradient @ step) - float((J @ step).square().sum()) / 2
        accepted = finite(value) and after < before and promised > 0
        gain = (before - after) / promised if accepted else 0.0
        steepest = _cosine(J, r, gradient, free)
        entry = Entry(before, float(gradient.norm()), float(step.norm()), self.damping, accepted)
        self.promises = [*self.promises, (before - after if accepted else 0.0, max(promised, 0.0))]
        self.promises = self.promises[-self.stop.trials :]
        moved = float((D * step).norm())
        size = float((D * x).norm())
        if accepted:
            self.variables = trial
            self._value = value
            self._slopes = None
            self.damping = max(self.damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), 1e-15)
            self.growth = 2.0
        else:
            self.damping = self.damping * self.growth
            self.growth = self.growth * 2
            if (
                not self.floor
                and self.growth == 2.0 ** (REJECTED + 1)
                and float(D.min()) < FLOOR * float(D.max())
            ):
                self.floor = FLOOR
                self.damping = entry.damping / 2.0 ** (REJECTED * (REJECTED - 1) // 2)
                self.growth = 2.0
        self.history.append(entry)
        self.stopped = self._why(steepest, moved, size, before, after, accepted)
        return entry

    def run(
        self,
        steps: int | None = None,
        progress: Callable[[Entry], object] | None = None,
    ) -> Tensor:
        """Step until a rule ends it, or for ``steps`` more. ``progress`` is called after each step.
        Returns the variables."""
        self.stopped = ""
        for _ in range(steps if steps is not None else self.stop.steps):
            entry = self.step()
            if progress is not None:
                progress(entry)
            if self.stopped:
                return self.variables
        self.stopped = "steps"
        return self.variables

    def state(self) -> dict[str, Any]:
        """Everything needed to go on, as numbers and lists that JSON and torch.save keep to the
        last bit."""
        return {
            "variables": self.variables.tolist(),
            "scale": self.scale.tolist(),
            "damping": self.damping,
            "growth": self.growth,
            "floor": self.floor,
            "promises": self.promises,
            "history": [list(astuple(entry)) for entry in self.history],
        }

    def resume(self, state: dict[str, Any]) -> Self:
        """Go on from ``state``; the same steps follow as without the break. Raises: ShapeError when
        it belongs to other variables."""
        found = torch.tensor(
            state["variables"], dtype=self.variables.dtype, device=self.variables.device
        )
        if found.shape != self.variables.shape:
            raise ShapeError(
                f"the state has {found.numel()} variables, this problem has {self.variables.numel()}; give "
                "the state of the same problem."
            )
        self.variables = found
        self.scale = torch.tensor(state["scale"], dtype=found.dtype, device=found.device)
        self.damping = float(state["damping"])
        self.growth = float(state["growth"])
        self.floor = float(state["floor"])
        self.promises = [(float(gain), float(promise)) for gain, promise in state["promises"]]
        self.history = [Entry(*row) for row in state["history"]]
        self._value = self._residuals(found)
        self._slopes = None
        return self

    def _residuals(self, variables):
        with torch.no_grad():
            value = self.residuals(variables)
        return check(value, "M>=0", "residuals")

    def _jacobian(self):
        slopes = self.jacobian(self.residuals, self.variables, self._value)
        remedy = "the residuals have no derivative here; start elsewhere, or bound the variables"
        shape = (self._value.numel(), self.variables.numel())
        return check(slopes, shape, "Jacobian", finite=True, remedy=remedy)

    def _why(self, steepest, moved, size, before, after, accepted):
        stop = self.stop
        if steepest <= stop.gradient:
            return "gradient"
        if moved <= stop.step * (size + stop.step):
            return "step"
        if accepted and before - after <= stop.loss * before:
            return "loss"
        if self.damping > stop.damping:
            return "damping"
        gained, promised = map(sum, zip(*self.promises, strict=True))
        return (
            "stall" if len(self.promises) == stop.trials and gained < stop.stall * promised else ""
        )


def _solve(J, r, damping):
    """Step of the damped linear problem, by QR of the stacked rows: squaring J would lose half the
    digits."""
    if not J.shape[1]:
        return J.new_zeros(0)
    Q, R = torch.linalg.qr(torch.cat([J, torch.diag(damping)]))
    return torch.linalg.solve_triangular(R, Q[: J.shape[0]].T @ -r[:, None], upper=True)[:, 0]


def _cosine(J, r, gradient, free):
    norms = torch.linalg.vector_norm(J, dim=0) * r.norm()
    return float(
        torch.where(free & (norms > 0), gradient.abs() / norms.clamp_min(1e-300), 0.0).max()
    )


def _bounds(start, lower, upper):
    low = torch.full_like(start, -math.inf) if lower is None else lower.to(start)
    high = torch.full_like(start, math.inf) if upper is None else upper.to(start)
    for bound in (low, high):
        check(bound, tuple(start.shape), "a bound of the variables")
    if not bool(((low <= start) & (start <= high)).all()):
        raise DomainError(
            "the start lies outside its bounds, or a lower bound above its upper; move the start inside."
        )
    return low, high
