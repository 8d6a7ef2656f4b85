"""One search from plane plates: a method, a seed, its stages and attempts; one optimiser step at a time, so
that it can stop anywhere and go on."""

from dataclasses import dataclass, replace

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
NUMBERS = ("steps", "evaluations", "seconds", "losses")  # of a search, which outlive its stages
LOSS_CHANGE = 1e-6  # a stage ends when a step gains less than this share


@dataclass(frozen=True)
class Outcome:
    """What a search found. losses: half the sum of squared residuals before each step of the last
    attempt."""

    method: str
    seed: int
    variables: list[float]
    succeeded: bool
    attempts: int
    steps: int
    evaluations: int
    seconds: float
    losses: list[float]


class Search:
    """A search under way. ``step`` until ``outcome`` is there; ``state`` and ``resume`` carry it over a
    break.

    goal_um: mean RMS spot that counts as success, together with all limits and all rays. shorten: divides the
      steps of every stage.
    """

    def __init__(self, method: str, seed: int, goal_um: float, shorten: int = 1):
        self.method = method
        self.seed = seed
        self.goal_um = goal_um
        self.stages = tuple(replace(s, steps=s.steps // shorten) for s in STAGES[method])
        self.attempt = self.steps = self.evaluations = 0
        self.seconds = 0.0
        self.outcome = None
        self._begin_attempt()

    def step(self):
        """One optimiser step. Returns its Entry."""
        entry = self.optimiser.step()
        self.losses.append(entry.loss)
        self.steps += 1
        ended = len(self.optimiser.history) >= self.stages[self.stage].steps or self.optimiser.stopped
        if ended and self.stage + 1 < len(self.stages):
            self._begin_stage(self.stage + 1, self.optimiser.variables)
        elif ended:
            self._end_attempt()
        return entry

    def state(self):
        """Numbers and lists for a state file."""
        return {
            **{name: getattr(self, name) for name in ("attempt", "stage", *NUMBERS)},
            "began": self.began.tolist(),
            "optimiser": self.optimiser.state(),
        }

    def resume(self, state: dict):
        """Go on from ``state`` of the same method and seed."""
        self.attempt = state["attempt"]
        self._begin_stage(state["stage"], torch.tensor(state["began"], dtype=torch.float64))
        self.optimiser.resume(state["optimiser"])
        for name in NUMBERS:
            setattr(self, name, state[name])
        taken = self.optimiser.history
        if taken and not taken[-1].accepted:
            self.evaluations -= len(self.began)  # slopes behind a rejected step are found a second time
        return self

    def _begin_attempt(self):
        self.losses = []
        self._begin_stage(0, draw_start(torch.Generator().manual_seed(1000 * self.seed + self.attempt)))

    def _begin_stage(self, stage, variables):
        self.stage = stage
        self.began = variables
        plain = residuals_of(self.stages[stage])

        def residuals(at):
            self.evaluations += 1
            return plain(at)

        self.optimiser = DampedLeastSquares(
            residuals, variables, by_differences(STEPS), stop=StopRules(loss=LOSS_CHANGE)
        )

    def _end_attempt(self):
        verdict = judge(self.optimiser.variables)
        succeeded = (
            verdict is not None
            and verdict.rays_pass
            and verdict.limits_hold
            and verdict.mean_um <= self.goal_um
        )
        self.attempt += 1
        if not succeeded and self.attempt < ATTEMPTS:
            self._begin_attempt()
            return
        numbers = {name: getattr(self, name) for name in NUMBERS}
        variables = self.optimiser.variables.tolist()
        self.outcome = Outcome(self.method, self.seed, variables, succeeded, self.attempt, **numbers)
