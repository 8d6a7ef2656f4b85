"""What tests of the frame call in processes of their own: without torch, which takes seconds to
import."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from codesign.errors import DomainError
from studies.frame import bench


def power(base, exponent):
    """A cell, and something to call in another process."""
    print("noise")
    if exponent < 0:
        raise DomainError("exponents are not below 0")
    return {"power": base**exponent, "process": os.getpid()}


def killed_once(folder, exponent):
    """Ends as by the system's memory killer, the first time."""
    mark = Path(folder) / str(exponent)
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return {"power": 2**exponent}


def killed(exponent):
    os.kill(os.getpid(), signal.SIGKILL)


def slow(seconds):
    time.sleep(seconds)
    return {"slept": seconds}


def told(name, peak_of):
    """A variable of the environment, and the peaks of calls with so many megabytes and with
    none."""
    calls = (lambda: np.ones(peak_of * 10**6, dtype=np.uint8).sum(), lambda: None)
    return [os.environ.get(name), *map(bench.peak_mb, calls)]
