"""Recordings, cut into packets of a fixed number of events: two that are made here, with exact
flow, and those the user names."""

import itertools
import statistics
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from codesign import events
from codesign.errors import DomainError
from codesign.events.stream import check_stream
from codesign.flow import metrics
from codesign.flow.sources import PacketOptions, read_packets
from codesign.flow.sources.packets import Packet
from codesign.types import EventStream
from scenes.windows.streams import sliding, turning
from studies.flow_quality import sharpest
from studies.frame.sweep import plain

# figure -> title and note of its table, what its worst value is called, and which that is
MEASURES = {
    "distance_px": (
        "Distance to the contrast maximisation, px",
        "Mean over pixels with events; mean over packets (worst). The judge sees single events, and searches "
        "all rotations or affine flows.",
        "largest",
        max,
    ),
    "aee_px": (
        "Endpoint error where events are, px",
        "Against the true flow, exact for the two that are made; mean over packets (worst).",
        "largest",
        max,
    ),
    "fwl": ("Flow warp loss (FWL)", "Above 1 is sharper; mean over packets (least).", "least", min),
}
JUDGED = "refiner"
REFERENCE = "closed_form_quadratic"  # whose distance the network's is compared with
# events around the middle of a packet that the contrast maximisation sees at least
CONTEXT = 30_000
EDGE = 0.05  # of the events of a recording left out at either end


@dataclass(frozen=True)
class Case:
    """A packet to judge on. kind: recording and number of events. seek: finds its flow by contrast
    maximisation; assumed: the flows among which."""

    kind: str
    packet: Packet
    seek: Callable[[], sharpest.Sharpest]
    assumed: str


def cases(config, say):
    """Cases of all recordings, the made ones first; a recording with too few events for a packet
    says so."""
    found, left_out = [], []
    for make, assumed in ((turning, "rotation"), (sliding, "affine")):
        recording = make(seed=config.seed)
        for count in config.packet_events:
            kind = _kind(recording.name, count)
            for p in cut(recording, count, config.packets):
                seek = partial(in_context, recording, p, assumed == "rotation")
                found.append(Case(kind, p, seek, assumed))
    seek, assumed = sharpest.affine, "affine"
    if config.focal_px:
        seek, assumed = partial(sharpest.rotation, focal_px=config.focal_px), "rotation"
    for path, name in zip(config.recording, named(config.recording), strict=True):
        for count in config.packet_events:
            options = PacketOptions(events=count, count=config.packets)
            try:
                packets = read_packets(path, None, options)
            except DomainError as error:
                say(f"{path}, packets of {count} events: left out: {error}")
                left_out.append(f"{name}, packets of {count} events: {error}")
                continue
            kind = _kind(name, count)
            found += [Case(kind, p, partial(seek, p), assumed) for p in packets]
    return found, left_out


def named(paths):
    """A name for each recording: its file's or folder's; that of the folder before it for events.txt,
    and with a number where another has it."""
    names = [
        plain((path.parent if path.stem == "events" else path).resolve().name)
        for path in map(Path, paths)
    ]
    found: list[str] = []
    for name in names:
        later = (f"{name}_{number}" for number in itertools.count(2))
        found.append(
            next(one for one in (name, *itertools.islice(later, len(names))) if one not in found)
        )
    return found


def _kind(name, count):
    return f"{name.replace('-', '_').replace('.', '_')}_{count / 1000:g}k"


def cut(recording, count, packets):
    stream = recording.stream
    total = len(stream)
    firsts = np.linspace(EDGE * total, (1 - EDGE) * total - count, packets).astype(int)
    return [_packet(recording, int(first), int(first) + count) for first in firsts]


def _packet(recording, first, stop):
    whole = recording.stream
    t_us, x, y, p = (getattr(whole, name)[first:stop] for name in ("t_us", "x", "y", "p"))
    stream = check_stream(EventStream(t_us, x, y, p, whole.height_px, whole.width_px))
    t0_us, t1_us = int(t_us[0]), int(t_us[-1])
    name = f"{recording.name} {t0_us * 1e-6:.3f} s"
    return Packet(name, stream, t0_us, t1_us, recording.truth(t0_us, t1_us))


def in_context(recording, packet, turns):
    """Flow of a packet of a made recording by contrast maximisation over at least CONTEXT events
    around its middle, scaled to its length: a few thousand events are too few to be sure of."""
    stream = recording.stream
    first = int(torch.searchsorted(stream.t_us, torch.tensor(packet.t0_us)))
    extra = max(0, CONTEXT - len(packet.stream)) // 2
    stop = min(len(stream), first + len(packet.stream) + extra)
    wide = _packet(recording, max(0, first - extra), stop)
    found = sharpest.rotation(wide, recording.focal_px) if turns else sharpest.affine(wide)
    share = (packet.t1_us - packet.t0_us) / (wide.t1_us - wide.t0_us)
    return sharpest.Sharpest(share * found.flow_px, found.contrast)


