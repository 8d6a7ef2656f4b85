"""What was chosen, and why, in a line per stage."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from codesign.fidelity.levels import STAGES, Fidelity, batch_of, levels_in, system_of
from codesign.fidelity.survey import Survey
from codesign.fidelity.task import Task
from codesign.system import Batch, System


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

    def batch(self) -> Batch:
        """The drives of the task at the frame times that were chosen."""
        return batch_of(self.task, self.fidelity)

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
        changes = {other: self.survey.changed(stage, other) for other in levels}
        other, off = levels[-1], changes[level]
        if level == other:
            other, off = min(list(changes.items())[:-1], key=lambda item: item[1])
        tried = replace(self.fidelity, **{stage: other})
        times = self.survey.cpu_s(tried) / self.survey.cpu_s(self.fidelity)
        return f"{other} would change {name} by {off:.2g} {unit}, {times:.2g}x the time"

    def __str__(self) -> str:
        task, wide = self.task, max(map(len, STAGES))
        lines = [
            f"{stage:<{wide}}  {getattr(self.fidelity, stage)!s:<9}  {reason}"
            for stage, reason in self.reasons().items()
        ]
        return "\n".join(
            [
                *lines,
                f"about {self.speedup:.2g}x faster than the finest; one finer changes {task.name} by "
                f"{self.change:.2g} {task.unit} ({self.tolerance:g} tolerated).",
            ]
        )
