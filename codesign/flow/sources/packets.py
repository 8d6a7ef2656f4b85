"""Packets of a recording: windows of events, each with its true flow where there is one."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError

from codesign import events
from codesign.errors import DomainError, FileFormatError
from codesign.events.entry import check_whole
from codesign.flow.checks import check_kind, check_number, check_path, check_size
from codesign.flow.sources import columns, folders, truth
from codesign.flow.sources.array_events import read_array_events
from codesign.flow.sources.attitude import read_gyroscope, read_poses
from codesign.flow.sources.calibration import read_calibration, signed_axes
from codesign.flow.sources.columns import EventColumns
from codesign.flow.sources.text_events import read_text_events
from codesign.types import EventStream, FlowField

WHOLE_S = 0.1  # a recording up to this long is one packet unless windows are asked for
# otherwise
WINDOW_S = 0.02
PACKETS = 10
LONGEST_S = 1.0  # of a packet that is a file of its own


@dataclass(frozen=True)
class Packet:
    """stream: the events of a window. t0_us, t1_us: its ends, both included. truth: flow over the window [1,
    2, H, W], or None. name, notes: for people."""

    name: str
    stream: EventStream
    t0_us: int
    t1_us: int
    truth: FlowField | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PacketOptions:
    """How a recording is read and cut.

    window_s, start_s, count: length of the windows, start of the first (seconds after the first event), and
      how many; events: cut by this number instead.
    size_px: (height, width) of the sensor. columns, time_unit: of text, see read_text_events. truth_unit:
      "px" per interval or "px/s".
    truth_interval_s: what a flow without times of its own covers. gyro_axes: camera axes from the
      gyroscope's. calibration: file, instead of calib.txt beside.
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


def read_packets(
    path: str | Path, truth_path: str | Path | None = None, options: PacketOptions | None = None
) -> list[Packet]:
    """Read a recording and its true flow.

    Args:
      path: folder with events.txt (Event-Camera Dataset), folder or subfolders of numbered packets, one event
        file of any kind, or a zip archive.
      truth_path: flow file or folder (see read_truth), imu.txt or groundtruth.txt. None: what lies beside the
        events, flow files before the gyroscope before poses. The last two need calib.txt and give the flow of
        rotation alone.
    Returns: [Packet], at least one. A flow over another time than its packet's is scaled linearly, and a note
      says so.
    Raises: FileFormatError, DomainError.
    """
    options = PacketOptions() if options is None else options
    _check(options, truth_path)
    with folders.opened(path) as place:
        files = folders.event_files(place)
        if len(files) > 1:
            if options.start_s is not None or options.events is not None:
                raise DomainError(
                    f"{path} holds {len(files)} packets, so a start or a number of events has no meaning; "
                    "give one of its files."
                )
            chosen = files[: options.count] if options.count else files
            given = [folders.truth_beside(file, False) or _alone(file) for file in chosen]
            if truth_path is None and not any(given) and len({file.parent for file in files}) == 1:
                truth_path = folders.truth_folder(files[0])
            if truth_path is not None:
                given = _numbered(truth_path, chosen, len(files))
            return [_as_packet(file, own, options) for file, own in zip(chosen, given, strict=True)]
        if truth_path is None and Path(path).is_dir():
            truth_path = folders.truth_beside(files[0], True) or folders.truth_folder(files[0])
        return _cut(files[0], truth_path, options)


def read_events(path: Path, options: PacketOptions, truth_path: Path | None = None) -> EventColumns:
    """EventColumns of one event file of any kind."""
    path = Path(path)
    size = options.size_px
    kind = path.suffix.lower()
    if kind in (".txt", ".csv"):
        told = truth.size_of(truth_path) if truth_path is not None else None
        told, by = (
            (told, f"the flow in {truth_path}") if told else (_size_of_images(path.parent), "its frames")
        )
        return read_text_events(path, size, told, by, options.columns, options.time_unit)
    if kind in (".npy", ".npz"):
        return read_array_events(path, size, options.time_unit)
    return columns.from_stream(
        events.read(path, **({} if size is None else {"height_px": size[0], "width_px": size[1]}))
    )


