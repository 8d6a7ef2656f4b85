"""Steps of set length along gradients that are noisy but right in the mean."""

from collections.abc import Callable

import torch
from torch import Tensor

from codesign.errors import NonFiniteError
from studies.placement.searches import Trail

FIRST = 0.15  # length of the first step and of the last, in shares of the cube
LAST = 0.02
MOMENTUM = 0.7
KEPT = 0.25  # of the way, its end, whose mean is the answer


def descend(
    slope: Callable[[Tensor, int], tuple[float, Tensor]],
    start: Tensor,
    steps: int,
    advance: Callable[[float], object] = lambda error: None,
) -> Trail:
    """Normalised momentum descent in the cube, its steps ever shorter.

    Args: slope: (share [V], number of the step) -> value and gradient [V], of other samples in every step. start: [V].
    Returns: Trail of the points whose slopes were asked for, and last the mean of the end of the way, which is the answer
      and has the error of the last step. Raises: NonFiniteError.
    """
    here = start.detach().clone()
    pace = torch.zeros_like(here)
    shares = []
    errors = []
    for step in range(steps):
        value, gradient = slope(here, step)
        if not bool(torch.isfinite(gradient).all()):
            raise NonFiniteError(f"the gradient of the placement is not finite at step {step + 1}.")
        shares.append(here)
        errors.append(value)
        advance(value)
        # what pushes through a wall of the cube has no part in the direction
        blocked = ((here <= 0) & (gradient > 0)) | ((here >= 1) & (gradient < 0))
        gradient = torch.where(blocked, 0.0, gradient)
        pace = MOMENTUM * pace + (1 - MOMENTUM) * gradient / gradient.norm().clamp_min(1e-12)
        length = FIRST * (LAST / FIRST) ** (step / max(1, steps - 1))
        here = (here - length * pace / pace.norm().clamp_min(1e-12)).clamp(0, 1)
    shares.append(here)
    errors.append(errors[-1])
    way = torch.stack(shares)
    return Trail(settled(way, steps), torch.tensor(errors, dtype=torch.float64))


def settled(way: Tensor, steps: int) -> Tensor:
    """Points [N, V] of so many steps, the last of which is the mean of the way's end."""
    return torch.cat([way[:-1], way[-max(1, round(KEPT * steps)) :].mean(0, keepdim=True)])
