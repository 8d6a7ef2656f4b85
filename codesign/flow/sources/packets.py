"""Packets of a recording: windows of events, each with its true flow where there is one."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image

from codesign.errors import DomainError, FileFormatError
from codesign.events.columns import EventColumns
from codesign.events.files import read_columns
from codesign.events.formats.arrival import Asked
from codesign.flow.sources import folders, truth
from codesign.flow.sources.packet import (
    OUTSIDE,
    Packet,
    PacketOptions,
    check_options,
    covers,
    none_fits,
    spread,
    windows,
    without,
)
from codesign.flow.sources.packet_truth import NO_TRUTH, Opened, is_motion, read_source
from codesign.reading import open_regular, reading

LONGEST_S = 1.0  # of a packet that is a file of its own
SAME = 1e-3  # share of its length by which a window may differ from what a true flow covers
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
      path: folder with events.txt (Event-Camera Dataset), folder or subfolders of numbered packets,
        one event file of any kind, or a zip archive.
      truth_path: flow file or folder (see read_truth), imu.txt or groundtruth.txt. None: what lies
        beside the events, flow files before the gyroscope before poses. The last two need calib.txt
        and give the flow of rotation alone.
    Returns: [Packet], at least one. A flow over another time than its packet's is scaled linearly,
      and a note says so. A window that the recorded motion does not cover is a packet without
      truth, and a note says so.
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
            found = [
                _as_packet(file, own, options) for file, own in zip(chosen, given, strict=True)
            ]
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
    """EventColumns of one event file of any kind that events.read takes, in order of time; events
    up to 1 ms late are put in order. The sensor is the one asked for, or that of the flow or of the
    frames beside, or the smallest of SENSORS_PX that holds the events."""
    told, told_by = None, "the file"
    if truth_path is not None:
        told, told_by = truth.size_of(truth_path), f"the flow in {truth_path}"
    if told is None and path.suffix.lower() in (".txt", ".csv"):
        told, told_by = _size_of_images(path.parent), "its frames"
    height, width = options.size_px or (None, None)
    found = read_columns(
        path,
        Asked(
            height,
            width,
            told,
            told_by,
            SENSORS_PX,
            options.columns,
            options.time_unit,
            options.skip,
        ),
    )
    if not len(found):
        raise FileFormatError(f"{path} holds no event that is on the sensor and in order of time.")
    return found


def _alone(file):
    """The flow file of a packet that has a folder of its own."""
    return folders.truth_beside(file, True) if file.stem.lower() == "events" else None


def _numbered(truth_path, chosen, total):
    """The truth of each packet: the same number of a folder's files, or of the flows of one
    file."""
    truth_path = Path(truth_path)
    if truth_path.is_dir():
        files = folders.flow_files(truth_path)
        if len(files) not in (total, len(chosen)):
            raise FileFormatError(
                f"{truth_path} holds {len(files)} flow files for {total} packets; one for each is needed."
            )
        return files[: len(chosen)]
    return [(truth_path, k, total) for k in range(len(chosen))]


def _opened(file, truth_path, options):
    """An event file with what is known of it."""
    sized = truth_path is not None and not is_motion(truth_path)
    held = read_events(file, options, truth_path if sized else None)
    if len(held) < 2 or held.t_us[-1] <= held.t_us[0]:
        raise FileFormatError(
            f"{file} holds {len(held)} event(s) at one time; a packet lasts some time."
        )
    others = ", ".join(path.name for path in folders.passed_over(file))
    notes = (f"events from {file.name}; {others} beside it not read",) if others else ()
    source = read_source(file, truth_path, held, options)
    return Opened(file, held, source, (int(held.t_us[0]), int(held.t_us[-1])), options, notes)


def _as_packet(file, own, options):
    """The packet that a whole event file is."""
    path, index, total = own if isinstance(own, tuple) else (own, None, 1)
    one = _opened(file, path, options)
    t0_us, t1_us = one.whole
    if options.window_s is not None:
        t1_us = t0_us + round(options.window_s * 1e6)
    elif t1_us - t0_us > LONGEST_S * 1e6:
        raise DomainError(
            f"{file} lasts {(t1_us - t0_us) * 1e-6:.3f} s, too long for one packet of several; give its "
            "folder alone to cut it, or a window."
        )
    flow = None
    if one.truth is not None and one.truth.flows is not None:
        flows = one.truth.flows
        if index is not None and len(flows) not in (1, total):
            raise FileFormatError(
                f"{path} holds {len(flows)} flows for {total} packets; one for each, or one for all, is "
                "needed."
            )
        flow = flows[index if index is not None and len(flows) > 1 else 0]
        if flow.span_s is not None and options.window_s is None:
            ends = round(flow.span_s[0] * 1e6), round(flow.span_s[1] * 1e6)
            if not covers((t0_us, t1_us), ends):
                raise FileFormatError(
                    f"{flow.name} runs from {flow.span_s[0]:.6f} to {flow.span_s[1]:.6f} s, "
                    f"the events of {file} do not; are both on one clock?"
                )
            t0_us, t1_us = ends
    return one.packet(f"{file.parent.name}/{file.name}", (t0_us, t1_us), flow)


def _cut(file, truth_path, options):
    """Windows of one event file."""
    one = _opened(file, truth_path, options)
    start_us = one.whole[0] + round((options.start_s or 0.0) * 1e6)
    if one.truth is not None and one.truth.flows is not None:
        return _cut_by_flows(one, one.truth.flows, start_us)
    chosen, left_out = windows(one.events, one.whole, start_us, options, in_turn=False)
    return [
        one.packet(f"{file.name} {(t0 - one.whole[0]) * 1e-6:.3f} s", (t0, t1), left_out=left_out)
        for t0, t1 in chosen
    ]


def _cut_by_flows(one, flows, start_us):
    """Windows of one event file with a flow for each: those of the flows' own times; without, the
    flows share the recording equally, or follow each other by ``truth_interval_s``."""
    options = one.options
    whole = one.whole
    left_out = {}
    over = None
    if all(flow.span_s is not None for flow in flows[:-1] or flows):
        ends = enumerate(flow.span_s for flow in flows)
        spans = [(k, (round(span[0] * 1e6), round(span[1] * 1e6))) for k, span in ends if span]
        pairs = [(k, span) for k, span in spans if covers((start_us, whole[1]), span)]
        if not pairs:
            raise FileFormatError(
                f"none of the {len(spans)} flows lies within the recording's {whole[0] * 1e-6:.6f} to "
                f"{whole[1] * 1e-6:.6f} s; are both on one clock?"
            )
        if outside := len(spans) - len(pairs):
            left_out[OUTSIDE] = outside
            note = f"{outside} of {len(spans)} true flows lie outside the recording or before the start asked for"
            one = replace(one, notes=(note, *one.notes))
        if options.window_s:
            length_us = round(options.window_s * 1e6)
            pairs = [(k, (t0_us, t0_us + length_us)) for k, (t0_us, _) in pairs]
    else:
        edges = np.rint(np.linspace(whole[0], whole[1], len(flows) + 1)).astype(np.int64).tolist()
        if options.truth_interval_s is not None:
            edges = [
                whole[0] + round(k * options.truth_interval_s * 1e6) for k in range(len(flows) + 1)
            ]
        over = edges[:2]
        pairs = _parts(one, list(pairwise(edges)), start_us)[: options.count]
        lasts_us, cut_us = edges[1] - edges[0], pairs[0][1][1] - pairs[0][1][0]
        timed = options.truth_interval_s or options.truth_unit != "px"
        if len(flows) == 1 and not timed and abs(cut_us - lasts_us) > SAME * lasts_us:
            raise DomainError(
                f"{one.file.name}: the true flow does not say over what time it is, and a window of {1e-3 * cut_us:g} ms is cut from "
                f"{1e-3 * lasts_us:g} ms: give its time (truth_interval_s, --truth-interval-ms), or its unit as px/s."
            )
    kept, more = without([window for _, window in pairs], one.events, options.skip)
    found = [
        one.packet(f"{one.file.name} {k}", window, flows[k], over, left_out | more)
        for k, window in pairs
        if window in kept
    ]
    return spread(found, options.count)


def _parts(one, spans, start_us):
    """The window (from, to) us asked for in each span of a flow, beside its number: of a length or
    a number of events it begins where the span does, or at the start asked for."""
    options = one.options
    if options.events is not None:
        if len(spans) > 1:
            raise DomainError(
                f"{len(spans)} flows without times say nothing of windows of {options.events} events; give their "
                "times, or windows in seconds."
            )
        first = replace(options, skip=(), count=1)  # one flow says nothing of a second window
        return list(enumerate(windows(one.events, one.whole, start_us, first, in_turn=True)[0]))
    found = [(k, (max(t0, start_us), t1)) for k, (t0, t1) in enumerate(spans) if t1 > start_us]
    length_us = spans[0][1] - spans[0][0]
    if options.window_s is not None:
        length_us = round(options.window_s * 1e6)
        found = [(k, (t0, t0 + length_us)) for k, (t0, _) in found]
    found = [(k, span) for k, span in found if covers(one.whole, span)]
    if not found:
        raise none_fits(one.whole, length_us)
    return found


def _with_truth_somewhere(packets: Sequence[Packet]) -> list[Packet]:
    """The packets, unless a truth was given that tells of none of them."""
    missing = [note for one in packets for note in one.notes if note.startswith(NO_TRUTH)]
    if len(missing) == len(packets):
        raise FileFormatError(
            f"{missing[0].removeprefix(NO_TRUTH)}, nor any other; are both on one clock?"
        )
    return list(packets)


def _size_of_images(folder):
    """(height, width) of the first frame in images/, or None."""
    place = folder / "images"
    first = (
        min(
            (entry for entry in place.iterdir() if entry.suffix.lower() in (".png", ".jpg")),
            default=None,
        )
        if place.is_dir()
        else None
    )
    if first is None:
        return None
    with open_regular(first) as file, reading(first, "remove this frame or give the sensor size"):
        with Image.open(file) as image:
            return image.height, image.width
