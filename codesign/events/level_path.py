"""The log level between frames: a cubic through the levels of the frames, sampled as finely as a
use asks for.

Frames of a moving scene are samples of smooth curves. A straight line between them, h apart, is
wrong by h^2
|L''|/8: it cuts off every crest, and with it events. The cubic through central slopes is wrong by h^3
|L'''|/62.
"""

import math

import torch
from torch import Tensor

from codesign.checks import FLOATS, check, check_positive
from codesign.events.entry import Times, check_room, check_times
from codesign.events.intensity import FrontEnd, log_levels

# of a part: what rounding of times (float32, or seconds since 1970) adds makes no part more
ROUNDING = 1e-3


def finer(
    frames: Tensor,
    t_s: Times,
    longest_s: float,
    *,
    log_input: bool = False,
) -> tuple[Tensor, Tensor]:
    """Frames between frames, so that no interval is longer than asked for.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale, or log levels with ``log_input``. t_s:
        [T] seconds, strictly increasing. longest_s: > 0; an interval longer than that by more than
        a thousandth is cut into equal parts.
    Returns: frames [T', ...] of the same kind and times [T'] float64, the given ones among them
      exactly; the given frames themselves where no interval is too long. Between two frames the log
      level is the cubic with the slopes of parabolas through three frames each: a parabola is met
      exactly, and where the four frames around are equal nothing moves. A step within one interval
      rings by 7 % of it in the intervals beside. Linear frames are never below 0.
    Gradient: frames, exact; none to times.
    Raises: ShapeError, DomainError for frames and times as ``memory``, and for a length that is not
      positive.
    Source: Catmull and Rom 1974, for uneven times. Slopes limited so that nothing rings (Fritsch
      and Carlson, SIAM J. Numer. Anal. 1980) flatten the crests, and steer worse than straight
      lines.

    Example:
    >>> level = torch.tensor([0.0, 1.0, 0.0]).reshape(3, 1)
    >>> found, times_s = finer(level, [0.0, 1.0, 2.0], 0.5, log_input=True)
    >>> times_s.tolist(), found.flatten().tolist()  # the parabola through three frames
    ([0.0, 0.5, 1.0, 1.5, 2.0], [0.0, 0.75, 1.0, 0.75, 0.0])
    """
    check(frames, "T>=2 ...", "frames", FLOATS)
    given_s = check_times(t_s, len(frames))
    interval, share, times_s = parts(given_s, longest_s, max(frames[0].numel(), len(frames)))
    if len(times_s) == len(frames):
        return frames, given_s
    level = log_levels(frames, log_input, minimum=2)
    inner = share < 1
    made = FrontEnd(log_input).frames(_cubic(level, given_s.diff(), interval[inner], share[inner]))
    # the given frames first, then those made: where each of the whole lies
    place = torch.where(inner, len(frames) - 1 + inner.cumsum(0), interval + 1)
    place = torch.cat((place.new_zeros(1), place)).to(level.device)
    return torch.cat((frames, made)).index_select(0, place), times_s


def parts(times_s: Tensor, longest_s: float, values: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Intervals cut into equal parts no longer than asked for.

    Args:
      times_s: [T] float64, strictly increasing, as from ``check_times``.
      longest_s: > 0.
      values: that will be made of each part.
    Returns: of each of the K parts the interval it lies in [K] and the share of it [K] at which it
      ends; times [K + 1] float64 of all ends, the given ones among them exactly.
    Raises: DomainError for a length that is not positive, or so short that the parts would fill the
      memory.
    """
    longest = longest_s if longest_s == math.inf else check_positive(longest_s, "longest_s")
    duration_s = times_s.diff()
    count = (duration_s / longest - ROUNDING).ceil().clamp(min=1)
    check_room(float(count.sum()) * values, f"intervals of at most {longest:g} s")
    count = count.long()
    interval = torch.repeat_interleave(count)
    first = (count.cumsum(0) - count)[interval]
    share = (torch.arange(1, len(interval) + 1) - first) / count[interval].double()
    return (
        interval,
        share,
        torch.cat((times_s[:1], torch.lerp(times_s[:-1][interval], times_s[1:][interval], share))),
    )


def _cubic(level, duration_s, interval, share):
    """Levels [K, ...] at shares [K] of intervals [K]."""
    rise = level.diff(dim=0)
    slope = _slopes(rise, duration_s)
    # weights of the rises and slopes in every level wanted: few intervals, so a full matrix is
    # cheapest
    row = torch.arange(len(interval))
    of_rise = torch.zeros(len(interval), len(rise), dtype=torch.float64)
    of_slope = torch.zeros(len(interval), len(level), dtype=torch.float64)
    of_rise[row, interval] = share**2 * (3 - 2 * share)
    of_slope[row, interval] = duration_s[interval] * share * (1 - share) ** 2
    of_slope[row, interval + 1] = -duration_s[interval] * share**2 * (1 - share)
    moved = of_rise.to(rise) @ rise.flatten(1) + of_slope.to(slope) @ slope.flatten(1)
    return level.index_select(0, interval.to(level.device)) + moved.reshape(-1, *level.shape[1:])


def _slopes(rise, duration_s):
    """Slopes [T, ...] at the frames, per second."""
    length = duration_s.to(rise).reshape(-1, *[1] * (rise.ndim - 1))
    rate = rise / length
    if len(rate) == 1:
        return rate.expand(2, *rate.shape[1:])
    weight = length[1:] / (length[:-1] + length[1:])
    middle = torch.lerp(rate[1:], rate[:-1], weight)
    return torch.cat((2 * rate[:1] - middle[:1], middle, 2 * rate[-1:] - middle[-1:]))
