"""Video to a higher frame rate, so that events see motion and not jumps: frames between frames along their
optical flow."""

import math
from collections.abc import Iterable, Iterator
from itertools import zip_longest
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, as_number
from codesign.events.entry import (
    Times,
    check_frames,
    check_layout,
    check_positive,
    check_times,
    check_whole,
    shown,
)
from codesign.events.intensity import lin_log
from codesign.events.upsampling.between import between, visibility
from codesign.events.upsampling.flow import flow_both_ways, flow_levels
from codesign.events.upsampling.hidden import repaired
from codesign.events.upsampling.steps import largest, largest_change, shares, step_times, steps_for

MAX_STEPS = 256


def upsample(
    frames: Tensor,
    t_s: Times,
    *,
    max_displacement_px: float = 1.0,
    max_log_change: float | None = None,
    max_steps: int = MAX_STEPS,
) -> tuple[Tensor, Tensor]:
    """Put frames between the frames of a video until nothing moves further than a bound from one to the next.

    Frames are taken as instantaneous: blur of an exposure is moved along and not undone. Motion is straight
    and even between two frames, and light changes evenly along it. Each interval gets as many steps as its
    own motion asks for.

    Args:
      frames: [T, H, W] linear intensity on the 0-255 scale, finite, >= 0.
      t_s: [T] frame times, seconds, strictly increasing.
      max_displacement_px: how far 99.9 % of the pixels move at most per step, by the flow found, > 0.
      max_log_change: how far the lin-log level of 99.9 % of the pixels moves at most per step, natural log
        units, > 0; None: not asked.
      max_steps: most steps per interval that may be needed.
    Returns: frames [T', H, W] and times [T'] float64, the given ones among them exactly. Where two frames are
      equal, nothing is put between.
    Gradient: frames, for the flow, visibility and number of steps found, which are held fixed; none to times.
    Raises: ShapeError for fewer than two frames or other shapes; DomainError for NaN, infinite or negative
      frames, times that do not increase, bounds that are not positive, or an interval that needs more than
      max_steps.
    Source: Gehrig et al., Video to Events, CVPR 2020 (upsampling before event generation); Rebecq et al.,
      ESIM, CoRL 2018 (both bounds).
    """
    check_frames(frames)
    if frames.ndim != 3:
        raise ShapeError(f"frames have shape {list(frames.shape)}; [T, H, W] is needed.")
    pieces = list(
        upsample_stream(
            frames,
            check_times(t_s, len(frames)),
            max_displacement_px=max_displacement_px,
            max_log_change=max_log_change,
            max_steps=max_steps,
        )
    )
    return torch.cat([piece for piece, _ in pieces]), torch.cat([times_s for _, times_s in pieces])


def upsample_stream(
    frames: Iterable[Tensor],
    t_s: Iterable[Any],
    *,
    max_displacement_px: float = 1.0,
    max_log_change: float | None = None,
    max_steps: int = MAX_STEPS,
) -> Iterator[tuple[Tensor, Tensor]]:
    """``upsample`` of frames that come one after the other, in the memory of one interval.

    Args: frames: anything that yields frames [H, W]. t_s: anything that yields as many times. The rest as for
      ``upsample``.
    Returns: iterator over (frames [n, H, W], times [n] float64): first the first frame alone, then for each
      later frame those that lead to it, and itself. Joined they are what ``upsample`` gives, bit for bit.
    Raises: as ``upsample``; bounds at once, frames and times when they come.
    """
    max_displacement_px = check_positive(max_displacement_px, "max_displacement_px")
    if max_log_change is not None:
        max_log_change = check_positive(max_log_change, "max_log_change")
    max_steps = check_whole(max_steps, "max_steps", 1)
    for name, given in (("frames", frames), ("t_s", t_s)):
        if not isinstance(given, Iterable):
            raise DomainError(f"{name} are {shown(given)}; something that yields them one by one is needed.")
    return _pieces(frames, t_s, max_displacement_px, max_log_change, max_steps)


def _pieces(frames, t_s, max_displacement_px, max_log_change, max_steps):
    before = None
    before_s = -math.inf
    for index, (frame, time_s) in enumerate(zip_longest(frames, t_s)):
        if frame is None or time_s is None:
            raise ShapeError(f"there is no {'frame' if frame is None else 'time'} {index}; give one of each.")
        check_layout(frame, 0, name=f"frame {index}")
        check_frames(frame[None], 1, name=f"frame {index}")
        time_s = as_number(time_s, f"the time of frame {index}")
        if frame.ndim != 2 or (
            before is not None and (frame.shape != before.shape or frame.dtype != before.dtype)
        ):
            raise ShapeError(
                f"frame {index} is {frame.dtype} {list(frame.shape)}; all frames are [H, W] of one size and "
                "type."
            )
        if not before_s < time_s < math.inf:
            raise DomainError(
                f"frame {index} is at {time_s!r} s, the one before at {before_s!r} s; times must be finite "
                "and increase strictly."
            )
        if before is None:
            yield frame[None], torch.tensor([time_s], dtype=torch.float64)
        else:
            made = _interval(before, frame, before_s, time_s, max_displacement_px, max_log_change, max_steps)
            yield made, step_times(before_s, time_s, len(made))
        before = frame
        before_s = time_s


def _interval(first, second, start_s, end_s, max_displacement_px, max_log_change, max_steps):
    """Frames that lead from the first to the second, the second among them."""
    flows = flow_both_ways(first.detach().float(), second.detach().float()).to(first)
    flows = repaired(flow_levels(first, second), flows, visibility(flows))
    seen = visibility(flows)
    count = steps_for(
        largest(flows.norm(dim=1)),
        max_displacement_px,
        max_steps,
        "the place of things, in pixels,",
        start_s,
        end_s,
    )
    while True:
        made = torch.stack([*(between(first, second, flows, seen, share) for share in shares(count)), second])
        if max_log_change is None:
            return made
        # at least one step more each time, for the change of a step need not shrink with its length
        change = largest_change(lin_log(torch.cat((first[None], made)).detach()))
        if change <= max_log_change:
            return made
        count = max(
            count + 1, steps_for(change * count, max_log_change, max_steps, "the log level", start_s, end_s)
        )
