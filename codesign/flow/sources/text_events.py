"""Events as text, one per line: ``t x y p`` as in the Event-Camera Dataset, or what a header line says.

Times with a fraction are seconds, whole ones microseconds; p is 1 and 0, or +1 and -1. Numbers are separated
by blanks or commas. A first line of two whole numbers is the sensor's width and height; lines that begin with
# are skipped at the top. Source: Mueggler et al., IJRR 2017 (layout of events.txt).
"""

import io
import re
import warnings
from collections.abc import Collection
from pathlib import Path

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats.arrival import DISORDER_US
from codesign.flow.checks import check_kind, check_path
from codesign.flow.sources.columns import (
    BACKWARDS,
    LIMIT_PX,
    OFF_SENSOR,
    EventColumns,
    on_sensor,
    settled_size,
)

CHUNK_BYTES = 2**23
MOST_EVENTS = 500_000_000
NAMES = {
    "t": "t",
    "ts": "t",
    "time": "t",
    "timestamp": "t",
    "timestamps": "t",
    "t_us": "t",
    "t_s": "t",
    "x": "x",
    "y": "y",
    "p": "p",
    "pol": "p",
    "polarity": "p",
}
ORDERS = ("txyp", "xytp")
UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def read_text_events(
    path: str | Path,
    size: tuple[int, int] | None = None,
    told: tuple[int, int] | None = None,
    told_by: str = "the file",
    columns: str = "auto",
    time_unit: str = "auto",
    skip: Collection[str] = (),
) -> EventColumns:
    """Read events from a text file, eight megabytes at a time.

    Args:
      path: file. size, told, told_by: see columns.settled_size.
      columns: order of the four columns, for example "txyp"; "auto" takes the header's, else "txyp", else
        "xytp" where only the third column rises.
      time_unit: "s", "ms", "us", "ns"; "auto": seconds where a time of the first chunk has a fraction, else
        microseconds.
      skip: faults whose events are left out and counted instead of refused: columns.BACKWARDS,
        columns.OFF_SENSOR.
    Returns: EventColumns in order of time. Events up to 1 ms late are put in order.
    Raises: FileFormatError naming the line that is not four numbers, goes back in time, lies outside the
      sensor or has another polarity.
    """
    path = check_path(path)
    columns = check_kind(columns, str, "the order of the columns")
    parts = []
    left_out = dict.fromkeys(skip, 0)
    number = 1
    carried_us = -(2**62)
    try:
        with open(path, "rb") as file:
            first_lines, columns, told_in_file = _head(path, file, columns)
            number += first_lines
            told, told_by = (told_in_file, "its first line") if told_in_file else (told, told_by)
            while lines := _whole_lines(path, file, number):
                table, at_lines = _table(path, lines, number)
                if not parts:
                    columns = _settled_order(path, table, columns)
                    time_unit = _settled_unit(path, table[:, columns.index("t")], time_unit)
                parts.append(
                    _checked(path, table, at_lines, columns, UNITS_US[time_unit], carried_us, left_out)
                )
                carried_us = max(carried_us, int(parts[-1][0].max())) if len(parts[-1][0]) else carried_us
                number += lines.count(b"\n")
                if sum(len(part[0]) for part in parts) > MOST_EVENTS:
                    raise FileFormatError(f"{path} holds more than {MOST_EVENTS} events; split it.")
    except OSError as error:
        raise FileFormatError(f"cannot read the events in {path}: {error.strerror or error}.") from error
    if not parts:
        raise FileFormatError(f"{path} holds no event; lines of 't x y p' are needed.")
    t_us, x, y, on = (np.concatenate(column) for column in zip(*parts, strict=True))
    del parts
    if bool((t_us[1:] < t_us[:-1]).any()):
        order = np.argsort(t_us, kind="stable")
        t_us = t_us[order]
        x = x[order]
        y = y[order]
        on = on[order]
    settled = settled_size(path, x, y, size, told, told_by)
    return on_sensor(path, (t_us, x, y, on), settled, skip, left_out)


def _head(path, file, columns):
    """(lines used up, order of the columns, (height, width) or None) of comments, a header, or a size at the
    top of the file."""
    used = 0
    told = None
    while True:
        here = file.tell()
        line = file.readline(4096)
        words = line.replace(b",", b" ").split()
        if line.startswith(b"#") and (
            not words[1:] or words[1].decode("ascii", "replace").lower() not in NAMES
        ):
            used += 1
        elif words and not NUMBER.fullmatch(words[-1]):
            names = [word.decode("ascii", "replace").lower() for word in words if word != b"#"]
            found = "".join(NAMES.get(name.removeprefix("#"), "?") for name in names)
            if sorted(found) != ["p", "t", "x", "y"]:
                raise FileFormatError(
                    f"{path}, line {used + 1}: {line[:60].decode('ascii', 'replace').rstrip()!r} is neither "
                    "an event of four numbers nor a header that names t, x, y, p."
                )
            used = used + 1
            columns = found if columns == "auto" else columns
        elif len(words) == 2 and told is None and all(word.isdigit() for word in words):
            used = used + 1
            told = (int(words[1]), int(words[0]))
            if not all(1 <= side <= LIMIT_PX for side in told):
                raise FileFormatError(
                    f"{path}, line {used}: a sensor of {told[1]} x {told[0]} pixels is announced; 1 to "
                    f"{LIMIT_PX} a side are possible."
                )
        else:
            file.seek(here)
            return used, columns, told


