"""Event volumes: counts on a grid of time bins, shared linearly between the two nearest bins.

With n bins the nodes are n equally spaced times from the start to the end of the interval. An event
between two nodes is shared in proportion to its nearness, so nothing is lost. The end bins collect
from one side
only: half as much as the others, centred a third of a node spacing inside.

Spike tensors [2, W, H, T] hold one binary spike per polarity, column, row and time step, ON first,
as spiking networks take them.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.checks import check_kind, check_whole
from codesign.errors import DomainError
from codesign.events.entry import Times, check_counts, check_dtype, check_room, check_times
from codesign.events.stream import check_stream
from codesign.types import EventStream, EventVolume

MOST_BINS = 2**20


def check_bins(bins: object) -> None:
    """Raise DomainError unless ``bins`` is a whole number >= 1."""
    check_whole(check_kind(bins, int, "bins"), "bins", 1, MOST_BINS)


def from_counts(counts: Tensor, t_s: Times, bins: int) -> EventVolume:
    """Sort the counts of consecutive frame intervals into time bins.

    Args:
      counts: [T-1, 2, ..., H, W] events per interval, ON first, axes between polarity and H as
        batch ([T-1, 2, H, W]: batch of one).
      t_s: [T] frame times, seconds, strictly increasing. The events of an interval sit at its
        middle.
      bins: number of bins, >= 1.
    Returns: EventVolume of counts [B, 2, bins, H, W]; the total is conserved.
      centroid_s: [bins] float64, seconds from t_s[0]: mean time of what a bin collects when events
        come at an even rate. It does not depend on the counts, so a rate that changes linearly with
        time is read off at the centroid exactly.
    Gradient: counts.
    Raises: ShapeError when axes or the number of times do not fit; DomainError for times that do
      not increase, counts that are not finite, bins < 1, and for fewer intervals than fill every
      bin.

    Example:
    >>> from codesign import events
    >>> counts = torch.ones(8, 2, 4, 6)  # one event of either polarity per pixel in each of 8 intervals
    >>> volume = events.from_counts(counts, torch.linspace(0, 0.08, 9), bins=3)
    >>> volume.counts.shape, volume.counts[0, 0, :, 0, 0].tolist()  # the end bins collect from one side
    (torch.Size([1, 2, 3, 4, 6]), [2.0, 4.0, 2.0])
    """
    check_counts(counts)
    check_bins(bins)
    times_s = check_times(t_s, counts.shape[0] + 1)
    middle_s = (times_s[1:] + times_s[:-1]) / 2 - times_s[0]
    place = middle_s / (times_s[-1] - times_s[0]) * (bins - 1)
    # of every interval in the bins, at most two of them each; one bin takes everything
    shares = (1 - (place[:, None] - torch.arange(bins)).abs()).clamp(min=0)
    collected_s = shares.T @ times_s.diff()
    if bool((collected_s <= 0).any()):
        empty = (collected_s <= 0).nonzero().flatten().tolist()
        raise DomainError(
            f"bins {empty} of {bins} collect no interval out of {counts.shape[0]}; use fewer bins or more "
            "frames."
        )
    centroid_s = (shares.T @ (times_s.diff() * middle_s)) / collected_s
    *batch, height, width = counts.shape[2:]
    volume = shares.T.to(counts) @ counts.flatten(1)
    volume = volume.reshape(bins, 2, -1, height, width).permute(2, 1, 0, 3, 4).contiguous()
    return EventVolume(volume, centroid_s.to(counts.device), collected_s.to(counts.device))


def from_stream(
    stream: EventStream, t0_us: int, t1_us: int, bins: int, *, dtype: torch.dtype = torch.float32
) -> EventVolume:
    """Sort single events into time bins by their timestamps.

    Args:
      stream: EventStream.
      t0_us, t1_us: the interval, integer microseconds, both ends included; tile time with [a, b],
        [b + 1, c]. Events outside are not asked for.
      bins: number of bins, >= 1.
    Returns: EventVolume of counts [1, 2, bins, H, W] whose total is the number of events in the
      interval, and centroid_s [bins] float64, seconds from t0: (t1 - t0)/(3 (bins - 1)) inside at
      the ends, the nodes between (even event rate).
    Gradient: none (timestamps are integers).
    Raises: DomainError for t1 <= t0 or bins < 1.

    Example:
    >>> from codesign import events
    >>> frames = torch.tensor([50.0, 100.0]).reshape(2, 1, 1)
    >>> stream = events.simulate(frames, [0.0, 0.01], events.SensorModel())  # at 2885, 5771 and 8656 us
    >>> events.from_stream(stream, 0, 10_000, bins=2).counts[0, 0, :, 0, 0]  # shared with the ends in time
    tensor([1.2688, 1.7312])
    """
    check_stream(stream, slice(0))
    check_whole(t0_us, "start of the interval t0_us", None)
    check_whole(t1_us, "end of the interval t1_us", int(t0_us) + 1)
    check_bins(bins)
    check_dtype(dtype, fractions=True)
    size_px = stream.height_px, stream.width_px
    duration_us = int(t1_us) - int(t0_us)
    check_interval(size_px, duration_us, bins)
    first, last = torch.searchsorted(
        stream.t_us, torch.tensor([int(t0_us), int(t1_us) + 1], device=stream.t_us.device)
    ).tolist()
    check_stream(stream, slice(first, last))
    rows = [column[first:last] for column in (stream.t_us, stream.x, stream.y, stream.p)]
    return of_rows(rows, size_px, int(t0_us), duration_us, bins, dtype)


def check_interval(size_px: tuple[int, int], duration_us: int, bins: int) -> None:
    """Raise DomainError for an interval, or pixels, of which there is no volume."""
    check_room(2 * bins * size_px[0] * size_px[1], "the volume")
    if duration_us * bins >= 2**63:
        raise DomainError(
            f"the interval of {duration_us:.3g} us is too long for {bins} bins; times are in microseconds."
        )


def of_rows(
    rows: Sequence[Tensor],
    size_px: tuple[int, int],
    t0_us: int,
    duration_us: int,
    bins: int,
    dtype: torch.dtype = torch.float32,
) -> EventVolume:
    """``from_stream`` of events t_us, x, y, p [N] and an interval that are checked."""
    t_us, x, y, p = rows
    height, width = size_px
    # numerators of the place in node spacings: whole numbers, exact at any time
    scaled = (t_us - t0_us) * (bins - 1)
    node = torch.div(scaled, duration_us, rounding_mode="floor")
    share = (scaled - node * duration_us).to(torch.float64) / duration_us
    cell = (((p < 0).long() * bins + node) * height + y) * width + x
    # one spare node: an event at the end gives it 0
    counts = torch.zeros(
        2 * bins * height * width + height * width, dtype=torch.float64, device=cell.device
    )
    counts.index_add_(0, cell, 1 - share)
    if bins > 1:
        counts.index_add_(0, cell + height * width, share)
    counts = counts[: 2 * bins * height * width]
    most = torch.finfo(dtype).max
    if len(t_us) > most and float(counts.max()) > most:
        raise DomainError(
            f"a bin holds {float(counts.max()):.3g} events, more than {dtype} can; take torch.float32."
        )
    node_s = torch.arange(bins, dtype=torch.float64, device=cell.device) / max(bins - 1, 1)
    third = 1 / (3 * max(bins - 1, 1))
    node_s[0], node_s[-1] = (third, 1 - third) if bins > 1 else (0.5, 0.5)
    collected_s = torch.full_like(node_s, duration_us * 1e-6 / max(bins - 1, 1))
    if bins > 1:
        collected_s[[0, -1]] /= 2
    return EventVolume(
        counts.reshape(1, 2, bins, height, width).to(dtype),
        node_s * (duration_us * 1e-6),
        collected_s,
    )


def spikes_from_stream(
    stream: EventStream, t0_us: int, step_us: int, steps: int, *, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Spike tensor of a stream.

    Args:
      stream: EventStream.
      t0_us: start of step 0, whole microseconds. step_us: length of a step, whole microseconds, >
        0. steps: number of steps T, >= 1.
    Returns: [2, W, H, T]: 1 where at least one event lies in [t0 + k step, t0 + (k + 1) step), else
      0. Events of one pixel, polarity and step become one spike (the number of events less the sum
      of the tensor says how many went into others); those outside the T steps are not asked for.
      Neurons of ``events.srm``: ``spikes.flatten(0, 2).T`` is [T, N].
    Gradient: none (timestamps are integers).
    Raises: DomainError for times or numbers that are not whole, or not positive.
    Source: layout of Gehrig et al., Event-Based Angular Velocity Regression with Spiking Networks,
      ICRA 2020, and of SLAYER (Shrestha, Orchard 2018).
    """
    t0_us = check_whole(t0_us, "t0_us", None)
    step_us = check_whole(step_us, "step_us")
    steps = check_whole(steps, "steps")
    check_stream(stream)
    check_dtype(dtype)
    check_room(2 * stream.width_px * stream.height_px * steps, "the spikes")
    step = torch.div(stream.t_us - t0_us, step_us, rounding_mode="floor")
    inside = (step >= 0) & (step < steps)
    shape = (2, stream.width_px, stream.height_px, steps)
    spikes = torch.zeros(shape, dtype=dtype, device=stream.t_us.device)
    spikes[(stream.p[inside] < 0).long(), stream.x[inside], stream.y[inside], step[inside]] = 1
    return spikes