def _check(options, truth_path):
    check_kind(options, PacketOptions, "the options")
    for name in ("window_s", "truth_interval_s"):
        if getattr(options, name) is not None:
            check_number(getattr(options, name), name, above=0.0)
    for name in ("count", "events"):
        if getattr(options, name) is not None:
            check_whole(getattr(options, name), name, 1)
    if options.start_s is not None:
        check_number(options.start_s, "start_s", 0.0)
    if options.size_px is not None:
        check_size(options.size_px, "size_px")
    for name in ("columns", "time_unit", "gyro_axes"):
        check_kind(getattr(options, name), str, name)
    for unit in (options.calibration, truth_path):
        if unit is not None:
            check_path(unit)
    if options.truth_unit not in ("px", "px/s"):
        raise DomainError(
            f"the truth's unit is {options.truth_unit!r}; 'px' (per interval) or 'px/s' is possible."
        )
    if options.window_s is not None and options.events is not None:
        raise DomainError("windows are cut by time or by number of events; give one of both.")


def _alone(file):
    """The flow file of a packet that has a folder of its own."""
    return folders.truth_beside(file, True) if file.stem.lower() == "events" else None


def _numbered(truth_path, chosen, total):
    """The truth of each packet: the same number of a folder's files, or of the flows of one file."""
    truth_path = Path(truth_path)
    if truth_path.is_dir():
        files = folders.flow_files(truth_path)
        if len(files) not in (total, len(chosen)):
            raise FileFormatError(
                f"{truth_path} holds {len(files)} flow files for {total} packets; one for each is needed."
            )
        return files[: len(chosen)]
    return [(truth_path, k, total) for k in range(len(chosen))]


def _as_packet(file, own, options):
    """The packet that a whole event file is."""
    path, index, total = own if isinstance(own, tuple) else (own, None, 1)
    held = read_events(
        file,
        options,
        path
        if path is not None and Path(path).suffix.lower() in folders.FLOW_SUFFIXES and not _is_motion(path)
        else None,
    )
    t0_us, t1_us = _ends(file, held)
    if options.window_s is not None:
        t1_us = t0_us + round(options.window_s * 1e6)
    elif t1_us - t0_us > LONGEST_S * 1e6:
        raise DomainError(
            f"{file} lasts {(t1_us - t0_us) * 1e-6:.3f} s, too long for one packet of several; give its "
            "folder alone to cut it, or a window."
        )
    source = _source(file, path, held, options)
    if isinstance(source, list):
        if index is not None and len(source) not in (1, total):
            raise FileFormatError(
                f"{path} holds {len(source)} flows for {total} packets; one for each, or one for all, is "
                "needed."
            )
        source = [source[index if index is not None and len(source) > 1 else 0]]
        if source[0].span_s is not None and options.window_s is None:
            if not _covers((t0_us, t1_us), [round(end * 1e6) for end in source[0].span_s]):
                raise FileFormatError(
                    f"{source[0].name} runs from {source[0].span_s[0]:.6f} to {source[0].span_s[1]:.6f} s, "
                    f"the events of {file} do not; are both on one clock?"
                )
            t0_us, t1_us = (round(end * 1e6) for end in source[0].span_s)
    return _packet(
        file.parent.name + "/" + file.name, held, t0_us, t1_us, source, 0, _ends(file, held), options
    )


