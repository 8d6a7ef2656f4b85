"""Events in the order a camera's file holds them, made a sorted stream; and the checks every binary format
needs."""

import numpy as np
import torch

from codesign.errors import FileFormatError
from codesign.events.stream import ordered
from codesign.types import EventStream

# read-out and packet merging swap neighbours within about a frame of the read-out; more than this is another
# fault
DISORDER_US = 1000


def arranged(path, t_us, x, y, p, *, size=None, height_px=None, width_px=None):
    """EventStream of events in file order.

    Args:
      path: the file, for messages.
      t_us, x, y: [N] integer arrays. p: [N] array, positive for ON, otherwise OFF.
      size: (height_px, width_px) from the file, or None where the format has no place for it.
      height_px, width_px: what the caller says; must agree with ``size``. Without either the smallest sensor
        that holds the events is taken.
    Returns: EventStream sorted by (t, y, x, p).
    Raises: FileFormatError for sizes that disagree, no size and no event, an event outside the sensor, or a
      time more than DISORDER_US before an earlier one.
    """
    height_px, width_px = settled_size(path, x, y, size, height_px, width_px)
    for name, values, limit in (("x", x, width_px), ("y", y, height_px)):
        if values.size and (int(values.min()) < 0 or int(values.max()) >= limit):
            at = int(np.argmax((values < 0) | (values >= limit)))
            raise FileFormatError(
                f"{path}: event {at} lies at {name} = {int(values[at])}; the sensor has {limit} pixels "
                f"there (0 to {limit - 1})."
            )
    t_us = np.ascontiguousarray(t_us, np.int64)
    latest_us = np.maximum.accumulate(t_us)
    late = t_us < latest_us - DISORDER_US
    if bool(late.any()):
        at = int(np.argmax(late))
        lag_us = int(latest_us[at]) - int(t_us[at])
        raise FileFormatError(
            f"{path}: event {at} lies {lag_us} us before an earlier one; at most {DISORDER_US} us of "
            "disorder is put in order."
        )
    return _sorted(t_us, x, y, p, height_px, width_px)


def settled_size(path, x, y, size, height_px, width_px):
    """(height_px, width_px) from the file, the caller, or the events, in this order."""
    for given, found, name in (
        (height_px, size and size[0], "height_px"),
        (width_px, size and size[1], "width_px"),
    ):
        if size and given is not None and given != found:
            raise FileFormatError(
                f"{path} comes from a sensor with {name} {found}, but {given} was asked for."
            )
    if size:
        return size
    if not x.size and (height_px is None or width_px is None):
        raise FileFormatError(
            f"{path} holds no event, so the sensor size cannot be told; pass height_px and width_px."
        )
    return (
        int(y.max()) + 1 if height_px is None else height_px,
        int(x.max()) + 1 if width_px is None else width_px,
    )


def _sorted(t_us, x, y, p, height_px, width_px):
    """Sort by one packed key where time and pixel fit 63 bits together: several times faster than sorting
    indices."""
    cells = 2 * height_px * width_px
    span_us = int(t_us.max()) - int(t_us.min()) + 1 if t_us.size else 0
    if span_us * cells >= 2**63:
        signed = np.where(np.asarray(p) > 0, 1, -1)
        return ordered(_tensor(t_us), _tensor(x), _tensor(y), _tensor(signed), height_px, width_px)
    first_us = int(t_us.min()) if t_us.size else 0
    key = (t_us - first_us) * cells + (np.asarray(y, np.int64) * width_px + x) * 2 + (np.asarray(p) > 0)
    if key.size and bool((key[1:] < key[:-1]).any()):
        key.sort(kind="stable")  # nearly sorted already: runs are merged
    since_us, cell = np.divmod(key, cells)
    row, column = np.divmod(cell >> 1, width_px)
    return EventStream(
        _tensor(since_us + first_us),
        _tensor(column),
        _tensor(row),
        _tensor((cell & 1) * 2 - 1),
        int(height_px),
        int(width_px),
    )


def _tensor(values):
    return torch.from_numpy(np.asarray(values, np.int64))


def columns(stream, *, height_limit_px, width_limit_px, first_us, last_us, name, t0_us=None):
    """t_us (less t0_us), x, y, p of a stream as int64 arrays, after checking that a format can hold it.

    Args: height_limit_px, width_limit_px: largest sensor. first_us, last_us: first and last time the format
      can hold. name: the format, for messages. t0_us: start time that the file tells, or None where the
      format has no place for one.
    Raises: FileFormatError naming what does not fit and what to do.
    """
    if stream.height_px > height_limit_px or stream.width_px > width_limit_px:
        raise FileFormatError(
            f"the sensor has {stream.width_px} x {stream.height_px} pixels; {name} holds at most "
            f"{width_limit_px} x {height_limit_px}; write .npz instead."
        )
    t_us, x, y, p = (values.cpu().numpy() for values in (stream.t_us, stream.x, stream.y, stream.p))
    # as Python integers, which do not wrap
    span_us = [int(t_us[at]) - (t0_us or 0) for at in (0, -1)] if t_us.size else []
    if any(not first_us <= time_us <= last_us for time_us in span_us):
        remedy = "shift the times" if t0_us is None else "pass another start time t0_us, kept in the header,"
        raise FileFormatError(
            f"times{f' less t0_us {t0_us}' if t0_us else ''} span {span_us[0]} to {span_us[1]} us; {name} "
            f"holds {first_us} to {last_us}; {remedy} or write .npz instead."
        )
    return t_us - (t0_us or 0), x, y, p
