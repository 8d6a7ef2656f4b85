"""A topic: some rows about one question, measured job by job, so that an interrupted run goes on behind the last."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from studies.event_gradient.compare import Row

Job = tuple[str | float, ...]  # plain values, which tell it from other jobs


@dataclass(frozen=True)
class Asked:
    """What a row's gradient has to reach."""

    cosine: float
    scale: tuple[float, float] = (0.0, float("inf"))

    def missed(self, row: Row) -> bool:
        """Whether cosine or scale of a row fall short."""
        low, high = self.scale
        return not (row.numbers["cosine"] >= self.cosine and low <= row.numbers["scale"] <= high)


@dataclass(frozen=True)
class Topic:
    """Rows about one question.

    title, text: heading and words of its section. columns: what ``Row.names`` are.
    jobs: quick -> what to measure, at best some seconds each. measure: cases and one job -> its rows.
    asked: what a row has to reach, None where nothing is asked. prefix: of its metrics' names.
    """

    title: str
    text: str
    columns: tuple[str, ...]
    jobs: Callable[[bool], Sequence[Job]]
    measure: Callable[..., Iterable[Row]]
    asked: Callable[[Row], Asked | None] = lambda row: None
    prefix: str = ""


def label(job: Job) -> str:
    """The name of a job in the stored state."""
    return " ".join(map(str, job))
