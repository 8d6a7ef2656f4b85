"""A packet of a recording, how a recording is to be read and cut into them, and where it has
gaps."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from codesign.checks import check_choice, check_kind, check_number, check_path, check_whole
from codesign.errors import DomainError, shown
from codesign.events.columns import EventColumns
from codesign.events.formats.arrival import BACKWARDS, OFF_SENSOR
from codesign.flow.checks import check_size
from codesign.types import EventStream, FlowField

EMPTY = "windows_without_events"
GAP = "windows_across_gaps"
OUTSIDE = "true_flows_outside"  # the recording, or before the start asked for
SKIPPABLE = (BACKWARDS, OFF_SENSOR, EMPTY, GAP)  # what PacketOptions.skip may name
MOST_S = 1e9  # of a recording
# the flow of a translation, for a scene 1 m away, that makes the flow of rotation alone no truth:
# px, and a share of it
TRANSLATION_PX = 0.1
TRANSLATION_SHARE = 0.25

Choice = TypeVar("Choice")
Window = tuple[int, int]
WHOLE_S = 0.1  # a recording up to this long is one packet unless windows are asked for
# otherwise
WINDOW_S = 0.02
PACKETS = 10
# a gap: no event of the whole sensor for so long, and for so many times the mean time between
# events
GAP_US = 10_000
GAP_EVENTS = 100


@dataclass(frozen=True)
class Packet:
    """A window of events with its true flow.

    stream: the events of the window. t0_us, t1_us: from its start, included, to its end,
      which belongs to the next one (the last of a recording is included). truth: flow over the
      window [1, 2, H, W], or None. name, notes: for people.
    rotation_only: the truth is the flow of the camera's rotation alone. neglected_px: length of the
      flow that it leaves out, for a scene 1 m away; None where nobody recorded how the camera
      moved.
    undistorted_px: by how much the truth would be off in the mean if it belonged to undistorted
      pixels; 0 where the camera has no distortion, or none is known.
    across_gap: at least half of the window lies where the recording has no event at all.
    left_out: how many events and windows of the recording were left out, by fault; the same for all
      its packets.
    """

    name: str
    stream: EventStream
    t0_us: int
    t1_us: int
    truth: FlowField | None
    notes: tuple[str, ...] = ()
    rotation_only: bool = False
    neglected_px: float | None = 0.0
    undistorted_px: float = 0.0
    across_gap: bool = False
    left_out: Mapping[str, int] = field(default_factory=dict)

    @property
    def translates(self) -> bool:
        """The camera moved so far that the flow of its rotation alone is no truth for scenes nearer
        than some metres."""
        if self.truth is None or not self.rotation_only or self.neglected_px is None:
            return False
        flow = self.truth.flow_px.square().sum(1).sqrt()[self.truth.valid]
        length = float(flow.mean()) if flow.numel() else 0.0
        return self.neglected_px > max(TRANSLATION_PX, TRANSLATION_SHARE * length)


@dataclass(frozen=True)
class PacketOptions:
    """How a recording is read and cut.

    window_s, start_s, count: length of the windows, start of the first (seconds after the first
      event), and how many; events: cut by this number instead.
    size_px: (height, width) of the sensor. columns, time_unit: of text, see events.read.
      truth_unit: "px" per interval or "px/s".
    truth_interval_s: what a flow without times of its own covers. gyro_axes: camera axes from the
      gyroscope's. calibration: file, instead of calib.txt beside.
    truth_pixels: "raw" where flow files belong to the sensor's pixels, "undistorted" where to those
      of a pinhole with the same focal lengths and centre, from which they are then carried to the
      sensor's.
    skip: faults that are left out and counted instead of refused (events) or kept (windows): names
      of SKIPPABLE.
    """

    window_s: float | None = None
    start_s: float | None = None
    count: int | None = None
    events: int | None = None
    size_px: tuple[int, int] | None = None
    columns: str = "auto"
    time_unit: str = "auto"
    truth_unit: str = "px"
    truth_interval_s: float | None = None
    gyro_axes: str = "xyz"
    calibration: Path | None = None
    truth_pixels: str = "raw"
    skip: tuple[str, ...] = ()


def check_options(options: PacketOptions, truth_path: object) -> None:
    """Raise DomainError, ShapeError or FileFormatError unless options and path mean something."""
    given = {
        n: v
        for n, v in vars(check_kind(options, PacketOptions, "the options")).items()
        if v is not None
    }
    for name in {"window_s", "truth_interval_s"} & given.keys():
        check_number(given[name], name, above=0.0, most=MOST_S)
    if "start_s" in given:
        check_number(given["start_s"], "start_s", 0.0, MOST_S)
    for name in {"count", "events"} & given.keys():
        check_whole(given[name], name, 1)
    if "size_px" in given:
        check_size(options.size_px, "size_px")
    for name in ("columns", "time_unit", "gyro_axes"):
        check_kind(getattr(options, name), str, name)
    for path in (options.calibration, truth_path):
        if path is not None:
            check_path(path)
    check_choice(options.truth_unit, "truth_unit", ("px", "px/s"))
    check_choice(options.truth_pixels, "truth_pixels", ("raw", "undistorted"))
    if not isinstance(options.skip, tuple) or not set(options.skip) <= set(SKIPPABLE):
        raise DomainError(
            f"skip is {shown(options.skip)}; a tuple of {', '.join(SKIPPABLE)} is possible."
        )
    if options.window_s is not None and options.events is not None:
        raise DomainError("windows are cut by time or by number of events; give one of both.")


def windows(
    held: EventColumns, whole: Window, start_us: int, options: PacketOptions, in_turn: bool
) -> tuple[list[Window], dict[str, int]]:
    """Windows whose times no truth tells, and how many were left out by which fault.

    The whole of a short recording; otherwise some, one after the other where a start or flows are
    given (``in_turn``), else spread evenly.
    """
    asked = options.window_s is not None or options.events is not None or options.count is not None
    if not asked and options.start_s is None and whole[1] - whole[0] <= WHOLE_S * 1e6:
        return [whole], {}
    if options.events is not None:
        first = int(np.searchsorted(held.t_us, start_us))
        starts = range(first, len(held) - options.events + 1, options.events)
        if not starts:
            raise DomainError(
                f"{len(held) - first} events follow the start; windows of {options.events} need more."
            )
        last = len(held) - 1
        ends = ((k, min(k + options.events, last)) for k in starts)
        # an end at the last event takes it in: where one event is left over, the window ends before
        # it, if there is a microsecond between them
        spare = int(
            first + len(starts) * options.events == last and held.t_us[-1] - held.t_us[-2] > 1
        )
        times = [(int(held.t_us[a]), int(held.t_us[b]) - (b == last) * spare) for a, b in ends]
        # events of one microsecond stay together
        possible = [(t0, t1) for t0, t1 in times if t1 > t0]
        if not possible:
            raise DomainError(
                f"all {len(held) - first} events behind the start are of one microsecond; a window lasts some time."
            )
    else:
        in_turn = in_turn or options.start_s is not None
        length_us = round((options.window_s or min(WINDOW_S, (whole[1] - whole[0]) * 1e-6)) * 1e6)
        number = (whole[1] - start_us) // length_us if length_us > 0 else 0
        if number < 1:
            raise none_fits(whole, length_us)
        possible = [
            (start_us + k * length_us, start_us + (k + 1) * length_us) for k in range(number)
        ]
    kept, left_out = without(possible, held, options.skip)
    count = options.count or PACKETS
    return (kept[:count] if in_turn else spread(kept, count)), left_out


def none_fits(whole: Window, length_us: int) -> DomainError:
    """What to raise where no window of a length lies within a recording behind the start."""
    return DomainError(
        f"the recording lasts {(whole[1] - whole[0]) * 1e-6:.6f} s; no window of {length_us * 1e-6:g} s fits behind the "
        "start."
    )


def without(
    possible: list[Window], held: EventColumns, skip: tuple[str, ...]
) -> tuple[list[Window], dict[str, int]]:
    """The windows without those that ``skip`` names (EMPTY, GAP), and how many these were."""
    left_out = {}
    ends = np.array(possible, np.int64).reshape(-1, 2)
    behind = ends[:, 1] + (ends[:, 1] >= held.t_us[-1])
    few = np.searchsorted(held.t_us, behind) == np.searchsorted(held.t_us, ends[:, 0])
    kept = np.ones(len(possible), bool)
    for fault, bad in ((EMPTY, few), (GAP, across(possible, gaps(held.t_us)))):
        if fault in skip:
            left_out[fault] = int((bad & kept).sum())
            kept &= ~bad
    possible = [window for window, one in zip(possible, kept, strict=True) if one]
    if not possible:
        raise DomainError(
            f"no window is left: {', '.join(f'{n} {name}' for name, n in left_out.items())}."
        )
    return possible, left_out


def gaps(t_us: np.ndarray) -> np.ndarray:
    """Times without any event [N, 2], microseconds: at least 10 ms, and 100 times the mean time
    between events."""
    mean_us = float(t_us[-1] - t_us[0]) / max(len(t_us) - 1, 1) if len(t_us) else 0
    least_us = max(GAP_US, GAP_EVENTS * mean_us)
    at = np.flatnonzero(np.diff(t_us) > least_us)
    return np.stack([t_us[at], t_us[at + 1]], -1)


def across(possible: list[Window], empty_us: np.ndarray) -> np.ndarray:
    """[N] whether at least half of each window lies in gaps [M, 2]."""
    ends = np.array(possible, np.int64).reshape(-1, 1, 2)
    common = np.minimum(ends[..., 1], empty_us[:, 1]) - np.maximum(ends[..., 0], empty_us[:, 0])
    return 2 * np.maximum(common, 0).sum(1) >= (ends[:, 0, 1] - ends[:, 0, 0])


def covers(whole: Window, span: Window) -> bool:
    """Whether a window lies within the times of events; a tenth of it may lie beside, where nothing
    may have happened."""
    slack = (span[1] - span[0]) / 10
    return whole[0] - slack <= span[0] and span[1] <= whole[1] + slack


def spread(choices: list[Choice], count: int | None) -> list[Choice]:
    """Evenly spread members of a list, at most ``count``."""
    if not count or len(choices) <= count:
        return choices
    return [choices[k] for k in np.linspace(0, len(choices) - 1, count).round().astype(int)]
