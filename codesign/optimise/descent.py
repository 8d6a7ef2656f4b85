"""Momentum descent for noisy gradients, as a torch optimiser."""

import inspect
import math
from collections.abc import Iterable
from typing import Any

import torch

from codesign.checks import check_number, check_positive

# parameters stay on a grid of 1/GRAIN: parallel sums in a backward pass differ in their last bits,
# and a run must repeat to the same numbers
GRAIN = 256


class Descent(torch.optim.Optimizer):
    """Steps along a running mean of the gradient, on a grid, with a weak pull towards 0.

    For parameters in natural units, where 0 is the start and a unit is a sensible step. The pull
    keeps those that the objective does not see from wandering. velocity <- momentum velocity +
    (1 - momentum)(gradient + pull parameter); parameter <- parameter - lr velocity.

    Args:
      params: as for any torch optimiser.
      lr: length of a step per unit of velocity.
      momentum: 0 to below 1.
      pull: >= 0.
      normalised: every gradient counts by its direction alone, and every step has length lr.
      grain: 1 over the spacing of the grid, on which steps below half its spacing do nothing; 0 for
        none.
    Raises: DomainError for numbers outside these ranges.

    >>> import torch
    >>> x = torch.nn.Parameter(torch.zeros(2))
    >>> optimiser = Descent([x], lr=0.5, momentum=0.0, pull=0.0)
    >>> x.grad = torch.tensor([1.0, -2.0]); optimiser.step(); x.tolist()
    [-0.5, 1.0]
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float,
        momentum: float = 0.9,
        pull: float = 0.02,
        normalised: bool = False,
        grain: int = GRAIN,
    ) -> None:
        check_positive(lr, "descent: lr")
        check_number(momentum, "descent: momentum", 0.0, below=1.0)
        check_number(pull, "descent: pull", 0.0)
        check_number(grain, "descent: grain", 0.0)
        super().__init__(
            params,
            {
                "lr": lr,
                "momentum": momentum,
                "pull": pull,
                "normalised": normalised,
                "grain": grain,
            },
        )

    # as torch has them before it imports its compiler for each, which takes a second
    add_param_group = inspect.unwrap(torch.optim.Optimizer.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.Optimizer.zero_grad)
    state_dict = inspect.unwrap(torch.optim.Optimizer.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.Optimizer.load_state_dict)

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """One step from the gradients in ``.grad``; parameters without one only feel pull and
        momentum."""
        with torch.enable_grad():
            value = None if closure is None else closure()
        for group in self.param_groups:
            slopes = [torch.zeros_like(p) if p.grad is None else p.grad for p in group["params"]]
            share = _over(1.0, slopes) if group["normalised"] else 1.0
            velocities = [
                self._velocity(p, (share * g.double()).to(g), group)
                for p, g in zip(group["params"], slopes, strict=True)
            ]
            reach = _over(group["lr"], velocities) if group["normalised"] else group["lr"]
            for parameter, velocity in zip(group["params"], velocities, strict=True):
                moved = parameter - (reach * velocity.double()).to(parameter)
                grain = group["grain"]
                parameter.copy_((moved * grain).round() / grain if grain else moved)
        return value

    def _velocity(
        self,
        parameter: torch.Tensor,
        slope: torch.Tensor,
        group: dict[str, Any],
    ) -> torch.Tensor:
        state = self.state[parameter]
        if "velocity" not in state:
            state["velocity"] = torch.zeros_like(parameter)
        pulled = slope + group["pull"] * parameter
        state["velocity"] = group["momentum"] * state["velocity"] + (1 - group["momentum"]) * pulled
        return state["velocity"]


def _over(length: float, vectors: list[torch.Tensor]) -> float:
    """Factor that gives vectors that length together; 0 where they have none."""
    own = math.hypot(*(float(v.double().norm()) for v in vectors))
    return length / own if own else 0.0
