"""What Prophesee's formats share: the ASCII header of lines ``% keyword value`` ahead of the binary part,
hardware clocks of few bits that start again at zero, and values that hold until the next word changes them.

Source: Prophesee Metavision documentation, "RAW File Format" and "DAT File Format".
"""

import numpy as np

from codesign.errors import FileFormatError

LIMIT_BYTES = 65536
# microseconds to add to every time: faery writes "t0" in .raw and "T0" in .dat, versions of codesign before
# it "codesign_t_offset_us"
START_KEYS = ("t0", "T0", "codesign_t_offset_us")


def unwrapped(ticks, loop):
    """Count the loops of a clock.

    A fall by three quarters of the loop or more is a new loop; a smaller fall is time going back, which the
    caller judges. (A single wrong bit changes a reading by at most half a loop, so it never passes for a new
    one.)

    Args: ticks: [N] int64 readings, 0 to loop - 1. loop: number of readings.
    Returns: [N] int64 readings plus ``loop`` for each new loop so far.
    """
    falls = np.zeros(len(ticks), np.int64)
    np.cumsum(ticks[1:] - ticks[:-1] <= -(loop // 4) * 3, out=falls[1:])
    return ticks + falls * loop


def held(starts, values, count):
    """The last value given before each event; and how many events precede them all.

    Args: starts: [M] rising numbers of the events that follow each value. values: [M]. count: number of
      events.
    """
    first = int(starts[0]) if len(starts) else count
    return np.repeat(values, np.diff(starts, append=count)), first


def parse_header(path, data):
    """(fields, start): the values by keyword, and where the binary part of ``data`` starts.

    Raises: FileFormatError for a header without an end, not ASCII, or with a keyword said twice in two ways.
    """
    fields = {}
    start = 0
    while data[start : start + 2] == b"% ":
        stop = data.find(b"\n", start, LIMIT_BYTES)
        if stop < 0:
            raise FileFormatError(
                f"{path}: the header line at byte {start} does not end within {LIMIT_BYTES} bytes; the file "
                "is damaged or not of this kind."
            )
        try:
            line = data[start + 2 : stop].decode("ascii").strip()
        except UnicodeDecodeError as error:
            raise FileFormatError(
                f"{path}: the header line at byte {start} is not ASCII text; the file is damaged."
            ) from error
        start = stop + 1
        key, _, value = line.partition(" ")
        if key == "end":
            break
        if fields.setdefault(key, value.strip()) != value.strip():
            raise FileFormatError(
                f"{path}: the header gives {key!r} twice, as {fields[key]!r} and {value.strip()!r}; keep "
                "the right one."
            )
    return fields, start


def whole_number(path, text, name, low, high):
    """The integer a header gives for ``name``."""
    digits = text[1:] if text.startswith("-") else text
    if not (digits.isascii() and digits.isdigit()) or len(digits) > 19 or not low <= int(text) <= high:
        raise FileFormatError(
            f"{path}: the header gives {name} as {text[:40]!r}; a whole number from {low} to {high} is "
            "needed."
        )
    return int(text)


def start_us(path, fields):
    """Time at which the clock of a file starts, which its words do not count: the header's ``t0``, or 0.

    Raises: FileFormatError when it is no whole number from 0 to 2^62, or said twice in two ways.
    """
    said = {fields[key] for key in START_KEYS if key in fields}
    if len(said) > 1:
        raise FileFormatError(
            f"{path}: the header gives the start time as {' and as '.join(sorted(said))}; keep the right one."
        )
    return whole_number(path, said.pop(), "the start time (t0)", 0, 2**62) if said else 0


def checked_start_us(t0_us):
    """``t0_us`` as a header can hold it.

    Raises: FileFormatError when it is no whole number from 0 to 2^62.
    """
    if isinstance(t0_us, bool) or not isinstance(t0_us, int) or not 0 <= t0_us <= 2**62:
        raise FileFormatError(f"t0_us is {t0_us!r}; a whole number of microseconds from 0 to 2^62 is needed.")
    return t0_us
