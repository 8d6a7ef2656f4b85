"""Recordings, cut into packets of a fixed number of events: two that are made here, with exact flow, and those
the user names."""

from dataclasses import dataclass
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
    """A packet to judge on. kind: recording and number of events. reference: flow by contrast maximisation;
    made_for: what it assumes."""

    kind: str
    packet: Packet
    reference: sharpest.Sharpest
    made_for: str


def cases(config, say):
    """Cases of all recordings, the made ones first; a recording with too few events for a packet says so."""
    found = []
    for made, focal_px in ((turning, True), (sliding, False)):
        recording = made(seed=config.seed)
        for count in config.packet_events:
            packets = _cut(recording, count, config.packets)
            found += [_case(p, recording.name, count, recording, focal_px) for p in packets]
    for path in config.recording:
        for count in config.packet_events:
            name = Path(path).stem.replace("-", "_").replace(".", "_")
            try:
                packets = read_packets(path, None, PacketOptions(events=count, count=config.packets))
            except DomainError as error:
                say(f"{path}, packets of {count} events: left out: {error}")
                continue
            found += [_read_case(p, name, count, config.focal_px) for p in packets]
    return found


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
    columns = (getattr(stream, name)[part] for name in ("t_us", "x", "y", "p"))
    return check_stream(EventStream(*columns, stream.height_px, stream.width_px))


def _case(packet, name, count, recording, turns):
    """A made packet; the contrast maximisation sees at least CONTEXT events around its middle, and its flow is
    scaled to the packet."""
    stream = recording.stream
    first = int(torch.searchsorted(stream.t_us, torch.tensor(packet.t0_us)))
    extra = max(0, CONTEXT - count) // 2
    start = max(0, first - extra)
    stop = min(len(stream), first + count + extra)
    wide = Packet(
        packet.name,
        _part(stream, slice(start, stop)),
        int(stream.t_us[start]),
        int(stream.t_us[stop - 1]),
        None,
    )
    best = sharpest.rotation(wide, recording.focal_px) if turns else sharpest.affine(wide)
    share = (packet.t1_us - packet.t0_us) / (wide.t1_us - wide.t0_us)
    best = sharpest.Sharpest(share * best.flow_px, best.contrast)
    return Case(f"{name}_{count // 1000}k", packet, best, "rotation" if turns else "affine")


def _read_case(packet, name, count, focal_px):
    best = sharpest.rotation(packet, focal_px) if focal_px else sharpest.affine(packet)
    return Case(f"{name}_{count // 1000}k", packet, best, "rotation" if focal_px else "affine")


def judged(case, estimate, bins):
    """Figures of an estimator on a packet: distance_px to the contrast maximisation and aee_px to the truth,
    over pixels with events; fwl. None where there is no truth."""
    packet = case.packet
    volume = events.from_stream(packet.stream, packet.t0_us, packet.t1_us, bins)
    flow_px = estimate(volume).flow_px
    return {
        "distance_px": float(
            metrics.aee(
                flow_px,
                torch.from_numpy(case.reference.flow_px).to(flow_px)[None],
                metrics.event_mask(volume),
            )
        ),
        **against_truth(packet, volume, flow_px),
        "fwl": metrics.fwl(packet.stream, flow_px, packet.t0_us, packet.t1_us),
    }


def of_reference(case, bins):
    """The same figures of the contrast maximisation itself, and of the true flow where there is one."""
    packet = case.packet
    volume = events.from_stream(packet.stream, packet.t0_us, packet.t1_us, bins)
    flow_px = torch.from_numpy(case.reference.flow_px).float()[None]
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
