"""A packet of a recording, and how a recording is to be read and cut into them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from codesign.errors import DomainError, shown
from codesign.events.entry import check_whole
from codesign.events.formats.arrival import BACKWARDS, OFF_SENSOR
from codesign.flow.checks import check_kind, check_number, check_path, check_size
from codesign.types import EventStream, FlowField

EMPTY = "windows_without_events"
GAP = "windows_across_gaps"
OUTSIDE = "true_flows_outside"  # the recording, or before the start asked for
SKIPPABLE = (BACKWARDS, OFF_SENSOR, EMPTY, GAP)  # what PacketOptions.skip may name
MOST_S = 1e9  # of a recording
# the flow of a translation, for a scene 1 m away, that makes the flow of rotation alone no truth: px, and a share of it
TRANSLATION_PX = 0.1
TRANSLATION_SHARE = 0.25


@dataclass(frozen=True)
class Packet:
    """A window of events with its true flow.

    stream: the events of the window. t0_us, t1_us: its ends, both included. truth: flow over the window [1, 2, H,
      W], or None. name, notes: for people.
    rotation_only: the truth is the flow of the camera's rotation alone. neglected_px: length of the flow that it
      leaves out, for a scene 1 m away; None where nobody recorded how the camera moved.
    undistorted_px: by how much the truth would be off in the mean if it belonged to undistorted pixels; 0 where
      the camera has no distortion, or none is known.
    across_gap: at least half of the window lies where the recording has no event at all.
    left_out: how many events and windows of the recording were left out, by fault; the same for all its packets.
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
        """The camera moved so far that the flow of its rotation alone is no truth for scenes nearer than some
        metres."""
        if self.truth is None or not self.rotation_only or self.neglected_px is None:
            return False
        flow = self.truth.flow_px.square().sum(1).sqrt()[self.truth.valid]
        length = float(flow.mean()) if flow.numel() else 0.0
        return self.neglected_px > max(TRANSLATION_PX, TRANSLATION_SHARE * length)


@dataclass(frozen=True)
class PacketOptions:
    """How a recording is read and cut.

    window_s, start_s, count: length of the windows, start of the first (seconds after the first event), and
      how many; events: cut by this number instead.
    size_px: (height, width) of the sensor. columns, time_unit: of text, see events.read. truth_unit:
      "px" per interval or "px/s".
    truth_interval_s: what a flow without times of its own covers. gyro_axes: camera axes from the
      gyroscope's. calibration: file, instead of calib.txt beside.
    truth_pixels: "raw" where flow files belong to the sensor's pixels, "undistorted" where to those of a pinhole
      with the same focal lengths and centre, from which they are then carried to the sensor's.
    skip: faults that are left out and counted instead of refused (events) or kept (windows): names of SKIPPABLE.
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
    check_kind(options, PacketOptions, "the options")
    for name in ("window_s", "truth_interval_s"):
        if getattr(options, name) is not None:
            check_number(getattr(options, name), name, above=0.0)
    for name in ("count", "events"):
        if getattr(options, name) is not None:
            check_whole(getattr(options, name), name, 1)
    if options.start_s is not None:
        check_number(options.start_s, "start_s", 0.0)
    for name in ("window_s", "truth_interval_s", "start_s"):
        if (getattr(options, name) or 0) > MOST_S:
            raise DomainError(
                f"{name} is {shown(getattr(options, name))}; at most {MOST_S:g} s are possible."
            )
    if options.size_px is not None:
        check_size(options.size_px, "size_px")
    for name in ("columns", "time_unit", "gyro_axes"):
        check_kind(getattr(options, name), str, name)
    for path in (options.calibration, truth_path):
        if path is not None:
            check_path(path)
    if options.truth_unit not in ("px", "px/s"):
        raise DomainError(
            f"the truth's unit is {shown(options.truth_unit)}; 'px' (per interval) or 'px/s' is possible."
        )
    if options.truth_pixels not in ("raw", "undistorted"):
        raise DomainError(
            f"truth_pixels is {shown(options.truth_pixels)}; 'raw' or 'undistorted' is possible."
        )
    if not isinstance(options.skip, tuple) or not set(options.skip) <= set(SKIPPABLE):
        raise DomainError(f"skip is {shown(options.skip)}; a tuple of {', '.join(SKIPPABLE)} is possible.")
    if options.window_s is not None and options.events is not None:
        raise DomainError("windows are cut by time or by number of events; give one of both.")
