"""Events of a long recording in few bytes each, from which windows are cut as event streams."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from codesign.errors import FileFormatError
from codesign.events.stream import ordered
from codesign.flow.checks import check_size
from codesign.types import EventStream

# width, height: the sensors that recordings without a size come from, smallest first
SENSORS_PX = {
    "DAVIS240C": (240, 180),
    "DAVIS346": (346, 260),
    "VGA (DVXplorer, Prophesee Gen3)": (640, 480),
    "Prophesee HD": (1280, 720),
}
LIMIT_PX = 2**15
CHUNK = 100_000  # events
BACKWARDS = "events_back_in_time"
OFF_SENSOR = "events_off_sensor"


@dataclass(frozen=True)
class EventColumns:
    """Events in order of time, 13 bytes each.

    t_us: [N] int64 microseconds. x, y: [N] int16. on: [N] bool. height_px, width_px: sensor size. size_from:
      a phrase that says where that came from. left_out: how many events of which fault were left out.
    """

    t_us: np.ndarray
    x: np.ndarray
    y: np.ndarray
    on: np.ndarray
    height_px: int
    width_px: int
    size_from: str
    left_out: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t_us)

    def window(self, t0_us: int, t1_us: int) -> EventStream:
        """EventStream of the events from t0_us to t1_us, both included."""
        first, last = np.searchsorted(self.t_us, [t0_us, t1_us + 1])
        t, x, y, on = (
            torch.from_numpy(values[first:last].astype(np.int64))
            for values in (self.t_us, self.x, self.y, self.on)
        )
        return ordered(t, x, y, 2 * on - 1, self.height_px, self.width_px)

    def chunks(self, size: int = CHUNK, start_us: int | None = None) -> Iterator[EventStream]:
        """EventStreams of ``size`` events each, in order, from ``start_us`` on; events of one microsecond may
        part."""
        first = 0 if start_us is None else int(np.searchsorted(self.t_us, start_us))
        for k in range(first, len(self), size):
            t, x, y, on = (
                torch.from_numpy(values[k : k + size].astype(np.int64))
                for values in (self.t_us, self.x, self.y, self.on)
            )
            yield EventStream(t, x, y, 2 * on - 1, self.height_px, self.width_px)


def from_stream(stream: EventStream, size_from: str = "the file") -> EventColumns:
    """EventColumns of an EventStream."""
    if max(stream.height_px, stream.width_px) > LIMIT_PX:
        raise FileFormatError(
            f"the sensor has {stream.width_px} x {stream.height_px} pixels; up to {LIMIT_PX} a side are read."
        )
    t, x, y, p = (values.cpu().numpy() for values in (stream.t_us, stream.x, stream.y, stream.p))
    return EventColumns(
        t, x.astype(np.int16), y.astype(np.int16), p > 0, stream.height_px, stream.width_px, size_from
    )


def settled_size(
    path: str | Path,
    x: np.ndarray,
    y: np.ndarray,
    given: tuple[int, int] | None = None,
    told: tuple[int, int] | None = None,
    told_by: str = "the file",
) -> tuple[int, int, str]:
    """(height_px, width_px, phrase that says where they are from).

    Args: path: for messages. x, y: [N] columns and rows of the events. given: (height_px, width_px) of the
      caller, or None. told: the same from the data, or None; told_by: what told them.
    A recording that says nothing is taken to be of the smallest sensor of SENSORS_PX that holds its events.
    Raises: FileFormatError for sizes that disagree.
    """
    given = None if given is None else check_size(given, "the sensor's size asked for")
    told = None if told is None else check_size(told, f"the sensor's size by {told_by}")
    if given is not None and told is not None and given != told:
        raise FileFormatError(
            f"{path} comes from a sensor of {told[1]} x {told[0]} pixels by {told_by}, but {given[1]} x "
            f"{given[0]} was asked for."
        )
    if told is not None:
        (height, width), phrase = told, told_by
    elif given is not None:
        (height, width), phrase = given, "the options"
    else:
        reach = (int(x.max()) + 1, int(y.max()) + 1) if len(x) else (1, 1)
        fits = [
            (name, size) for name, size in SENSORS_PX.items() if size[0] >= reach[0] and size[1] >= reach[1]
        ]
        name, (width, height) = fits[0] if fits else ("its events", reach)
        phrase = (
            f"{name}, the smallest known sensor that holds the events" if fits else "the events themselves"
        )
    return int(height), int(width), phrase


def on_sensor(
    path: str | Path,
    table: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    size: tuple[int, int, str],
    skip: Collection[str] = (),
    left_out: dict[str, int] | None = None,
) -> EventColumns:
    """EventColumns of t_us, x, y, on, all on a sensor of ``size`` (see settled_size).

    Args: skip: faults whose events are left out and counted: OFF_SENSOR. left_out: counts so far.
    Raises: FileFormatError for an event outside, with its number, and where nothing is left.
    """
    height, width, phrase = size
    counted = dict(left_out or {})
    _, x, y, _ = table
    outside = (x < 0) | (x >= width) | (y < 0) | (y >= height)
    if bool(outside.any()) and OFF_SENSOR not in skip:
        at = int(np.argmax(outside))
        label, value, limit = ("x", x[at], width) if not 0 <= x[at] < width else ("y", y[at], height)
        raise FileFormatError(
            f"{path}: event {at} lies at {label} = {int(value)}; the sensor has {limit} pixels there by {phrase} "
            f"(0 to {limit - 1}); give its true size, or leave such events out (skip)."
        )
    if OFF_SENSOR in skip:
        counted[OFF_SENSOR] = counted.get(OFF_SENSOR, 0) + int(outside.sum())
        table = tuple(values[~outside] for values in table)  # pyright: ignore[reportAssignmentType]
    if not len(table[0]):
        raise FileFormatError(f"{path} holds no event that is on the sensor and in order of time.")
    return EventColumns(*table, height, width, phrase, counted)
