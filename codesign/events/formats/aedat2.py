"""AEDAT 2.0 as jAER reads it for DAVIS cameras, written only: '#' lines, then big-endian pairs of 32-bit
address and 32-bit microseconds.

Bits of the address: 22 to 30 the row, counted from the bottom; 12 to 21 the column, counted from the right;
11 the polarity; 31 (frame sample) and 10 (external) are zero for an event of a pixel.
Source: iniVation documentation, "AEDAT file formats", AEDAT 2.0; jAER, DavisBaseCamera (mirrored columns);
  v2e, aedat2_output.
"""

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats.arrival import columns

CHIPS = {(260, 346): "DAVIS346", (180, 240): "DAVIS240C"}
EXTERNAL = 1 << 10
HEADER = (
    "#!AER-DAT2.0\r\n# Data format is int32 address, int32 timestamp (8 bytes total), repeated for each "
    "event\r\n# Timestamps tick is 1 us\r\n# AEChip: {}\r\n#End Of ASCII Header\r\n"
)


def write_aedat2(path, stream):
    """Write events to ``path``.

    Where the first event would begin with the byte of '#', which readers take for one more header line, an
    external record at the same time (bit 10 set; no event of a pixel) goes ahead of it.
    Raises: FileFormatError for other sensors than 346 x 260 and 240 x 180, and for times outside 0 to 2^31 -
      1 us.
    """
    chip = CHIPS.get((stream.height_px, stream.width_px))
    if chip is None:
        sizes = " and ".join(f"{width} x {height}" for height, width in CHIPS)
        raise FileFormatError(
            f"AEDAT 2.0 is written for DAVIS sensors of {sizes} pixels, not {stream.width_px} x "
            f"{stream.height_px}."
        )
    height_px = stream.height_px
    width_px = stream.width_px
    t_us, x, y, p = columns(stream, "AEDAT 2.0", 2**15, 0, 2**31 - 1)
    records = np.stack(
        ((height_px - 1 - y) << 22 | (width_px - 1 - x) << 12 | (p > 0).astype(np.int64) << 11, t_us), axis=1
    )
    if len(records) and records[0, 0] >> 24 == ord("#"):
        records = np.concatenate(([[EXTERNAL, t_us[0]]], records))
    path.write_bytes(HEADER.format(chip).encode("ascii") + records.astype(">i4").tobytes())


def read_aedat2(path, _):
    """Refuse: addresses depend on the camera, and the header does not reliably name it."""
    raise FileFormatError(
        f"{path}: AEDAT 2.0 is written, not read; convert the recording to .aedat4 or .raw."
    )
