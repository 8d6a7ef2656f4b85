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
from codesign.events.formats.arrival import columns

LAST_T = 2**32 - 1


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


def check_index(path, t, first, index):
    """Raise FileFormatError unless ms_to_idx parts the times ``t`` of the events from number ``first`` on: none before
    an entry at or after its millisecond, none behind it earlier."""
    limit_us = 1000 * np.arange(len(index), dtype=np.int64)
    at = index[1:] - first
    inside, behind = (at >= 0) & (at < len(t)), (at > 0) & (at <= len(t))
    if bool(
        (t[at[inside]] < limit_us[1:][inside]).any() or (t[at[behind] - 1] >= limit_us[1:][behind]).any()
    ):
        raise FileFormatError(
            f"{path}: ms_to_idx does not give the first event of each millisecond; the file is damaged."
        )


def pixels(path, attributes, name):
    """A sensor side from the attributes of the group."""
    value = np.asarray(attributes.get(name))
    if value.dtype.kind not in "iu" or value.size != 1 or not 1 <= int(value.reshape(-1)[0]) <= 2**16:
        raise FileFormatError(
            f"{path}: attribute {name} is {value}; a whole number from 1 to 65536 is needed."
        )
    return int(value.reshape(-1)[0])
