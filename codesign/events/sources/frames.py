"""Frames to make events of, whatever they come from: read in order, piece by piece."""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign.errors import FileFormatError

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")


@dataclass(frozen=True)
class FrameSource:
    """Frames that can be read in order, from any of them on.

    path: where they come from. count: number of frames. height_px, width_px: their size.
    white: digital value of full scale: 255, 65535, that of the camera for .mraw, or 255 for
      floating-point stacks, which are taken to be on the 0-255 scale.
    t_s: [count] float64 times since the first frame, seconds, as the container or the file has
      them; None where it has none.
    clock: where t_s comes from, for people.
    read: function from the index of a frame to an iterator over it and all later ones: [H, W] or
      [H, W, 3] (red, green, blue), as stored.
    complaint: what the decoder found wrong with the file, empty when nothing.
    """

    path: Path
    count: int
    height_px: int
    width_px: int
    white: float
    t_s: Tensor | None
    clock: str
    read: Callable[[int], Generator[np.ndarray, None, None]]
    complaint: str = ""


def same_size(frames, path, shape, count):
    """Pass frames on while they have one shape. Raises: FileFormatError naming the first that
    differs, or the number of frames that are missing."""
    index = -1
    for index, frame in frames:
        if frame.shape != shape:
            raise FileFormatError(
                f"frame {index} of {path} is {_size(frame.shape)}, the first is {_size(shape)}; all frames "
                "must have one size and kind."
            )
        yield frame
    if index + 1 < count:
        raise FileFormatError(
            f"{path} ends after frame {index + 1} of {count}; the file is damaged: use a whole copy, or "
            "stop earlier."
        )


def times_from_fps(count, fps):
    """[count] float64 seconds of frames at an even rate, frame 0 at 0."""
    return torch.arange(count, dtype=torch.float64) / fps


def _size(shape):
    return f"{shape[1]} x {shape[0]} pixels{' in colour' if len(shape) == 3 else ''}"
