"""Time surfaces: how long ago the last event was, per pixel and polarity, as exp(-(t_ref - t_last) / tau); 0
where none was yet.

The gradient of the surface of hard counts is that of its mean over where pixels stand inside their
thresholds. In the mean over places inside a threshold C it is (1/C) times the integral of exp(-age/tau) over
the last C of level
that the pixel went through: later crossings hide what fired more than a threshold before. One hard pixel does
not know where that window ends, but its own last event lies evenly in it and the one before evenly in the
threshold behind, so the mean of the windows that begin at either is right to first order in their length.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.events.entry import Times, check_counts, check_times
from codesign.events.stream import check_stream
from codesign.events.volumes.traces import check_tau, segments
from codesign.types import EventStream

NEVER_US = torch.iinfo(torch.int64).min


def surface_from_stream(
    stream: EventStream, at_us: Tensor | Sequence[int], tau_s: float, *, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Time surface of a stream at given times.

    Args:
      stream: EventStream.
      at_us: [K] reference times, whole microseconds, strictly increasing. Events at a reference time belong
        to it, later ones do not.
      tau_s: time in which the surface fades to 1/e, seconds, > 0.
    Returns: [K, 2, H, W] in 0 to 1, ON first; the difference of times is taken in whole microseconds, so
      epoch times lose nothing.
    Gradient: none (timestamps are integers); ``surface_from_times`` has one.
    Raises: DomainError for reference times that are not whole or do not increase, and for tau.
    Source: Lagorce et al., HOTS, PAMI 2017, eq. 2 and 3.
    """
    tau_s = check_tau(tau_s)
    check_stream(stream)
    height = stream.height_px
    width = stream.width_px
    last_us = torch.full((2 * height * width,), NEVER_US, device=stream.t_us.device)
    surfaces = []
    for time_us, (cell, t_us) in segments(stream, at_us):
        last_us.scatter_reduce_(0, cell, t_us, "amax")
        fired = last_us != NEVER_US
        age_us = torch.where(fired, time_us - torch.where(fired, last_us, time_us), 0)
        surfaces.append(
            torch.where(fired, torch.exp(age_us.to(torch.float64) / (-1e6 * tau_s)), 0.0)
            .to(dtype)
            .reshape(2, height, width)
        )
    return torch.stack(surfaces)


def surface_from_times(
    t_s: Tensor,
    x: Tensor,
    y: Tensor,
    p: Tensor,
    height_px: int,
    width_px: int,
    at_s: Tensor | Sequence[float],
    tau_s: float,
) -> Tensor:
    """Time surface of events whose times are real numbers, such as analytic crossing times.

    Args:
      t_s: [N] floating-point times, seconds, in any order. x, y: [N] int64 column and row. p: [N] +1 or -1.
      height_px, width_px: sensor size. at_s: [K] reference times, seconds, strictly increasing. tau_s:
        seconds, > 0.
    Returns: [K, 2, H, W] of the type of t_s, ON first.
    Gradient: t_s: surface / tau for the last event of a pixel, 0 for the others (where two events are last
      together, to one of them).
    Raises: ShapeError when lengths differ; DomainError for times that are not finite, events outside the
      sensor, another polarity, and for tau.
    Numerics: give times relative to the start of a recording; float64 epoch times are exact to 0.2 us.
    """
    tau_s = check_tau(tau_s)
    if not (t_s.ndim == 1 and t_s.shape == x.shape == y.shape == p.shape) or not t_s.is_floating_point():
        given = [(str(v.dtype), list(v.shape)) for v in (t_s, x, y, p)]
        raise ShapeError(
            f"t_s, x, y, p are {given}; four lists of equal length are needed, t_s of floating-point seconds."
        )
    check_finite(t_s, "t_s")
    if any(values.is_floating_point() for values in (x, y, p)):
        raise DomainError("x, y and p hold fractions; tensors of whole numbers are needed.")
    outside = (x < 0) | (x >= width_px) | (y < 0) | (y >= height_px) | (p.abs() != 1)
    if bool(outside.any()):
        at = int(outside.nonzero()[0])
        raise DomainError(
            f"event {at} is x {int(x[at])}, y {int(y[at])}, p {int(p[at])}; x below {width_px}, y below "
            f"{height_px}, and polarity +1 or -1 are allowed."
        )
    order = torch.argsort(t_s.detach(), stable=True)
    times_s = t_s[order]
    cell = (((p < 0).long() * height_px + y) * width_px + x)[order]
    rank = torch.arange(len(order), device=cell.device)
    surfaces = []
    for time_s in check_times(at_s).tolist():
        seen = int(
            torch.searchsorted(
                times_s.detach(), torch.tensor(time_s, dtype=t_s.dtype, device=t_s.device), right=True
            )
        )
        last = torch.full((2 * height_px * width_px,), -1, device=cell.device).scatter_reduce_(
            0, cell[:seen], rank[:seen], "amax"
        )
        fired = (last >= 0).nonzero().flatten()
        surface = torch.zeros(last.shape, dtype=t_s.dtype, device=t_s.device).index_put(
            (fired,), torch.exp((times_s[last[fired]] - time_s) / tau_s)
        )
        surfaces.append(surface.reshape(2, height_px, width_px))
    return torch.stack(surfaces)


