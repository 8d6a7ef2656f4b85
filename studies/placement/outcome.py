"""What a race for a mount came to on unseen samples: errors, ratios with intervals, metrics and the
raw table."""

import csv
import io
import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from codesign.mount.pose import NAMES
from studies.frame.compare import median_ratio, ratio_of_means
from studies.frame.sweep import plain
from studies.placement.problem import Problem
from studies.placement.race import DEFAULT, GRADIENT, Race

RESAMPLED = 4000
INTERVAL = 0.9
# of fewer paired units all may be ahead by chance at that level: 2 / 2^4 > 1 - INTERVAL > 2 / 2^5
LEAST_UNITS = 5


@dataclass(frozen=True)
class Paired:
    """Ratio of errors, ours over theirs, over paired starts: median and interval of resampled
    starts, which is shown of LEAST_UNITS or more; how many below 1."""

    median: float
    low: float
    high: float
    ahead: int
    count: int

    def __str__(self):
        if self.count == 1:
            return f"{self.median:.2f}, one start"
        interval = f" ({self.low:.2f} to {self.high:.2f})" if self.count >= LEAST_UNITS else ""
        return f"{self.median:.2f}{interval}, ahead {self.ahead} of {self.count}"


def paired(ours: Tensor, theirs: Tensor) -> Paired:
    found = median_ratio(ours, theirs, level=INTERVAL, draws=RESAMPLED)
    return Paired(found.value, found.low, found.high, int((ours < theirs).sum()), found.count)


def over_worlds(ours: Tensor, theirs: Tensor, worlds: int) -> tuple[float, float, float]:
    """Ratio of mean errors [N], world after world, ours over theirs; and its interval over
    resampled worlds."""
    means = (errors.unflatten(0, (worlds, -1)).mean(1) for errors in (ours, theirs))
    found = ratio_of_means(*means, level=INTERVAL, draws=RESAMPLED)
    return found.value, found.low, found.high


def standard_error(errors: Tensor, worlds: int) -> float:
    """Of the mean of errors [N], world after world: of the worlds' means, since drives in one world
    err alike; of one world's drives where there is one."""
    means = errors.unflatten(0, (worlds, -1)).mean(1) if worlds > 1 else errors
    return float(means.std() / math.sqrt(len(means))) if len(means) > 1 else 0.0


@dataclass(frozen=True)
class Outcome:
    """A race, and its answers on unseen samples.

    unseen: worlds and drives that judged. judged: errors [N] by start and search (``Race.judge``).
    """

    race: Race
    unseen: Problem
    judged: dict[tuple[int, str], Tensor]

    @property
    def starts(self) -> int:
        return sum(name == "start" for _, name in self.judged)

    @cached_property
    def errors(self) -> dict[str, Tensor]:
        """Mean errors of the starts and of what each search ends with, [starts]."""
        names = dict.fromkeys(name for _, name in self.judged if name != DEFAULT)
        return {
            name: torch.stack([self.judged[number, name].mean() for number in range(self.starts)])
            for name in names
        }

    @cached_property
    def rivals(self) -> dict[str, Paired]:
        ours = self.errors[GRADIENT]
        return {
            name: paired(ours, theirs)
            for name, theirs in self.errors.items()
            if name not in ("start", GRADIENT)
        }

    @cached_property
    def best(self) -> tuple[int, str]:
        """Start and search of the answer that training samples choose, whoever found it;
        (0, DEFAULT): they choose the pair's own mount."""
        return self.race.chosen(self.starts)

    @property
    def found_by(self) -> str:
        """The search that found the answer, in words."""
        name = self.best[1]
        return {
            DEFAULT: "the robot's own design",
            GRADIENT: "the gradient",
            "random": "random search",
        }.get(name, name)

    @property
    def groups(self) -> int:
        """Unseen worlds, or groups of drives through the one world, that intervals resample."""
        return len(self.unseen.numbers)

    @property
    def answered(self) -> Tensor:
        return self.judged[self.best]

    @property
    def share(self) -> Tensor:
        """The mount [6] that is the answer."""
        if self.best[1] == DEFAULT:
            return self.race.problem.start
        return self.race.answer(*self.best)

    @property
    def pose(self) -> Tensor:
        return self.race.problem.ranges.pose(self.share)

    @property
    def error(self) -> float:
        return float(self.answered.mean())

    @property
    def default_error(self) -> float:
        return float(self.judged[0, DEFAULT].mean())

    @property
    def over_default(self) -> tuple[float, float, float]:
        """Ratio of the answer's error to that of the pair's own mount, and its interval over
        worlds."""
        return over_worlds(self.answered, self.judged[0, DEFAULT], self.groups)

    def metrics(self) -> dict[str, float | int]:
        ratio, low, high = self.over_default
        found: dict[str, float | int] = {
            "default_error": self.default_error,
            "samples_per_search": self.race.samples(0, GRADIENT),
            "samples_judged": self.unseen.samples,
            "chosen_start": -1 if self.best[1] == DEFAULT else self.best[0],
            "chosen_is_gradient": int(self.best[1] == GRADIENT),
            "seeds": self.starts,
            "over_default": ratio,
        }
        if self.groups >= LEAST_UNITS:
            found |= {"over_default_low90": low, "over_default_high90": high}
        for name, values in self.errors.items():
            found[f"{plain(name)}_median_error"] = values.quantile(0.5)
        for name, beside in self.rivals.items():
            over = f"over_{plain(name)}"
            found |= {f"{over}_median": beside.median, f"{over}_ahead": beside.ahead}
            if beside.count >= LEAST_UNITS:
                found |= {f"{over}_low90": beside.low, f"{over}_high90": beside.high}
        return found

    def table(self) -> str:
        """race.csv: every answer with its mount, what it rendered and its error."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["pair", "seed", "search", *NAMES, "samples", "error", "standard_error"])
        race, problem = self.race, self.race.problem
        for (number, name), errors in sorted(self.judged.items()):
            share, samples = problem.start, 0
            if name == "start":
                share = race.trail(number, GRADIENT).share[0]
            elif name != DEFAULT:
                share, samples = race.answer(number, name), race.samples(number, name)
            numbers = [f"{value:.5f}" for value in problem.ranges.numbers(share).tolist()]
            told = errors.mean(), standard_error(errors, self.groups)
            seed = race.run.config.seed + number
            said = (f"{figure:.5f}" for figure in told)
            writer.writerow([problem.pair.name, seed, name, *numbers, samples, *said])
        return text.getvalue()
