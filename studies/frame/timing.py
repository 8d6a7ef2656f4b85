"""Times of a function: wall clock and processor time, median and interquartile range of repeats."""

import os
import resource
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Timing:
    """Seconds of every repeat, in order: by the clock, and of the process's threads together (steadier on a
    shared machine)."""

    wall_s: tuple[float, ...]
    cpu_s: tuple[float, ...]

    @property
    def wall(self):
        return statistics.median(self.wall_s)

    @property
    def cpu(self):
        return statistics.median(self.cpu_s)

    @property
    def wall_iqr(self):
        """Difference of the upper and lower quartile of the wall-clock seconds."""
        lower, _, upper = statistics.quantiles(self.wall_s, n=4, method="inclusive")
        return upper - lower


def measure(function, repeats, warm=2, after_each=None):
    """Call ``function`` ``warm`` times untimed, then ``repeats`` >= 2 times timed. ``after_each`` is called,
    untimed, after every timed call."""
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


def resident_mb():
    """Memory of the process that is in use now, MB; its largest so far where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