def surface_from_counts(counts: Tensor, t_s: Times, tau_s: float) -> Tensor:
    """Time surface after every frame interval, from hard or soft counts.

    The events of an interval of length d sit at its middle. With m = min(count, 1): S <- (1 - m) S exp(-d /
    tau) + m exp(-d / (2 tau)). Whole counts give the surface of such events exactly; a count between 0 and 1
    is the share of an event, and mixes the two.

    Args:
      counts: [T-1, 2, ..., H, W] counts >= 0, ON first. t_s: [T] seconds, strictly increasing. tau_s:
        seconds, > 0.
    Returns: [T-1, 2, ..., H, W]; entry k belongs to t_s[k + 1].
    Gradient: counts up to and including 1; none above, where one more event moves no last time.
    Raises: ShapeError, DomainError as ``from_counts``; DomainError for negative counts and for tau.
    """
    tau_s = check_tau(tau_s)
    check_counts(counts, non_negative=True)
    fade = torch.exp(check_times(t_s, len(counts) + 1).diff() / -tau_s).tolist()
    share = counts.clamp(max=1)
    surface = torch.zeros_like(counts[0])
    surfaces = []
    for now, factor in zip(share, fade, strict=True):
        surface = (1 - now) * surface * factor + now * factor**0.5
        surfaces.append(surface)
    return torch.stack(surfaces)


def surface_from_hard_counts(
    counts: Tensor, t_s: Times, at_s: Tensor | Sequence[float], tau_s: float
) -> Tensor:
    """Time surface at given times of events that sit at the middles of their intervals.

    Args:
      counts: [T-1, 2, ..., H, W] whole numbers >= 0, ON first, of short intervals (``EventLayer.finely``).
        t_s: [T] seconds, strictly increasing. at_s: [K] reference times, seconds, strictly increasing; an
        interval belongs to those at or after its end. tau_s: seconds, > 0.
    Returns: [K, 2, ..., H, W] exp(-age/tau) of the last event, 0 where none was yet.
    Gradient: counts: made for counts that carry the slope of their mean (``memory``), then that of the mean
      surface over beginnings, to first order in exp(-age/tau) per threshold, and where a level did not turn
      since. None for the surface as a function of a count.
    Raises: ShapeError, DomainError as ``from_counts``; DomainError for counts that are not whole, and for
      tau.
    Source: the surface: Lagorce et al., HOTS, PAMI 2017; the gradient is ours.
    """
    tau_s = check_tau(tau_s)
    check_counts(counts)
    times_s = check_times(t_s, len(counts) + 1)
    wrong = counts.detach()[(counts.detach() < 0) | (counts.detach() % 1 != 0)]
    if len(wrong):
        raise DomainError(
            f"counts hold {float(wrong[0]):g}; whole numbers of events are needed (surface_from_counts takes "
            "shares of events)."
        )
    return _LastEvents.apply(counts, times_s, check_times(at_s), tau_s)


class _LastEvents(Function):
    @staticmethod
    def forward(ctx, counts, times_s, at_s, tau_s):
        middle_s = (times_s[1:] + times_s[:-1]) / 2
        seen = torch.searchsorted(times_s[1:], at_s, right=True).tolist()
        # 1 + index of the interval of the last event, and of the one before it; 0: none was
        last = torch.zeros(counts.shape[1:], dtype=torch.long, device=counts.device)
        before = torch.zeros_like(last)
        surface = []
        older = []
        start = 0
        for stop, time_s in zip(seen, at_s, strict=True):
            for index in range(start, stop):
                fired = counts[index] > 0
                before = torch.where(counts[index] > 1, index + 1, torch.where(fired, last, before))
                last = torch.where(fired, index + 1, last)
            start = max(start, stop)
            shown = torch.cat((torch.zeros(1, dtype=middle_s.dtype), ((middle_s - time_s) / tau_s).exp()))
            shown = shown.to(counts)
            surface.append(shown[last])
            older.append(shown[before])
        ctx.course = seen, middle_s, at_s, tau_s
        surface = torch.stack(surface)
        ctx.save_for_backward(counts.clamp(max=2).to(torch.uint8), surface, torch.stack(older))
        return surface

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        """Once back through time. A surface joins in at the last interval that it sees; its windows leave at
        the event that they begin at, the last one or the one before it."""
        counts, last, before = ctx.saved_tensors
        seen, middle_s, at_s, tau_s = ctx.course
        pull = torch.zeros(counts.shape, dtype=grad.dtype, device=grad.device)
        # of the surfaces whose last event is not met yet, and of those with one event met: what an event now
        # would
        # show, less what the windows' beginnings show
        now = torch.zeros_like(pull[0])
        begun = now
        begun_before = now
        now_past = now
        begun_past = now
        number = len(seen) - 1
        for index in range(len(counts) - 1, -1, -1):
            if index + 1 < len(counts):
                fade = math.exp(float(middle_s[index] - middle_s[index + 1]) / tau_s)
                now = now * fade
                now_past = now_past * fade
            while number >= 0 and seen[number] > index:
                now = now + grad[number] * math.exp(float(middle_s[index] - at_s[number]) / tau_s)
                begun = begun + grad[number] * last[number]
                begun_before = begun_before + grad[number] * before[number]
                number -= 1
            once = counts[index] == 1
            quiet = counts[index] == 0
            now_past = torch.where(quiet, now_past, torch.where(once, now, 0))
            begun_past = torch.where(quiet, begun_past, torch.where(once, begun_before, 0))
            now, begun, begun_before = (torch.where(quiet, value, 0) for value in (now, begun, begun_before))
            pull[index] = now + (now_past - begun - begun_before - begun_past) / 2
        return pull, None, None, None
