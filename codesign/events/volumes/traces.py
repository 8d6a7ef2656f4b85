"""Exponential decay: traces that grow by one with every event and fade between them."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.events.entry import Times, check_layout, check_positive, check_times
from codesign.events.stream import check_stream
from codesign.types import EventStream


def decay(counts: Tensor, t_s: Times, tau_s: float) -> Tensor:
    """Exponentially fading sum of events, per polarity, after every frame interval.

    Args:
      counts: [T-1, 2, ...] hard or soft counts per interval, counted as if at the interval's end.
      t_s: [T] times around the intervals, seconds, strictly increasing.
      tau_s: time in which a trace fades to 1/e, seconds, > 0.
    Returns: [T-1, 2, ...]; after each interval of length d: s = s exp(-d/tau) + counts.
    Gradient: counts (the sum is linear in them).
    """
    check_tau(tau_s)
    check_layout(counts, 1, name="counts")
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
    check_tau(tau_s)
    check_stream(stream)
    height = stream.height_px
    width = stream.width_px
    trace = torch.zeros(2 * height * width, dtype=torch.float64, device=stream.t_us.device)
    before_us = None
    if start is not None:
        earlier, before_us = start
        if earlier.shape != (2, height, width):
            raise ShapeError(
                f"the trace to go on with has shape {list(earlier.shape)}; the sensor's is "
                f"{[2, height, width]}."
            )
        trace += earlier.to(trace).flatten()
    traces = []
    for time_us, (cell, t_us) in segments(stream, at_us):
        if before_us is not None:
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
    except (TypeError, ValueError, RuntimeError):
        times_us = torch.empty(0)
    if (
        times_us.ndim != 1
        or not len(times_us)
        or times_us.is_floating_point()
        or times_us.is_complex()
        or bool((times_us.diff() <= 0).any())
    ):
        raise DomainError(
            f"at_us is {at_us if len(str(at_us)) < 80 else str(at_us)[:80] + ' …'}; a list of whole "
            "microseconds that increase strictly is needed."
        )
    ends = torch.searchsorted(stream.t_us, times_us.to(stream.t_us), right=True).tolist()
    cell = ((stream.p < 0).long() * stream.height_px + stream.y) * stream.width_px + stream.x
    for time_us, first, last in zip(times_us.tolist(), [0, *ends], ends, strict=False):
        yield time_us, (cell[first:last], stream.t_us[first:last])


def check_tau(tau_s):
    """Raise DomainError unless a fading time is a finite number of seconds > 0."""
    check_positive(tau_s, "tau_s", " s")
