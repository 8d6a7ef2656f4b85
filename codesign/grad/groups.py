"""Groups of parameters at a point: what they may be, lines through them, their gradients."""

import math
from collections.abc import Callable, Iterator, Mapping

import torch

from codesign.errors import DomainError, GradientError, NonFiniteError, ShapeError

Loss = Callable[[dict[str, torch.Tensor]], torch.Tensor]

SAME_NUMBERS = 1e-4  # two calls at one point may differ by rounding, not by random numbers


def check_groups(
    params: Mapping[str, torch.Tensor],
    scales: Mapping[str, float | torch.Tensor],
) -> None:
    """Raise DomainError or ShapeError for parameters that are not floating or are empty, and for
    scales that are of none, do not fit, or are not positive and finite."""
    if not params:
        raise DomainError("there are no parameters; give a dict of names and tensors.")
    for name, value in params.items():
        if not (isinstance(value, torch.Tensor) and value.is_floating_point() and value.numel()):
            given = (
                f"a {value.dtype} tensor of shape {tuple(value.shape)}"
                if isinstance(value, torch.Tensor)
                else f"a {type(value).__name__}"
            )
            raise DomainError(
                f"'{name}' is {given}; gradients are taken at floating, non-empty tensors."
            )
    for name, scale in scales.items():
        if name not in params:
            raise DomainError(
                f"scales name '{name}', which is no parameter; there are {', '.join(params)}."
            )
        unit = torch.as_tensor(scale)
        shape = tuple(params[name].shape)
        if unit.numel() > 1 and tuple(unit.shape) != shape[-unit.ndim :]:
            raise ShapeError(
                f"the scale of '{name}' has shape {tuple(unit.shape)}; give a number or {shape}."
            )
        if not bool(((unit > 0) & unit.isfinite()).all()):
            raise DomainError(f"the scale of '{name}' is {scale}; it must be positive and finite.")


def check_scalar(loss: object) -> None:
    """Raise GradientError unless a loss is a floating scalar tensor."""
    if not isinstance(loss, torch.Tensor) or not loss.is_floating_point():
        kind = loss.dtype if isinstance(loss, torch.Tensor) else type(loss).__name__
        raise GradientError(f"the function returned a {kind}; a floating scalar tensor is needed.")
    if loss.numel() != 1:
        raise GradientError(
            f"a scalar function is needed, got shape {tuple(loss.shape)}; reduce it to one number."
        )


def components(value: torch.Tensor) -> Iterator[torch.Tensor]:
    """Unit vectors along every number of a tensor, in its shape."""
    for k in range(value.numel()):
        line = torch.zeros_like(value, memory_format=torch.contiguous_format)
        line.view(-1)[k] = 1
        yield line


def random_lines(
    value: torch.Tensor,
    count: int,
    generator: torch.Generator,
) -> Iterator[torch.Tensor]:
    """Unit vectors in random directions, in the tensor's shape."""
    for _ in range(count):
        drawn = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        yield (drawn / drawn.norm()).to(value)


def gradients(fn: Loss, point: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Gradient to every group by one pass of autograd.

    Raises: GradientError where the loss is no floating scalar, or the graph is cut; NonFiniteError
      where a gradient is not finite.
    """
    leaves = {name: value.clone().requires_grad_(True) for name, value in point.items()}
    with torch.enable_grad():
        loss = fn(dict(leaves))
    check_scalar(loss)
    if not loss.requires_grad:
        raise GradientError(
            "the function returns a loss without a graph; do not detach it, convert it to a number, or "
            "compute it under no_grad."
        )
    grads = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    for name, grad in zip(leaves, grads, strict=True):
        if grad is None:
            raise GradientError(
                f"the function does not depend on '{name}' through autograd; the graph is cut somewhere "
                "before it."
            )
        if not bool(grad.isfinite().all()):
            raise NonFiniteError(
                f"the gradient with respect to '{name}' is not finite at this point; move the point, or look "
                "for a square root, norm or division at zero on the way."
            )
    return dict(zip(leaves, grads, strict=True))


def repeated(judge: Loss, point: Mapping[str, torch.Tensor]) -> tuple[float, float]:
    """(eps of the loss, difference of two calls at the point); random numbers must be the same in
    both.

    Raises: GradientError where they are not, or the loss is no floating scalar; NonFiniteError
      where it is not finite.
    """
    with torch.no_grad():
        first = judge(dict(point))
        again = judge(dict(point))
    check_scalar(first)
    one, two = float(first), float(again)
    if not (math.isfinite(one) and math.isfinite(two)):
        raise NonFiniteError(
            f"the loss is {one} at the point itself; choose a point inside its domain."
        )
    if abs(one - two) > SAME_NUMBERS * max(abs(one), abs(two)):
        raise GradientError(
            f"two calls at the same point gave {one:g} and {two:g}, so differences would be those of random "
            "numbers; seed your generator inside the function, so that every call draws the same ones."
        )
    return torch.finfo(first.dtype).eps, abs(one - two)
