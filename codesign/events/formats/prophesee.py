"""Prophesee's files: an ASCII header of lines ``% keyword value``, then, little-endian, EVT 2.0 or
EVT 3.0 words (.raw), or a byte each for event type and size and 8-byte events (.dat).

Hardware clocks have few bits and start again at zero: their loops are counted when reading.
Prophesee's own readers count no loop of .dat, readers disagree on those of EVT 2.0, so none is
written there; in EVT 3.0 they are told by time words, which every reader counts. The start time
(``% t0``, ``% T0``) that faery and we write where asked to is added to all times.
Source: Prophesee Metavision documentation, "RAW File Format", "DAT File Format"; faery.
"""

import re
import warnings

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats.arrival import arranged, columns
from codesign.events.formats.evt import ENCODINGS, unwrapped

LIMIT_BYTES = 65536
# microseconds to add to every time: faery writes "t0" in .raw and "T0" in .dat, versions of
# codesign before it "codesign_t_offset_us"
START_KEYS = ("t0", "T0", "codesign_t_offset_us")
GEOMETRY = re.compile(r"(\d{1,5})x(\d{1,5})")
RAW_SIDE_PX = 2**11
DAT_SIDE_PX = 2**14
DAT_EVENT = np.dtype([("t", "<u4"), ("address", "<u4")])
DAT_TYPES = (0x00, 0x0C)  # generic events of pixels, and contrast detection
DAT_LOOP_US = 2**32


def read_raw(path, asked):
    """EventColumns of ``path``.

    Events before the first word that gives a time or row are left out with a warning: recordings
    may start amid the camera's words.
    Raises: FileFormatError for another encoding, a damaged header or word, a file cut amid a word,
      or time going back (see arrival).
    """
    data = path.read_bytes()
    fields, start = parse_header(path, data)
    version, options = _format(path, fields)
    word, _, decoded, _ = ENCODINGS[version]
    t_us, x, y, p, lost = decoded(path, _whole(path, data, start, word, "a word"))
    if lost:
        warnings.warn(
            f"{path}: {lost} events before the first time, row or column base are left out; the file "
            "starts amid the camera's words.",
            stacklevel=2,
        )
    t_us += start_us(path, fields)
    return arranged(path, asked, t_us, x, y, p, size=_raw_size(path, fields, options))


def write_raw(path, stream, *, evt=3, t0_us=0):
    """Write events to ``path`` as EVT 3.0 or (evt=2) EVT 2.0, their times less ``t0_us``, which the
    header tells.

    Raises: FileFormatError for a sensor beyond 2048 x 2048, another ``evt``, or times (less t0_us)
      below 0 or beyond 2^44 us (EVT 2.0: 2^34 us).
    """
    if not isinstance(evt, int) or evt not in ENCODINGS:
        raise FileFormatError(f"evt={evt!r} was given; 2 (EVT 2.0) and 3 (EVT 3.0) are written.")
    _, limit_us, _, encoded = ENCODINGS[evt]
    events = columns(stream, f"EVT {evt}.0", RAW_SIDE_PX, 0, limit_us - 1, _checked_start_us(t0_us))
    height_px = stream.height_px
    width_px = stream.width_px
    header = _header(
        f"evt {evt}.0",
        f"format EVT{evt};height={height_px};width={width_px}",
        f"geometry {width_px}x{height_px}",
        *([f"t0 {t0_us}"] if t0_us else []),
        "end",
    )
    path.write_bytes(header + encoded(*events).tobytes())


def read_dat(path, asked):
    """EventColumns of ``path``. A header with nothing behind it, as faery writes for no events, is
    an empty stream.

    Raises: FileFormatError for another version or event type, a damaged header, a file cut amid an
      event, an unknown polarity, or time going back.
    """
    data = path.read_bytes()
    fields, start = parse_header(path, data)
    if fields.get("Version") != "2":
        raise FileFormatError(
            f"{path}: the header gives version {fields.get('Version', 'none')!r}; DAT version 2 is read."
        )
    body = data[start:] or bytes((DAT_TYPES[0], DAT_EVENT.itemsize))
    if len(body) < 2 or body[0] not in DAT_TYPES or body[1] != DAT_EVENT.itemsize:
        raise FileFormatError(
            f"{path}: event type and size are {body[:2].hex(' ')}; 0c 08 "
            "(contrast detection) or 00 08 is read."
        )
    events = _whole(path, body, 2, DAT_EVENT, "an event")
    address = events["address"].astype(np.int64)
    t_us = unwrapped(events["t"].astype(np.int64), DAT_LOOP_US) + start_us(path, fields)
    size = None
    if "Height" in fields or "Width" in fields:
        sides = ((name, fields.get(name, "")) for name in ("Height", "Width"))
        size = tuple(whole_number(path, text, name, 1, DAT_SIDE_PX) for name, text in sides)
    x, y = address & 0x3FFF, address >> 14 & 0x3FFF
    return arranged(path, asked, t_us, x, y, address >> 28, size=size)


