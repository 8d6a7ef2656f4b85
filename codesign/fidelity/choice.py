"""What was chosen, and why, in a line per stage."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from codesign.fidelity.levels import STAGES, Fidelity, levels_in, system_of
from codesign.fidelity.survey import Survey
from codesign.fidelity.task import Task
from codesign.system import System


@dataclass(frozen=True)
class Choice:
    """The fidelity that was chosen; prints as a line per stage.

    fidelity: a level of every stage. change: of what is judged on the whole film, against the
    combination one finer. predicted: sum of what the levels change in the survey. gradient: way of
    ``render.frames`` that is right for this scene, where the task asks for gradients. survey: of
    all levels.
    """

    fidelity: Fidelity
    change: float
    predicted: float
    tolerance: float
    survey: Survey
    scene: Any
    task: Task
    gradient: str = "interior"

    @property
    def speedup(self) -> float:
        """Processor time of the finest chain over that of this one, as the survey tells."""
        return sum(self.survey.reference.values()) / self.survey.cpu_s(self.fidelity)

    def system(self, objectives: Mapping[str, Callable[..., Tensor]], **parts: Any) -> System:
        """The chain at this fidelity; ``parts`` as of ``System``, in place of its own."""
        own = {"objectives": objectives, "gradient": self.gradient}
        return system_of(self.scene, self.task, self.fidelity, **{**own, **parts})

    def reasons(self) -> dict[str, str]:
        """Stage -> why its level, in a few words."""
        return {stage: self._reason(stage) for stage in STAGES}

    def _reason(self, stage):
        level, levels = getattr(self.fidelity, stage), self.survey.levels[stage]
        name, unit = self.task.name, self.task.unit
        if len(levels) == 1:
            return "there is no other"
        if (stage, level) not in levels_in(self.fidelity):
            return "does not count"
        if level != levels[-1]:
            best = levels[-1]
            dearer = self.survey.cpu_s(replace(self.fidelity, **{stage: best}))
            times = dearer / self.survey.cpu_s(self.fidelity)
            off = self.survey.changed(stage, level)
            return f"{best} would change {name} by {off:.2g} {unit}, {times:.1f}x the time"
        others = {other: self.survey.changed(stage, other) for other in levels[:-1]}
        near = min(others, key=lambda other: others[other])
        return f"{near}, the nearest, would change {name} by {others[near]:.2g} {unit}"

    def __str__(self) -> str:
        task, wide = self.task, max(map(len, STAGES))
        lines = [
            f"{stage:<{wide}}  {getattr(self.fidelity, stage)!s:<9}  {reason}"
            for stage, reason in self.reasons().items()
        ]
        return "\n".join(
            [
                *lines,
                f"{self.speedup:.1f}x faster than the finest; one finer changes {task.name} by "
                f"{self.change:.2g} {task.unit} ({self.tolerance:g} tolerated).",
            ]
        )
