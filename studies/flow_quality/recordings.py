"""Recordings, cut into packets of a fixed number of events: two that are made here, with exact flow, and those
the user names."""

from collections.abc import Callable
from dataclasses import dataclass, replace
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
from scenes.flow_streams import sliding, turning
from studies.flow_quality import sharpest

CONTEXT = 30_000  # events around the middle of a packet that the contrast maximisation sees at least
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
    """Cases of all recordings, the made ones first; a recording with too few events for a packet says so."""
    found = []
    for make, turns in ((turning, True), (sliding, False)):
        recording = make(seed=config.seed)
        for count in config.packet_events:
            packets = _cut(recording, count, config.packets)
            assumed = "rotation" if turns else "affine"
            found += [
                Case(_kind(recording.name, count), p, partial(_in_context, recording, p, turns), assumed)
                for p in packets
            ]
    for path in config.recording:
        for count in config.packet_events:
            try:
                packets = read_packets(path, None, PacketOptions(events=count, count=config.packets))
            except DomainError as error:
                say(f"{path}, packets of {count} events: left out: {error}")
                continue
            seek = (
                partial(sharpest.rotation, focal_px=config.focal_px) if config.focal_px else sharpest.affine
            )
            assumed = "rotation" if config.focal_px else "affine"
            kind = _kind(Path(path).stem, count)
            found += [Case(kind, p, partial(seek, p), assumed) for p in packets]
    return found


def _kind(name, count):
    return f"{name.replace('-', '_').replace('.', '_')}_{count / 1000:g}k"


def _cut(recording, count, packets):
    """Packets spread over a made recording."""
    stream = recording.stream
    total = len(stream)
    firsts = np.linspace(EDGE * total, (1 - EDGE) * total - count, packets).astype(int)
    return [_window(recording, int(first), count) for first in firsts]


def _window(recording, first, count):
    stream = recording.stream
    t0_us, t1_us = int(stream.t_us[first]), int(stream.t_us[first + count - 1])
    return Packet(
        f"{recording.name} {t0_us * 1e-6:.3f} s",
        _part(stream, slice(first, first + count)),
        t0_us,
        t1_us,
        recording.truth(t0_us, t1_us),
    )


def _part(stream, part):
    t_us, x, y, p = (getattr(stream, name)[part] for name in ("t_us", "x", "y", "p"))
    return check_stream(EventStream(t_us, x, y, p, stream.height_px, stream.width_px))


def _in_context(recording, packet, turns):
    """Flow of a packet of a made recording by contrast maximisation over at least CONTEXT events around its
    middle, scaled to its length: a few thousand events are too few to be sure of."""
    stream = recording.stream
    first = int(torch.searchsorted(stream.t_us, torch.tensor(packet.t0_us)))
    extra = max(0, CONTEXT - len(packet.stream)) // 2
    start = max(0, first - extra)
    stop = min(len(stream), first + len(packet.stream) + extra)
    wide = replace(
        packet,
        stream=_part(stream, slice(start, stop)),
        t0_us=int(stream.t_us[start]),
        t1_us=int(stream.t_us[stop - 1]),
    )
    found = sharpest.rotation(wide, recording.focal_px) if turns else sharpest.affine(wide)
    share = (packet.t1_us - packet.t0_us) / (wide.t1_us - wide.t0_us)
    return sharpest.Sharpest(share * found.flow_px, found.contrast)


def judged(case, reference, estimate, bins):
    """Figures of an estimator on a packet: distance_px to the contrast maximisation and aee_px to the truth,
    over pixels with events; fwl. None where there is no truth."""
    packet = case.packet
    volume = events.from_stream(packet.stream, packet.t0_us, packet.t1_us, bins)
    flow_px = estimate(volume).flow_px
    return {
        "distance_px": float(
            metrics.aee(
                flow_px,
                torch.from_numpy(reference.flow_px).to(flow_px)[None],
                metrics.event_mask(volume),
            )
        ),
        **against_truth(packet, volume, flow_px),
        "fwl": metrics.fwl(packet.stream, flow_px, packet.t0_us, packet.t1_us),
    }


def of_reference(case, reference, bins):
    """The same figures of the contrast maximisation itself, and of the true flow where there is one."""
    packet = case.packet
    volume = events.from_stream(packet.stream, packet.t0_us, packet.t1_us, bins)
    flow_px = torch.from_numpy(reference.flow_px).float()[None]
    rows = {
        "contrast_maximisation": {
            "distance_px": None,
            **against_truth(packet, volume, flow_px),
            "fwl": metrics.fwl(packet.stream, flow_px, packet.t0_us, packet.t1_us),
        }
    }
    if packet.truth is not None:
        true_px = packet.truth.flow_px
        still = against_truth(packet, volume, torch.zeros_like(true_px))
        rows["true_flow"] = {
            "distance_px": None,
            "aee_px": None,
            "fwl": metrics.fwl(packet.stream, true_px, packet.t0_us, packet.t1_us),
        }
        rows["zero_flow"] = {"distance_px": None, **still, "fwl": 1.0}
    return rows


def against_truth(packet, volume, flow_px):
    """{"aee_px"} over valid pixels with events."""
    if packet.truth is None:
        return {"aee_px": None}
    mask = packet.truth.valid & metrics.event_mask(volume)
    return {"aee_px": float(metrics.aee(flow_px, packet.truth.flow_px, mask)) if bool(mask.any()) else None}
