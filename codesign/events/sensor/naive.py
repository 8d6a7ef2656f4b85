"""The naive emulator: the difference of consecutive frames against a threshold."""

import torch
from torch import Tensor

from codesign.errors import ShapeError
from codesign.events.entry import Times, check_per_pixel, check_times
from codesign.events.intensity import log_levels
from codesign.events.stream import ordered
from codesign.types import EventStream


@torch.no_grad()
def naive(frames: Tensor, t_s: Times, theta: Tensor | float, *, log_input: bool = False) -> EventStream:
    """At most one event per pixel and frame: ON when dL >= theta, OFF when dL <= -theta between consecutive
    frames.

    What stays below the threshold is forgotten, what exceeds it several times counts once: slow motion goes
    unseen and fast edges lose events.

    Args:
      frames: [T, H, W] linear intensity on the 0-255 scale (lin-log is applied here); log intensity with
        ``log_input``.
      t_s: [T] frame times, seconds, strictly increasing. An event gets the time of the later frame, to the
        nearest microsecond.
      theta: contrast threshold > 0, natural log units, scalar or broadcasting over one frame.
    Returns: EventStream sorted by (t, y, x, p).
    Gradient: none.
    Raises: ShapeError for fewer than two frames or other shapes; DomainError for theta <= 0, NaN, negative
      input or times that do not increase.
    """
    level = log_levels(frames, log_input, minimum=2)
    if level.ndim != 3:
        raise ShapeError(f"frames have shape {list(frames.shape)}; [T, H, W] is needed.")
    theta = check_per_pixel(theta, "theta", level)
    times_us = (check_times(t_s, len(level)) * 1e6).round().long().to(level.device)
    step = level.diff(dim=0)
    polarity = (step >= theta).long() - (step <= -theta).long()
    frame, y, x = polarity.nonzero(as_tuple=True)
    return ordered(times_us[frame + 1], x, y, polarity[frame, y, x], *level.shape[1:])