def true_flow(packet):
    """The truth of a packet; None where it is of rotation alone and the camera moved as well."""
    return None if packet.translates else packet.truth


def judged(packet, mask, flow_px, sharpest_px=None):
    """Figures of a flow on a packet, those that are defined: distance_px to the contrast
    maximisation and aee_px to the truth, over pixels with events (mask); fwl."""
    found = {"fwl": float(metrics.fwl(packet.stream, flow_px, packet.t0_us, packet.t1_us))}
    if sharpest_px is not None:
        found["distance_px"] = float(metrics.aee(flow_px, sharpest_px.to(flow_px), mask))
    truth = true_flow(packet)
    if truth is not None and (both := truth.valid & mask).any():
        found["aee_px"] = float(metrics.aee(flow_px, truth.flow_px, both))
    return found


def measured(case, who, bins):
    """{name: figures} of all estimators on a packet, of the contrast maximisation itself, and of
    the true flow and of zero flow where there is a truth."""
    packet = case.packet
    sharpest_px = torch.from_numpy(case.seek().flow_px)[None]
    volume = events.from_stream(packet.stream, packet.t0_us, packet.t1_us, bins)
    mask = metrics.event_mask(volume)
    rows = {
        name: judged(packet, mask, estimate(volume).flow_px, sharpest_px)
        for name, estimate in who.items()
    }
    rows["contrast_maximisation"] = judged(packet, mask, sharpest_px.float())
    if (truth := true_flow(packet)) is not None:
        true_px = truth.flow_px
        rows["true_flow"] = {"fwl": judged(packet, mask, true_px)["fwl"]}
        rows["zero_flow"] = judged(packet, mask, torch.zeros_like(true_px))
    return rows


def show(run, who, bins, todo, left_out):
    """Measure the cases, record, and show on the page, with what was left out."""
    found, cases_of = defaultdict(list), defaultdict(list)
    with run.progress(len(todo), "packets") as progress:
        for case in todo:
            found[case.kind].append(measured(case, who, bins))
            cases_of[case.kind].append(case)
            progress.advance()
    for kind, packets in found.items():
        record(run, kind, packets)
    run.section(
        "Recordings",
        "Packets of a fixed number of events. `turning` and `sliding` are made here with the full sensor "
        "(bandwidth, mismatch, noise, leak, dead time, hot pixels) and have exact flow.",
    )
    if left_out:
        run.text(f"Left out: {'; '.join(left_out)}")
    if any(case.packet.translates for case in todo):
        run.text(
            "Where the camera moved besides turning, the flow of its rotation is no truth: no error is shown."
        )
    rows = []
    for kind, mine in cases_of.items():
        packets = [each.packet for each in mine]
        stream = packets[0].stream
        length_ms = statistics.fmean(1e-3 * (each.t1_us - each.t0_us) for each in packets)
        density = statistics.fmean(len(each.stream) for each in packets)
        density /= stream.height_px * stream.width_px
        rows.append([kind, len(mine), round(length_ms, 2), round(density, 3), mine[0].assumed])
    run.table(
        "Packets",
        ["packets", "number", "mean ms", "events per px", "contrast maximisation of"],
        rows,
    )
    names = [*who, "contrast_maximisation", "true_flow", "zero_flow"]
    for measure, (title, note, _, worst) in MEASURES.items():
        rows = []
        for kind, packets in found.items():
            values = [_values(packets, name, measure) for name in names]
            cells = [
                f"{statistics.fmean(each):.2f} ({worst(each):.2f})" if each else None
                for each in values
            ]
            if any(cells):
                rows.append([kind, *cells])
        run.table(title, ["packets", *(name.replace("_", " ") for name in names)], rows, note)


def record(run, kind, packets):
    for name in sorted({name for rows in packets for name in rows}):
        for measure, (_, _, extreme, worst) in MEASURES.items():
            values = _values(packets, name, measure)
            if values:
                key = f"{kind}_{name}_{measure}"
                run.record(**{key: statistics.fmean(values), f"{key}_{extreme}": worst(values)})
    if JUDGED in packets[0] and REFERENCE in packets[0]:
        shares = [rows[JUDGED]["distance_px"] / rows[REFERENCE]["distance_px"] for rows in packets]
        run.record(**{f"{kind}_{JUDGED}_distance_over_closed_form_largest": max(shares)})


def _values(packets, name, measure):
    return [rows[name][measure] for rows in packets if measure in rows.get(name, {})]