def _cut(file, truth_path, options):
    """Windows of one event file."""
    held = read_events(
        file, options, truth_path if truth_path is not None and not _is_motion(truth_path) else None
    )
    source = _source(file, truth_path, held, options)
    whole = _ends(file, held)
    flows = source if isinstance(source, list) else None
    asked = options.window_s is not None or options.events is not None
    start_us = whole[0] + round((options.start_s or 0.0) * 1e6)
    if flows and all(flow.span_s is not None for flow in flows[:-1] or flows):
        flows = [flow for flow in flows if flow.span_s is not None]
        spans = [tuple(round(end * 1e6) for end in flow.span_s) for flow in flows if flow.span_s is not None]
        kept = [k for k, span in enumerate(spans) if _covers((start_us, whole[1]), span)]
        if not kept:
            raise FileFormatError(
                f"none of the {len(spans)} flows lies within the recording's {whole[0] * 1e-6:.6f} to "
                f"{whole[1] * 1e-6:.6f} s; are both on one clock?"
            )
        left_out = (
            ()
            if len(kept) == len(spans)
            else (
                f"{len(spans) - len(kept)} of {len(spans)} true flows lie outside the recording or before "
                "the start asked for",
            )
        )
        kept = _spread(kept, options.count)
        windows = [
            (spans[k][0], spans[k][0] + round(options.window_s * 1e6) if options.window_s else spans[k][1])
            for k in kept
        ]
        return [
            _packet(f"{file.name} {k}", held, *window, [flows[k]], 0, whole, options, left_out)
            for k, window in zip(kept, windows, strict=True)
        ]
    if flows and not asked and options.start_s is None:
        edges = np.rint(np.linspace(whole[0], whole[1], len(flows) + 1)).astype(np.int64).tolist()
        if options.truth_interval_s is not None:
            edges = [whole[0] + round(k * options.truth_interval_s * 1e6) for k in range(len(flows) + 1)]
        windows = list(pairwise(edges))[: options.count]
        return [
            _packet(f"{file.name} {k}", held, *window, flows, k, window, options)
            for k, window in enumerate(windows)
        ]
    windows = _windows(held, whole, start_us, options, asked, in_turn=bool(flows))
    if flows:
        windows = windows[: len(flows)]  # one flow says nothing of a second window
    return [
        _packet(f"{file.name} {(t0 - whole[0]) * 1e-6:.3f} s", held, t0, t1, source, k, whole, options)
        for k, (t0, t1) in enumerate(windows)
    ]


def _windows(held, whole, start_us, options, asked, in_turn):
    """Windows whose times no truth tells: the whole of a short recording; otherwise some, one after the other
    where a start or flows are given, else spread evenly."""
    if (
        not asked
        and options.start_s is None
        and options.count is None
        and whole[1] - whole[0] <= WHOLE_S * 1e6
    ):
        return [whole]
    if options.events is not None:
        first = int(np.searchsorted(held.t_us, start_us))
        starts = list(range(first, len(held) - options.events + 1, options.events))
        if not starts:
            raise DomainError(
                f"{len(held) - first} events follow the start; windows of {options.events} need more."
            )
        starts = starts[: options.count or PACKETS] if in_turn else _spread(starts, options.count or PACKETS)
        return [
            (int(held.t_us[k]), max(int(held.t_us[k + options.events - 1]), int(held.t_us[k]) + 1))
            for k in starts
        ]
    length_us = round((options.window_s or min(WINDOW_S, (whole[1] - whole[0]) * 1e-6)) * 1e6)
    possible = (whole[1] - start_us) // length_us if length_us > 0 else 0
    if possible < 1:
        raise DomainError(
            f"the recording lasts {(whole[1] - whole[0]) * 1e-6:.6f} s; no window of {length_us * 1e-6:g} s "
            "fits behind the start."
        )
    in_turn = in_turn or options.start_s is not None
    chosen = (
        range(min(possible, options.count or PACKETS))
        if in_turn
        else _spread(list(range(possible)), options.count or PACKETS)
    )
    return [(start_us + k * length_us, start_us + (k + 1) * length_us) for k in chosen]


def _covers(whole, span):
    """Whether a window lies within the times of events; a tenth of it may lie beside, where nothing may have
    happened."""
    slack = (span[1] - span[0]) / 10
    return whole[0] - slack <= span[0] and span[1] <= whole[1] + slack


