"""Jacobians by autograd or by differences, and scales that give every variable the same effect."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from codesign.errors import DomainError

Jacobian = Callable[[Callable[[Tensor], Tensor], Tensor, Tensor], Tensor]


def by_autograd(residuals: Callable[[Tensor], Tensor], variables: Tensor, value: Tensor) -> Tensor:
    """Jacobian [M, V] by one backward pass per residual: exact; for few residuals, or as a
    reference."""
    at = variables.detach().requires_grad_()
    with torch.enable_grad():
        found = residuals(at)
        if not found.requires_grad:
            raise DomainError(
                "the residuals do not depend on the variables through torch; use by_differences."
            )
        slopes = variables.new_zeros(len(found), len(variables))
        for row, entry in zip(slopes, found, strict=True):
            row += torch.autograd.grad(entry, at, retain_graph=True, materialize_grads=True)[0]
    return slopes


def by_differences(step: float | Tensor, central: bool = False) -> Jacobian:
    """A Jacobian by differences of the variables: V more evaluations, 2 V when ``central``.

    Args:
      step: a number or [V]; the error is about step (step^2 when central) times curvature, plus
        rounding over step.
    Where the far side is not finite the other side is used; where neither is, the Jacobian is not
    finite.

    >>> x = torch.tensor([1.0, 2.0], dtype=torch.float64)
    >>> by_differences(1e-4, central=True)(torch.square, x, x.square()).round(decimals=6).tolist()
    [[2.0, 0.0], [0.0, 4.0]]
    """

    def jacobian(residuals, variables, value):
        steps = torch.as_tensor(step, dtype=variables.dtype, device=variables.device).expand_as(
            variables
        )
        with torch.no_grad():
            return torch.stack(
                [
                    _slope(residuals, variables, value, v, float(steps[v]), central)
                    for v in range(variables.numel())
                ],
                1,
            )

    return jacobian


def _slope(residuals, variables, value, at, step, central):
    def moved(by):
        shifted = variables.clone()
        shifted[at] += by
        # the step that rounding leaves
        return residuals(shifted), float(shifted[at] - variables[at])

    plus, plus_step = moved(step)
    if finite(plus) and not central:
        return (plus - value) / plus_step
    minus, minus_step = moved(-step)
    if not finite(plus):
        return (minus - value) / minus_step
    return (
        (plus - minus) / (plus_step - minus_step) if finite(minus) else (plus - value) / plus_step
    )


def finite(value: Tensor) -> bool:
    """Whether every entry is a finite number."""
    return bool(value.isfinite().all())


def column_scales(jacobian: Tensor, limit: float | Tensor = math.inf) -> Tensor:
    """Step per variable [V] that changes the residuals by 1: one over the column norms, at most
    ``limit``.

    Args: jacobian [M, V]; limit: number or [V], for variables the residuals hardly see.
    """
    norms = torch.linalg.vector_norm(jacobian, dim=0)
    return torch.minimum(
        1 / norms.clamp_min(torch.finfo(norms.dtype).tiny),
        torch.as_tensor(limit, dtype=norms.dtype, device=norms.device),
    )


def principal_modes(
    jacobian: Tensor, limit: float = math.inf, size: Tensor | float = 1.0
) -> Tensor:
    """Basis [V, V] whose columns are directions with effects at right angles, each of which changes
    the residuals by 1, the weakest first.

    Args:
      jacobian: [M, V], by variables in units of their ``size``.
      limit: largest change of any variable by a column, in these units, for directions the
        residuals hardly see.
      size: [V] or one of all, what makes variables comparable; the basis is in the variables' own
        units.
    Source: eigenvectors of J^T J.
    """
    power, modes = torch.linalg.eigh(jacobian.T @ jacobian)
    reach = torch.minimum(power.clamp_min(1e-30).rsqrt(), limit / modes.abs().amax(0))
    size = torch.as_tensor(size, dtype=modes.dtype, device=modes.device)
    return size.reshape(-1, 1) * modes * reach
