"""v2e's layout of events in HDF5: one dataset ``events`` of rows (t in microseconds, x, y, p 1 or 0), uint32;
frames beside it give the sensor size.

Source: v2e, class EventEmulator, output ``dvs_h5`` (Hu et al., "v2e: From Video Frames to Realistic DVS
  Events", CVPRW 2021).
"""

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats.arrival import arranged


def from_v2e(path, arrays, attributes, height_px, width_px):
    """EventStream of the rows of a file.

    Args: arrays: events, [N, 4] integers. attributes: the size of the frames beside them, or empty.
    Raises: FileFormatError for another shape, values beyond 62 bits, an unknown polarity, and what arrival
      refuses.
    """
    rows = arrays["events"]
    if rows.ndim != 2 or rows.shape[1] != 4:
        raise FileFormatError(f"{path}: events has shape {list(rows.shape)}; rows of t, x, y, p are needed.")
    if rows.size and (int(rows.max()) > 2**62 or int(rows.min()) < 0):
        raise FileFormatError(
            f"{path}: events spans {int(rows.min())} to {int(rows.max())}; 0 to 2^62 is allowed."
        )
    t_us, x, y, p = rows.astype(np.int64).T
    if p.size and int(p.max()) > 1:
        raise FileFormatError(
            f"{path}: event {int(np.argmax(p > 1))} has polarity {int(p.max())}; 0 (OFF) and 1 (ON) are "
            "allowed."
        )
    size = (int(attributes["height_px"]), int(attributes["width_px"])) if attributes else None
    return arranged(path, t_us, x, y, p, size=size, height_px=height_px, width_px=width_px)
