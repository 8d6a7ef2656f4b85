"""Event streams as CSV: a header line ``t,x,y,p``, then one event per line, t in whole microseconds, p +1 or
-1."""

import re

import numpy as np
import torch

from codesign.errors import FileFormatError
from codesign.events.stream import ordered

HEADER = "t,x,y,p"
LINE = re.compile(r"\s*[+-]?\d{1,19}\s*(,\s*[+-]?\d{1,19}\s*){3}")


def write_csv(path, stream):
    """Write events to ``path``. The format has no place for the sensor size: pass it when reading."""
    rows = torch.stack((stream.t_us, stream.x, stream.y, stream.p), dim=1).cpu().numpy()
    np.savetxt(path, rows, fmt="%d", delimiter=",", header=HEADER, comments="")


def read_csv(path, height_px=None, width_px=None):
    """Read events from ``path``; the sensor size is the smallest that holds them unless given.

    Raises: FileFormatError naming the first line that is not four whole numbers, goes back in time, or has a
      negative pixel or unknown polarity (+1 and -1, or 1 and 0, are read as ON and OFF); also without events
      and without a size.
    """
    try:
        with open(path, encoding="ascii", newline=None) as file:
            lines = file.read().split("\n")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path} is not a text file (byte {error.start} is {error.object[error.start]:#x}); CSV events "
            "are plain ASCII."
        ) from error
    if lines[0].strip() != HEADER:
        raise FileFormatError(f"{path}, line 1: {lines[0][:60]!r} found, the header {HEADER!r} is needed.")
    if lines[-1] == "":
        lines.pop()
    rows = _parse(path, lines[1:])
    for bad, reason in (
        (
            np.flatnonzero(np.diff(rows[:, 0], prepend=rows[:1, 0]) < 0),
            "its time lies before that of the line above",
        ),
        (np.flatnonzero((rows[:, 1:3] < 0).any(axis=1)), "pixel coordinates are 0 or more"),
        (np.flatnonzero(~np.isin(rows[:, 3], (-1, 0, 1))), "polarity is +1 or -1 (or 1 and 0)"),
        (
            np.flatnonzero(rows[:, 3] == 0) if (rows[:, 3] == -1).any() else np.empty(0, int),
            "polarity 0 in a file that also holds -1",
        ),
        (
            np.flatnonzero(rows[:, 1] >= (np.inf if width_px is None else width_px)),
            f"x is below the width, {width_px}",
        ),
        (
            np.flatnonzero(rows[:, 2] >= (np.inf if height_px is None else height_px)),
            f"y is below the height, {height_px}",
        ),
    ):
        if bad.size:
            raise FileFormatError(f"{path}, line {bad[0] + 2}: {lines[bad[0] + 1]!r}: {reason}.")
    if not len(rows) and (height_px is None or width_px is None):
        raise FileFormatError(
            f"{path} holds no event, so the sensor size cannot be told; pass height_px and width_px."
        )
    t_us, x, y, p = torch.from_numpy(rows).unbind(1)
    height_px = int(y.max()) + 1 if height_px is None else height_px
    width_px = int(x.max()) + 1 if width_px is None else width_px
    return ordered(t_us, x, y, torch.where(p > 0, 1, -1), height_px, width_px)


def _parse(path, lines):
    """[N, 4] int64 of lines of four whole numbers."""
    for number, line in enumerate(lines, start=2):
        if LINE.fullmatch(line) is None:
            raise FileFormatError(
                f"{path}, line {number}: {line[:60]!r} is not four whole numbers ({HEADER})."
            )
    if not lines:
        return np.empty((0, 4), np.int64)
    try:
        return np.loadtxt(lines, dtype=np.int64, delimiter=",", ndmin=2, comments=None)
    except ValueError as error:  # all are numbers, so one is too large
        number, line = next(
            (n, line)
            for n, line in enumerate(lines, start=2)
            if any(not -(2**63) <= int(value) < 2**63 for value in line.split(","))
        )
        raise FileFormatError(f"{path}, line {number}: {line[:60]!r} exceeds 64-bit integers.") from error
