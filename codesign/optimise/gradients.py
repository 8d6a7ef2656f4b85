"""Gradients of samples, one by one: clipped before they are averaged, because a few are tens of
times too long."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from codesign.errors import DomainError, GradientError, ShapeError


def sample_gradients(
    losses: Iterable[Tensor],
    parameters: Sequence[Tensor],
) -> tuple[Tensor, Tensor, list[bool]]:
    """Values and gradients of sample losses, each taken as soon as it is made, so that one graph
    lives at a time.

    Args:
      losses: scalars, S of them; a generator makes each when it is needed.
      parameters: leaves that ask for gradients, of any shapes.
    Returns: values [S] and gradients [S, V] to the parameters' numbers in order, float64; whether
      any sample depends on each parameter.
    Raises: GradientError when a loss does not depend on any of the parameters, or shares its graph
      with another; DomainError, ShapeError for samples that are no scalar tensors, or none.
    """
    if isinstance(losses, Tensor) or not isinstance(losses, Iterable):
        raise DomainError(
            f"samples are one {type(losses).__name__}; give a list or generator of scalar losses."
        )
    values = []
    rows = []
    felt = [False] * len(parameters)
    for loss in losses:
        if not isinstance(loss, Tensor) or loss.numel() != 1:
            given = tuple(loss.shape) if isinstance(loss, Tensor) else type(loss).__name__
            raise ShapeError(
                f"a sample's loss is {given}; give one number as a tensor, such as a mean."
            )
        if not loss.requires_grad:
            raise GradientError(
                "a sample's loss has no gradient; the graph is cut before the objective."
            )
        try:
            grads = torch.autograd.grad(loss, list(parameters), allow_unused=True)
        except RuntimeError as error:
            if "second time" not in str(error):
                raise
            raise GradientError(
                "the samples share a graph, which the first of them used up; make each by a pass of its own (a "
                "generator), or add them up to one loss."
            ) from error
        if all(g is None for g in grads):
            raise GradientError(
                "a sample's loss does not depend on any parameter that is optimised."
            )
        felt = [known or g is not None for known, g in zip(felt, grads, strict=True)]
        values.append(float(loss.detach()))
        rows.append(torch.cat([_flat(g, p) for g, p in zip(grads, parameters, strict=True)]))
    if not rows:
        raise DomainError("there are no samples in this step; give at least one loss.")
    return torch.tensor(values, dtype=torch.float64), torch.stack(rows), felt


def clipped_mean(gradients: Tensor, limit: float | None) -> Tensor:
    """Mean [V] of gradients [S, V], those longer than ``limit`` cut to it; None cuts to the median
    length."""
    lengths = gradients.norm(dim=1)
    felt = lengths[lengths > 0]
    longest = limit if limit is not None else float(felt.median()) if felt.numel() else 1.0
    return (gradients * (longest / lengths.clamp_min(1e-300)).clamp(max=1.0)[:, None]).mean(0)


def assign(parameters: Sequence[Tensor], gradient: Tensor, felt: Sequence[bool]) -> None:
    """Put a flat gradient [V] where torch's optimisers look for it; none where a parameter was not
    ``felt``, which they then leave alone, weight decay included."""
    sizes = [p.numel() for p in parameters]
    for parameter, part, known in zip(parameters, gradient.split(sizes), felt, strict=True):
        # laid out as the parameter is, as torch wants it
        parameter.grad = (
            torch.empty_like(parameter).copy_(part.reshape(parameter.shape)) if known else None
        )


@contextmanager
def scaled_rates(optimiser: torch.optim.Optimizer, factor: float) -> Iterator[None]:
    """Within it, learning rates are as many times what a schedule or the user has set."""
    groups = optimiser.param_groups
    told = [group["lr"] for group in groups]
    try:
        for group, rate in zip(groups, told, strict=True):
            group["lr"] = rate * factor
        yield
    finally:
        for group, rate in zip(groups, told, strict=True):
            group["lr"] = rate


def _flat(gradient: Tensor | None, parameter: Tensor) -> Tensor:
    found = torch.zeros_like(parameter) if gradient is None else gradient
    return found.detach().reshape(-1).double().cpu()
