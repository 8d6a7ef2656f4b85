"""The loop around an optimiser: draw samples, clip, step, judge now and then, keep the best, save,
resume."""

import math
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check_positive, check_whole
from codesign.errors import DomainError, GradientError, NonFiniteError, ShapeError
from codesign.optimise.gradients import assign, clipped_mean, sample_gradients, scaled_rates

SHRINK = 0.5  # of the step sizes, after a judgement that is worse than the best


@dataclass
class Record:
    """What happened: loss and gradient length by step; step, score and whether it was kept by
    judgement."""

    loss: list[float] = field(default_factory=list)
    gradient: list[float] = field(default_factory=list)
    judged_step: list[int] = field(default_factory=list)
    score: list[float] = field(default_factory=list)
    kept: list[bool] = field(default_factory=list)


class Loop:
    """Steps of any torch optimiser on clipped sample gradients; the best point by judgement is
    kept.

    Straight-through gradients are noisy: single samples point anywhere, and some are tens of times
    too long. So samples are clipped one by one, and what counts is a score on fixed cases, such as
    the hard sensor's.

    Args:
      optimiser: torch.optim.Optimizer over what is optimised.
      samples: step number -> the samples' scalar losses, best as a generator.
      clip: longest gradient of a sample within a parameter group; None clips to the median length
        of the samples.
      judge: () -> score, the lower the better, at the parameters as they are; where it is worse
        than the best, the loop goes back to that point with half the step sizes. Without one the
        last point is the best.
      judge_every: steps between judgements; the start and the end are judged too.
    record: Record. best, best_score: clones of the parameters at the best judgement, and its score.
    Raises: DomainError for numbers that make no sense; GradientError for a frozen parameter.

    >>> import torch
    >>> x = torch.nn.Parameter(torch.zeros(1))
    >>> loop = Loop(torch.optim.SGD([x], lr=0.5), lambda step: [(x - 2).square().sum()], clip=10.0)
    >>> round(float(loop.run(20)[0]), 3)
    2.0
    """

    def __init__(
        self,
        optimiser: torch.optim.Optimizer,
        samples: Callable[[int], Iterable[Tensor]],
        *,
        clip: float | None = 1.5,
        judge: Callable[[], float] | None = None,
        judge_every: int = 5,
    ) -> None:
        if clip is not None:
            check_positive(clip, "loop: clip")
        check_whole(judge_every, "loop: judge_every")
        if not callable(samples):
            raise DomainError(
                f"loop: samples is a {type(samples).__name__}; give a function of the step's number."
            )
        self.optimiser = optimiser
        self.samples = samples
        self.clip = clip
        self.judge = judge
        self.judge_every = judge_every
        if isinstance(optimiser, torch.optim.LBFGS):
            raise DomainError(
                "loop: LBFGS asks for the loss several times a step; choose an optimiser that asks once."
            )
        self.parameters = [p for group in optimiser.param_groups for p in group["params"]]
        check_parameters(self.parameters)
        self.record = Record()
        self.best = self._now()
        self.best_score = math.inf
        self._shrunk = 1.0

    @property
    def step_number(self) -> int:
        """Steps made, those before a resume included."""
        return len(self.record.loss)

    def run(
        self,
        steps: int,
        advance: Callable[..., object] | None = None,
        save: Callable[[], object] | None = None,
    ) -> list[Tensor]:
        """Go on until ``steps`` are made in all, and leave the parameters at the best point.

        Args:
          advance: called after every step with loss= and score=; may raise to stop.
          save: called after every judgement.
        Returns: the best point, one tensor per parameter.
        Raises: NonFiniteError when a loss or gradient is not finite; the parameters are then at the
          best point.
        """
        try:
            while self.step_number < steps:
                if self.step_number % self.judge_every == 0 and not self._judged():
                    self._judgement(save)
                self._step()
                if advance is not None:
                    shown = {"score": self.record.score[-1]} if self.record.score else {}
                    advance(loss=self.record.loss[-1], **shown)
            if not self._judged():
                self._judgement(save)
        except NonFiniteError as error:
            self._go(self.best)
            raise NonFiniteError(
                f"{error} Optimisation stopped at step {self.step_number + 1}; the parameters are back at the "
                "best point so far."
            ) from error
        self._go(self.best)
        return self.best

    def _step(self) -> None:
        values, gradients, felt = sample_gradients(self.samples(self.step_number), self.parameters)
        if not bool(values.isfinite().all() and gradients.isfinite().all()):
            raise NonFiniteError("a sample's loss or its gradient is infinite or NaN.")
        assign(self.parameters, self._clipped(gradients), felt)
        with scaled_rates(self.optimiser, self._shrunk):
            self.optimiser.step()
        self.record.loss.append(float(values.mean()))
        self.record.gradient.append(float(gradients.norm(dim=1).mean()))

    def _clipped(self, gradients: Tensor) -> Tensor:
        """Mean of the samples' gradients, clipped group by group: weights and lenses have no common
        unit."""
        sizes = [sum(p.numel() for p in group["params"]) for group in self.optimiser.param_groups]
        return torch.cat([clipped_mean(part, self.clip) for part in gradients.split(sizes, 1)])

    def _judged(self) -> bool:
        return bool(self.record.judged_step) and self.record.judged_step[-1] == self.step_number

    def _judgement(self, save: Callable[[], object] | None) -> None:
        with torch.no_grad():
            score = 0.0 if self.judge is None else float(self.judge())
        if not math.isfinite(score):
            raise NonFiniteError(f"the score is {score}.")
        kept = self.judge is None or score <= self.best_score
        self.record.judged_step.append(self.step_number)
        self.record.score.append(score)
        self.record.kept.append(kept)
        if kept:
            self.best = self._now()
            self.best_score = score
        else:
            self._go(self.best)
            self.optimiser.state.clear()
            self._shrunk *= SHRINK
        if save is not None:
            save()

    def _now(self) -> list[Tensor]:
        return [p.detach().clone() for p in self.parameters]

    @torch.no_grad()
    def _go(self, point: Sequence[Tensor]) -> None:
        for parameter, value in zip(self.parameters, point, strict=True):
            parameter.copy_(value)

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything needed to go on: tensors by name, and plain numbers (see codesign.state)."""
        tensors = {f"now_{i}": p.detach().clone() for i, p in enumerate(self.parameters)}
        tensors |= {f"best_{i}": b.clone() for i, b in enumerate(self.best)}
        numbers: dict[str, Any] = {
            "best_score": self.best_score if math.isfinite(self.best_score) else None,
            "shrunk": self._shrunk,
            "record": deepcopy(vars(self.record)),
            "optimiser": type(self.optimiser).__name__,
            "rates": [float(group["lr"]) for group in self.optimiser.param_groups],
        }
        for i, parameter in enumerate(self.parameters):
            for name, value in self.optimiser.state.get(parameter, {}).items():
                if torch.is_tensor(value):
                    tensors[f"optimiser_{i}_{name}"] = value.clone()
                elif value is not None:
                    raise DomainError(
                        f"{type(self.optimiser).__name__} keeps '{name}', which is no tensor and cannot be stored; "
                        "choose another optimiser, or do not save."
                    )
        return tensors, numbers

    @torch.no_grad()
    def resume(self, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> "Loop":
        """Go on from ``state()``, learning rates included; the same steps follow as without the
        break. A schedule's own state is the caller's.

        Raises: ShapeError when the state is of other parameters; DomainError when it is of another
          optimiser.
        """
        shapes = [
            tuple(tensors[f"now_{i}"].shape)
            for i in range(len(self.parameters))
            if f"now_{i}" in tensors
        ]
        if shapes != [tuple(p.shape) for p in self.parameters]:
            raise ShapeError(
                f"the state has parameters of shapes {shapes}, this loop {[tuple(p.shape) for p in self.parameters]}; "
                "give the state of the same problem."
            )
        kind = type(self.optimiser).__name__
        if numbers.get("optimiser", kind) != kind:
            raise DomainError(
                f"the state is of the optimiser {numbers['optimiser']}, this loop has {kind}; go on with the same one."
            )
        self._go([tensors[f"now_{i}"] for i in range(len(self.parameters))])
        self.best = [tensors[f"best_{i}"].to(p).clone() for i, p in enumerate(self.parameters)]
        self.best_score = math.inf if numbers["best_score"] is None else numbers["best_score"]
        self._shrunk = numbers["shrunk"]
        for group, rate in zip(self.optimiser.param_groups, numbers.get("rates", ()), strict=False):
            group["lr"] = rate
        self.record = Record(**deepcopy(numbers["record"]))
        self.optimiser.state.clear()
        for name, value in tensors.items():
            if name.startswith("optimiser_"):
                _, index, entry = name.split("_", 2)
                parameter = self.parameters[int(index)]
                # numbers such as NAdam's product of momenta have a dtype of their own, and stay on
                # the CPU
                own = value.clone() if value.ndim == 0 else value.to(parameter, copy=True)
                self.optimiser.state[parameter][entry] = own
        return self


def check_parameters(parameters: Sequence[Tensor]) -> None:
    """Raise GradientError for parameters that cannot be optimised: none at all, frozen, or not
    leaves."""
    if not parameters:
        raise GradientError(
            "the optimiser has no parameters; give it those of lens, mount, sensor or network."
        )
    for index, parameter in enumerate(parameters):
        if not parameter.requires_grad:
            raise GradientError(
                f"parameter {index} of the optimiser, of shape {tuple(parameter.shape)}, is frozen; thaw it with "
                "requires_grad_(True), or leave it out."
            )
        if not parameter.is_leaf:
            raise GradientError(
                f"parameter {index} of the optimiser is computed from others; give what it is computed from."
            )
