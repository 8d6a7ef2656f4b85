"""What the columns of a table of events mean where its format does not say: their order and the unit of the times."""

import numpy as np

from codesign.errors import FileFormatError, shown
from codesign.events.columns import LIMIT_PX

ORDERS = ("txyp", "xytp")
UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
NAMES = {
    "t": ("t", "t_us", "t_s", "t_ms", "t_ns", "ts", "time", "timestamp", "timestamps"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity"),
}


def check_asked(path, asked):
    """Raise FileFormatError unless the order and the unit asked for mean something."""
    if not isinstance(asked.columns, str) or sorted(asked.columns) not in (list("ptxy"), sorted("auto")):
        raise FileFormatError(
            f"columns {shown(asked.columns)} given for {path}; the four letters t, x, y, p in the file's order are "
            "needed, for example 'txyp'."
        )
    if not isinstance(asked.time_unit, str) or asked.time_unit not in ("auto", *UNITS_US):
        raise FileFormatError(
            f"time unit {shown(asked.time_unit)} given for {path}; choose one of {', '.join(UNITS_US)} or auto."
        )


def settled_order(path, table, columns, default=None):
    """Which letter of t, x, y, p stands for which column of ``table`` [N, 4].

    "auto": t is the first or the third column, the one of both whose values mostly are no pixels (fractions, beyond
    LIMIT_PX), else the one that never falls. ``default`` where neither or both are; without one, FileFormatError.
    """
    if columns != "auto":
        return columns
    kinds = [table[:, order.index("t")] for order in ORDERS]
    no_pixel = [2 * np.count_nonzero((t % 1 != 0) | (t < 0) | (t >= LIMIT_PX)) > len(t) for t in kinds]
    rising = [bool((t[1:] >= t[:-1]).all()) for t in kinds]
    for evidence in (no_pixel, rising):
        if sum(evidence) == 1:
            return ORDERS[evidence.index(True)]
    if default is not None:
        return default
    raise FileFormatError(
        f"{path} does not say whether its rows are t x y p or x y t p, and its numbers could be either; give "
        "columns='txyp' or columns='xytp'."
    )


def settled_unit(t, unit, name=""):
    """The unit of times ``t`` [N] of a column called ``name``; "auto": what the name says, else seconds where a time
    has a fraction, else microseconds."""
    told = name.removeprefix("t_")
    if unit != "auto":
        return unit
    return told if told in UNITS_US else "s" if bool((t % 1 != 0).any()) else "us"


def microseconds(t, unit):
    """Times in microseconds, rounded; whole ones stay exact."""
    return (
        signed(t) if unit == "us" and t.dtype.kind in "iu" else np.rint(t.astype(np.float64) * UNITS_US[unit])
    )


def signed(t):
    """Whole numbers as int64; those beyond 62 bits as 62 bits, which no reader lets pass."""
    if t.dtype.kind == "u":
        return np.minimum(t.astype(np.uint64), 2**62).astype(np.int64)
    return np.clip(t.astype(np.int64), -(2**62), 2**62)
