"""The loop of a training: a budget of steps or processor time, a schedule over it, and what is
counted."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from codesign.errors import DomainError
from codesign.train.batches import without_truth
from codesign.train.learner import Learner


@dataclass
class Progress:
    """What a training has done so far.

    Args:
      step: steps made.
      data_s, training_s: processor seconds of all processes, for making windows and for the rest of
        the steps.
      validation_s: those of the first process for validation.
      clipped: steps whose gradient was shortened.
      blind: windows shown that had no pixel with known flow.
      loss, norm, rate: by step.
      validation: list of {"step", figures}.
    """

    step: int = 0
    data_s: float = 0.0
    training_s: float = 0.0
    validation_s: float = 0.0
    clipped: int = 0
    blind: int = 0
    loss: list[float] = field(default_factory=list)
    norm: list[float] = field(default_factory=list)
    rate: list[float] = field(default_factory=list)
    validation: list[dict[str, Any]] = field(default_factory=list)


class Clock:
    """Processor seconds of this process by kind of work: data, training, validation."""

    def __init__(self):
        self.spent = {"data": 0.0, "training": 0.0, "validation": 0.0}

    @contextmanager
    def __call__(self, kind: str) -> Iterator[None]:
        """Count a block as this kind of work."""
        began = time.process_time()
        try:
            yield
        finally:
            self.spent[kind] += time.process_time() - began


@dataclass(frozen=True)
class Budget:
    """When a training ends: after so many steps, or when all processes have spent so many processor
    seconds; with both, at whichever comes first, and the steps set the schedule."""

    steps: int | None = None
    cpu_s: float | None = None

    def share(self, step: int, spent_s: float) -> float:
        """Share of the budget that is spent, 1 at its end."""
        if self.cpu_s is not None and spent_s >= self.cpu_s:
            return 1.0
        if self.steps is not None:
            return step / self.steps
        if self.cpu_s is not None:
            return spent_s / self.cpu_s
        raise DomainError("a training without end: give steps, or processor time.")


@dataclass(frozen=True)
class Cosine:
    """Factor on the learning rate by share of the budget: grows linearly over ``warm_up``, then
    falls as a half cosine to a hundredth.

    >>> [round(Cosine(warm_up=0.2)(share), 3) for share in (0.0, 0.2, 0.6, 1.0)]
    [0.01, 1.0, 0.505, 0.01]
    """

    warm_up: float = 0.05

    def __call__(self, share: float) -> float:
        """The factor when this share of the budget is spent."""
        if share < self.warm_up:
            return 0.01 + 0.99 * share / self.warm_up
        fallen = (share - self.warm_up) / (1 - self.warm_up)
        return 0.01 + 0.495 * (1 + math.cos(math.pi * fallen))


def run(
    learner: Learner,
    batches: Callable[[int], Any],
    progress: Progress,
    budget: Budget,
    schedule: Callable[[float], float],
    *,
    clock: Clock | None = None,
    after_step: Callable[[float], object] | None = None,
) -> None:
    """All steps that the budget leaves.

    Args:
      learner: what is trained.
      batches: step -> batch.
      progress: of earlier sessions; is carried on.
      budget: when it ends.
      schedule: share of the budget -> factor on the learning rates.
      clock: counts what was spent before.
      after_step: is told the share that is spent, when a step is whole; what it raises ends the
        loop.
    """
    clock = clock or Clock()
    ranks = learner.ranks
    earlier = progress.data_s, progress.training_s
    spent_s = sum(earlier) + ranks.sum(clock.spent["data"])[0]
    share = budget.share(progress.step, spent_s)
    if share >= 1.0 and progress.step == 0:
        raise DomainError(
            f"the processor time of {(budget.cpu_s or 0.0) / 60:.2f} minutes is over before the first step: "
            f"making the first windows took {spent_s / 60:.2f}; give more."
        )
    while share < 1.0:
        with clock("data"):
            batch = batches(progress.step)
        with clock("training"):
            made = learner.step(batch, schedule(share))
        blind, data_s, training_s = ranks.sum(
            without_truth(batch), clock.spent["data"], clock.spent["training"]
        )
        progress.data_s = earlier[0] + data_s
        progress.training_s = earlier[1] + training_s
        progress.step += 1
        progress.clipped += made.clipped
        progress.blind += int(blind)
        progress.loss.append(made.loss)
        progress.norm.append(made.norm)
        progress.rate.append(made.rate)
        share = budget.share(progress.step, progress.data_s + progress.training_s)
        if after_step is not None:
            after_step(share)
