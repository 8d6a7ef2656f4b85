"""Event streams: put in order, joined, and counted per frame interval."""

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from codesign.checks import check_kind, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.events.entry import Times, check_dtype, check_room, check_times, exactly
from codesign.types import EventStream

MANY = 1 << 15  # from so many keys on torch counts digits, below numpy is faster


def sorted_keys(keys):
    """[N] whole numbers, sorted."""
    if len(keys) >= MANY:
        return keys.sort().values
    return torch.from_numpy(np.sort(keys.cpu().numpy())).to(keys.device)


def ordered(
    t_us: Tensor,
    x: Tensor,
    y: Tensor,
    p: Tensor,
    height_px: int,
    width_px: int,
) -> EventStream:
    """EventStream of the given events, sorted by (t, y, x, p).

    Args:
      t_us, x, y, p: [N] tensors of whole numbers: microseconds, column, row, polarity +1 or -1.
      height_px, width_px: sensor size.
    Raises: ShapeError when lengths differ; DomainError for fractions, events outside the sensor or
      another polarity.
    """
    for values, name in ((t_us, "t_us"), (x, "x"), (y, "y"), (p, "p")):
        if not isinstance(values, Tensor) or values.is_complex():
            given = values.dtype if isinstance(values, Tensor) else type(values).__name__
            raise DomainError(f"{name} is {given}; a tensor of whole numbers is needed.")
        parted = values.is_floating_point() and (values != values.round()) | values.isinf()
        if values.is_floating_point() and bool(parted.any()):
            first = float(values[parted][0])
            raise DomainError(
                f"{name} holds {first!r}; whole numbers are needed: round them first."
            )
    t_us, x, y, p = (values.to(torch.int64) for values in (t_us, x, y, p))
    _check_columns(t_us, x, y, p, height_px, width_px)
    x_bits, y_bits = (int(side - 1).bit_length() for side in (width_px, height_px))
    bits = x_bits + y_bits + 1
    place = (y << (x_bits + 1)) | (x << 1) | (p > 0)
    if len(t_us) and int(t_us.max()) - (first_us := int(t_us.min())) < 2 ** (63 - bits):
        key = sorted_keys(((t_us - first_us) << bits) | place)
        x, y = (key >> 1) & ((1 << x_bits) - 1), (key >> (x_bits + 1)) & ((1 << y_bits) - 1)
        columns = (key >> bits) + first_us, x, y, 2 * (key & 1) - 1
    else:  # more than one number holds
        rank = torch.argsort(place, stable=True)
        rank = rank[torch.argsort(t_us[rank], stable=True)]
        columns = t_us[rank], x[rank], y[rank], p[rank]
    return EventStream(*columns, int(height_px), int(width_px))


def check_stream(
    stream: EventStream, part: slice = slice(None), ordered: bool = True
) -> EventStream:
    """Return ``stream`` when it is one: lists of int64 of equal length, times that do not go back
    (where asked) and, in ``part``, pixels of the sensor, polarities +1 and -1; DomainError,
    ShapeError otherwise."""
    check_kind(
        stream, EventStream, "the events", "events.read and events.simulate give an EventStream"
    )
    for side, name in ((stream.height_px, "height_px"), (stream.width_px, "width_px")):
        check_whole(side, f"{name} of the stream", 0, 2**31 - 1)
    columns = (stream.t_us, stream.x, stream.y, stream.p)
    if not all(
        isinstance(values, Tensor)
        and values.dtype == torch.int64
        and values.layout == torch.strided
        and not values.is_meta
        for values in columns
    ):
        given = [getattr(values, "dtype", type(values).__name__) for values in columns]
        raise DomainError(
            f"t_us, x, y, p of the stream are {given}; dense tensors of int64 are needed."
        )
    _check_columns(*columns, stream.height_px, stream.width_px, part)
    if ordered and not stream.in_order:
        raise DomainError(
            "the times of the stream go back; order it with codesign.events.stream.ordered."
        )
    return stream


def _check_columns(t_us, x, y, p, height_px, width_px, part=slice(None)):
    """Refuse lists of unequal length and, in ``part``, events outside the sensor or of another
    polarity."""
    if not (t_us.shape == x.shape == y.shape == p.shape == (t_us.numel(),)):
        raise ShapeError(
            f"t_us, x, y, p have shapes {[list(v.shape) for v in (t_us, x, y, p)]}; four lists of equal "
            "length are needed."
        )
    for values, name, size in ((x[part], "x", width_px), (y[part], "y", height_px)):
        low, high = (int(bound) for bound in values.aminmax()) if len(values) else (0, -1)
        if low < 0 or high >= size:
            raise DomainError(
                f"{name} spans {low} to {high}; the sensor has {size} pixels there (0 to {size - 1})."
            )
    p = p[part]
    if bool((p.abs() != 1).any()):
        raise DomainError(
            f"polarity {int(p[p.abs() != 1][0])} found; +1 (ON) or -1 (OFF) is allowed."
        )


def concatenate(streams: Iterable[EventStream]) -> EventStream:
    """One ordered stream of several from the same sensor (for example of consecutive chunks).

    Raises: ShapeError for none, or for sensors of several sizes; DomainError for anything but
      streams.
    """
    if not isinstance(streams, Iterable):
        raise DomainError(f"the streams are {streams!r}; a list of EventStreams is needed.")
    streams = [check_stream(stream, slice(0), ordered=False) for stream in streams]
    sizes = {(stream.height_px, stream.width_px) for stream in streams}
    if len(sizes) != 1:
        raise ShapeError(
            f"sensor sizes {sorted(sizes)} given; at least one stream is needed and all must come from one "
            "sensor."
        )
    t_us, x, y, p = (
        torch.cat([getattr(stream, name) for stream in streams]) for name in ("t_us", "x", "y", "p")
    )
    return ordered(t_us, x, y, p, *sizes.pop())


def to_counts(stream: EventStream, t_s: Times, *, dtype: torch.dtype = torch.float32) -> Tensor:
    """Count the events of each interval between given times.

    Args:
      stream: EventStream.
      t_s: [T] times, seconds, strictly increasing, used to the nearest microsecond. An event at a
        time belongs to the interval that ends there; one at the first time belongs to the first
        interval. Events before the first and after the last time are not asked for.
    Returns: [T-1, 2, H, W] counts, ON first.
    Gradient: none.
    """
    check_stream(stream)
    check_dtype(dtype)
    times_us = (check_times(t_s) * 1e6).round().long()
    if len(times_us) < 2 or bool((times_us.diff() <= 0).any()):
        raise DomainError(
            f"t_s holds {len(times_us)} times; at least two, a microsecond or more apart, are needed."
        )
    times_us = times_us.to(stream.t_us.device)
    inside = (stream.t_us >= times_us[0]) & (stream.t_us <= times_us[-1])
    interval = (torch.searchsorted(times_us, stream.t_us[inside]) - 1).clamp(min=0)
    cell = (
        (interval * 2 + (stream.p[inside] < 0)) * stream.height_px + stream.y[inside]
    ) * stream.width_px + stream.x[inside]
    shape = (len(times_us) - 1, 2, stream.height_px, stream.width_px)
    check_room(torch.Size(shape).numel(), "the counts")
    counts = torch.bincount(cell, minlength=torch.Size(shape).numel())
    return exactly(counts.reshape(shape), dtype)