def write_dat(path, stream, *, t0_us=0):
    """Write events to ``path`` as contrast-detection events, version 2, their times less ``t0_us``,
    which the header tells.

    Raises: FileFormatError for a sensor beyond 16384 x 16384, and times (less t0_us) below 0 or
      beyond 2^32 us.
    """
    t_us, x, y, p = columns(
        stream, "DAT", DAT_SIDE_PX, 0, DAT_LOOP_US - 1, _checked_start_us(t0_us)
    )
    events = np.empty(len(t_us), DAT_EVENT)
    events["t"] = t_us
    events["address"] = (p > 0).astype(np.int64) << 28 | y << 14 | x
    header = _header(
        "Data file containing CD events",
        "Version 2",
        f"Width {stream.width_px}",
        f"Height {stream.height_px}",
        *([f"T0 {t0_us}"] if t0_us else []),
    )
    path.write_bytes(header + bytes((DAT_TYPES[-1], DAT_EVENT.itemsize)) + events.tobytes())


def parse_header(path, data):
    """(fields, start): the values by keyword, and where the binary part of ``data`` starts.

    Raises: FileFormatError for a header without an end, not ASCII, or with a keyword said twice in
      two ways.
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
        line = data[start + 2 : stop]
        if not line.isascii():
            raise FileFormatError(
                f"{path}: the header line at byte {start} is not ASCII text; the file is damaged."
            )
        start = stop + 1
        key, _, value = line.decode("ascii").strip().partition(" ")
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
    digits = text.removeprefix("-")
    if (
        not (digits.isascii() and digits.isdigit())
        or len(digits) > 19
        or not low <= int(text) <= high
    ):
        raise FileFormatError(
            f"{path}: the header gives {name} as {text[:40]!r}; a whole number from {low} to {high} is "
            "needed."
        )
    return int(text)


def start_us(path, fields):
    """Time at which the clock of a file starts, which its words do not count: the header's ``t0``,
    or 0.

    Raises: FileFormatError when it is no whole number from 0 to 2^62, or said twice in two ways.
    """
    said = {fields[key] for key in START_KEYS if key in fields}
    if len(said) > 1:
        raise FileFormatError(
            f"{path}: the header gives the start time as {' and as '.join(sorted(said))}; keep the right one."
        )
    return whole_number(path, said.pop(), "the start time (t0)", 0, 2**62) if said else 0


def _checked_start_us(t0_us):
    """``t0_us`` as a header can hold it."""
    if isinstance(t0_us, bool) or not isinstance(t0_us, int) or not 0 <= t0_us <= 2**62:
        raise FileFormatError(
            f"t0_us is {t0_us!r}; a whole number of microseconds from 0 to 2^62 is needed."
        )
    return t0_us


def _header(*lines):
    return "".join(f"% {line}\n" for line in lines).encode("ascii")


def _whole(path, data, start, kind, what):
    """The rest of a file as words or events, none of which was cut."""
    if (len(data) - start) % kind.itemsize:
        raise FileFormatError(
            f"{path} ends amid {what} of {kind.itemsize} bytes; it was cut, copy it again."
        )
    return np.frombuffer(data, kind, offset=start)


def _format(path, fields):
    """(2 or 3, options) from ``% evt 3.0`` and ``% format EVT3;height=720;width=1280``."""
    name, *rest = fields.get("format", "").split(";")
    options = dict(part.partition("=")[::2] for part in rest)
    said = {fields["evt"]} if "evt" in fields else set()
    said |= (
        {f"{name[3:]}.0" if name.startswith("EVT") and name[3:].isdigit() else name}
        if name
        else set()
    )
    if len(said) != 1 or not said <= {"2.0", "3.0"}:
        raise FileFormatError(
            f"{path}: the header gives the encoding {sorted(said) or 'nowhere'}; EVT 2.0 and EVT 3.0 are "
            "read."
        )
    endianness = fields.get("endianness", options.get("endianness", "little"))
    if endianness != "little":
        raise FileFormatError(
            f"{path}: the header says the words are {endianness!r}-endian; little-endian is read."
        )
    return int(float(said.pop())), options


def _raw_size(path, fields, options):
    """(height_px, width_px) of the header, or None."""
    sizes = set()
    if "geometry" in fields:
        match = GEOMETRY.fullmatch(fields["geometry"])
        if match is None:
            raise FileFormatError(
                f"{path}: the header gives the geometry as {fields['geometry'][:40]!r}; WIDTHxHEIGHT is "
                "needed."
            )
        sizes.add((match[2], match[1]))
    if "height" in options or "width" in options:
        sizes.add((options.get("height", ""), options.get("width", "")))
    sizes = {
        (
            whole_number(path, height, "the height", 1, RAW_SIDE_PX),
            whole_number(path, width, "the width", 1, RAW_SIDE_PX),
        )
        for height, width in sizes
    }
    if len(sizes) > 1:
        raise FileFormatError(
            f"{path}: the header gives two sensor sizes, {sorted(sizes)}; keep the right one."
        )
    return sizes.pop() if sizes else None
