"""The smallest study, whose runs tests of the frame look at, and what its folder holds."""

import json
from dataclasses import dataclass
from pathlib import Path
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


def stored(folder, name):
    return json.loads((folder / f"{name}.json").read_text())


def numbers(folder):
    return {k: v for k, v in stored(folder, "metrics").items() if k not in ("versions", "hardware")}


def contents(folder):
    return {path.name: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}
