"""Events as text, one per line: ``t x y p`` as in the Event-Camera Dataset, or what a header line
says.

Times with a fraction are seconds, whole ones microseconds; p is 1 and 0, or +1 and -1. Numbers are
separated by blanks or commas. A first line of two whole numbers is the sensor's width and height;
lines that begin with # are skipped at the top. Written: a header line ``t,x,y,p``, t in whole
microseconds, p +1 or -1.
Source: Mueggler et al., IJRR 2017 (layout of events.txt).
"""

import codecs
import contextlib
import io
import re
import warnings

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.columns import LIMIT_PX
from codesign.events.formats.arrival import (
    LAST_US,
    NAMES,
    Arrival,
    columns,
    microseconds,
    settled_order,
    settled_unit,
)

CHUNK_BYTES = 2**23
LETTERS = {name: letter for letter, names in NAMES.items() for name in names}
NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def write_csv(path, stream):
    """Write events to ``path``. The format has no place for the sensor size: pass it when
    reading."""
    rows = columns(stream, "CSV", LIMIT_PX, 1 - LAST_US, LAST_US - 1)
    np.savetxt(path, np.stack(rows, 1), fmt="%d", delimiter=",", header="t,x,y,p", comments="")


def read_text(path, asked):
    """EventColumns of a text file, eight megabytes at a time.

    Raises: FileFormatError naming the line that is not four numbers, and what tables and arrival
      refuse.
    """
    with open(path, "rb") as file:
        # a mark that some editors put before a text
        if file.read(3) != codecs.BOM_UTF8:
            file.seek(0)
        number, names, size = _head(path, file)
        arrival = Arrival(path, asked, size, "its first line", "line")
        order, unit = "".join(LETTERS[name] for name in names), asked.time_unit
        order = asked.columns if asked.columns != "auto" or not names else order
        while lines := _whole_lines(path, file, number):
            table, at_lines = _table(path, lines, number)
            if not arrival.count and len(table):
                order = settled_order(path, table, order)
                name = next((name for name in names if LETTERS[name] == "t"), "")
                first = lines.split(b"\n", 1)[0].replace(b",", b" ").split()
                if unit == "auto" and [b"." in word for word in first] == [c == "t" for c in order]:
                    unit = "s"  # the times alone have decimals, all of them 0 or not
                unit = settled_unit(table[:, order.index("t")], unit, name)
            if len(table):
                t, x, y, p = (table[:, order.index(letter)] for letter in "txyp")
                arrival.add(microseconds(t, unit), x, y, p, at_lines)
            number += lines.count(b"\n")
    return arrival.columns()


def _head(path, file):
    """(number of the first line behind comments, a header, or a size at the top of the file; names
    of the header, or ""; (height, width) or None)."""
    used = 0
    names: list[str] = []
    told = None
    while True:
        here = file.tell()
        line = file.readline(4096)
        words = line.decode("latin-1").lower().replace(",", " ").split()
        if line.startswith(b"#"):
            words = " ".join(words).removeprefix("#").split()
        if line.startswith(b"#") and (not words or words[0] not in LETTERS):
            used += 1
        elif words and not names and not NUMBER.fullmatch(words[-1].encode("latin-1")):
            names = words
            if sorted(LETTERS.get(name, "?") for name in names) != ["p", "t", "x", "y"]:
                raise FileFormatError(
                    f"{path}, line {used + 1}: {line[:60].decode('ascii', 'replace').rstrip()!r} is neither "
                    "an event of four numbers nor a header that names t, x, y, p."
                )
            used += 1
        elif len(words) == 2 and told is None and all(word.isdigit() for word in words):
            used += 1
            told = (int(words[1]), int(words[0]))
            if not all(1 <= side <= LIMIT_PX for side in told):
                raise FileFormatError(
                    f"{path}, line {used}: a sensor of {' x '.join(words)[:60]} pixels is announced; 1 to "
                    f"{LIMIT_PX} a side are possible."
                )
        else:
            file.seek(here)
            return used + 1, names, told


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
    """[N, 4] int64 or float64 of whole lines, and the number of the line of each row. Every line
    must hold four numbers or nothing."""
    raw = np.frombuffer(lines, np.uint8)
    blank = raw <= 32
    starts = ~blank & np.concatenate([[True], blank[:-1]])
    ends = np.flatnonzero(raw == 10)
    words = np.diff(np.cumsum(starts, dtype=np.int64)[ends], prepend=0)
    wrong = np.flatnonzero((words != 4) & (words != 0))
    if wrong.size:
        raise _bad(path, lines, number, int(wrong[0]))
    rows = np.flatnonzero(words)
    found = np.empty(0)
    for kind in (np.int64, np.float64):  # whole numbers stay exact
        # what numpy says where it meets no number, older versions by a warning
        with contextlib.suppress(ValueError, DeprecationWarning), warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            found = np.fromstring(lines.decode("latin-1"), kind, sep=" ")
            break
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