def _spread(choices, count):
    """Evenly spread members of a list, at most ``count``."""
    if not count or len(choices) <= count:
        return choices
    return [choices[k] for k in np.linspace(0, len(choices) - 1, count).round().astype(int)]


def _ends(file, held):
    if len(held) < 2 or held.t_us[-1] <= held.t_us[0]:
        raise FileFormatError(f"{file} holds {len(held)} event(s) at one time; a packet lasts some time.")
    return int(held.t_us[0]), int(held.t_us[-1])


def _is_motion(path):
    return Path(path).name.lower().endswith(("imu.txt", "groundtruth.txt", "imu.csv", "groundtruth.csv"))


def _source(file, path, held, options):
    """[TrueFlow], (Attitude, Calibration), or None."""
    if path is None:
        path = next(
            (
                found
                for name in ("imu.txt", "groundtruth.txt")
                if (found := folders.side_file(file, name)) is not None
            ),
            None,
        )
        if path is None or (options.calibration is None and folders.side_file(file, "calib.txt") is None):
            return None
    if not _is_motion(path):
        return truth.read_truth(path, (held.height_px, held.width_px))
    calibration = (
        options.calibration
        or folders.side_file(Path(path), "calib.txt")
        or folders.side_file(file, "calib.txt")
    )
    if calibration is None:
        raise FileFormatError(
            f"flow from {path} needs the camera: no calib.txt lies beside it; name the file."
        )
    read = (
        read_gyroscope(path, signed_axes(options.gyro_axes))
        if "imu" in Path(path).name.lower()
        else read_poses(path)
    )
    return read, read_calibration(calibration)


def _packet(name, held, t0_us, t1_us, source, index, whole, options, more_notes=()):
    """One packet; a flow is brought to its window."""
    stream = held.window(t0_us, t1_us)
    seconds = (t1_us - t0_us) * 1e-6
    notes = [*more_notes, f"sensor {held.width_px} x {held.height_px} px by {held.size_from}"]
    if source is None:
        return Packet(name, stream, t0_us, t1_us, None, tuple(notes))
    if isinstance(source, tuple):
        attitude, calibration = source
        flow, valid = calibration.rotation_flow(
            attitude.turn(t0_us * 1e-6, t1_us * 1e-6), held.height_px, held.width_px
        )
        moved = attitude.moved_m(t0_us * 1e-6, t1_us * 1e-6)
        notes.append(
            f"true flow of rotation alone, from {Path(attitude.name).name}"
            + ("" if moved is None else f"; the camera also moved {1e3 * moved:.2f} mm, which is neglected")
        )
    else:
        true = source[index if len(source) > 1 else 0]
        span_s = (
            true.span_s[1] - true.span_s[0]
            if true.span_s is not None
            else options.truth_interval_s or (whole[1] - whole[0]) * 1e-6
        )
        scale = seconds if options.truth_unit == "px/s" else seconds / span_s
        if abs(scale - 1) > 1e-3 and options.truth_unit == "px":
            notes.append(f"true flow over {1e3 * span_s:.3f} ms scaled linearly to {1e3 * seconds:.3f} ms")
        else:
            scale = scale if options.truth_unit == "px/s" else 1.0
        flow = true.flow * scale
        valid = true.valid
        notes.append(f"true flow from {Path(true.name).name}")
    field = FlowField(
        torch.from_numpy(flow).float()[None], torch.from_numpy(np.ascontiguousarray(valid))[None], seconds
    )
    return Packet(name, stream, t0_us, t1_us, field, tuple(notes))


def _size_of_images(folder):
    """(height, width) of the first frame in images/, or None."""
    place = folder / "images"
    first = (
        min((entry for entry in place.iterdir() if entry.suffix.lower() in (".png", ".jpg")), default=None)
        if place.is_dir()
        else None
    )
    if first is None:
        return None
    try:
        with Image.open(first) as image:
            return image.height, image.width
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise FileFormatError(
            f"{first} is not a readable frame ({error}); remove it or give the sensor size."
        ) from error
