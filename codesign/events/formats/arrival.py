"""Events in the order a file holds them, packet by packet, checked and put in order; what columns
mean where a format does not say (their order, the unit of times); and what a format can hold."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from codesign.errors import FileFormatError, shown
from codesign.events.columns import LIMIT_PX, EventColumns

ORDERS = ("txyp", "xytp")
UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
NAMES = {
    "t": ("t", "t_us", "t_s", "t_ms", "t_ns", "ts", "time", "timestamp", "timestamps"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity"),
}
# read-out and packet merging swap neighbours within about a frame of the read-out; more than this
# is another fault
DISORDER_US = 1000
LAST_US = 2**61
MOST_EVENTS = 2_000_000_000
BACKWARDS = "events_back_in_time"
OFF_SENSOR = "events_off_sensor"


def check_asked(path, asked):
    """Raise FileFormatError unless the order and the unit asked for mean something."""
    if not isinstance(asked.columns, str) or sorted(asked.columns) not in (
        list("ptxy"),
        sorted("auto"),
    ):
        raise FileFormatError(
            f"columns {shown(asked.columns)} given for {path}; the four letters t, x, y, p in the file's "
            "order are needed, for example 'txyp'."
        )
    if not isinstance(asked.time_unit, str) or asked.time_unit not in ("auto", *UNITS_US):
        raise FileFormatError(
            f"time unit {shown(asked.time_unit)} given for {path}; choose one of {', '.join(UNITS_US)} or "
            "auto."
        )


def settled_order(path, table, columns, default=None):
    """Which letter of t, x, y, p stands for which column of ``table`` [N, 4].

    "auto": t is the first or the third column, the one of both whose values mostly are no pixels
    (fractions, beyond LIMIT_PX), else the one that never falls. ``default`` where neither or both
    are; without one, FileFormatError.
    """
    if columns != "auto":
        return columns
    kinds = [table[:, order.index("t")] for order in ORDERS]
    no_pixel = [
        2 * np.count_nonzero((t % 1 != 0) | (t < 0) | (t >= LIMIT_PX)) > len(t) for t in kinds
    ]
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
    """The unit of times ``t`` [N] of a column called ``name``; "auto": what the name says, else
    seconds where a time has a fraction, else microseconds."""
    told = name.removeprefix("t_")
    if unit != "auto":
        return unit
    if t.dtype == np.float32 and len(t) and np.abs(t).max() >= 2**24:
        raise FileFormatError(
            "times from 2^24 on are not told apart in float32; store float64 or whole numbers, or say time_unit=."
        )
    return told if told in UNITS_US else "s" if bool((t % 1 != 0).any()) else "us"


def microseconds(t, unit):
    """Times in microseconds, rounded to the next, of two the even one; whole ones stay exact."""
    if unit in ("us", "ns") and t.dtype.kind in "iu":
        if unit == "us":
            return signed(t)
        # wide enough for what is done to them; double precision ends at a hundred days
        whole, rest = np.divmod(t.astype(np.uint64 if t.dtype.kind == "u" else np.int64), 1000)
        return signed(whole + (2 * rest + whole % 2 > 1000))
    return np.rint(t.astype(np.float64) * UNITS_US[unit])


def signed(t):
    """Whole numbers as int64; those beyond 62 bits as 62 bits, which no reader lets pass."""
    if t.dtype.kind == "u":
        return np.minimum(t.astype(np.uint64), 2**62).astype(np.int64)
    return np.clip(t.astype(np.int64), -(2**62), 2**62)


@dataclass(frozen=True)
class Asked:
    """What the caller says of a file.

    height_px, width_px: sensor size, or None. told: (height, width) by ``told_by``, which lies
      beside the file, or None. sensors: name -> (width, height), of which the smallest that holds
      the events is taken where nothing tells; without any, the smallest size that does.
    columns: order of the columns of rows, four letters, or "auto". time_unit: s, ms, us, ns or
      "auto".
    skip: faults whose events are left out and counted; None: where the caller cannot ask for that.
    """

    height_px: int | None = None
    width_px: int | None = None
    told: tuple[int, int] | None = None
    told_by: str = "the file"
    sensors: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    columns: str = "auto"
    time_unit: str = "auto"
    skip: tuple[str, ...] | None = None


def check_nothing_told(path: Path, asked: Asked, those: str, *names: str) -> None:
    """Raise FileFormatError where the caller says of a file what its format says: the ``names`` of
    Asked, columns and time_unit when left out; ``those``: of which files they can be said."""
    names = names or ("columns", "time_unit")
    if any(getattr(asked, name) != "auto" for name in names):
        raise FileFormatError(
            f"{path} has these by its format; leave {' and '.join(names)} away ({those})."
        )


class Arrival:
    """The events of one file, on their way to EventColumns.

    Args:
      path: for messages.
      size, size_from: (height_px, width_px) by the file, or None, and what in it says so.
      place: what the events are numbered by.
    Raises: FileFormatError for sizes that disagree.
    """

    def __init__(self, path, asked, size=None, size_from="the file", place="event"):
        self.path = path
        self.asked = asked
        self.place = place
        size, self.size_from = (size, size_from) if size else (asked.told, asked.told_by)
        self.size = [asked.height_px, asked.width_px]
        for k, name in enumerate(("height_px", "width_px")):
            if size and self.size[k] not in (None, size[k]):
                raise FileFormatError(
                    f"{path} comes from a sensor with {name} {size[k]} by {self.size_from}, but "
                    f"{self.size[k]} was asked for."
                )
            self.size[k] = size[k] if size else self.size[k]
        self.size_from = self.size_from if size else "the options"
        self.left_out = dict.fromkeys(asked.skip or (), 0)
        self.count = 0
        self.latest_us = -LAST_US
        self.off = None
        self.parts = [(np.empty(0, np.int64), *[np.empty(0, np.int16)] * 2, np.empty(0, bool))]

    def add(self, t_us, x, y, p, places=None):
        """Take the events that follow.

        Args:
          t_us, x, y, p: [N] numbers; p above 0 for ON, else 0, or -1.
          places: [N] line numbers, or None.
        Raises: FileFormatError naming the first that is no event, lies outside the sensor or more
          than DISORDER_US before an earlier one.
        """
        outside = [
            self._outside(*axis) for axis in (("x", x, self.size[1]), ("y", y, self.size[0]))
        ]
        seen_us = t_us
        if OFF_SENSOR in self.left_out:  # what is left out makes no later event late
            seen_us = np.where(outside[0][0] | outside[1][0], -LAST_US, t_us)
        latest_us = (
            np.maximum(np.maximum.accumulate(seen_us), self.latest_us) if len(t_us) else t_us
        )
        if self.off is None:
            self.off = next(iter(p[(p == 0) | (p == -1)][:1].tolist()), None)
        unfit = ~((p == 1) | (p == (0 if self.off is None else self.off)))

        def bad_time(at):
            return f"its time is {t_us[at]} us; 61 bits of microseconds are read"

        def late(at):
            return (
                f"it lies {int(latest_us[at]) - int(t_us[at])} us before an earlier one; at most {DISORDER_US} "
                "us of disorder is put in order"
            )

        def bad_polarity(at):
            off = "0 or -1" if self.off is None else f"{self.off:g}, as in the events before"
            return f"its polarity is {p[at]:g}; 1 for ON, {off}, for OFF is allowed"

        kept = np.ones(len(t_us), bool)
        for fault, bad, say in (
            ("", ~((t_us > -LAST_US) & (t_us < LAST_US)), bad_time),
            (BACKWARDS, latest_us - t_us > DISORDER_US, late),
            *((OFF_SENSOR, *found) for found in outside),
            ("", unfit, bad_polarity),
        ):
            bad &= kept
            if fault in self.left_out:
                self.left_out[fault] += int(bad.sum())
                kept &= ~bad
            elif bool(bad.any()):
                at = int(np.argmax(bad))
                number = self.count + at if places is None else places[at]
                skips = fault and self.asked.skip is not None
                advice = f", or leave such events out (skip: {fault})" if skips else ""
                raise FileFormatError(f"{self.path}, {self.place} {number}: {say(at)}{advice}.")
        self.count += len(t_us)
        self.latest_us = latest_us[-1] if len(t_us) else self.latest_us
        if self.count > MOST_EVENTS:
            raise FileFormatError(f"{self.path} holds more than {MOST_EVENTS} events; split it.")
        t_us, x, y, p = (values[kept] for values in (t_us, x, y, p))
        self.parts.append((t_us.astype(np.int64), x.astype(np.int16), y.astype(np.int16), p > 0))

    def columns(self):
        """EventColumns of all that was taken. Raises: FileFormatError where neither anything nor
        anybody tells the sensor size."""
        t_us, x, y, on = (np.concatenate(column) for column in zip(*self.parts, strict=True))
        self.parts.clear()
        if bool((t_us[1:] < t_us[:-1]).any()):
            order = np.argsort(t_us, kind="stable")
            t_us, x, y, on = (values[order] for values in (t_us, x, y, on))
        height, width, size_from = self._settled(x, y)
        return EventColumns(t_us, x, y, on, height, width, size_from, self.left_out)

    def _settled(self, x, y):
        height, width = self.size
        if height is not None and width is not None:
            return height, width, self.size_from
        if not len(x):
            raise FileFormatError(
                f"{self.path} holds no event, so the sensor size cannot be told; pass height_px and width_px."
            )
        needed = max(int(x.max()) + 1, width or 1), max(int(y.max()) + 1, height or 1)
        for name, sensor in self.asked.sensors.items():
            if sensor[0] >= needed[0] and sensor[1] >= needed[1]:
                return (
                    sensor[1],
                    sensor[0],
                    f"{name}, the smallest known sensor that holds the events",
                )
        return height or needed[1], width or needed[0], "the events themselves"

    def _outside(self, name, values, limit):
        """Which values lie outside a side of the sensor, and what to say of one."""
        by = f" by {self.size_from}" if limit is not None else ", as far as sensors are known,"
        most = LIMIT_PX if limit is None else limit

        def said(at):
            return (
                f"it lies at {name} = {values[at]:.15g}; the sensor has {most} pixels there{by} (0 to "
                f"{most - 1}, whole numbers); give {'its true size' if values[at] % 1 == 0 else 'whole pixels'}"
            )

        return ~((values >= 0) & (values < most)) | (values % 1 != 0), said


def arranged(path, asked, t_us, x, y, p, size=None):
    """EventColumns of the events of a file, all at once; see Arrival."""
    arrival = Arrival(path, asked, size)
    arrival.add(t_us, x, y, p)
    return arrival.columns()


def columns(stream, name, side_px, first_us, last_us, t0_us=None):
    """t_us (less t0_us), x, y, p of a stream as int64 arrays, after checking that a format can hold
    it.

    Args:
      name: the format, for messages.
      side_px: largest height and width of a sensor.
      first_us, last_us: first and last time the format can hold.
      t0_us: start time that the file tells, or None where the format has no place for one.
    Raises: FileFormatError naming what does not fit and what to do.
    """
    if max(stream.height_px, stream.width_px) > side_px:
        raise FileFormatError(
            f"the sensor has {stream.width_px} x {stream.height_px} pixels; {name} holds at most "
            f"{side_px} x {side_px}; write .npz instead."
        )
    t_us, x, y, p = (values.cpu().numpy() for values in (stream.t_us, stream.x, stream.y, stream.p))
    # as Python integers, which do not wrap
    span_us = [int(t_us[at]) - (t0_us or 0) for at in (0, -1)] if t_us.size else []
    if any(not first_us <= time_us <= last_us for time_us in span_us):
        remedy = (
            "shift the times"
            if t0_us is None
            else "pass another start time t0_us, kept in the header,"
        )
        raise FileFormatError(
            f"times{f' less t0_us {t0_us}' if t0_us else ''} span {span_us[0]} to {span_us[1]} us; {name} "
            f"holds {first_us} to {last_us}; {remedy} or write .npz instead."
        )
    return t_us - (t0_us or 0), x, y, p
