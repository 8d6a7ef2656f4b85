"""Prophesee DAT files: an ASCII header, a byte each for event type and size, then 8-byte events of a 32-bit
time and packed x, y, polarity.

The time starts again at 2^32 us. Loops are counted when reading, but not by Prophesee's own readers, so none
is written; the start time ``% T0`` that faery and we write where asked to is added to all times.
Source: Prophesee Metavision documentation, "DAT File Format"; faery (``T0``).
"""

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats.arrival import arranged, columns
from codesign.events.formats.prophesee import (
    checked_start_us,
    parse_header,
    start_us,
    unwrapped,
    whole_number,
)

EVENT = np.dtype([("t", "<u4"), ("address", "<u4")])
TYPES = (0x00, 0x0C)  # generic events of pixels, and contrast detection
LOOP_US = 2**32
SIDE_PX = 2**14


def read_dat(path, asked):
    """EventColumns of ``path``. A header with nothing behind it, as faery writes for no events, is an empty
    stream.

    Raises: FileFormatError for another version or event type, a damaged header, a file cut amid an event, an
      unknown polarity, or time going back.
    """
    data = path.read_bytes()
    fields, start = parse_header(path, data)
    if fields.get("Version") != "2":
        raise FileFormatError(
            f"{path}: the header gives version {fields.get('Version', 'none')!r}; DAT version 2 is read."
        )
    body = data[start:] or bytes((TYPES[0], EVENT.itemsize))
    if len(body) < 2 or body[0] not in TYPES or body[1] != EVENT.itemsize:
        raise FileFormatError(
            f"{path}: event type and size are {body[:2].hex(' ')}; 0c 08 "
            "(contrast detection) or 00 08 is read."
        )
    if (len(body) - 2) % EVENT.itemsize:
        raise FileFormatError(
            f"{path} ends amid an event of {EVENT.itemsize} bytes; it was cut, copy it again."
        )
    events = np.frombuffer(body, EVENT, offset=2)
    address = events["address"].astype(np.int64)
    t_us = unwrapped(events["t"].astype(np.int64), LOOP_US) + start_us(path, fields)
    x, y = address & 0x3FFF, address >> 14 & 0x3FFF
    return arranged(path, asked, t_us, x, y, address >> 28, size=_size(path, fields))


def write_dat(path, stream, *, t0_us=0):
    """Write events to ``path`` as contrast-detection events, version 2, their times less ``t0_us``, which the
    header tells.

    Raises: FileFormatError for a sensor beyond 16384 x 16384, and times (less t0_us) below 0 or beyond 2^32
      us.
    """
    t_us, x, y, p = columns(stream, "DAT", SIDE_PX, 0, LOOP_US - 1, checked_start_us(t0_us))
    events = np.empty(len(t_us), EVENT)
    events["t"] = t_us
    events["address"] = (p > 0).astype(np.int64) << 28 | y << 14 | x
    lines = (
        "Data file containing CD events",
        "Version 2",
        f"Width {stream.width_px}",
        f"Height {stream.height_px}",
        *([f"T0 {t0_us}"] if t0_us else []),
    )
    header = "".join(f"% {line}\n" for line in lines)
    path.write_bytes(header.encode("ascii") + bytes((TYPES[-1], EVENT.itemsize)) + events.tobytes())


def _size(path, fields):
    """(height_px, width_px) of the header, or None."""
    if "Height" not in fields and "Width" not in fields:
        return None
    return tuple(whole_number(path, fields.get(name, ""), name, 1, SIDE_PX) for name in ("Height", "Width"))
