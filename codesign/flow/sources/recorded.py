"""Training data, whichever of the layouts it has, and windows of any recording that
``read_packets`` reads."""

from dataclasses import replace
from pathlib import Path

import torch

from codesign.checks import check_path
from codesign.events.volumes.volume import from_stream
from codesign.flow.sources.dsec import DsecWindows
from codesign.flow.sources.mvsec import DATA, MvsecWindows
from codesign.flow.sources.packet import PacketOptions
from codesign.flow.sources.packets import read_packets
from codesign.flow.sources.rendered import DatasetWindows
from codesign.flow.sources.windows import Recording, Windows, check_lengths

WINDOW_S = 0.02
ALL = 2**31  # more windows than any recording has


class RecordingWindows(Windows):
    """Windows of a recording: events in text, arrays or an event file, packets with flow files, or
    a zip of either.

    Args:
      path: as for read_packets.
      bins: of the volumes.
      crop_px: (height, width) of a piece at a random place, or None.
      seed: of that place.
      options: PacketOptions; windows of 20 ms, all of them, where it does not say.
    Where nothing is known of the flow, ``truth.valid`` is False. All events are kept in memory.
    Raises: FileFormatError, DomainError as read_packets; DomainError for windows of different
      lengths.
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
        self.packets = read_packets(path, None, replace(options, count=options.count or ALL))
        if options.events is None:
            check_lengths(
                [1e-6 * (packet.t1_us - packet.t0_us) for packet in self.packets], str(path)
            )
        windows = [(k, (packet.t0_us, packet.t1_us)) for k, packet in enumerate(self.packets)]
        super().__init__(
            [_Recorded(packet) for packet in self.packets], windows, bins, crop_px, seed
        )


class _Recorded(Recording):
    """One packet."""

    def __init__(self, packet):
        self.packet = packet
        self.size_px = packet.stream.height_px, packet.stream.width_px

    def counts(self, bins, t0_us, t1_us):
        return from_stream(self.packet.stream, t0_us, t1_us, bins).counts[0]

    def flow(self, *which):
        truth = self.packet.truth
        if truth is None or self.packet.translates:  # what rotation alone says is no truth then
            return torch.zeros(2, *self.size_px), torch.zeros(self.size_px, dtype=torch.bool)
        return truth.flow_px[0], truth.valid[0]


def open_windows(
    folder: str | Path,
    bins: int = 8,
    window_frames: int = 1,
    crop_px: tuple[int, int] | None = None,
    seed: int = 0,
    window_s: float = WINDOW_S,
) -> DatasetWindows | DsecWindows | MvsecWindows | RecordingWindows:
    """The source of windows that a folder or file is: one of our data sets, DSEC, MVSEC, or a
    recording.

    Args:
      bins: of the volumes.
      window_frames: frame intervals per window (our data sets), or grey frames (MVSEC); DSEC has
        its own windows.
      crop_px: (height, width) of a piece at a random place, or None.
      seed: of that place.
      window_s: length of the windows of a recording, seconds.
    Returns: DatasetWindows, DsecWindows, MvsecWindows or RecordingWindows: ``len(source)`` and
      ``source.batch(indices)``.
    Raises: FileFormatError when nothing of these is there, or something in it is missing or
      damaged.
    """
    folder = check_path(folder, "the data set or recording")
    if (folder / "manifest.json").is_file() or (folder / "frames.h5").is_file():
        return DatasetWindows(folder, bins, window_frames, crop_px=crop_px, seed=seed)
    if next(folder.rglob(f"*{DATA}"), None) is not None:
        return MvsecWindows(folder, window_frames, bins, crop_px, seed)
    if next(folder.rglob("forward_timestamps.txt"), None) is not None:
        return DsecWindows(folder, bins, crop_px, seed)
    return RecordingWindows(folder, bins, crop_px, seed, PacketOptions(window_s=window_s))
