"""The two designers: one makes spots small by damped least squares, one lowers the flow error by gradients through the
chain."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from codesign.grad.jacobian import by_differences
from codesign.lens import GeoLens
from codesign.optimise import DampedLeastSquares, Descent, Loop, StopRules
from codesign.system import Batch
from studies.lens_opt.task import TRAINING
from studies.lens_trade import cases
from studies.lens_trade.problem import STEP, Problem, Weights

PENALTY = 10.0
SAMPLES = 15  # rays per pixel while optimising; twice as many when judging
DRAWS = (11, 12, 13, 14)  # errors of manufacture that a spot designer looks at
SCORED = 10
LEAST_GAP = 0.005  # between surfaces, in focal lengths


def by_spots(problem: Problem, start: Tensor, weights: Weights, steps: int = 60) -> Tensor:
    """Variables of the least weighted mean square spot within the limits, from a start."""
    residuals = problem.residuals(weights, DRAWS if problem.made else ())
    stop = StopRules(steps=steps, loss=1e-5)
    lower = torch.full_like(start, -torch.inf)
    gaps = len(problem.template.surfaces) - 1
    lower[gaps : 2 * gaps] = LEAST_GAP
    start = torch.maximum(start, lower)
    return DampedLeastSquares(residuals, start, by_differences(STEP), lower, stop=stop).run()


class DesignedCamera(nn.Module):
    """A camera whose lens moves along modes of ray motion, zero at the start; with errors of manufacture drawn by
    ``draw``."""

    def __init__(self, problem: Problem, start: Tensor):
        super().__init__()
        self.problem = problem
        self.start = start
        self.modes = problem.modes(start)
        self.z = nn.Parameter(torch.zeros_like(start))
        self.draw = 0

    def point(self) -> Tensor:
        return self.start + self.modes @ self.z

    def optics(self) -> GeoLens:
        return self.problem.lens(self.point())

    def forward(self):
        return cases.camera(self.problem.manufactured(self.optics(), self.draw), SAMPLES)


def by_flow(
    problem: Problem,
    light: cases.Light,
    start: Tensor,
    steps: int,
    batch: int,
    seed: int,
    step_size: float = 0.3,
    advance: Callable[..., object] = lambda **_: None,
) -> Tensor:
    """Variables that lower the flow error within the limits, from a start: the best of the hard sensor's score on fixed
    training cases along the way."""
    seen_by = DesignedCamera(problem, start)
    system = cases.system(seen_by, cases.smooth_layer(light), light, problem.fno)
    fixed = cases.judged_cases(TRAINING, 7_000_000, SCORED, problem.efl_mm)

    def penalty():
        return PENALTY * problem.limit_rows(seen_by.optics()).square().sum()

    def samples(step):
        for k in range(batch):
            seen_by.draw = (seed + 1) * 100_000 + step * batch + k
            case = cases.draw_case(TRAINING, seen_by.draw, problem.efl_mm)
            yield system(case).loss + penalty()

    def score():
        with torch.no_grad():
            return mean_log_error(problem, light, seen_by.optics(), fixed, SAMPLES) + float(penalty())

    loop = Loop(Descent([seen_by.z], step_size), samples, judge=score, judge_every=4)
    loop.run(steps, advance)
    with torch.no_grad():
        return seen_by.start + seen_by.modes @ loop.best[0]


def by_search(problem: Problem, light: cases.Light, start: Tensor, tries: int, seed: int) -> Tensor:
    """The same without gradients, as a check on them: a (1 + 1) evolution strategy over the modes on the hard score of
    fixed training cases, with the one-fifth rule (Rechenberg 1973)."""
    seen_by = DesignedCamera(problem, start)
    fixed = cases.judged_cases(TRAINING, 7_100_000, 2 * SCORED, problem.efl_mm)
    generator = torch.Generator().manual_seed(seed)

    def score(z):
        geo = problem.lens(start + seen_by.modes @ z)
        penalty = PENALTY * float(problem.limit_rows(geo).square().sum())
        return mean_log_error(problem, light, geo, fixed, SAMPLES) + penalty

    with torch.no_grad():
        best = torch.zeros_like(start)
        least = score(best)
        reach = 0.5
        for _ in range(tries):
            trial = (
                best
                + reach * torch.randn(len(best), generator=generator, dtype=best.dtype) / len(best) ** 0.5
            )
            found = score(trial)
            better = found < least
            best, least = (trial, found) if better else (best, least)
            reach *= 1.5 if better else 1.5**-0.25
        return start + seen_by.modes @ best


def log_errors(
    problem: Problem, light: cases.Light, geo: GeoLens, judged: Sequence[Batch], samples: int = 2 * SAMPLES
) -> list[float]:
    """Hard log errors (mrad) of a lens case by case; each case has its own errors of manufacture."""
    with torch.no_grad():
        return [
            cases.hard_log_error(problem.manufactured(geo, case.seed), case, light, problem.fno, samples)
            for case in judged
        ]


def mean_log_error(problem, light, geo, judged, samples=2 * SAMPLES) -> float:
    return sum(log_errors(problem, light, geo, judged, samples)) / len(judged)
