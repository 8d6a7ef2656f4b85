"""Packets of a recording: windows of events, each with its true flow where there is one."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image

from codesign.errors import DomainError, FileFormatError
from codesign.events.columns import EventColumns
from codesign.events.files import read_columns
from codesign.events.formats.arrival import Asked
from codesign.flow.checks import check_kind, check_path, check_size
from codesign.flow.sources import folders, truth
from codesign.flow.sources.packet import (
    OUTSIDE,
    Packet,
    PacketOptions,
    check_options,
    covers,
    spread,
    windows,
    without,
)
from codesign.flow.sources.packet_truth import NO_TRUTH, Truth, is_motion, packet, read_source
from codesign.reading import open_regular, reading

LONGEST_S = 1.0  # of a packet that is a file of its own
# width, height: the sensors that recordings without a size come from, smallest first
SENSORS_PX = {
    "DAVIS240C": (240, 180),
    "DAVIS346": (346, 260),
    "VGA (DVXplorer, Prophesee Gen3)": (640, 480),
    "Prophesee HD": (1280, 720),
}


def read_packets(
    path: str | Path, truth_path: str | Path | None = None, options: PacketOptions | None = None
) -> list[Packet]:
    """Read a recording and its true flow.

    Args:
      path: folder with events.txt (Event-Camera Dataset), folder or subfolders of numbered packets, one
        event file of any kind, or a zip archive.
      truth_path: flow file or folder (see read_truth), imu.txt or groundtruth.txt. None: what lies
        beside the events, flow files before the gyroscope before poses. The last two need calib.txt and
        give the flow of rotation alone.
    Returns: [Packet], at least one. A flow over another time than its packet's is scaled linearly, and a note
      says so. A window that the recorded motion does not cover is a packet without truth, and a note says so.
    Raises: FileFormatError, DomainError.
    """
    options = PacketOptions() if options is None else options
    check_options(options, truth_path)
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
            found = [_as_packet(file, own, options) for file, own in zip(chosen, given, strict=True)]
            return _with_truth_somewhere(found)
        if truth_path is None and Path(path).is_dir():
            truth_path = folders.truth_beside(files[0], True) or folders.truth_folder(files[0])
        return _with_truth_somewhere(_cut(files[0], truth_path, options))


def read_recording(path: str | Path, options: PacketOptions | None = None) -> EventColumns:
    """All events of a recording that is one event file, or a folder or zip archive with one.

    Returns: EventColumns, whose ``chunks()`` a flow.Tracker takes.
    Raises: FileFormatError, DomainError; also for a folder of several packets.
    """
    options = PacketOptions() if options is None else options
    check_options(options, None)
    with folders.opened(path) as place:
        files = folders.event_files(place)
        if len(files) > 1:
            raise DomainError(
                f"{path} holds {len(files)} packets, which are no one stream; give one of its files."
            )
        return read_events(files[0], options)


def read_events(path: Path, options: PacketOptions, truth_path: Path | None = None) -> EventColumns:
    """EventColumns of one event file of any kind that events.read takes."""
    told = truth.size_of(truth_path) if truth_path is not None else None
    told_by = f"the flow in {truth_path}"
    if told is None and Path(path).suffix.lower() in (".txt", ".csv"):
        told, told_by = _size_of_images(Path(path).parent), "its frames"
    return read_text_events(
        path, options.size_px, told, told_by, options.columns, options.time_unit, options.skip
    )


def read_text_events(
    path: str | Path,
    size: tuple[int, int] | None = None,
    told: tuple[int, int] | None = None,
    told_by: str = "the file",
    columns: str = "auto",
    time_unit: str = "auto",
    skip: Collection[str] = (),
) -> EventColumns:
    """Read events from a file of text, or any other that events.read takes.

    Args:
      path: file.
      size: (height, width) of the sensor.
      told, told_by: the same from what lies beside, and what that is. Without either, the smallest
        sensor of SENSORS_PX that holds the events, where the file does not say.
      columns, time_unit: as of events.read.
      skip: faults whose events are left out and counted instead of refused: events_back_in_time,
        events_off_sensor.
    Returns: EventColumns in order of time. Events up to 1 ms late are put in order.
    Raises: FileFormatError, as events.read, and where no event is left.
    """
    height, width = (None, None) if size is None else check_size(size, "the sensor's size asked for")
    told = None if told is None else check_size(told, f"the sensor's size by {told_by}")
    skip = tuple(check_kind(fault, str, "a fault to skip") for fault in skip)
    found = read_columns(
        check_path(path), Asked(height, width, told, told_by, SENSORS_PX, columns, time_unit, skip)
    )
    if not len(found):
        raise FileFormatError(f"{path} holds no event that is on the sensor and in order of time.")
    return found


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
        if path is not None and Path(path).suffix.lower() in folders.FLOW_SUFFIXES and not is_motion(path)
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
    source = read_source(file, path, held, options)
    if source is not None and source.flows is not None:
        flows = source.flows
        if index is not None and len(flows) not in (1, total):
            raise FileFormatError(
                f"{path} holds {len(flows)} flows for {total} packets; one for each, or one for all, is "
                "needed."
            )
        own_flow = flows[index if index is not None and len(flows) > 1 else 0]
        source = replace(source, flows=[own_flow])
        if own_flow.span_s is not None and options.window_s is None:
            ends = round(own_flow.span_s[0] * 1e6), round(own_flow.span_s[1] * 1e6)
            if not covers((t0_us, t1_us), ends):
                raise FileFormatError(
                    f"{own_flow.name} runs from {own_flow.span_s[0]:.6f} to {own_flow.span_s[1]:.6f} s, "
                    f"the events of {file} do not; are both on one clock?"
                )
            t0_us, t1_us = ends
    name = f"{file.parent.name}/{file.name}"
    return packet(name, held, (t0_us, t1_us), source, 0, _ends(file, held), options, _beside(file))


def _cut(file, truth_path, options):
    """Windows of one event file."""
    held = read_events(
        file, options, truth_path if truth_path is not None and not is_motion(truth_path) else None
    )
    source = read_source(file, truth_path, held, options)
    whole = _ends(file, held)
    start_us = whole[0] + round((options.start_s or 0.0) * 1e6)
    notes = _beside(file)
    if source is not None and source.flows is not None:
        return _cut_by_flows(file, held, source, source.flows, whole, start_us, options, notes)
    chosen, left_out = windows(held, whole, start_us, options, in_turn=False)
    return [
        packet(
            f"{file.name} {(t0 - whole[0]) * 1e-6:.3f} s",
            held,
            (t0, t1),
            source,
            0,
            whole,
            options,
            notes,
            left_out,
        )
        for t0, t1 in chosen
    ]


def _cut_by_flows(file, held, source: Truth, flows, whole, start_us, options, notes):
    """Windows of one event file with a flow for each: those of the flows' own times, or one after the
    other."""
    asked = options.window_s is not None or options.events is not None
    unlimited = replace(options, skip=(), count=options.count or len(flows))
    left_out = {}
    if all(flow.span_s is not None for flow in flows[:-1] or flows):
        spans = [tuple(round(end * 1e6) for end in flow.span_s or ()) for flow in flows]
        inside = [k for k, span in enumerate(spans) if span and covers((start_us, whole[1]), span)]
        timed = sum(map(bool, spans))
        if not inside:
            raise FileFormatError(
                f"none of the {timed} flows lies within the recording's {whole[0] * 1e-6:.6f} to "
                f"{whole[1] * 1e-6:.6f} s; are both on one clock?"
            )
        if len(inside) < timed:
            left_out[OUTSIDE] = timed - len(inside)
            notes = (
                f"{timed - len(inside)} of {timed} true flows lie outside the recording or before the start asked for",
                *notes,
            )
        length_us = round(options.window_s * 1e6) if options.window_s else 0
        pairs = [(k, (spans[k][0], spans[k][0] + length_us if length_us else spans[k][1])) for k in inside]
        wholes = [whole] * len(pairs)
    elif asked or options.start_s is not None:
        pairs = list(enumerate(windows(held, whole, start_us, unlimited, in_turn=True)[0][: len(flows)]))
        wholes = [whole] * len(pairs)  # one flow says nothing of a second window
    else:
        edges = np.rint(np.linspace(whole[0], whole[1], len(flows) + 1)).astype(np.int64).tolist()
        if options.truth_interval_s is not None:
            edges = [whole[0] + round(k * options.truth_interval_s * 1e6) for k in range(len(flows) + 1)]
        pairs = list(enumerate(pairwise(edges)))[: options.count]
        wholes = [window for _, window in pairs]
    kept, more = without([window for _, window in pairs], held, options.skip)
    found = [
        packet(f"{file.name} {k}", held, window, source, k, one, options, notes, left_out | more)
        for (k, window), one in zip(pairs, wholes, strict=True)
        if window in kept
    ]
    return spread(found, options.count)


def _with_truth_somewhere(packets: Sequence[Packet]) -> list[Packet]:
    """The packets, unless a truth was given that tells of none of them."""
    missing = [note for one in packets for note in one.notes if note.startswith(NO_TRUTH)]
    if len(missing) == len(packets):
        raise FileFormatError(f"{missing[0].removeprefix(NO_TRUTH)}, nor any other; are both on one clock?")
    return list(packets)


def _beside(file):
    """Notes of the event files of the same name that were passed over."""
    others = folders.passed_over(file)
    return (
        (f"events from {file.name}; {', '.join(path.name for path in others)} beside it not read",)
        if others
        else ()
    )


def _ends(file, held):
    if len(held) < 2 or held.t_us[-1] <= held.t_us[0]:
        raise FileFormatError(f"{file} holds {len(held)} event(s) at one time; a packet lasts some time.")
    return int(held.t_us[0]), int(held.t_us[-1])


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
    with open_regular(first) as file, reading(first, "remove this frame or give the sensor size"):
        with Image.open(file) as image:
            return image.height, image.width
