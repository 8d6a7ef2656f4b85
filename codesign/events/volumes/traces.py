"""Exponential decay: traces that grow by one with every event and fade between them."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.events.entry import (
    Times,
    check_dtype,
    check_layout,
    check_positive,
    check_times,
    check_whole,
    shown,
)
from codesign.events.stream import check_stream
from codesign.types import EventStream

NANOSECOND = 1e-9


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
    check_layout(counts, 1, name="counts")
    check_finite(counts, "counts")
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
        earlier, before_us = start[0], check_whole(start[1], "the time of the trace")
        check_layout(earlier, name="the trace to go on with")
        if earlier.shape != (2, height, width):
            raise ShapeError(
                f"the trace to go on with has shape {list(earlier.shape)}; the sensor's is "
                f"{[2, height, width]}."
            )
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
        check_whole(int(times_us.abs().max()) if len(times_us) else 0, "at_us")
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
    return check_positive(tau_s, "tau_s", " s", NANOSECOND)
