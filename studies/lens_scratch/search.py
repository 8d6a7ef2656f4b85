"""One search from plane plates: a method, a seed, its stages and attempts."""

import time
from typing import Any

import torch

from codesign.grad.jacobian import by_differences
from codesign.optimise.least_squares import DampedLeastSquares, StopRules
from studies.lens_scratch.task import LINES, STEPS, Stage, draw_start, judge, residuals_of

METHODS = {
    "curriculum": "damped least squares; aperture and field grow together",
    "direct": "damped least squares at full aperture and field at once",
}
STAGES = {
    "curriculum": (
        Stage(0.4, 0.4, ("F", "C"), 20),
        Stage(0.6, 0.6, ("F", "C"), 15),
        Stage(0.8, 0.8, ("F", "C"), 20),
        Stage(1.0, 1.0, LINES, 150),
    ),
    "direct": (Stage(1.0, 1.0, LINES, 200),),
}
ATTEMPTS = 3  # draws of a start until one succeeds
LOSS_CHANGE = 1e-6  # a stage ends when a step gains less than this share


def search(method: str, seed: int, goal_um: float, shorten: int = 1) -> dict[str, Any]:
    """The design of the first attempt that succeeds, else of the last one, and what it took.

    Args:
      goal_um: mean RMS spot that counts as success, together with all limits and all rays.
      shorten: divides the steps of every stage.
    Returns: variables [11] of the design, and how it came about, as plain numbers.
    """
    began = time.monotonic()
    evaluations = steps = attempt = 0
    succeeded = False
    variables = torch.empty(0)

    while not succeeded and attempt < ATTEMPTS:
        variables = draw_start(torch.Generator().manual_seed(1000 * seed + attempt))
        for stage in STAGES[method]:
            residuals = residuals_of(stage)

            def counted(at, residuals=residuals):
                nonlocal evaluations
                evaluations += 1
                return residuals(at)

            stop = StopRules(steps=stage.steps // shorten, loss=LOSS_CHANGE)
            solver = DampedLeastSquares(counted, variables, by_differences(STEPS), stop=stop)
            variables = solver.run()
            steps += len(solver.history)
        verdict = judge(variables)
        succeeded = verdict is not None and verdict.good and verdict.mean_um <= goal_um
        attempt += 1
    return {
        "variables": variables.tolist(),
        "succeeded": succeeded,
        "attempts": attempt,
        "steps": steps,
        "evaluations": evaluations,
        "seconds": time.monotonic() - began,
    }
