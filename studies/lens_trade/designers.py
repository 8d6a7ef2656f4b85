"""The two designers: one makes spots small by damped least squares, one lowers the flow error by gradients through the chain."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from codesign.errors import DomainError
from codesign.grad.jacobian import by_differences
from codesign.lens import GeoLens
from codesign.optimise import DampedLeastSquares, Descent, Loop, StopRules
from codesign.system import Batch
from studies.lens_trade import cases
from studies.lens_trade.problem import STEP, Problem, Weights

PENALTY = 10.0
SAMPLES = 15


def by_spots(problem: Problem, start: Tensor, weights: Weights, steps: int = 60) -> Tensor:
    """Variables of the least weighted mean square spot within the limits, from a start."""
    solver = DampedLeastSquares(
        problem.residuals(weights), start, by_differences(STEP), stop=StopRules(steps=steps, loss=1e-5)
    )
    return solver.run()


class Variable(nn.Module):
    """A camera whose lens moves along modes of ray motion, zero at the start."""

    def __init__(self, problem: Problem, start: Tensor):
        super().__init__()
        self.problem = problem
        self.start = start
        self.modes = problem.modes(start)
        self.z = nn.Parameter(torch.zeros_like(start))

    def point(self) -> Tensor:
        return self.start + self.modes @ self.z

    def optics(self) -> GeoLens:
        return self.problem.lens(self.point())

    def forward(self):
        return cases.camera(self.optics(), SAMPLES)


def by_flow(
    problem: Problem,
    start: Tensor,
    light: cases.Light,
    steps: int,
    batch: int,
    seed: int,
    score: Callable[[GeoLens], float],
    step_size: float = 0.3,
    advance: Callable[..., object] | None = None,
) -> Tensor:
    """Variables that lower the flow error within the limits, from a start."""
    seen_by = Variable(problem, start)
    system = cases.system(seen_by, cases.smooth_layer(light), light, problem.fno)

    def penalty():
        return PENALTY * problem.limit_rows(seen_by.optics()).square().sum()

    def samples(step):
        first = (seed + 1) * 100_000 + step * batch
        return (
            system(cases.draw_case(cases.TRAINING, first + k, problem.efl_mm)).loss + penalty()
            for k in range(batch)
        )

    def judged():
        return score(seen_by.optics()) + float(penalty())

    loop = Loop(Descent([seen_by.z], step_size), samples, judge=judged)
    loop.run(steps, advance)
    with torch.no_grad():
        return seen_by.start + seen_by.modes @ loop.best[0]
