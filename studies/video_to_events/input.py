"""What the sensor sees of an input, and when: times of the frames, and light from digital
values."""

from decimal import Decimal, InvalidOperation

import numpy as np
import torch
from torch.nn.functional import interpolate

from codesign import events
from codesign.errors import DomainError, FileFormatError
from codesign.reading import read_text

UNITS_PER_SECOND = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}
LUMINANCE = (0.2126, 0.7152, 0.0722)  # red, green, blue: ITU-R BT.709, for linear light


def frame_times(config, source, most=None):
    """Times of all frames and which of them are used.

    Args:
      config: the options of the study.
      source: FrameSource.
      most: use no more frames than that.
    Returns: t_s [count] float64 seconds, index of the first frame used and of the one behind the
      last, and a sentence about the clock.
    Raises: DomainError when there are no times, two kinds of them, times that do not increase by a
      microsecond or more, or fewer than two frames left.
    """
    if config.timestamps is not None and config.fps is not None:
        raise DomainError(
            "--timestamps and --fps are both given; give the one that says when the frames were seen."
        )
    if config.timestamps is not None:
        t_s = read_times(config.timestamps, config.timestamp_unit, source.count)
        clock = f"times of {config.timestamps.name}"
    elif config.fps is not None:
        t_s = torch.arange(source.count, dtype=torch.float64) / config.fps
        clock = f"{config.fps:g} frames per second, as asked"
    elif source.t_s is not None:
        t_s = source.t_s
        clock = source.clock
    else:
        raise DomainError(
            f"{source.path} does not say when its frames were seen; give their rate with --fps, or their "
            "times with --timestamps."
        )
    if config.slow_motion != 1:
        t_s = t_s[0] + (t_s - t_s[0]) / config.slow_motion
        clock = f"{clock}; plays {config.slow_motion:g} times slower than life"
    if not (t_s.isfinite().all() & ((t_s * 1e6).round().diff() >= 1).all()):
        raise DomainError(
            f"two frames lie {t_s.diff().min() * 1e6:.3g} us apart; times must be finite and increase "
            "strictly, by a microsecond or more, in which events are counted."
        )
    used = torch.ones(source.count, dtype=torch.bool)
    if config.start_s is not None:
        used &= t_s >= config.start_s
    if config.stop_s is not None:
        used &= t_s <= config.stop_s
    kept = used.nonzero().flatten()[:most]
    if len(kept) < 2:
        raise DomainError(
            f"{len(kept)} frame(s) lie between --start-s and --stop-s; the input has {source.count}, from "
            f"{t_s[0]:g} to {t_s[-1]:g} s, and two are needed."
        )
    return t_s, int(kept[0]), int(kept[-1]) + 1, clock


def read_times(path, unit, count):
    """[count] float64 seconds from a text file of one number per line; empty lines and lines that
    begin with # are left out.

    Numbers are read as decimals, so whole microseconds and nanoseconds of epoch times become the
    nearest float.
    """
    times = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        text = line.strip()
        if text and not text.startswith("#"):
            try:
                times.append(float(Decimal(text) / UNITS_PER_SECOND[unit]))
            except InvalidOperation:
                raise FileFormatError(
                    f"{path}, line {number}: {text[:60]!r} is not a number; one time per line is needed."
                ) from None
    if len(times) != count:
        raise DomainError(
            f"{path} holds {len(times)} times, the input {count} frames; one time per frame is needed."
        )
    return torch.tensor(times, dtype=torch.float64)


class Light:
    """Turns frames as stored into intensity on the 0-255 scale.

    white: digital value that becomes 255.
    linear: undo the sRGB gamma (IEC 61966-2-1) first; else values are taken as they are.
    size: (width, height) of the sensor, or None for that of the frames.
    device: where the result lies.
    """

    def __init__(self, white, linear, size=None, device: torch.device | str = "cpu"):
        self.white = float(white)
        self.linear = linear
        self.size = size
        self.device = device
        self.largest = 0.0  # digital value seen so far
        self.tables = {}

    def __call__(self, frames, first):
        """Intensity [N, H, W] float32 of ``frames``, a list of [H, W] or [H, W, 3] arrays, the
        first of which has number ``first``.

        Red, green and blue are weighted as in BT.709, after the gamma is undone where that is asked
        for. A new size is reached by bilinear interpolation that averages all pixels it covers, on
        intensities.
        Raises: DomainError naming the frame that holds NaN, infinity or a negative value.
        """
        values = np.stack(frames)
        if values.dtype.kind == "f" and (bad := ~np.isfinite(values) | (values < 0)).any():
            index = tuple(int(axis[0]) for axis in bad.nonzero())
            raise DomainError(
                f"frame {first + index[0]} holds {values[index]} at row {index[1]}, column {index[2]}; "
                "intensities are finite and 0 or more: repair the input."
            )
        self.largest = max(self.largest, float(values.max()))
        light = torch.from_numpy(self._curve(values)).to(self.device)
        if light.ndim == 4:
            light = light @ torch.tensor(LUMINANCE, device=light.device)
        if self.size is not None and self.size != (light.shape[2], light.shape[1]):
            size = self.size[::-1]
            light = interpolate(
                light[:, None], size, mode="bilinear", antialias=True, align_corners=False
            )
            light = light[:, 0].clamp_(min=0)
        return light

    def _curve(self, values):
        if values.dtype.kind == "u":  # every digital value is worked out once
            if values.dtype not in self.tables:
                every = np.arange(np.iinfo(values.dtype).max + 1, dtype=np.float64)
                self.tables[values.dtype] = self._intensity(every)
            return self.tables[values.dtype][values]
        return self._intensity(values.astype(np.float64))

    def _intensity(self, values):
        share = values / self.white
        if self.linear:
            share = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        return (255 * share).astype(np.float32)


def pieces(max_displacement_px, before, before_s, seen, t_s):
    """What the sensor sees of a chunk: frames [n, H, W] and their times, piece by piece, with
    frames between in the memory of one interval. The pieces of all chunks together do not depend on
    where the chunks begin.

    Args:
      max_displacement_px: see ``events.upsample``; None: the frames as they are, in one piece.
      before, before_s: last frame [H, W] of the chunk before and its time; None for the first
        chunk.
      seen: [N, H, W] frames of the chunk.
      t_s: [N] seconds.
    """
    if max_displacement_px is None:
        yield seen, t_s
        return
    given = [*seen] if before is None else [before.to(seen), *seen]
    times = t_s.tolist() if before is None else [before_s, *t_s.tolist()]
    made = events.upsample_stream(given, times, max_displacement_px=max_displacement_px)
    first, first_s = next(made)
    for frames, times_s in made:
        if before is None:  # a sensor wants two frames at first
            frames, times_s, before = (
                torch.cat((first, frames)),
                torch.cat((first_s, times_s)),
                first,
            )
        yield frames, times_s
