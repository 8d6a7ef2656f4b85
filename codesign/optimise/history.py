"""What the optimisers share: the record of their steps, and the check of a start."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from codesign.errors import ShapeError, check_finite


@dataclass(frozen=True)
class Entry:
    """One step: the loss before it, the norm of its gradient, the length of the trial step, damping (or step
    size), whether it was accepted."""

    loss: float
    gradient: float
    step: float
    damping: float
    accepted: bool


@dataclass
class History:
    """All steps of a run. Indexing and len() go over Entry; ``column`` gives one figure over the steps."""

    entries: list[Entry] = field(default_factory=list)

    def add(self, entry: Entry) -> None:
        self.entries.append(entry)

    def column(self, name: str) -> list[Any]:
        """One field of every step, a list."""
        return [getattr(entry, name) for entry in self.entries]

    def rows(self) -> list[list[Any]]:
        """Plain lists for a state file."""
        return [list(dataclasses.astuple(entry)) for entry in self.entries]

    @staticmethod
    def of(rows: Iterable[Sequence[Any]]) -> "History":
        """The history that ``rows`` came from."""
        return History([Entry(*row) for row in rows])

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, at: int) -> Entry:
        return self.entries[at]


def check_start(start: Tensor) -> Tensor:
    """The start as a detached vector. Raises: ShapeError unless [V >= 1]; DomainError when it is not
    finite."""
    if start.ndim != 1 or not start.numel():
        raise ShapeError(f"the start must be a vector [V >= 1], got {tuple(start.shape)}.")
    return check_finite(start.detach().clone(), "start")
