"""What something costs: seconds by the clock and of the processor, memory, and functions in
processes of their own.

    timing = measure(lambda: trace(rays), repeats=7)
    f"{1e3 * timing.cpu:.1f} ms of processor time, {1e3 * timing.wall:.1f} by the clock"

    turns({"ours": ours, "peer": peer}, rounds=5)   # a change of the machine's load meets both
    apart(cost_of_tracing, "float32", 1_000_000)    # a fresh process: its memory is the function's
    alone

Processor time is what to judge by on a shared machine, the median what to judge by at all.
"""

import contextlib
import importlib
import importlib.util
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from codesign.errors import CodesignError, DomainError

Key = TypeVar("Key")
RUNNING: set[subprocess.Popen] = set()


class KilledError(CodesignError):
    """A process that a signal ended, such as that of a machine without memory."""


@dataclass(frozen=True)
class Timing:
    """Seconds of every repeat, in order: by the clock, and of the process's threads together."""

    wall_s: tuple[float, ...]
    cpu_s: tuple[float, ...]

    @property
    def wall(self) -> float:
        return statistics.median(self.wall_s)

    @property
    def cpu(self) -> float:
        return statistics.median(self.cpu_s)

    def __add__(self, other: "Timing") -> "Timing":
        """The repeats of both."""
        return Timing(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)


def measure(
    function: Callable[[], object],
    repeats: int,
    warm: int = 2,
    after_each: Callable[[], object] | None = None,
) -> Timing:
    """Times of a function.

    Args:
      function: what is timed; its result is dropped before the next call.
      repeats: timed calls.
      warm: untimed calls before them.
      after_each: called, untimed, after every timed call.
    """
    for _ in range(warm):
        function()
    walls = []
    cpus = []
    for _ in range(repeats):
        wall = time.perf_counter()
        cpu = time.process_time()
        function()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
        if after_each:
            after_each()
    return Timing(tuple(walls), tuple(cpus))


def turns(
    works: Mapping[Key, Callable[[], object]],
    rounds: int,
    repeats: int = 1,
    warm: int = 1,
) -> dict[Key, Timing]:
    """Times of several functions, each ``repeats`` times in every round, so that what else the
    machine does meets all.

    Args:
      works: what is timed, by name.
      rounds: turns of each.
      repeats: timed calls of a turn.
      warm: untimed calls before each turn; one more before the first, which compiles.
    """
    found: dict[Key, Timing] = {}
    for number in range(rounds):
        for name, work in works.items():
            timing = measure(work, repeats, warm if number else warm + 1)
            found[name] = found[name] + timing if name in found else timing
    return found


def installed(peers: Mapping[str, str]) -> list[str]:
    """Those of the peers (name -> package it needs) that are installed."""
    return [name for name, package in peers.items() if importlib.util.find_spec(package)]


def apart(
    function: Callable[..., Any],
    *arguments: Any,
    environment: Mapping[str, str] | None = None,
    **keywords: Any,
) -> Any:
    """What a function returns in a fresh process; what it prints there goes nowhere.

    Args:
      function: of the top level of a module.
      arguments, keywords: plain values, as JSON keeps them; so is what it returns.
      environment: variables that the process has besides those of this one.
    Raises: CodesignError with the last line of its stderr when the process fails, KilledError when
      a signal ended it.
    """
    name = named(function)
    process = subprocess.Popen(
        [sys.executable, "-m", "studies.frame.bench", name, json.dumps([arguments, keywords])],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **(environment or {})},
        # Ctrl-C is for the one who waits, which ends this process where it must
        start_new_session=True,
    )
    RUNNING.add(process)
    try:
        said, complaint = process.communicate()
    except BaseException:
        process.kill()
        process.communicate()
        raise
    finally:
        RUNNING.discard(process)
    if process.returncode:
        last = (complaint.strip().splitlines() or ["no word"])[-1][:300]
        given = ", ".join(map(str, (*arguments, *keywords.values())))
        kind = KilledError if process.returncode < 0 else CodesignError
        raise kind(f"{function.__name__}({given}) ended with code {process.returncode}: {last}")
    return json.loads(said)


def named(function: Callable[..., Any]) -> str:
    """Module and name by which another process finds a function.

    Raises: DomainError for one of a script, which no other process can import.
    """
    module = function.__module__
    if module == "__main__":
        spec = getattr(sys.modules[module], "__spec__", None)
        if spec is None:
            raise DomainError(
                f"{function.__qualname__} stands in the script that runs, where other processes do not find it; move it "
                "into a module and import it."
            )
        module = spec.name
    return f"{module}:{function.__qualname__}"


def end_running() -> None:
    """End the processes that ``apart`` started, in other threads, and waits for."""
    for process in list(RUNNING):
        process.kill()


def resident_mb() -> float:
    """Memory of the process that is in use now, MB; its largest so far where the system does not
    tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return _largest_mb()


def peak_mb(function: Callable[[], object]) -> float:
    """Largest memory during one call beyond what was in use before it, MB.

    Where the system cannot start that count anew (not Linux), earlier peaks count too. Freed memory
    that the process kept hides a peak: ask in a process of its own (``apart``).
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    before = resident_mb()
    result = function()
    try:
        told = Path("/proc/self/status").read_text().partition("VmHWM:")[2]
        largest = int(told.split()[0]) * 1024 / 1e6
    except (OSError, IndexError):
        largest = _largest_mb()
    del result
    return largest - before


def cost(work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median seconds of calls after the first, wall_s and cpu_s, and the peak of memory of the
    first,
    peak_mb: the figures of a process of its own, in which what compiles has run on something
      small."""
    peak = peak_mb(work)
    timing = measure(work, repeats, warm=0)
    return {"wall_s": timing.wall, "cpu_s": timing.cpu, "peak_mb": peak}


def _largest_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        1e6 if sys.platform == "darwin" else 1e3
    )


def called(name: str, arguments: Sequence[Any], keywords: Mapping[str, Any]) -> str:
    """JSON of what the function with this name ("module:function") returns; what it prints goes to
    stderr."""
    import codesign  # noqa: F401  (first: it sets OpenMP's wait policy before torch is imported)

    module, function = name.split(":")
    with contextlib.redirect_stdout(sys.stderr):
        found = getattr(importlib.import_module(module), function)(*arguments, **keywords)
    return json.dumps(found)


if __name__ == "__main__":
    print(called(sys.argv[1], *json.loads(sys.argv[2])))
