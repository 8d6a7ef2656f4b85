"""What every stage is told."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from studies.frame.config import StudyConfig

Name = Literal["chain", "select", "lens", "render", "growth", "events", "spiking", "flow", "live"]


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"repeats": 3, "rounds": 1}
    stages: tuple[Name, ...] = ("chain",)
    """What is measured: chain (every stage's cheaper and finer levels, and whole chains of them, on
    one small scene); select (what codesign.select picks on six scenes); lens (ray tracing beside
    optiland), render, growth (rendering and outlines over objects and faces, the chain over pixels,
    rays, frames and bins), events, spiking (beside snnTorch and norse), flow (estimators), live
    (estimators along a stream)."""
    repeats: int = 7
    """Timed repeats of each thing; at least 3."""
    rounds: int = 2
    """Turns that everything gets that is timed in turns."""
