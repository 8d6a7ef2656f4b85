"""Adam with a scale, or a basis, per variable: steps in units of what the variables do, not of what they are
measured in. Resumable."""

import math
from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor

from codesign.errors import DomainError, NonFiniteError, ShapeError
from codesign.grad.jacobian import finite
from codesign.optimise.history import Entry, History, check_start

__all__ = ["ScaledAdam"]


class ScaledAdam:
    """Minimises ``loss(variables [V]) -> scalar`` from analytic gradients.

    The variables are start + basis @ u, and Adam moves u by about ``step_size`` per step. A curvature and a
    thickness have no common unit;
    with ``column_scales`` or ``principal_modes`` of the Jacobian of ray errors as basis, a unit of u moves
    the rays by the same distance.

    Args:
      loss: differentiable by autograd.
      start: [V].
      basis: [V] scales or [V, V], or None for 1.
      step_size: in units of the basis.
      betas: decay of the averages of gradient and square.
    A loss or gradient that is not finite is a failed step: the last good point comes back, averages restart,
      and the step size halves.
    variables: where it stands (always finite). best, best_loss: the lowest loss seen. history: History.
    Raises: ShapeError; DomainError when the start is not finite; NonFiniteError when the loss or gradient at
      the start is not.
    Source: Kingma and Ba, Adam, ICLR 2015, algorithm 1.

    >>> start = torch.zeros(2, dtype=torch.float64)
    >>> adam = ScaledAdam(lambda x: (x - torch.tensor([1.0, -2.0])).square().sum(), start)
    >>> adam.run(200).round(decimals=2).tolist()
    [1.0, -2.0]
    """

    def __init__(
        self,
        loss: Callable[[Tensor], Tensor],
        start: Tensor,
        basis: Tensor | None = None,
        step_size: float = 0.1,
        betas: tuple[float, float] = (0.9, 0.999),
    ) -> None:
        self.loss = loss
        self.start = check_start(start)
        self.basis = torch.ones_like(self.start) if basis is None else basis.detach().to(self.start)
        count = self.start.numel()
        if self.basis.shape not in ((count,), (count, count)):
            raise ShapeError(
                f"the basis must be [{count}] or [{count}, {count}], got {tuple(self.basis.shape)}."
            )
        if not 0 < step_size < math.inf or not all(0 <= b < 1 for b in betas):
            raise DomainError(
                f"step size {step_size} must be positive and finite, and betas {betas} in [0, 1)."
            )
        self.step_size = float(step_size)
        self.betas = tuple(betas)
        zero = torch.zeros_like(self.start)
        self.units = zero
        self.mean = zero
        self.square = zero
        self.count = 0
        self.history = History()
        value, slope = self._evaluate(zero)
        if not (math.isfinite(value) and finite(slope)):
            raise NonFiniteError("the loss or its gradient at the start is not finite; start elsewhere.")
        self._good = (zero, value, slope)
        self.best = self.variables
        self.best_loss = value

    @property
    def variables(self) -> Tensor:
        return self.start + self._spread(self.units)

    def step(self) -> Entry:
        """One step. Returns its Entry, with the loss before it."""
        units, value, slope = self._good
        b1, b2 = self.betas
        self.count += 1
        self.mean = b1 * self.mean + (1 - b1) * slope
        self.square = b2 * self.square + (1 - b2) * slope.square()
        step = (
            -self.step_size
            * (self.mean / (1 - b1**self.count))
            / ((self.square / (1 - b2**self.count)).sqrt() + 1e-12)
        )
        trial = units + step
        next_value, next_slope = self._evaluate(trial)
        accepted = math.isfinite(next_value) and finite(next_slope) and finite(trial)
        entry = Entry(
            value,
            float(slope.norm()),
            float(self._spread(step).norm()) if finite(step) else 0.0,
            self.step_size,
            accepted,
        )
        if accepted:
            self.units = trial
            self._good = (trial, next_value, next_slope)
            if next_value < self.best_loss:
                self.best = self.variables
                self.best_loss = next_value
        else:
            zero = torch.zeros_like(self.mean)
            self.mean = zero
            self.square = zero
            self.count = 0
            self.step_size = self.step_size / 2
        self.history.add(entry)
        return entry

    def run(
        self, steps: int, progress: Callable[[Entry], object] | None = None, gradient: float = 0.0
    ) -> Tensor:
        """``steps`` more, or until the gradient's norm (in units of the basis) is at most ``gradient``.
        Returns the best variables."""
        for _ in range(steps):
            entry = self.step()
            if progress is not None:
                progress(entry)
            if entry.gradient <= gradient:
                break
        return self.best

    def state(self) -> dict[str, Any]:
        """Everything needed to go on, as numbers and lists that JSON and torch.save keep to the last bit."""
        vectors = {name: getattr(self, name).tolist() for name in ("units", "mean", "square", "best")}
        return {
            **vectors,
            "count": self.count,
            "step_size": self.step_size,
            "best_loss": self.best_loss,
            "history": self.history.rows(),
        }

    def resume(self, state: dict[str, Any]) -> Self:
        """Go on from ``state``; the same steps follow as without the break. Raises: ShapeError when it
        belongs to other variables."""
        if len(state["units"]) != self.start.numel():
            raise ShapeError(
                f"the state has {len(state['units'])} variables, this problem has {self.start.numel()}; "
                "give the state of the same problem."
            )
        for name in ("units", "mean", "square", "best"):
            setattr(self, name, torch.tensor(state[name], dtype=self.start.dtype, device=self.start.device))
        self.count = int(state["count"])
        self.step_size = float(state["step_size"])
        self.best_loss = float(state["best_loss"])
        self.history = History.of(state["history"])
        self._good = (self.units, *self._evaluate(self.units))
        return self

    def _spread(self, units):
        return self.basis * units if self.basis.ndim == 1 else self.basis @ units

    def _evaluate(self, units):
        """Loss and its gradient with respect to the units."""
        at = (self.start + self._spread(units)).detach().requires_grad_()
        with torch.enable_grad():
            value = self.loss(at)
        if value.numel() != 1:
            raise ShapeError(f"the loss must be a scalar, got {tuple(value.shape)}; sum it.")
        (slope,) = torch.autograd.grad(value, at)
        return float(value.detach()), self.basis * slope if self.basis.ndim == 1 else self.basis.T @ slope
