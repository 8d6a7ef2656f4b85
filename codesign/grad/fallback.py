"""Where autograd is not to be trusted: per group of parameters, the way to the gradient is chosen by measurement.

Autograd is kept where it agrees with what the judge does, differences with common random numbers, averaged over
draws. A small group whose autograd fails goes by those differences, two calls of the judge per number; a larger one, or
one whose differences are lost in noise, by evolution: differences along Gaussian directions, all numbers at once.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from codesign.checks import check_positive, check_seed, check_whole
from codesign.errors import DomainError, GradientError, NonFiniteError
from codesign.grad.differences import Difference, central
from codesign.grad.groups import check_groups, components, gradients, loss_at, random_lines, repeated
from codesign.grad.row import SIGMAS, make_row

Way: TypeAlias = Literal["autograd", "differences", "evolution"]
DrawLoss: TypeAlias = Callable[[dict[str, Tensor], int], Tensor]

SMALL = 12  # numbers of a group that differences may serve
DIRECTIONS = 12  # random ones in which a larger group is looked at
PAIRS = 16  # of evolution
KNOWN = 1 / SIGMAS  # standard error up to which differences count as known


@dataclass(frozen=True)
class Choice:
    """The way chosen for a group, and why.

    way: "autograd", "differences" or "evolution". relative_l2, cosine: of autograd against the differences, both averaged
      over the draws; NaN where autograd is not finite. noise: standard error of those differences, relative to them.
    calls: of the judge for the gradient of one draw, beside the pass of autograd that all groups share.

    >>> print(Choice("differences", relative_l2=2.0, cosine=-1.0, noise=0.03, calls=12))
    differences, 12 calls a draw: autograd is off by 200.0% (cosine -1.000), differences are known to 3.0%
    """

    way: Way
    relative_l2: float
    cosine: float
    noise: float
    calls: int

    def __str__(self):
        cost = f", {self.calls} calls a draw" if self.calls else ""
        return (
            f"{self.way}{cost}: autograd is off by {self.relative_l2:.1%} (cosine {self.cosine:.3f}), "
            f"differences are known to {self.noise:.1%}"
        )


def choose(
    loss: DrawLoss,
    params: Mapping[str, Tensor],
    draws: Sequence[int],
    *,
    scales: Mapping[str, float | Tensor],
    judge: DrawLoss | None = None,
    directions: int = DIRECTIONS,
    relative_l2: float = 0.1,
    cosine: float = 0.95,
    pairs: int = PAIRS,
    generator: torch.Generator | None = None,
) -> dict[str, Choice]:
    """A way to the gradient for every group of parameters.

    Args:
      loss: (parameters by name, draw) -> scalar, the same random numbers for the same draw. params: name -> floating
        tensor, the point where the ways are compared. draws: two or more numbers; what is judged is the mean over them.
      scales: name -> how far differences move each number (a number, or a tensor like the parameter), and the standard
        deviation of evolution's directions: far enough to change many events, near enough that the loss is straight.
      judge: what the gradient shall be of, when it is not ``loss`` itself, such as the hard loss beside its
        straight-through one.
      directions: random ones for groups of more than SMALL numbers, every number moved by its scale (root mean square);
        smaller groups are looked at number by number.
      relative_l2, cosine: autograd is kept where its mean is within both. pairs: calls of evolution, halved.
      generator: of the directions; seed 0 where left out.
    Returns: name -> Choice; its text is a line of a log. Gradient: none.
    Raises: GradientError where two calls of one draw differ, a loss is no scalar, or the judge does not move in any draw
      where autograd does; NonFiniteError where the judge is not finite; DomainError and ShapeError for what is missing or
      of the wrong size.
    """
    _check(params, scales, draws)
    for name, value in (("relative_l2", relative_l2), ("cosine", cosine)):
        check_positive(value, name)
    judged = judge or loss
    generator = generator or torch.Generator().manual_seed(0)
    count = check_whole(directions, "directions")
    point = {name: value.detach() for name, value in params.items()}
    steps = {name: _steps(value, scales[name], count, generator) for name, value in point.items()}
    for each in dict.fromkeys((loss, judged)):
        repeated(lambda p, each=each: each(p, draws[0]), point)
    means = {name: torch.zeros_like(value, dtype=torch.float64) for name, value in point.items()}
    found: dict[str, list[list[float]]] = {name: [] for name in point}
    for draw in draws:
        for name, grad in _autograd(loss, point, draw).items():
            means[name] += grad.double() / len(draws)
        for name, lines in steps.items():
            found[name].append(_differences(judged, point, name, lines, draw))
    chosen = {}
    for name, value in point.items():
        table = torch.tensor(found[name], dtype=torch.float64)
        errors = table.std(0) / math.sqrt(len(draws))
        slopes = [float((means[name] * step.double()).sum()) for step in steps[name]]
        mean = [
            Difference(m, 1.0, e, ()) for m, e in zip(table.mean(0).tolist(), errors.tolist(), strict=True)
        ]
        row = make_row(name, slopes, mean, relative_l2)
        if not bool(table.any()) and any(slopes):
            raise GradientError(
                f"'{name}': the judge does not change in any draw when its numbers move by their scale, although "
                "autograd does; give a larger scale, or leave the group out."
            )
        if row.relative_error <= relative_l2 and row.cosine >= cosine:
            way, calls = "autograd", 0
        elif value.numel() <= SMALL and row.noise_floor <= KNOWN:
            way, calls = "differences", 2 * value.numel()
        else:
            way, calls = "evolution", 2 * check_whole(pairs, "pairs")
        chosen[name] = Choice(way, row.relative_error, row.cosine, row.noise_floor, calls)
    return chosen


def gradient(
    loss: DrawLoss,
    params: Mapping[str, Tensor],
    ways: Mapping[str, Choice],
    draw: int,
    *,
    scales: Mapping[str, float | Tensor],
    judge: DrawLoss | None = None,
) -> dict[str, Tensor]:
    """The gradient of one draw, each group by its way: one pass of autograd for all that go by it, calls of the judge
    without a graph for the others.

    Args: as for ``choose``. ways: what it returned. draw: seeds the directions of evolution too.
    Returns: name -> tensor like the parameter. By differences it is that of the judge with the kinks within a scale
      averaged; by evolution, in expectation, that of the judge smoothed by a Gaussian of the scales.
    Raises: GradientError where autograd's graph is cut; NonFiniteError where a loss or gradient is not finite;
      DomainError for a group without a way or scale; ShapeError.
    Source: evolution with antithetic pairs: Salimans et al., arXiv 1703.03864, 2017.
    """
    _check(params, scales, (draw, draw))
    if missing := [name for name in params if name not in ways]:
        raise DomainError(f"no way is chosen for '{missing[0]}'; give one for every group, as choose does.")
    judged = judge or loss
    point = {name: value.detach() for name, value in params.items()}
    smooth = {name: value for name, value in point.items() if ways[name].way == "autograd"}
    found = {}
    if smooth:
        found = gradients(lambda p: loss({**point, **p}, draw), smooth)
    for number, (name, value) in enumerate(point.items()):
        if ways[name].way == "differences":
            unit = _unit(value, scales[name])
            slopes = _differences(judged, point, name, [line * unit for line in components(value)], draw)
            found[name] = torch.tensor(slopes, dtype=torch.float64).to(value).reshape(value.shape) / unit
        elif ways[name].way == "evolution":
            found[name] = _evolution(judged, point, name, scales[name], draw, number, ways[name].calls // 2)
    return {name: found[name] for name in point}


def _evolution(judge, point, name, scale, draw, number, pairs):
    """Mean over pairs of the difference along a Gaussian direction, times that direction."""
    value = point[name]
    unit = _unit(value, scale).double()
    # away from the seeds of the loss, whose own noise is likely to come from the same numbers
    seed = np.random.SeedSequence([draw % 2**63, number]).generate_state(1)[0]
    random = torch.Generator().manual_seed(int(seed))
    deviates = torch.randn(pairs, *value.shape, generator=random, dtype=torch.float64).to(value.device)
    slopes = _differences(judge, point, name, [(unit * each).to(value) for each in deviates], draw)
    weights = torch.tensor(slopes, dtype=torch.float64, device=value.device) / pairs
    return (torch.tensordot(weights, deviates, 1) / unit).to(value)


def _autograd(loss, point, draw):
    """Gradient to every group; zero where the graph is cut."""
    value, leaves = loss_at(lambda p: loss(p, draw), point)
    if not value.requires_grad:
        return {name: torch.zeros_like(leaf) for name, leaf in leaves.items()}
    grads = torch.autograd.grad(value, list(leaves.values()), allow_unused=True)
    return {
        name: torch.zeros_like(leaf) if grad is None else grad
        for (name, leaf), grad in zip(leaves.items(), grads, strict=True)
    }


def _differences(judge, point, name, steps, draw):
    """Half the change of the judge from one end of each step to the other."""

    def alone(x):
        return judge({**point, name: x}, draw)

    found = [central(alone, point[name], step, 1.0) for step in steps]
    if not all(map(math.isfinite, found)):
        raise NonFiniteError(
            f"the judge is not finite when '{name}' moves by its scale (draw {draw}); give a smaller scale, or a point "
            "inside its domain."
        )
    return found


def _steps(value, scale, directions, generator):
    """Steps in a group's shape: one along each number, or, of a large group, random ones of the same length a number."""
    unit = _unit(value, scale)
    if value.numel() <= SMALL:
        return [line * unit for line in components(value)]
    return [math.sqrt(value.numel()) * line * unit for line in random_lines(value, directions, generator)]


def _unit(value, scale):
    return torch.as_tensor(scale, dtype=torch.float64).to(value) * torch.ones_like(value)


def _check(params, scales, draws):
    check_groups(params, scales)
    if missing := [name for name in params if name not in scales]:
        raise DomainError(
            f"'{missing[0]}' has no scale; say how far its numbers move until the loss changes visibly but gently."
        )
    if len(draws) < 2:
        raise DomainError(f"{len(draws)} draws are given; two or more are needed to know the noise.")
    for draw in draws:
        check_seed(draw, "draw")
