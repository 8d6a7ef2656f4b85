"""The certificate of a gradient: autograd against central differences with common random numbers."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import torch

from codesign.errors import DomainError, GradientError, NonFiniteError, ShapeError
from codesign.grad.differences import Ladder, rounding_noise
from codesign.grad.row import SIGMAS, Row, make_row, verdict

Loss = Callable[[dict[str, torch.Tensor]], torch.Tensor]

DEFAULT_LADDER = tuple(10.0**-k for k in (2, 2.5, 3, 3.5, 4, 4.5, 5))
LARGER_STEPS = (10**-1.5, 10**-1.0)  # added to the default ladder where rounding hides the gradient
NOISE_STEP = 1e-2  # of the largest step: near enough to be straight, far enough to round anew
SAME_NUMBERS = 1e-4  # two calls at one point may differ by rounding, not by random numbers


def certify(
    fn: Loss,
    params: Mapping[str, torch.Tensor],
    *,
    scales: Mapping[str, float | torch.Tensor] | None = None,
    ladder: Sequence[float] | None = None,
    tolerance: float = 0.01,
    directions: int | None = None,
    generator: torch.Generator | None = None,
    difference_fn: Loss | None = None,
) -> list[Row]:
    """Compare autograd of a scalar function with differences, group by group.

    >>> import torch
    >>> rows = certify(lambda p: p["x"].sin().sum(), {"x": torch.linspace(0, 1, 5)})
    >>> rows[0].name, rows[0].verdict
    ('x', 'pass')

    Args:
      fn: function of a dict of tensors -> scalar tensor; the same random numbers at every call.
      params: name -> floating tensor (the point where the gradient is checked).
      scales: name -> step unit (number or tensor like the parameter); 1 where left out. A ladder rung h moves
        a parameter by h * scale.
      ladder: relative steps; where left out 1e-2 to 1e-5, and up to 1e-1 where rounding needs it (float32).
      tolerance: relative error that is allowed.
      directions: None checks every component; a number checks that many random unit directions per group
        (many parameters; take four or more), drawn with ``generator`` (on the CPU; seed 0 where left out),
        and every component of a group that has no more.
      difference_fn: function whose differences judge, when it is not ``fn`` itself (a hard loss beside its
        smooth gradient).
    Returns: list of Row, one per group.
    Raises: GradientError when the loss is no scalar, does not depend on a group through autograd, or differs
      between two calls at the point. DomainError for parameters that are empty or not floating, and for
      scales, steps, tolerance or directions that are not positive. NonFiniteError when loss or gradient is
      not finite at the point, or the loss at no step.
    """
    scales = scales or {}
    steps = tuple(DEFAULT_LADDER if ladder is None else ladder)
    _check(params, scales, steps, tolerance, directions)
    generator = generator or torch.Generator().manual_seed(0)
    judge = difference_fn or fn
    point = {name: value.detach() for name, value in params.items()}
    grads = _gradients(fn, point)
    eps, jitter = _repeated(judge, point)
    rows = []
    for name, value in point.items():

        def alone(x: torch.Tensor, name: str = name) -> torch.Tensor:
            return judge({**point, name: x})

        unit = torch.as_tensor(scales.get(name, 1.0)).to(value) * torch.ones_like(value)
        probe = next(_random(value, 1, generator)) * unit
        noise = max(jitter, rounding_noise(alone, value, probe, NOISE_STEP * max(steps)))
        group = _Group(name, alone, value, unit, grads[name], noise, eps, steps, ladder is None, tolerance)
        if directions is None or directions >= value.numel():
            lines = _components(value)
        else:
            lines = _random(value, directions, generator)
        rows.append(group.row(lines))
    return rows


def worst(rows: Sequence[Row]) -> tuple[float, float]:
    """Largest relative error and smallest cosine over rows."""
    return max(r.relative_error for r in rows), min(r.cosine for r in rows)


@dataclass(frozen=True)
class _Group:
    """One group of parameters at its point, and what measuring it needs (extend: larger steps too)."""

    name: str
    alone: Callable[[torch.Tensor], torch.Tensor]
    value: torch.Tensor
    unit: torch.Tensor
    grad: torch.Tensor
    noise: float
    eps: float
    steps: tuple[float, ...]
    extend: bool
    tolerance: float

    def row(self, lines):
        """Row of the derivatives along lines of the scaled parameters; where they are lost in noise, the
        length of the gradient is measured along itself, where the signal is largest."""
        row = make_row(self.name, *self.measured(lines), self.tolerance)
        slope = self.grad.double() * self.unit.double()
        if row.verdict != "noise" or not bool(slope.any()):
            return row
        (length,), (found,) = self.measured([slope / slope.norm()])
        if found.value == 0:
            return row
        failed = verdict(abs(length - found.value), abs(found.value), found.noise, self.tolerance) == "fail"
        return dataclasses.replace(
            row, length_bias=length / found.value - 1, verdict="fail" if failed else "noise"
        )

    def measured(self, lines):
        """Derivatives along lines: by autograd, and Differences."""
        slopes = []
        ladders = []
        for line in lines:
            step = line.to(self.unit) * self.unit
            slopes.append(float((self.grad.double() * step.double()).sum()))
            ladders.append(Ladder(self.alone, self.value, step, self.noise, self.eps))
            ladders[-1].take(self.steps)
        found = [ladder.difference() for ladder in ladders]
        size = math.hypot(*(f.value for f in found))
        if not self.extend or SIGMAS * math.hypot(*(f.noise for f in found)) <= self.tolerance * size:
            return slopes, found
        for ladder, step in product(ladders, LARGER_STEPS):
            try:
                ladder.take((step,))
            except (ArithmeticError, RuntimeError, ValueError):  # nobody asked for steps as large as these
                ladder.left_out.append(step)
        return slopes, [ladder.difference() for ladder in ladders]


def _components(value: torch.Tensor) -> Iterator[torch.Tensor]:
    for k in range(value.numel()):
        line = torch.zeros_like(value, memory_format=torch.contiguous_format)
        line.view(-1)[k] = 1
        yield line


def _random(value: torch.Tensor, count: int, generator: torch.Generator) -> Iterator[torch.Tensor]:
    for _ in range(count):
        drawn = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        yield (drawn / drawn.norm()).to(value)


def _gradients(fn, point):
    leaves = {name: value.clone().requires_grad_(True) for name, value in point.items()}
    with torch.enable_grad():
        loss = fn(leaves)
    _check_scalar(loss)
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


def _repeated(judge, point):
    """(eps of the loss, difference of two calls at the point); random numbers must be the same in both."""
    with torch.no_grad():
        first = judge(dict(point))
        again = judge(dict(point))
    _check_scalar(first)
    one, two = float(first), float(again)
    if not (math.isfinite(one) and math.isfinite(two)):
        raise NonFiniteError(f"the loss is {one} at the point itself; choose a point inside its domain.")
    if abs(one - two) > SAME_NUMBERS * max(abs(one), abs(two)):
        raise GradientError(
            f"two calls at the same point gave {one:g} and {two:g}, so differences would be those of random "
            "numbers; seed your generator inside the function, so that every call draws the same ones."
        )
    return torch.finfo(first.dtype).eps, abs(one - two)


def _check_scalar(loss):
    if not isinstance(loss, torch.Tensor) or not loss.is_floating_point():
        kind = loss.dtype if isinstance(loss, torch.Tensor) else type(loss).__name__
        raise GradientError(f"the function returned a {kind}; certify needs a floating scalar tensor.")
    if loss.numel() != 1:
        raise GradientError(
            f"certify needs a scalar function, got shape {tuple(loss.shape)}; reduce it to one number."
        )


def _check(params, scales, steps, tolerance, directions):
    if not params:
        raise DomainError("certify got no parameters; give a dict of names and tensors.")
    for name, value in params.items():
        if not (isinstance(value, torch.Tensor) and value.is_floating_point() and value.numel()):
            given = (
                f"a {value.dtype} tensor of shape {tuple(value.shape)}"
                if isinstance(value, torch.Tensor)
                else f"a {type(value).__name__}"
            )
            raise DomainError(f"'{name}' is {given}; gradients are certified at floating, non-empty tensors.")
    for name, scale in scales.items():
        if name not in params:
            raise DomainError(f"scales name '{name}', which is no parameter; there are {', '.join(params)}.")
        unit = torch.as_tensor(scale)
        shape = tuple(params[name].shape)
        if unit.numel() > 1 and tuple(unit.shape) != shape[-unit.ndim :]:
            raise ShapeError(
                f"the scale of '{name}' has shape {tuple(unit.shape)}; give a number or {shape}."
            )
        if not bool(((unit > 0) & unit.isfinite()).all()):
            raise DomainError(f"the scale of '{name}' is {scale}; it must be positive and finite.")
    if not steps or not all(math.isfinite(h) and h > 0 for h in steps) or len(set(steps)) < len(steps):
        raise DomainError(f"ladder = {steps}: give one or more different, positive, finite steps.")
    if not (math.isfinite(tolerance) and tolerance > 0):
        raise DomainError(f"tolerance = {tolerance} must be positive and finite.")
    if directions is not None and directions < 1:
        raise DomainError(f"directions = {directions} must be at least 1, or None for every component.")
