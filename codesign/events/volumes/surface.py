"""What fades, per pixel and polarity. Time surfaces: how long ago the last event was, as
exp(-(t_ref - t_last) / tau); 0 where none was yet. Traces, which grow by one with every event and
fade between them."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.checks import FLOATS, check, check_positive, check_whole
from codesign.errors import DomainError
from codesign.events.entry import Times, check_counts, check_dtype, check_times, shown
from codesign.events.stream import check_stream
from codesign.types import EventStream

NANOSECOND = 1e-9
NEVER_US = torch.iinfo(torch.int64).min


def surface_from_stream(
    stream: EventStream,
    at_us: Tensor | Sequence[int],
    tau_s: float,
    *,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Time surface of a stream at given times.

    Args:
      stream: EventStream.
      at_us: [K] reference times, whole microseconds, strictly increasing. Events at a reference
        time belong to it, later ones do not.
      tau_s: time in which the surface fades to 1/e, seconds, > 0.
    Returns: [K, 2, H, W] in 0 to 1, ON first; the difference of times is taken in whole
      microseconds, so epoch times lose nothing.
    Gradient: none (timestamps are integers).
    Raises: DomainError for reference times that are not whole or do not increase, and for tau.
    Source: Lagorce et al., HOTS, PAMI 2017, eq. 2 and 3.
    """
    tau_s = check_tau(tau_s)
    check_dtype(dtype, fractions=True)
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

    The events of an interval of length d sit at its middle. With m = min(count, 1): S <- (1 - m) S
    exp(-d / tau) + m exp(-d / (2 tau)). Whole counts give the surface of such events exactly; a
    count between 0 and 1 is the share of an event, and mixes the two.

    Args:
      counts: [T-1, 2, ..., H, W] counts >= 0, ON first. t_s: [T] seconds, strictly increasing.
        tau_s: seconds, > 0.
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
    """Exponentially fading sum of single events at given times: sum over t <= t_ref of
    exp(-(t_ref - t) / tau).

    Args:
      stream: EventStream.
      at_us: [K] reference times, whole microseconds, strictly increasing. Events at a reference
        time belong to it.
      tau_s: seconds, > 0.
      start: (trace [2, H, W], its time in whole microseconds) of an earlier chunk, whose events are
        then not in the stream; None: nothing before.
    Returns: [K, 2, H, W], summed in float64, ON first.
    Gradient: none (timestamps are integers).
    Raises: DomainError for reference times that are not whole or do not increase, for tau, and for
      events up to the time of the trace; ShapeError for a trace of another size.
    """
    tau_s = check_tau(tau_s)
    check_stream(stream)
    check_dtype(dtype, fractions=True)
    height = stream.height_px
    width = stream.width_px
    trace = torch.zeros(2 * height * width, dtype=torch.float64, device=stream.t_us.device)
    before_us = None
    if start is not None:
        if not isinstance(start, tuple) or len(start) != 2 or not isinstance(start[0], Tensor):
            raise DomainError(
                f"start is {shown(start)}; a trace and its time in microseconds are needed."
            )
        earlier, before_us = start[0], check_whole(start[1], "the time of the trace", None)
        check(earlier, (2, height, width), "the trace to go on with", FLOATS)
        trace += earlier.to(trace).flatten()
        if len(stream) and int(stream.t_us[0]) <= before_us:
            raise DomainError(
                f"the trace is of {before_us} us, and the stream begins at {int(stream.t_us[0])} us with events that it "
                "holds already; give those after it."
            )
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
    """For every reference time: the time, and (cell, t_us) of the events after the one before, up
    to and including it.

    A cell is the place of (polarity, row, column) in a flattened [2, H, W]. Raises: DomainError for
    times that are not whole or do not increase.
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
