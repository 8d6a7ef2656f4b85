"""Surrogate derivatives of the spike, with the antiderivative that makes an exact smooth twin of
the layer.

A surrogate is the density rho(x) that stands in for the derivative of the step at x = u - theta.
Its integral from -infinity replaces the step in the smooth twin, whose gradient is therefore exact.
All three have their largest value 1/alpha at the threshold and the width 1/beta.
"""

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from codesign.checks import check_positive
from codesign.errors import DomainError, shown

LOG2_E = math.log2(math.e)


@dataclass(frozen=True)
class Operations:
    """The functions a surrogate is written in, of one array library."""

    exp2: Callable[..., Any]
    abs: Callable[..., Any]
    maximum: Callable[..., Any]
    select: Callable[..., Any]


TORCH = Operations(torch.exp2, torch.abs, lambda x, floor: x.clamp_min(floor), torch.where)


@dataclass(frozen=True)
class Surrogate:
    """Height 1/alpha at the threshold (alpha in spikes^-1 times potential units), width 1/beta in
    potential units.

    Raises: DomainError when alpha or beta is not a positive finite number.
    """

    alpha: float
    beta: float
    mass: ClassVar[float]  # integral over the real line, times alpha beta

    def __post_init__(self):
        for name in ("alpha", "beta"):
            check_positive(getattr(self, name), f"{type(self).__name__}: {name}")

    @classmethod
    def unit(cls, width: float) -> Self:
        """The surrogate of the given width in potential units whose integral is 1, like that of the
        step's true derivative."""
        width = check_positive(width, f"{cls.__name__}.unit: width")
        return cls(cls.mass * width, 1 / width)

    @staticmethod
    def density(operations: Operations, x: Any, alpha: Any, beta: Any) -> Any:
        """rho(x), for arrays of the library that ``operations`` belongs to."""
        raise NotImplementedError

    @staticmethod
    def integral(operations: Operations, x: Any, alpha: Any, beta: Any) -> Any:
        """Integral of rho from -infinity to x: the smooth spike."""
        raise NotImplementedError

    def torch_density(self, x: Tensor) -> Tensor:
        """rho(x) of a torch tensor of real numbers. Raises: DomainError for anything else."""
        return self.density(TORCH, _real(x), *astuple(self))

    def torch_integral(self, x: Tensor) -> Tensor:
        """Integral of rho up to a torch tensor x of real numbers, differentiable. Raises:
        DomainError for anything else."""
        return self.integral(TORCH, _real(x), *astuple(self))


def _real(x):
    if not isinstance(x, Tensor) or not x.is_floating_point() or x.layout != torch.strided:
        given = f"{x.dtype}, {x.layout}" if isinstance(x, Tensor) else shown(x)
        raise DomainError(
            f"x is {given}; a dense tensor of real numbers, potential less threshold, is needed."
        )
    return x


class Laplace(Surrogate):
    """rho = exp(-beta |x|) / alpha.

    Source: Shrestha and Orchard, SLAYER, NeurIPS 2018, eq. 13.
    """

    mass = 2.0

    @staticmethod
    def density(operations: Operations, x: Any, alpha: Any, beta: Any) -> Any:
        # exp2: drjit's exp takes twice as long
        return operations.exp2(-LOG2_E * beta * operations.abs(x)) / alpha

    @staticmethod
    def integral(operations: Operations, x: Any, alpha: Any, beta: Any) -> Any:
        tail = operations.exp2(-LOG2_E * beta * operations.abs(x))
        return operations.select(x < 0, tail, 2 - tail) / (alpha * beta)


class FastSigmoid(Surrogate):
    """rho = 1 / (alpha (1 + beta |x|)^2): heavy tails, so neurons far below threshold still learn.

    Source: Zenke and Ganguli, SuperSpike, Neural Computation 2018.
    """

    mass = 2.0

    @staticmethod
    def density(operations: Operations, x: Any, alpha: Any, beta: Any) -> Any:
        flank = 1 + beta * operations.abs(x)
        return 1 / (alpha * flank * flank)

    @staticmethod
    def integral(operations: Operations, x: Any, alpha: Any, beta: Any) -> Any:
        tail = 1 / (1 + beta * operations.abs(x))
        return operations.select(x < 0, tail, 2 - tail) / (alpha * beta)


class Triangular(Surrogate):
    """rho = max(0, 1 - beta |x|) / alpha: zero outside the width, so the adjoint is sparse.

    Source: Esser et al., PNAS 2016; Bellec et al., NeurIPS 2018.
    """

    mass = 1.0

    @staticmethod
    def density(operations: Operations, x: Any, alpha: Any, beta: Any) -> Any:
        return operations.maximum(1 - beta * operations.abs(x), 0.0) / alpha

    @staticmethod
    def integral(operations: Operations, x: Any, alpha: Any, beta: Any) -> Any:
        rest = operations.maximum(1 - beta * operations.abs(x), 0.0)
        tail = rest * rest / 2
        return operations.select(x < 0, tail, 1 - tail) / (alpha * beta)
