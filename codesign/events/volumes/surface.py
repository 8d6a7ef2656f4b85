"""What fades, per pixel and polarity. Time surfaces: how long ago the last event was, as exp(-(t_ref -
t_last) / tau); 0 where none was yet. Traces, which grow by one with every event and fade between them.

The gradient of the surface of hard counts is that of its mean over where pixels stand inside their
thresholds. In the mean over places inside a threshold C it is (1/C) times the integral of exp(-age/tau) over
the last C of level that the pixel went through: later crossings hide what fired more than a threshold before.
One hard pixel does not know where that window ends, but its own last event lies evenly in it and the one
before evenly in the threshold behind, so the mean of the windows that begin at either is right to first order
in their length.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.checks import FLOATS, check, check_positive, check_whole
from codesign.errors import DomainError
from codesign.events.entry import Times, check_counts, check_dtype, check_times, shown
from codesign.events.stream import check_stream
from codesign.types import EventStream

NANOSECOND = 1e-9
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
    Gradient: none (timestamps are integers).
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


def decay(counts: Tensor, t_s: Times, tau_s: float) -> Tensor:
    """Exponentially fading sum of events, per polarity, after every frame interval.

    Args:
      counts: [T-1, 2, ...] hard or soft counts per interval, counted as if at the interval's end.
      t_s: [T] times around the intervals, seconds, strictly increasing.
      tau_s: time in which a trace fades to 1/e, seconds, > 0.
    Returns: [T-1, 2, ...]; after each interval of length d: s = s exp(-d/tau) + counts.
    Gradient: counts (the sum is linear in them).
    """
    tau_s = check_tau(tau_s)
    check(counts, "T-1 ...", "counts", FLOATS, finite=True)
    fade = torch.exp(check_times(t_s, len(counts) + 1).diff() / -tau_s).tolist()
    trace = torch.zeros_like(counts[0])
    traces = []
    for now, factor in zip(counts, fade, strict=True):
        trace = trace * factor + now
        traces.append(trace)
    return torch.stack(traces)


def decay_from_stream(
    stream: EventStream,
    at_us: Tensor | Sequence[int],
    tau_s: float,
    *,
    start: tuple[Tensor, int] | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Exponentially fading sum of single events at given times: sum over t <= t_ref of exp(-(t_ref - t) /
    tau).

    Args:
      stream: EventStream.
      at_us: [K] reference times, whole microseconds, strictly increasing. Events at a reference time belong
        to it.
      tau_s: seconds, > 0.
      start: (trace [2, H, W], its time in whole microseconds) of an earlier chunk, whose events are then not
        in the stream; None: nothing before.
    Returns: [K, 2, H, W], summed in float64, ON first.
    Gradient: none (timestamps are integers).
    Raises: DomainError for reference times that are not whole or do not increase, and for tau; ShapeError for
      a trace of another size.
    """
    tau_s = check_tau(tau_s)
    check_stream(stream)
    check_dtype(dtype)
    height = stream.height_px
    width = stream.width_px
    trace = torch.zeros(2 * height * width, dtype=torch.float64, device=stream.t_us.device)
    before_us = None
    if start is not None:
        if not isinstance(start, tuple) or len(start) != 2 or not isinstance(start[0], Tensor):
            raise DomainError(f"start is {shown(start)}; a trace and its time in microseconds are needed.")
        earlier, before_us = start[0], check_whole(start[1], "the time of the trace", None)
        check(earlier, (2, height, width), "the trace to go on with", FLOATS)
        trace += earlier.to(trace).flatten()
    traces = []
    for time_us, (cell, t_us) in segments(stream, at_us):
        if before_us is not None:
            if time_us < before_us:
                raise DomainError(
                    f"the trace is of {before_us} us, after the first time asked for, {time_us} us."
                )
            trace *= math.exp((time_us - before_us) / (-1e6 * tau_s))
        trace.index_add_(0, cell, torch.exp((time_us - t_us).to(torch.float64) / (-1e6 * tau_s)))
        before_us = time_us
        traces.append(trace.to(dtype, copy=True).reshape(2, height, width))
    return torch.stack(traces)


def segments(stream, at_us):
    """For every reference time: the time, and (cell, t_us) of the events after the one before, up to and
    including it.

    A cell is the place of (polarity, row, column) in a flattened [2, H, W]. Raises: DomainError for times
    that are not whole or do not increase.
    """
    try:
        times_us = torch.as_tensor(at_us)
        check_whole(int(times_us.abs().max()) if len(times_us) else 0, "at_us", 0)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        times_us = torch.empty(0)
    if (
        times_us.ndim != 1
        or not len(times_us)
        or times_us.is_floating_point()
        or times_us.is_complex()
        or bool((times_us.diff() <= 0).any())
    ):
        raise DomainError(
            f"at_us is {shown(at_us)}; a list of whole microseconds that increase strictly is needed."
        )
    ends = torch.searchsorted(stream.t_us, times_us.to(stream.t_us), right=True).tolist()
    cell = ((stream.p < 0).long() * stream.height_px + stream.y) * stream.width_px + stream.x
    for time_us, first, last in zip(times_us.tolist(), [0, *ends], ends, strict=False):
        yield time_us, (cell[first:last], stream.t_us[first:last])


def check_tau(tau_s):
    """A fading time as a float; DomainError unless it is a finite number of seconds of at least a
    nanosecond."""
    return check_positive(tau_s, "tau_s", NANOSECOND)
