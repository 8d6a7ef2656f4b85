"""Pictures in linear light, .hdr (Radiance RGBE) and .exr, read so that damaged bytes end in a
sentence.

Source: Ward, Real Pixels, Graphics Gems II, 1991; the run lengths as Radiance's color.c has them.
"""

import io
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from codesign.reading import check_regular, check_room, read_bytes, reading

MOST_BYTES = 1 << 30
LONGEST_S = 120.0
# run by a process of its own: a library in C++ that meets damaged bytes may end the process that it
# runs in
APART = """import sys, numpy, drjit, mitsuba
drjit.set_thread_count(max(2, drjit.thread_count()))  # one alone waits for another to read OpenEXR
mitsuba.set_variant("scalar_rgb")
rgb, number = mitsuba.Bitmap.PixelFormat.RGB, mitsuba.Struct.Type.Float32
numpy.save(sys.stdout.buffer, numpy.array(mitsuba.Bitmap(sys.argv[1]).convert(rgb, number, False)))"""


def read(path: str | Path) -> np.ndarray:
    """Values [H, W, C] float64 of an .hdr or .exr picture, in the units of its file.

    Raises: FileFormatError for a file that is missing or damaged, an .hdr in XYZ or one that does
      not begin at the top left.
    """
    if Path(path).suffix.lower() == ".hdr":
        return radiance(path)
    check_regular(path, MOST_BYTES)
    with reading(path, "it is no whole OpenEXR picture; convert it to .hdr or PNG"):
        done = subprocess.run(
            [sys.executable, "-c", APART, str(path)],
            capture_output=True,
            timeout=LONGEST_S,
            check=False,
        )
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise ValueError(
                said[-1] if done.returncode > 0 and said else "its reader ended without a word"
            )
        return np.load(io.BytesIO(done.stdout)).astype(np.float64)


def radiance(path: str | Path) -> np.ndarray:
    """As ``read``, of an RGBE picture whatever its name ends in."""
    data = read_bytes(path, MOST_BYTES)
    head = re.match(rb"#\?[^\n]*\n(?:[^\n]+\n)*\n-Y (\d{1,6}) \+X (\d{1,6})\n", data[:65536])
    with reading(path):
        if head is None or b"32-bit_rle_xyze" in head[0]:
            raise ValueError("its header does not say RGBE from the top left")
        height, width = int(head[1]), int(head[2])
        if not height * width:
            raise ValueError(f"it has {width} x {height} pixels")
        check_room(path, (height, width, 4), 4)
        rgbe = _pixels(data, head.end(), height, width)
    # in float64 no exponent of 8 bits overflows; in float32 127 does
    values = np.ldexp(rgbe[..., :3].astype(np.float64), rgbe[..., 3:].astype(np.int64) - 136)
    return np.where(rgbe[..., 3:] > 0, values, 0)


def _pixels(data, at, height, width):
    """RGBE [H, W, 4] uint8 of the bytes from ``at``. Raises: IndexError, ValueError where they do
    not suffice."""
    out = np.empty((height, width, 4), dtype=np.uint8)
    for row in range(height):
        if 8 <= width < 32768 and data[at : at + 2] == b"\2\2" and data[at + 2] < 128:
            if int.from_bytes(data[at + 2 : at + 4], "big") != width:
                raise ValueError(f"row {row} says another width than the header")
            at += 4
            for channel in range(4):
                line, at = _line(data, at, width)
                out[row, :, channel] = line
        else:
            whole = np.frombuffer(data[at : at + 4 * width], np.uint8).reshape(width, 4)
            if (whole[:, :3] == 1).all(1).any():
                raise ValueError("it has run lengths of the older kind; save it anew")
            out[row] = whole
            at += 4 * width
    return out


def _line(data, at, width):
    """One channel of a row in runs, and where the next begins."""
    line = bytearray()
    while len(line) < width:
        count = data[at]
        line += (
            data[at + 1 : at + 2] * (count - 128) if count > 128 else data[at + 1 : at + 1 + count]
        )
        at += 2 if count > 128 else 1 + count
        if not count or at > len(data):
            raise ValueError("its runs end early")
    if len(line) > width:
        raise ValueError("a run is longer than its row")
    return np.frombuffer(line, np.uint8), at
