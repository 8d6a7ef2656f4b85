"""The smallest study, whose runs tests of the frame look at."""

from dataclasses import dataclass
from typing import ClassVar

from studies.frame.config import StudyConfig
from studies.frame.run import Run


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"limit": 0.125}
    limit: float = 1.0
    sizes: tuple[int, ...] = (1, 2)


def record_one(run: Run[Config]):
    """The smallest study."""
    run.record(limit=run.config.limit)
    run.finish("One number", "It was recorded.")
