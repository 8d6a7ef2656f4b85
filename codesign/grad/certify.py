"""The certificate of a gradient: autograd against central differences with common random
numbers."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import torch

from codesign.checks import check_positive, check_whole
from codesign.errors import DomainError
from codesign.grad.differences import EPS, Ladder, rounding_noise, stair
from codesign.grad.groups import Loss, check_groups, components, gradients, random_lines, repeated
from codesign.grad.row import SIGMAS, Row, make_row

DEFAULT_LADDER = tuple(10.0**-k for k in (2, 2.5, 3, 3.5, 4, 4.5, 5))
# added to the default ladder where it does not decide: rounding hides the gradient, or the function
# is too quick
MORE_STEPS = (10**-1.5, 1e-1, 1e-6, 1e-7, 1e-8)
FEW, MANY = 4, 12  # spacings at which noise stays alike before it is believed
NOISE_STEP = 1e-2  # of the largest step: near enough to be straight, far enough to round anew


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
      scales: name -> step unit (number or tensor like the parameter); 1 where left out. A ladder
        rung h moves a parameter by h * scale.
      ladder: relative steps; where left out 1e-2 to 1e-5, and 1e-1 to 1e-8 where these do not
        decide.
      tolerance: relative error that is allowed.
      directions: None checks every component; a number checks that many random unit directions per
        group (many parameters; take four or more), drawn with ``generator`` (on the CPU; seed 0
        where left out), and every component of a group that has no more.
      difference_fn: function whose differences judge, when it is not ``fn`` itself (a hard loss
        beside its smooth gradient).
    Returns: list of Row, one per group.
    Raises: GradientError when the loss is no scalar, does not depend on a group through autograd,
      or differs between two calls at the point. DomainError for parameters that are empty or not
      floating, and for scales, steps, tolerance or directions that are not positive. NonFiniteError
      when loss or gradient is not finite at the point, or the loss at no step.
    """
    scales = scales or {}
    steps = tuple(DEFAULT_LADDER if ladder is None else ladder)
    check_groups(params, scales)
    _check(steps, tolerance, directions)
    generator = generator or torch.Generator().manual_seed(0)
    judge = difference_fn or fn
    point = {name: value.detach() for name, value in params.items()}
    grads = gradients(fn, point)
    eps, jitter = repeated(judge, point)
    rows = []
    for name, value in point.items():

        def alone(x: torch.Tensor, name: str = name) -> torch.Tensor:
            return judge({**point, name: x})

        unit = torch.as_tensor(scales.get(name, 1.0)).to(value) * torch.ones_like(value)
        probe = next(random_lines(value, 1, generator)) * unit
        group = _Group(
            name,
            alone,
            value,
            unit,
            grads[name],
            probe,
            jitter,
            eps,
            steps,
            ladder is None,
            tolerance,
        )
        if directions is None or directions >= value.numel():
            lines = components(value)
        else:
            lines = random_lines(value, directions, generator)
        rows.append(group.row(lines))
    return rows


def worst(rows: Sequence[Row]) -> tuple[float, float]:
    """Largest relative error and smallest cosine over rows."""
    return max(r.relative_error for r in rows), min(r.cosine for r in rows)


@dataclass(frozen=True)
class _Group:
    """One group of parameters at its point, and what measuring it needs (probe: line on which noise
    is measured; extend: more steps too)."""

    name: str
    alone: Callable[[torch.Tensor], torch.Tensor]
    value: torch.Tensor
    unit: torch.Tensor
    grad: torch.Tensor
    probe: torch.Tensor
    jitter: float
    eps: float
    steps: tuple[float, ...]
    extend: bool
    tolerance: float

    def row(self, lines):
        """Row of the derivatives along lines of the scaled parameters; where they are lost in
        noise, the length of the gradient is measured along itself, where the signal is largest."""
        row = self.measured(lines)
        slope = self.grad.double() * self.unit.double()
        if row.verdict != "noise" or not bool(slope.any()):
            return row
        along = self.measured([slope / slope.norm()])
        if along.difference == (0.0,):
            return row
        failed = "fail" if along.verdict == "fail" else "noise"
        return dataclasses.replace(row, length_bias=along.signed_bias, verdict=failed)

    def measured(self, lines):
        """Row of the derivatives along lines, by autograd and by differences; with more steps, and
        noise looked for at smaller ones, where the first do not decide."""
        lines = list(lines)
        row = self.tried(lines, FEW, ())
        decided = row.verdict == "pass" and SIGMAS * row.noise_floor <= self.tolerance
        return row if decided or not self.extend else self.tried(lines, MANY, MORE_STEPS)

    def tried(self, lines, spacings, more, least=0.0):
        seen = []

        def fn(x):
            seen.append(self.alone(x))
            return seen[-1]

        step = NOISE_STEP * max(self.steps)
        noise = max(self.jitter, least, rounding_noise(fn, self.value, self.probe, step, spacings))
        slopes = []
        ladders = []
        for line in lines:
            step = line.to(self.unit) * self.unit
            slopes.append(float((self.grad.double() * step.double()).sum()))
            ladders.append(Ladder(fn, self.value, step, noise, self.eps, self.grad))
            ladders[-1].take(self.steps)
        for ladder, step in product(ladders, more):
            try:
                ladder.take((step,))
            # nobody asked for steps as large as these
            except (ArithmeticError, RuntimeError, ValueError):
                ladder.left_out.append(step)
        rounded = stair([float(value) for value in seen]) if self.eps == EPS else 0.0
        if rounded > noise:
            return self.tried(lines, spacings, more, rounded)
        return make_row(
            self.name, slopes, [ladder.difference() for ladder in ladders], self.tolerance
        )


def _check(steps, tolerance, directions):
    if (
        not steps
        or not all(math.isfinite(h) and h > 0 for h in steps)
        or len(set(steps)) < len(steps)
    ):
        raise DomainError(f"ladder = {steps}: give one or more different, positive, finite steps.")
    check_positive(tolerance, "tolerance")
    if directions is not None:
        check_whole(directions, "directions", remedy="None is every component")
