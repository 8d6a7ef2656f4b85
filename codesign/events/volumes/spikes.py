"""Spike tensors [2, W, H, T]: one binary spike per polarity, column, row and time step, ON first, as spiking
networks take them."""

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.events.entry import check_counts, check_dtype, check_layout, check_room, check_whole
from codesign.events.stream import check_stream, ordered
from codesign.types import EventStream


def spikes_from_stream(
    stream: EventStream, t0_us: int, step_us: int, steps: int, *, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Spike tensor of a stream.

    Args:
      stream: EventStream.
      t0_us: start of step 0, whole microseconds. step_us: length of a step, whole microseconds, > 0. steps:
        number of steps T, >= 1.
    Returns: [2, W, H, T]: 1 where at least one event lies in [t0 + k step, t0 + (k + 1) step), else 0. Events
      of one pixel, polarity and step become one spike (the number of events less the sum of the tensor says
      how many went into others); those outside the T steps are not asked for. Neurons of ``events.srm``:
      ``spikes.flatten(0, 2).T`` is [T, N].
    Gradient: none (timestamps are integers).
    Raises: DomainError for times or numbers that are not whole, or not positive.
    Source: layout of Gehrig et al., Event-Based Angular Velocity Regression with Spiking Networks, ICRA 2020,
      and of SLAYER (Shrestha, Orchard 2018).
    """
    t0_us = check_whole(t0_us, "t0_us")
    step_us = check_whole(step_us, "step_us", 1)
    steps = check_whole(steps, "steps", 1)
    check_stream(stream)
    check_dtype(dtype)
    check_room(2 * stream.width_px * stream.height_px * steps, "the spikes")
    step = torch.div(stream.t_us - t0_us, step_us, rounding_mode="floor")
    inside = (step >= 0) & (step < steps)
    shape = (2, stream.width_px, stream.height_px, steps)
    spikes = torch.zeros(shape, dtype=dtype, device=stream.t_us.device)
    spikes[(stream.p[inside] < 0).long(), stream.x[inside], stream.y[inside], step[inside]] = 1
    return spikes


def stream_from_spikes(spikes: Tensor, t0_us: int, step_us: int) -> EventStream:
    """Stream with one event per spike, at the start of its step; ``spikes_from_stream`` of it gives the same
    spikes.

    Args:
      spikes: [2, W, H, T] of 0 and 1, ON first. t0_us, step_us: as for ``spikes_from_stream``.
    Raises: ShapeError for another shape; DomainError for values other than 0 and 1.
    """
    t0_us = check_whole(t0_us, "t0_us")
    step_us = check_whole(step_us, "step_us", 1)
    check_layout(spikes, 1, name="spikes")
    if spikes.ndim != 4 or spikes.shape[0] != 2 or 0 in spikes.shape:
        raise ShapeError(f"spikes have shape {list(spikes.shape)}; [2, W, H, T] is needed (ON first).")
    if not bool(((spikes == 0) | (spikes == 1)).all()):
        raise DomainError(
            "spikes hold values other than 0 and 1; round soft spikes before making single events of them."
        )
    check_whole(t0_us + spikes.shape[3] * step_us, "the end of the stream")
    off, x, y, step = spikes.nonzero(as_tuple=True)
    return ordered(t0_us + step * step_us, x, y, 1 - 2 * off, spikes.shape[2], spikes.shape[1])


def spikes_from_counts(counts: Tensor) -> Tensor:
    """Spike tensor of counts per interval, one step per interval: min(count, 1).

    Args: counts: [T, 2, H, W] hard or soft counts >= 0, ON first, of intervals of equal length.
    Returns: [2, W, H, T]; binary for whole counts, shares of a spike between 0 and 1 for soft ones.
    Gradient: counts up to and including 1; none above.
    Raises: ShapeError for another shape; DomainError for counts that are negative or not finite.
    """
    check_counts(counts, non_negative=True)
    if counts.ndim != 4:
        raise ShapeError(f"counts have shape {list(counts.shape)}; [T, 2, H, W] is needed, without a batch.")
    return counts.clamp(max=1).permute(1, 3, 2, 0).contiguous()