def _whole_lines(path, file, number):
    """The next bytes up to the end of a line; empty at the end of the file."""
    block = file.read(CHUNK_BYTES)
    if block and not block.endswith(b"\n"):
        block += file.readline(4096)
        if not block.endswith(b"\n"):
            if file.read(1):
                raise FileFormatError(
                    f"{path}: a line after line {number} is longer than 4096 bytes; this is no text file of "
                    "events."
                )
            block += b"\n"
    return block.replace(b",", b" ") if b"," in block else block


def _table(path, lines, number):
    """[N, 4] float64 of whole lines, and the number of the line of each row. Every line must hold four
    numbers or nothing."""
    raw = np.frombuffer(lines, np.uint8)
    blank = raw <= 32
    starts = ~blank & np.concatenate([[True], blank[:-1]])
    ends = np.flatnonzero(raw == 10)
    words = np.diff(np.cumsum(starts, dtype=np.int64)[ends], prepend=0)
    wrong = np.flatnonzero((words != 4) & (words != 0))
    if wrong.size:
        raise _bad(path, lines, number, int(wrong[0]))
    rows = np.flatnonzero(words)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DeprecationWarning
            )  # how older versions of numpy say that they met no number
            found = np.fromstring(lines.decode("latin-1"), np.float64, sep=" ")
    except ValueError:
        found = np.empty(0)
    if len(found) != 4 * len(rows) or not np.isfinite(found).all():
        for at, line in enumerate(io.BytesIO(lines)):
            if line.strip() and not all(
                NUMBER.fullmatch(word) and np.isfinite(float(word)) for word in line.split()
            ):
                raise _bad(path, lines, number, at)
    return found.reshape(-1, 4), number + rows


def _bad(path, lines, number, at):
    number += at
    line = lines.split(b"\n", at + 1)[at][:60].decode("ascii", "replace").rstrip()
    return FileFormatError(
        f"{path}, line {number}: {line!r} is not an event of four finite numbers (t x y p)."
    )


def _settled_order(path, table, columns):
    if columns == "auto":
        rising = [
            order
            for order in ORDERS
            if bool((np.diff(table[:, order.index("t")]) >= 0).all())
            and bool((table[:, [order.index("x"), order.index("y")]] % 1 == 0).all())
        ]
        return (
            rising[0] if rising else ORDERS[0]
        )  # without either, the line that goes back in time is named by the check that follows
    if sorted(columns) != ["p", "t", "x", "y"]:
        raise FileFormatError(
            f"columns {columns!r} given for {path}; the four letters t, x, y, p in the file's order are "
            "needed, for example 'txyp'."
        )
    return columns


def _settled_unit(path, times, unit):
    if unit == "auto":
        return "s" if bool((times % 1 != 0).any()) else "us"
    if not isinstance(unit, str) or unit not in UNITS_US:
        raise FileFormatError(
            f"time unit {unit!r} given for {path}; choose one of {', '.join(UNITS_US)} or auto."
        )
    return unit


def _checked(path, table, at_lines, columns, us, carried_us, left_out):
    """(t_us, x, y, on) of the rows of a table, narrow; faults named in ``left_out`` are counted there."""
    t, x, y, p = (table[:, columns.index(name)] for name in "txyp")
    t_us = np.rint(t * us)
    latest_us = np.maximum(np.maximum.accumulate(t_us), carried_us) if len(t_us) else t_us
    kept = np.ones(len(t_us), bool)
    for fault, bad, reason in (
        ("", np.abs(t_us) >= 2**61, "its time exceeds 61 bits of microseconds"),
        (
            BACKWARDS,
            t_us < latest_us - DISORDER_US,
            f"its time lies more than {DISORDER_US} us before that of an earlier line",
        ),
        (
            OFF_SENSOR,
            (x % 1 != 0) | (y % 1 != 0) | (x < 0) | (y < 0) | (x >= LIMIT_PX) | (y >= LIMIT_PX),
            f"pixel coordinates are whole numbers from 0 to {LIMIT_PX - 1}",
        ),
        ("", ~((p == 1) | (p == 0) | (p == -1)), "polarity is 1 or 0 (or +1 and -1)"),
    ):
        bad = bad & kept
        if fault in left_out:
            left_out[fault] += int(bad.sum())
            kept &= ~bad
        elif bool(bad.any()):
            at = int(np.argmax(bad))
            raise FileFormatError(
                f"{path}, line {at_lines[at]}: {' '.join(f'{value:.15g}' for value in table[at])!r}: "
                f"{reason}."
            )
    t_us, x, y, p = (values[kept] for values in (t_us, x, y, p))
    return t_us.astype(np.int64), x.astype(np.int16), y.astype(np.int16), p > 0
