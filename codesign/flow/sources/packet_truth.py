"""The true flow of a packet: from flow files, or of the camera's rotation."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch

from codesign.errors import FileFormatError
from codesign.events.columns import EventColumns
from codesign.flow.sources import folders
from codesign.flow.sources.camera import (
    Attitude,
    Calibration,
    read_calibration,
    read_gyroscope,
    read_poses,
)
from codesign.flow.sources.packet import Packet, PacketOptions, across, gaps
from codesign.flow.sources.truth import TrueFlow, read_truth
from codesign.types import FlowField

NO_TRUTH = "no true flow in some windows: "


@dataclass(frozen=True)
class Truth:
    """flows: the fields of files, in order; or motion: how the camera turned, and places: where it
    was (None:
    not recorded). calibration: of the camera, or None."""

    flows: list[TrueFlow] | None
    motion: Attitude | None = None
    places: Attitude | None = None
    calibration: Calibration | None = None


def is_motion(path: str | Path) -> bool:
    """Whether a file tells of the camera's motion, not of flow."""
    return (
        Path(path)
        .name.lower()
        .endswith(("imu.txt", "groundtruth.txt", "imu.csv", "groundtruth.csv"))
    )


def read_source(
    file: Path, path: str | Path | None, held: EventColumns, options: PacketOptions
) -> Truth | None:
    """Truth of an event file: of ``path``, or of what lies beside; None without any."""
    beside = options.calibration or folders.side_file(file, "calib.txt")
    if path is None:
        path = folders.side_file(file, "imu.txt") or folders.side_file(file, "groundtruth.txt")
        if path is None or beside is None:
            return None
    calibration = options.calibration or folders.side_file(Path(path), "calib.txt") or beside
    if not is_motion(path):
        flows = read_truth(path, (held.height_px, held.width_px))
        if options.truth_pixels == "undistorted" and calibration is None:
            raise FileFormatError(
                f"the flow in {path} is of undistorted pixels, and no calib.txt lies beside it; name the file."
            )
        return Truth(
            flows, calibration=None if calibration is None else read_calibration(calibration)
        )
    if calibration is None:
        raise FileFormatError(
            f"flow from {path} needs the camera: no calib.txt lies beside it; name the file."
        )
    if "imu" not in Path(path).name.lower():
        poses = read_poses(path)
        return Truth(None, poses, poses, read_calibration(calibration))
    recorded = folders.side_file(Path(path), "groundtruth.txt")
    places = None if recorded is None else read_poses(recorded)
    return Truth(
        None, read_gyroscope(path, options.gyro_axes), places, read_calibration(calibration)
    )


@dataclass(frozen=True)
class Opened:
    """An event file that becomes packets. events: of it all. truth: None without any. whole:
    (from, to) us.
    notes: of every packet."""

    file: Path
    events: EventColumns
    truth: Truth | None
    whole: tuple[int, int]
    options: PacketOptions
    notes: tuple[str, ...]

    def packet(
        self,
        name: str,
        window: tuple[int, int],
        flow: TrueFlow | None = None,
        over: tuple[int, int] | None = None,
        left_out: Mapping[str, int] = MappingProxyType({}),
    ) -> Packet:
        """One packet; its flow is brought to its window.

        Args:
          window: (from, to) us.
          flow: of the truth's files, where it is of such.
          over: what a flow without times covers, (from, to) us; ``whole`` when None.
          left_out: see Packet.
        """
        empty = gaps(self.events.t_us)
        t_us = self.events.t_us
        lasts_s = max(1e-6 * float(t_us[-1] - t_us[0]), 1e-6) if len(t_us) else 1e-6
        notes = [
            *self.notes,
            f"sensor {self.events.width_px} x {self.events.height_px} px by {self.events.size_from}",
            f"{len(t_us):,} events in {lasts_s:.4g} s, {len(t_us) / lasts_s:,.0f} a second",
        ]
        if len(empty):
            longest = float(np.diff(empty, axis=1).max()) * 1e-6
            notes.append(
                f"the recording has {len(empty)} gap(s) without any event, the longest of {longest:.3f} s"
            )
        found = Packet(
            name,
            # an end is the start of the next window, but at the recording's own
            self.events.window(window[0], window[1] - (window[1] < self.whole[1])),
            *window,
            None,
            tuple(notes),
            across_gap=bool(across([window], empty)[0]),
            left_out={**self.events.left_out, **left_out},
        )
        if flow is not None:
            return self._with_flow(found, flow, over or self.whole)
        return found if self.truth is None else _with_rotation(found, self.truth)

    def _with_flow(self, found, true, over):
        seconds = (found.t1_us - found.t0_us) * 1e-6
        over_s = self.options.truth_interval_s or (over[1] - over[0]) * 1e-6
        span_s = over_s if true.span_s is None else true.span_s[1] - true.span_s[0]
        notes = [*found.notes, f"true flow from {Path(true.name).name}"]
        scale = seconds
        if self.options.truth_unit == "px":
            scale = seconds / span_s
            if abs(scale - 1) > 1e-3:
                notes.append(
                    f"true flow over {1e3 * span_s:.3f} ms scaled linearly to {1e3 * seconds:.3f} ms"
                )
            else:
                scale = 1.0
        flow = true.flow * scale
        valid = true.valid
        off_px = 0.0
        calibration = None if self.truth is None else self.truth.calibration
        if calibration is not None and any(calibration.distortion):
            raw, seen = calibration.raw_flow(flow, valid)
            both = seen & valid
            if self.options.truth_pixels == "undistorted":
                flow, valid = raw, seen
                notes.append("true flow carried from undistorted to the sensor's pixels")
            elif both.any():
                off_px = float(np.hypot(*(raw - flow))[both].mean())
                notes.append(
                    f"the camera has distortion: if the true flow is of undistorted pixels, it is {off_px:.2f} px off in "
                    "the mean (truth_pixels says which)"
                )
        return replace(
            found, truth=_field(flow, valid, seconds), notes=tuple(notes), undistorted_px=off_px
        )


def _with_rotation(found, source):
    ends_s = found.t0_us * 1e-6, found.t1_us * 1e-6
    missing = source.motion.missing(*ends_s)
    if missing:
        return replace(found, notes=(*found.notes, f"{NO_TRUTH}{missing}"))
    size_px = found.stream.height_px, found.stream.width_px
    flow, valid = source.calibration.rotation_flow(source.motion.turn(*ends_s), *size_px)
    moved = (
        None
        if source.places is None or source.places.missing(*ends_s)
        else source.places.moved_m(*ends_s)
    )
    focal_px = sum(source.calibration.focal_px) / 2
    left_out = (
        "; how far it moved is not recorded"
        if moved is None
        else f"; it also moved {1e3 * moved:.2f} mm, which is neglected ({focal_px * moved:.2f} px of flow for a scene "
        "1 m away)"
    )
    return replace(
        found,
        truth=_field(flow, valid, ends_s[1] - ends_s[0]),
        notes=(
            *found.notes,
            f"true flow of the camera's rotation alone, from {Path(source.motion.name).name}{left_out}",
        ),
        rotation_only=True,
        neglected_px=None if moved is None else focal_px * moved,
    )


def _field(flow, valid, seconds):
    return FlowField(
        torch.from_numpy(np.ascontiguousarray(flow)).float()[None],
        torch.from_numpy(np.ascontiguousarray(valid))[None],
        seconds,
    )
