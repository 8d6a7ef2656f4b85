"""A topic: some rows about one question, measured job by job, so that an interrupted run goes on
behind the last."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import median

from codesign.grad import Row as CertificateRow

Job = tuple[str | float, ...]  # plain values, which tell it from other jobs
RIGHT, WRONG, NOT_JUDGEABLE = "right", "wrong", "not judgeable"
STATES = {"pass": RIGHT, "fail": WRONG, "noise": NOT_JUDGEABLE}
LEAST_NOISE = 1e-16


@dataclass(frozen=True)
class Row:
    """A line of a table. names: what tells it from the others. numbers: figures by name, such as
    cosine and scale. state: of STATES, where a certificate judges it."""

    names: tuple[str, ...]
    numbers: dict[str, float]
    state: str = ""

    def metrics(self, prefix: str = "") -> dict[str, float]:
        """Figures by the names that they have in metrics.json: cosine_memory_contrast_240fps."""
        words = [prefix, *self.names]
        name = "_".join(
            filter(None, (re.sub(r"[^a-z0-9.]+", "_", word.lower()).strip("_") for word in words))
        )
        return {f"{key}_{name}": value for key, value in self.numbers.items()}


def of_certificate(names: tuple[str, ...], row: CertificateRow, state: str = "") -> Row:
    """A row of a certificate as one of the study's; the plateau is the step of its differences, in
    the middle of them."""
    numbers = {
        "relative_error": row.relative_error,
        "cosine": row.cosine,
        "signed_bias": row.signed_bias,
        "signal_to_noise": 1 / max(row.noise_floor, LEAST_NOISE),
        "plateau_step": median(row.step_plateau),
    }
    return Row(names, numbers, state)


@dataclass(frozen=True)
class Asked:
    """What a row's numbers have to reach: at least, at most, by name."""

    least: dict[str, float]
    most: dict[str, float]

    def missed(self, row: Row) -> bool:
        """Whether the row is wrong, or a number falls short; NaN does."""
        return row.state == WRONG or not (
            all(row.numbers[name] >= value for name, value in self.least.items())
            and all(row.numbers[name] <= value for name, value in self.most.items())
        )


@dataclass(frozen=True)
class Topic:
    """Rows about one question.

    title, text: heading and words of its section.
    columns: what ``Row.names`` are.
    jobs: quick -> what to measure, at best some seconds each.
    measure: the study's configuration and one job -> its rows.
    asked: what a row has to reach, None where nothing is asked.
    """

    title: str
    text: str
    columns: tuple[str, ...]
    jobs: Callable[[bool], Sequence[Job]]
    measure: Callable[..., Iterable[Row]]
    asked: Callable[[Row], Asked | None] = lambda row: None


def label(job: Job) -> str:
    return " ".join(map(str, job))
