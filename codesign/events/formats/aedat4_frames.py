"""The frames that DAVIS cameras record beside the events, from AEDAT 4.0 files.

Source: iniVation documentation, "AEDAT file formats", AEDAT 4.0; FlatBuffers schema ``frame`` of
  dv-processing.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign.errors import FileFormatError
from codesign.events.entry import check_path
from codesign.events.formats import flatbuffer
from codesign.events.formats.aedat4_container import read_container
from codesign.reading import check_regular

# places in the schema
TIMESTAMP = 0
EXPOSURE_START = 3
EXPOSURE_END = 4
FORMAT = 5
WIDTH = 6
HEIGHT = 7
LEFT = 8
TOP = 9
PIXELS = 10
EXPOSURE = 11
GRAY = 0


@dataclass(frozen=True)
class RecordedFrames:
    """Grey frames of a camera, on the clock of its events.

    frames: [T, H, W] uint8. exposure_start_us, exposure_end_us: [T] int64 microseconds.
    """

    frames: Tensor
    exposure_start_us: Tensor
    exposure_end_us: Tensor


def read_frames(path: str | Path) -> RecordedFrames:
    """Read the frames of an AEDAT 4.0 file.

    Args: path: file ending in .aedat4.
    Returns: RecordedFrames.
    Raises: FileFormatError when the file is missing, damaged, cut short, without a single stream of frames,
      or has frames in colour or of several sizes.
    """
    path = check_regular(check_path(path))
    packets, size, _ = read_container(path, "FRME")
    if not packets:
        raise FileFormatError(f"{path} holds no frame.")
    tables = [flatbuffer.root(path, packet.body, b"FRME") for packet in packets]
    frames = []
    times_us = []
    for table in tables:
        height_px = table.scalar(HEIGHT, "<h")
        width_px = table.scalar(WIDTH, "<h")
        pixels = table.array(PIXELS, "u1")
        if table.scalar(FORMAT, "<b") != GRAY:
            raise FileFormatError(
                f"{path}: frame {len(frames)} has pixel format {table.scalar(FORMAT, '<b')}; 0 (8-bit grey) "
                "is read."
            )
        if height_px < 1 or width_px < 1 or pixels.size != height_px * width_px:
            raise FileFormatError(
                f"{path}: frame {len(frames)} has {pixels.size} values for {width_px} x {height_px} pixels; "
                "the file is damaged."
            )
        if (height_px, width_px) != (size or (height_px, width_px)) or (
            table.scalar(LEFT, "<h"),
            table.scalar(TOP, "<h"),
        ) != (0, 0):
            raise FileFormatError(
                f"{path}: frame {len(frames)} shows {width_px} x {height_px} pixels, a part of the sensor; "
                "whole frames are read."
            )
        size = height_px, width_px
        frames.append(pixels.reshape(size))
        times_us.append(_exposure_us(table))
    start_us, end_us = torch.tensor(times_us, dtype=torch.int64).unbind(1)
    if bool((end_us < start_us).any()):
        raise FileFormatError(
            f"{path}: frame {int((end_us < start_us).nonzero()[0])} ends its exposure before it starts; the "
            "file is damaged."
        )
    return RecordedFrames(torch.from_numpy(np.stack(frames)), start_us, end_us)


def _exposure_us(table):
    """Start and end of exposure; recorders since dv-processing 1.2 give the start as the time of the frame,
    and a duration."""
    start_us = table.scalar(EXPOSURE_START, "<q")
    end_us = table.scalar(EXPOSURE_END, "<q")
    if start_us or end_us:
        return start_us, end_us
    return table.scalar(TIMESTAMP, "<q"), table.scalar(TIMESTAMP, "<q") + table.scalar(EXPOSURE, "<q")
