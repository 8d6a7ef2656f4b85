"""When every frame was seen: by the container, a frame rate, or a list of times."""

from decimal import Decimal, InvalidOperation

import torch

from codesign.errors import DomainError, FileFormatError
from codesign.events.entry import check_times
from codesign.events.sources.frames import times_from_fps
from codesign.reading import read_text

UNITS_PER_SECOND = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}


def frame_times(config, source, most=None):
    """Times of all frames and which of them are used.

    Args: config: the options of the study. source: FrameSource. most: use no more frames than that.
    Returns: t_s [count] float64 seconds, index of the first frame used and of the one behind the last, and a
      sentence about the clock.
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
        t_s = times_from_fps(source.count, config.fps)
        clock = f"{config.fps:g} frames per second, as asked"
    elif source.t_s is not None:
        t_s = source.t_s
        clock = source.clock
    else:
        raise DomainError(
            f"{source.path} does not say when its frames were seen; give their rate with --fps, or their "
            "times with --timestamps."
        )
    t_s = check_times(t_s, source.count)
    if config.slow_motion != 1:
        t_s = t_s[0] + (t_s - t_s[0]) / config.slow_motion
        clock = f"{clock}; plays {config.slow_motion:g} times slower than life"
    if bool(((t_s * 1e6).round().diff() < 1).any()):
        raise DomainError(
            f"two frames lie {float(t_s.diff().min()) * 1e6:.3g} us apart; events are counted in "
            "microseconds, so frames must be one or more apart."
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
            f"{float(t_s[0]):g} to {float(t_s[-1]):g} s, and two are needed."
        )
    return t_s, int(kept[0]), int(kept[-1]) + 1, clock


def read_times(path, unit, count):
    """[count] float64 seconds from a text file of one number per line; empty lines and lines that begin with
    # are left out.

    Numbers are read as decimals, so whole microseconds and nanoseconds of epoch times become the nearest
    float.
    """
    lines = read_text(path).splitlines()
    times = []
    for number, line in enumerate(lines, start=1):
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
