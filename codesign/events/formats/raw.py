"""Prophesee RAW files: an ASCII header, then EVT 2.0 or EVT 3.0 words, little-endian.

Times are those of the file, plus the start time ``% t0`` that faery and we write where asked to. Times beyond
the first loop of the clock are told in EVT 3.0 by time words, which every reader counts; EVT 2.0's readers
disagree, so its times end with the first loop.
Source: Prophesee Metavision documentation, "RAW File Format"; faery (``t0``).
"""

import re
import warnings

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats import evt2, evt3
from codesign.events.formats.arrival import arranged, columns
from codesign.events.formats.prophesee import checked_start_us, parse_header, start_us, whole_number

ENCODINGS = {2: evt2, 3: evt3}
SIDE_PX = 2048  # 11 bits
GEOMETRY = re.compile(r"(\d{1,5})x(\d{1,5})")


def read_raw(path, asked):
    """EventColumns of ``path``.

    Events before the first word that gives a time or row are left out with a warning: recordings may start
    amid the camera's words.
    Raises: FileFormatError for another encoding, a damaged header or word, a file cut amid a word, or time
      going back (see arrival).
    """
    data = path.read_bytes()
    fields, start = parse_header(path, data)
    version, options = _format(path, fields)
    encoding = ENCODINGS[version]
    if (len(data) - start) % encoding.WORD.itemsize:
        raise FileFormatError(
            f"{path} ends amid a word of {encoding.WORD.itemsize} bytes; it was cut, copy it again."
        )
    t_us, x, y, p, lost = encoding.decoded(path, np.frombuffer(data, encoding.WORD, offset=start))
    if lost:
        warnings.warn(
            f"{path}: {lost} events before the first time, row or column base are left out; the file "
            "starts amid the camera's words.",
            stacklevel=2,
        )
    t_us += start_us(path, fields)
    return arranged(path, asked, t_us, x, y, p, size=_size(path, fields, options))


def write_raw(path, stream, *, evt=3, t0_us=0):
    """Write events to ``path`` as EVT 3.0 or (evt=2) EVT 2.0, their times less ``t0_us``, which the header
    tells.

    Raises: FileFormatError for a sensor beyond 2048 x 2048, another ``evt``, or times (less t0_us) below 0 or
      beyond 2^44 us (EVT 2.0: 2^34 us).
    """
    if not isinstance(evt, int) or evt not in ENCODINGS:
        raise FileFormatError(f"evt={evt!r} was given; 2 (EVT 2.0) and 3 (EVT 3.0) are written.")
    encoding = ENCODINGS[evt]
    t_us, x, y, p = columns(
        stream, f"EVT {evt}.0", SIDE_PX, 0, encoding.LIMIT_US - 1, checked_start_us(t0_us)
    )
    height_px = stream.height_px
    width_px = stream.width_px
    lines = (
        f"evt {evt}.0",
        f"format EVT{evt};height={height_px};width={width_px}",
        f"geometry {width_px}x{height_px}",
        *([f"t0 {t0_us}"] if t0_us else []),
        "end",
    )
    header = "".join(f"% {line}\n" for line in lines)
    path.write_bytes(header.encode("ascii") + encoding.encoded(t_us, x, y, p).tobytes())


def _format(path, fields):
    """(2 or 3, options) from ``% evt 3.0`` and ``% format EVT3;height=720;width=1280``."""
    name, *rest = fields.get("format", "").split(";")
    options = dict(part.partition("=")[::2] for part in rest)
    said = {fields["evt"]} if "evt" in fields else set()
    said |= {f"{name[3:]}.0" if name.startswith("EVT") and name[3:].isdigit() else name} if name else set()
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


def _size(path, fields, options):
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
        tuple(
            whole_number(path, text, name, 1, SIDE_PX)
            for text, name in zip(size, ("the height", "the width"), strict=True)
        )
        for size in sizes
    }
    if len(sizes) > 1:
        raise FileFormatError(
            f"{path}: the header gives two sensor sizes, {sorted(sizes)}; keep the right one."
        )
    return sizes.pop() if sizes else None
