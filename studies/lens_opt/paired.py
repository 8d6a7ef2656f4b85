"""Two lenses on the same cases: the log ratio of their errors, case by case, and who wins."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from scipy.stats import t as student

from codesign.errors import DomainError, ShapeError

LEVEL = 0.95


@dataclass(frozen=True)
class Paired:
    """Mean log ratio of a design's errors over a rival's, its interval at LEVEL, and the number of cases.

    Below 0 the design is better. With a single case the interval is infinite.
    """

    mean: float
    low: float
    high: float
    cases: int

    @property
    def outcome(self) -> str:
        """ "wins" or "loses" (of the design) where the interval leaves out 0, "ties" otherwise."""
        if self.high < 0:
            return "wins"
        return "loses" if self.low > 0 else "ties"

    def percent(self) -> str:
        """The change of error as a sentence reads it: "-3.1 % (-5.0 to -1.2 %)"."""
        mean, low, high = (_percent(v) for v in (self.mean, self.low, self.high))
        return f"{mean} % ({low} to {high} %)"


def paired(design: Sequence[float], rival: Sequence[float]) -> Paired:
    """Paired of two rows of errors > 0 on the same cases; see ``of_differences``."""
    return of_differences(log_ratios(design, rival))


def log_ratios(design: Sequence[float], rival: Sequence[float]) -> torch.Tensor:
    """Log ratio of errors > 0, case by case, [N] float64.

    Raises: ShapeError for rows of different lengths or none; DomainError for errors that are not above 0.
    """
    if len(design) != len(rival) or not len(design):
        raise ShapeError(f"{len(design)} and {len(rival)} errors; pairs need one of each per case.")
    if not all(0 < e < math.inf for e in (*design, *rival)):
        raise DomainError("errors must be finite and above 0, since their log ratio is taken.")
    return torch.tensor(design, dtype=torch.float64).log() - torch.tensor(rival, dtype=torch.float64).log()


def of_differences(logs: torch.Tensor) -> Paired:
    """Paired of log ratios [N], by Student's t over the cases."""
    count = logs.numel()
    mean = float(logs.mean())
    if count == 1:
        return Paired(mean, -math.inf, math.inf, 1)
    half = float(student.ppf((1 + LEVEL) / 2, count - 1)) * float(logs.std()) / math.sqrt(count)
    return Paired(mean, mean - half, mean + half, count)


def pooled(logs: torch.Tensor) -> Paired:
    """Paired of log ratios [seeds, cases], the same cases for every seed.

    The interval is the wider of two: over cases, each averaged over the seeds (other cases, these seeds), and over
    seeds, each averaged over its cases (these cases, other seeds). Of a single seed it is that over its cases.
    """
    if len(logs) == 1:
        return of_differences(logs[0])
    wider = max((of_differences(logs.mean(0)), of_differences(logs.mean(1))), key=lambda p: p.high - p.low)
    return Paired(wider.mean, wider.low, wider.high, logs.shape[1])


def verdict(design: str, rivals: Mapping[str, Paired]) -> str:
    """One sentence that says first who wins: the rivals that do, those that tie, or the design where it beats all.

    Args: design: what it is called, "the flow design". rivals: what each is called -> Paired of the design over it.
    """
    said = []
    for outcome, words in (("loses", ("wins", "win")), ("ties", ("ties", "tie"))):
        found = {name: pair for name, pair in rivals.items() if pair.outcome == outcome}
        if found:
            several = len(found) > 1
            said.append(
                f"{' and '.join(found)} {words[several]}: the flow error of {design} against "
                f"{'them' if several else 'it'} is {' and '.join(pair.percent() for pair in found.values())}"
            )
    if not said:
        name, closest = max(rivals.items(), key=lambda item: item[1].mean)
        said.append(f"{design} wins: its flow error against its best rival, {name}, is {closest.percent()}")
    cases = next(iter(rivals.values())).cases
    return f"{_capital('; '.join(said))} on {cases} unseen cases."


def _capital(text):
    return text[0].upper() + text[1:]


def _percent(log_ratio):
    return f"{100 * math.expm1(log_ratio):+.1f}" if log_ratio < 700 else "inf"
