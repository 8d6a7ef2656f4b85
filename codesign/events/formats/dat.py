"""Prophesee DAT files: an ASCII header, a byte each for event type and size, then 8-byte events of a 32-bit
time and packed x, y, polarity.

The time starts again at 2^32 us; loops are counted when reading. A stream that starts beyond the first loop
is written with those whole loops in the header, under a keyword of ours that other readers pass over. Loops
between events cannot be told, so silences as long as a loop are refused.
Source: Prophesee Metavision documentation, "DAT File Format".
"""

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats.arrival import arranged, columns
from codesign.events.formats.clock import unwrapped
from codesign.events.formats.percent_header import OFFSET_KEY, parsed, time_offset_us, whole_number

EVENT = np.dtype([("t", "<u4"), ("address", "<u4")])
TYPES = (0x00, 0x0C)  # generic events of pixels, and contrast detection
LOOP_US = 2**32
SIDE_PX = 2**14


def read_dat(path, height_px=None, width_px=None):
    """Read events from ``path``; the sensor size is the header's, else the caller's, else the smallest that
    holds the events.

    Raises: FileFormatError for another version or event type, a damaged header, a file cut amid an event, an
      unknown polarity, or time going back.
    """
    data = path.read_bytes()
    fields, start = parsed(path, data)
    if fields.get("Version") != "2":
        raise FileFormatError(
            f"{path}: the header gives version {fields.get('Version', 'none')!r}; DAT version 2 is read."
        )
    if len(data) < start + 2 or data[start] not in TYPES or data[start + 1] != EVENT.itemsize:
        raise FileFormatError(
            f"{path}: event type and size are {data[start : start + 2].hex(' ') or 'absent'}; 0c 08 "
            "(contrast detection) or 00 08 is read."
        )
    if (len(data) - start - 2) % EVENT.itemsize:
        raise FileFormatError(
            f"{path} ends amid an event of {EVENT.itemsize} bytes; it was cut, copy it again."
        )
    events = np.frombuffer(data, EVENT, offset=start + 2)
    address = events["address"].astype(np.int64)
    on = address >> 28
    if on.size and int(on.max()) > 1:
        at = int(np.argmax(on > 1))
        raise FileFormatError(
            f"{path}: event {at} has polarity {int(on[at])}; 0 or 1 is allowed, the file is damaged."
        )
    t_us = unwrapped(events["t"].astype(np.int64), LOOP_US) + time_offset_us(path, fields, LOOP_US)
    return arranged(
        path,
        t_us,
        address & 0x3FFF,
        address >> 14 & 0x3FFF,
        on,
        size=_size(path, fields),
        height_px=height_px,
        width_px=width_px,
    )


def write_dat(path, stream):
    """Write events to ``path`` as contrast-detection events, version 2.

    Raises: FileFormatError for a sensor beyond 16384 x 16384, negative times, or silences that hide a loop of
      the 32-bit clock.
    """
    t_us, x, y, p = columns(
        stream, height_limit_px=SIDE_PX, width_limit_px=SIDE_PX, first_us=0, last_us=2**62, name="DAT"
    )
    offset_us = int(t_us[0]) // LOOP_US * LOOP_US if t_us.size else 0
    events = np.empty(len(t_us), EVENT)
    events["t"] = t_us % LOOP_US
    if not np.array_equal(unwrapped(t_us % LOOP_US, LOOP_US) + offset_us, t_us):
        raise FileFormatError(
            "a silence hides a loop of DAT's 32-bit clock (2^32 us, 71 minutes); write .raw or .npz instead."
        )
    events["address"] = (p > 0).astype(np.int64) << 28 | y << 14 | x
    header = f"% Data file containing CD events\n% Version 2\n% Width {stream.width_px}\n% Height {stream.height_px}\n% {OFFSET_KEY} {offset_us}\n"
    path.write_bytes(header.encode("ascii") + bytes((0x0C, EVENT.itemsize)) + events.tobytes())


def _size(path, fields):
    """(height_px, width_px) of the header, or None."""
    if "Height" not in fields and "Width" not in fields:
        return None
    return tuple(whole_number(path, fields.get(name, ""), name, 1, SIDE_PX) for name in ("Height", "Width"))
