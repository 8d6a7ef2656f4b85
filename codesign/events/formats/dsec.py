"""DSEC's layout of events in HDF5: datasets t, x, y, p under events, an epoch t_offset, and an index
ms_to_idx of milliseconds.

t is uint32 microseconds since t_offset (int64), x and y uint16, p uint8 (1 ON, 0 OFF); ms_to_idx[k] is the
first event with t >= 1000 k. What is written carries the sensor size as attributes height_px and width_px of
the group; published files have none.
Source: Gehrig et al., "DSEC: A Stereo Event Camera Dataset for Driving Scenarios", RA-L 2021; its published
  description of the data format.
"""

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats.arrival import arranged, columns

LAST_T = 2**32 - 1


def from_dsec(path, arrays, attributes, height_px, width_px):
    """EventStream of the arrays of a file.

    Args: arrays: t, x, y, p, t_offset, and where present ms_to_idx (integers of any width). attributes: the
      sensor size, or empty.
    Raises: FileFormatError for lists of unequal length, times beyond 61 bits, an unknown polarity, an index
      that is not that of the times, and what arrival refuses.
    """
    t, x, y, p = (arrays[name] for name in ("t", "x", "y", "p"))
    if not (t.shape == x.shape == y.shape == p.shape == (t.size,)):
        raise FileFormatError(
            f"{path}: t, x, y, p have shapes {[list(values.shape) for values in (t, x, y, p)]}; four lists "
            "of equal length are needed."
        )
    offset = arrays["t_offset"].reshape(-1)
    extremes = [int(value) for values in (offset, t) if values.size for value in (values.min(), values.max())]
    if offset.size != 1 or not all(-(2**61) <= value <= 2**61 for value in extremes):
        raise FileFormatError(
            f"{path}: t_offset has {offset.size} values and times reach {max(extremes, default=0)}; one "
            "t_offset and 61 bits are allowed."
        )
    if p.size and not (int(p.min()) >= 0 and int(p.max()) <= 1):
        raise FileFormatError(
            f"{path}: polarity spans {int(p.min())} to {int(p.max())}; 0 (OFF) and 1 (ON) are allowed."
        )
    t = t.astype(np.int64)
    if "ms_to_idx" in arrays:
        _check_index(path, t, arrays["ms_to_idx"])
    size = None
    if attributes:
        size = tuple(_pixels(path, attributes.get(name), name) for name in ("height_px", "width_px"))
    return arranged(
        path,
        t + int(offset[0]),
        x.astype(np.int64),
        y.astype(np.int64),
        p,
        size=size,
        height_px=height_px,
        width_px=width_px,
    )


def to_dsec(stream):
    """(arrays, attributes) that hold a stream; t_offset is the time of the first event.

    Raises: FileFormatError for a stream longer than 2^32 us, because t has 32 bits, and for a sensor beyond
      65536 x 65536.
    """
    t_us, x, y, p = columns(
        stream,
        height_limit_px=2**16,
        width_limit_px=2**16,
        first_us=-(2**61),
        last_us=2**61,
        name="DSEC's layout",
    )
    offset_us = int(t_us[0]) if t_us.size else 0
    t = t_us - offset_us
    if t.size and int(t[-1]) > LAST_T:
        raise FileFormatError(
            f"the stream lasts {int(t[-1])} us; DSEC's times have 32 bits (71 minutes); split it or write "
            ".npz instead."
        )
    milliseconds = np.arange(
        int(t[-1]) // 1000 + 2 if t.size else 1, dtype=np.int64
    )  # the last entry closes the last millisecond
    arrays = {
        "events/t": t.astype(np.uint32),
        "events/x": x.astype(np.uint16),
        "events/y": y.astype(np.uint16),
        "events/p": (p > 0).astype(np.uint8),
        "t_offset": np.array(offset_us, np.int64),
        "ms_to_idx": np.searchsorted(t, milliseconds * 1000).astype(np.uint64),
    }
    return arrays, {"height_px": stream.height_px, "width_px": stream.width_px}


def _check_index(path, t, index):
    """ms_to_idx must part the times: none before an entry at or after its millisecond, none behind it
    earlier."""
    if index.ndim != 1 or (index.size and int(index.max()) > t.size):
        raise FileFormatError(
            f"{path}: ms_to_idx is no list of places in {t.size} events; the file is damaged."
        )
    index, limit_us = index.astype(np.int64)[1:], 1000 * np.arange(1, max(index.size, 1), dtype=np.int64)
    inside = index < t.size
    behind = index > 0
    if (
        bool((index < 0).any())
        or bool((t[index[inside]] < limit_us[inside]).any())
        or bool((t[index[behind] - 1] >= limit_us[behind]).any())
    ):
        raise FileFormatError(
            f"{path}: ms_to_idx does not give the first event of each millisecond; the file is damaged."
        )


def _pixels(path, value, name):
    """A sensor side from an attribute."""
    value = np.asarray(value)
    if value.dtype.kind not in "iu" or value.size != 1 or not 1 <= int(value.reshape(-1)[0]) <= 2**16:
        raise FileFormatError(
            f"{path}: attribute {name} is {value}; a whole number from 1 to 65536 is needed."
        )
    return int(value.reshape(-1)[0])
