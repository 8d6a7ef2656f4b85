"""Windows of any recording that ``read_packets`` reads, with true flow where it has some."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from codesign.events.volumes.volume import from_stream
from codesign.flow.checks import check_count
from codesign.flow.sources.collate import Crop, Sample, check_indices, check_lengths, collate
from codesign.flow.sources.packet import PacketOptions
from codesign.flow.sources.packets import read_packets
from codesign.types import FlowWindows

WINDOW_S = 0.02
ALL = 2**31  # more windows than any recording has


class RecordingWindows:
    """Windows of a recording: events in text, arrays or an event file, packets with flow files, or a zip of either.

    Args:
      path: as for read_packets. bins: of the volumes. crop_px: (height, width) of a piece at a random place, or None.
      seed: of that place.
      options: PacketOptions; windows of 20 ms, all of them, where it does not say.
    Where nothing is known of the flow, ``truth.valid`` is False. All events are kept in memory.
    Raises: FileFormatError, DomainError as read_packets; DomainError for windows of different lengths.
    """

    def __init__(
        self,
        path: str | Path,
        bins: int = 8,
        crop_px: tuple[int, int] | None = None,
        seed: int = 0,
        options: PacketOptions | None = None,
    ) -> None:
        options = options or PacketOptions(window_s=WINDOW_S)
        self.bins = check_count(bins, "bins", 1)
        self.crop = Crop(crop_px, seed)
        self.packets = read_packets(path, None, replace(options, count=options.count or ALL))
        if options.events is None:
            check_lengths([1e-6 * (packet.t1_us - packet.t0_us) for packet in self.packets], str(path))
        for packet in self.packets:
            self.crop.check(packet.stream.height_px, packet.stream.width_px)

    def __len__(self) -> int:
        return len(self.packets)

    def batch(self, indices: Iterable[int] | Tensor) -> FlowWindows:
        """FlowWindows of these samples, without frames; each depends on its index and the seed alone."""
        return collate([self.crop(index, self._sample(index)) for index in check_indices(indices, len(self))])

    def _sample(self, index):
        packet = self.packets[index]
        counts = from_stream(packet.stream, packet.t0_us, packet.t1_us, self.bins).counts[0]
        if packet.truth is None or packet.translates:  # what rotation alone says is no truth then
            flow = torch.zeros(2, *counts.shape[-2:])
            valid = torch.zeros(counts.shape[-2:], dtype=torch.bool)
        else:
            flow, valid = packet.truth.flow_px[0].float(), packet.truth.valid[0]
        return Sample(counts, flow, valid, 1e-6 * (packet.t1_us - packet.t0_us))
