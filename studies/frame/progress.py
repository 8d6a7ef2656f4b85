"""Progress of a loop: a bar with loss and time left on a terminal; elsewhere a line at the first
and last step and every few seconds."""

import time
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

SECONDS_BETWEEN_LINES = 5.0


@dataclass
class Pace:
    """Seconds and number of the timed steps of one loop, over all sessions: the first step of each
    session, which compiles kernels, apart from the others."""

    seconds: float = 0.0
    steps: int = 0
    first_seconds: float = 0.0
    first_steps: int = 0

    def add(self, seconds: float, first: bool):
        """Take in a step."""
        if first:
            self.first_seconds += seconds
            self.first_steps += 1
        else:
            self.seconds += seconds
            self.steps += 1

    @property
    def seconds_per_step(self):
        """Mean seconds of a step; of first steps only where there were no others, None where there
        were none."""
        if self.steps:
            return self.seconds / self.steps
        return self.first_seconds / self.first_steps if self.first_steps else None


class StepProgress:
    """Context manager around a loop of ``total`` steps, of which ``done`` were made in an earlier
    session.

    Args:
      console: rich console; its kind decides between bar and lines.
      total: number of steps.
      description: what the loop does, one or two words.
      done: steps already made, 0 for a fresh loop.
      interruption: codesign.interrupt.Interruption whose safe point every advance is.
      pace: what earlier sessions measured; goes on to be filled.
    """

    def __init__(
        self,
        console: Console,
        total: int,
        description: str,
        done: int,
        interruption,
        pace: Pace,
    ):
        self.total = total
        self.description = description
        self.done = done
        self._console = console
        self._interruption = interruption
        self._pace = pace
        self._fresh = True  # no step of this session yet
        self._bar = None
        if console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[numbers]}"),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, console=console)
            self._task = self._bar.add_task(description, total=total, completed=done, numbers="")

    def __enter__(self):
        if self._interruption.in_loop:
            raise RuntimeError(
                "loops with progress cannot be nested: an interrupt needs one safe point"
            )
        self._interruption.in_loop = True
        self._last_line = self._last_step = time.monotonic()
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_):
        self._interruption.in_loop = False
        if self._bar:
            self._bar.stop()

    def advance(self, **numbers):
        """One more whole step was made; ``numbers`` (loss=…) are shown. A pressed Ctrl-C takes
        effect here, after saving."""
        self.done += 1
        first, self._fresh = self._fresh, False
        now = time.monotonic()
        self._pace.add(now - self._last_step, first)
        self._last_step = now
        shown = "  ".join(f"{name} {float(value):.4g}" for name, value in numbers.items())
        if self._bar:
            self._bar.update(self._task, completed=self.done, numbers=shown)
        elif first or self.done == self.total or now - self._last_line >= SECONDS_BETWEEN_LINES:
            self._last_line = now
            line = f"{self.description}  {self.done}/{self.total}  {shown}  {self._time_left()}"
            self._console.print(line.rstrip(), highlight=False, markup=False, soft_wrap=True)
        self._interruption.safe_point()

    @property
    def seconds_per_step(self):
        """Mean wall-clock seconds of a step over all sessions of the run whose state was stored,
        the first step of each (which compiles kernels) left out where there are others; None where
        no step was timed."""
        return self._pace.seconds_per_step

    def _time_left(self):
        each = self.seconds_per_step
        if each is None or not self._pace.steps or self.done >= self.total:
            return ""
        minutes, seconds = divmod(round(each * (self.total - self.done)), 60)
        return f"{minutes}:{seconds:02d} left"
