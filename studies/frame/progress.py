"""Progress of a loop: a bar with loss and time left on a terminal; elsewhere a line at the first and last
step and every few seconds."""

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

SECONDS_BETWEEN_LINES = 5.0


class StepProgress:
    """Context manager around a loop of ``total`` steps, of which ``done`` were made in an earlier session.

    Args:
      console: rich console; its kind decides between bar and lines.
      total: number of steps.
      description: what the loop does, one or two words.
      done: steps already made, 0 for a fresh loop.
      interruption: codesign.interrupt.Interruption whose safe point every advance is.
    """

    def __init__(self, console: Console, total: int, description: str, done: int, interruption):
        self.total = total
        self.description = description
        self.done = done
        self._console = console
        self._interruption = interruption
        self._first_done: tuple[float, int] | None = (
            None  # the first step compiles kernels and would spoil the rate
        )
        self._last_line = self._last_step = time.monotonic()
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
            raise RuntimeError("loops with progress cannot be nested: an interrupt needs one safe point")
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
        """One more whole step was made; ``numbers`` (loss=…) are shown. A pressed Ctrl-C takes effect here,
        after saving."""
        self.done += 1
        self._last_step = time.monotonic()
        if self._first_done is None:
            self._first_done = (self._last_step, self.done)
        shown = "  ".join(f"{name} {float(value):.4g}" for name, value in numbers.items())
        if self._bar:
            self._bar.update(self._task, completed=self.done, numbers=shown)
        elif (
            self.done in (self._first_done[1], self.total)
            or self._last_step - self._last_line >= SECONDS_BETWEEN_LINES
        ):
            self._last_line = self._last_step
            self._console.print(
                f"{self.description}  {self.done}/{self.total}  {shown}  {self._time_left()}".rstrip(),
                highlight=False,
                markup=False,
                soft_wrap=True,
            )
        self._interruption.safe_point()

    @property
    def seconds_per_step(self):
        """Mean wall-clock seconds of a step of this session, the first (which compiles kernels) left out;
        None before the second."""
        if self._first_done is None or self.done <= self._first_done[1]:
            return None
        return (self._last_step - self._first_done[0]) / (self.done - self._first_done[1])

    def _time_left(self):
        each = self.seconds_per_step
        if each is None or self.done >= self.total:
            return ""
        minutes, seconds = divmod(round(each * (self.total - self.done)), 60)
        return f"{minutes}:{seconds:02d} left"
