"""Does the certificate of a gradient tell right from wrong? Judged where the truth is known.

Functions drawn at random, in single and double precision, from three numbers to images of 64 x 64: half of
them with autograd's own gradient, half with one that is 30 % off in length, in direction or in some signs.
Counted: right gradients that fail, wrong ones that pass, and how many of each are decided at all.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch

from codesign.errors import DomainError
from codesign.grad import Row, certify
from studies.frame.run import Run, StudyConfig, main

WRONG = 0.3  # relative error of every wrong gradient, in L2
KINDS = ("shorter", "longer", "turned", "signs")
DTYPES = {"float32": torch.float32, "float64": torch.float64}
DIRECTIONS = 4

Function = Callable[[torch.Tensor], torch.Tensor]
Drawn = tuple[Function, torch.Tensor, int | None]


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"cases": 4}
    cases: int = 40
    """Right gradients per function and precision, and as many wrong ones."""


def study(run: Run[Config]) -> None:
    if run.config.cases < 1:
        raise DomainError(f"cases = {run.config.cases} must be at least 1.")
    count = run.config.cases
    jobs = [(name, dtype) for name in FUNCTIONS for dtype in DTYPES]
    table = []
    with run.progress(len(jobs), "certifying") as progress:
        for name, dtype in jobs:
            right = [judged(name, dtype, run.config.seed + k, None).verdict for k in range(count)]
            wrong = [
                judged(name, dtype, run.config.seed + count + k, KINDS[k % len(KINDS)]).verdict
                for k in range(count)
            ]
            label = f"{name}_{dtype}".replace(" ", "_")
            for truth, found in (("right", right), ("wrong", wrong)):
                run.record(**{f"{label}_{truth}_{v}": found.count(v) for v in ("pass", "noise", "fail")})
            table.append((name, dtype, *(found.count(v) for found in (right, wrong) for v in VERDICTS)))
            progress.advance()
    false = sum(row[4] for row in table), sum(row[5] for row in table)
    run.record(cases=2 * count * len(jobs), right_failed=false[0], wrong_passed=false[1])
    run.card("Right gradients that fail", str(false[0]), f"of {count * len(jobs)}")
    run.card("Wrong gradients that pass", str(false[1]), f"of {count * len(jobs)}")
    columns = ("function", "precision", *(f"{truth}: {v}" for truth in ("right", "wrong") for v in VERDICTS))
    run.table(f"Verdicts on {count} right and {count} wrong gradients each", columns, table)
    run.finish(
        "Precision of the certificate",
        f"{false[0]} right gradients fail and {false[1]} wrong ones pass, of {count * len(jobs)} each.",
    )


VERDICTS = ("pass", "noise", "fail")


def judged(name: str, dtype: str, seed: int, kind: str | None) -> Row:
    """Certificate of one drawn function with its right gradient (kind None) or a wrong one (see KINDS)."""
    generator = torch.Generator().manual_seed(seed)
    fn, x, directions = FUNCTIONS[name](generator, DTYPES[dtype])
    if kind is not None:
        fn = spoiled(fn, x, kind, generator)
    (row,) = certify(lambda p: fn(p["x"]), {"x": x}, directions=directions, generator=generator)
    return row


def spoiled(fn: Function, x: torch.Tensor, kind: str, generator: torch.Generator) -> Function:
    """The function with the same values and a gradient that is 30 % off."""
    leaf = x.clone().requires_grad_(True)
    (grad,) = torch.autograd.grad(fn(leaf), leaf)
    if kind == "shorter":
        error = -WRONG * grad
    elif kind == "longer":
        error = WRONG * grad
    elif kind == "turned":
        error = torch.randn(x.shape, generator=generator, dtype=torch.float64).to(grad)
        error -= (error * grad).sum() / grad.square().sum() * grad
        error *= WRONG * grad.norm() / error.norm() if bool(error.any()) else 0
    else:
        order = torch.randperm(x.numel(), generator=generator)
        share = grad.flatten()[order].square().cumsum(0) / grad.square().sum()
        turned = order[
            : int((share < (WRONG / 2) ** 2).sum()) + 1
        ]  # a flipped sign is an error of twice its size
        error = torch.zeros_like(grad)
        error.view(-1)[turned] = -2 * grad.flatten()[turned]

    def wrong(x: torch.Tensor) -> torch.Tensor:
        extra = (error * x).sum()
        return fn(x) + (extra - extra.detach())

    return wrong


def uniform(generator: torch.Generator, dtype: torch.dtype, *shape: int) -> torch.Tensor:
    return torch.rand(shape, generator=generator, dtype=torch.float64).to(dtype)


def logarithms(*shape: int, directions: int | None = None) -> Callable[..., Drawn]:
    """Sum of log(x + 1)^2."""

    def draw(generator, dtype):
        return lambda x: (x + 1).log().square().sum(), uniform(generator, dtype, *shape), directions

    return draw


def squares(*shape: int, offset: float = 0.0) -> Callable[..., Drawn]:
    """Weighted mean of squares, on top of a constant."""

    def draw(generator, dtype):
        weight = uniform(generator, dtype, *shape)
        return (
            lambda x: offset + (weight * x.square()).mean(),
            2 * uniform(generator, dtype, *shape) - 1,
            DIRECTIONS,
        )

    return draw


def exponentials(*shape: int) -> Callable[..., Drawn]:
    """logsumexp of a few brightnesses."""

    def draw(generator, dtype):
        return lambda x: (5 * x).flatten().logsumexp(0), uniform(generator, dtype, *shape), DIRECTIONS

    return draw


def network(generator: torch.Generator, dtype: torch.dtype) -> Drawn:
    """Weights of two convolutions with ReLU between, on a batch of images 12 x 12; mean squared output."""
    image = uniform(generator, dtype, 2, 1, 12, 12)
    weights = torch.randn(4 * 9 + 2 * 4 * 9, generator=generator, dtype=torch.float64).to(dtype) / 3

    def fn(x):
        hidden = torch.nn.functional.conv2d(image, x[:36].view(4, 1, 3, 3)).relu()
        return torch.nn.functional.conv2d(hidden, x[36:].view(2, 4, 3, 3)).square().mean()

    return fn, weights, None


def contrast(*shape: int) -> Callable[..., Drawn]:
    """Squared difference of log brightness between neighbouring pixels."""

    def draw(generator, dtype):
        return (
            lambda x: (x + 0.1).log().diff(dim=-1).square().sum(),
            uniform(generator, dtype, *shape),
            DIRECTIONS,
        )

    return draw


FUNCTIONS: dict[str, Callable[[torch.Generator, torch.dtype], Drawn]] = {
    "three logarithms": logarithms(3),
    "thousand logarithms": logarithms(1000),
    "logarithms 12x12": logarithms(12, 12, directions=DIRECTIONS),
    "logarithms 64x64": logarithms(64, 64, directions=DIRECTIONS),
    "squares 64x64": squares(64, 64),
    "squares 12x12 on 1000": squares(12, 12, offset=1e3),
    "logsumexp 12x12": exponentials(12, 12),
    "contrast 64x64": contrast(64, 64),
    "weights of a network": network,
}


if __name__ == "__main__":
    sys.exit(main(study, Config))
