"""Windows of DSEC as published: events/left/events.h5 with rectify_map.h5, flow/forward/*.png with
forward_timestamps.txt, per sequence.

The true flow lies on the rectified picture of the left event camera, so events are rectified before
they are counted. Each flow file is one window (100 ms).
Source: Gehrig et al., "DSEC: A Stereo Event Camera Dataset for Driving Scenarios", RA-L 2021; its
  published description of the data format.
"""

from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign.errors import FileFormatError
from codesign.events.formats.hdf5 import Hdf5Events
from codesign.events.formats.hdf5_rows import Rows
from codesign.flow.files import PNG_START, read_flow
from codesign.flow.sources.folders import natural
from codesign.flow.sources.truth import read_spans
from codesign.flow.sources.windows import Recording, Windows, check_lengths

SIZE_PX = (480, 640)
SLACK_US = 2000  # of the clock of the flow beyond the events


class DsecWindows(Windows):
    """Windows of all sequences under a folder that have flow.

    Args:
      folder: one sequence, a folder of sequences, or one that holds train_events and
        train_optical_flow side by side.
      bins: of the volumes.
      crop_px: (height, width) of a piece at a random place, or None.
      seed: of that place.
      size_px: of the camera.
    Raises: FileFormatError, before anything is read in earnest, for files that are missing, cut, or
      do not fit together.
    """

    def __init__(
        self,
        folder: str | Path,
        bins: int = 8,
        crop_px: tuple[int, int] | None = None,
        seed: int = 0,
        size_px: tuple[int, int] = SIZE_PX,
    ) -> None:
        size_px = int(size_px[0]), int(size_px[1])
        sequences = [Sequence(events, flow, size_px) for events, flow in _places(Path(folder))]
        windows = [
            (k, span_us, file)
            for k, sequence in enumerate(sequences)
            for file, span_us in zip(sequence.files, sequence.spans_us, strict=True)
        ]
        check_lengths([(t1 - t0) * 1e-6 for _, (t0, t1), _ in windows], f"DSEC in {folder}")
        super().__init__(sequences, windows, bins, crop_px, seed)


class Sequence(Recording):
    """One sequence. files: its flow files. spans_us: [(from, to)] of each, on the clock of the
    events with t_offset added."""

    def __init__(self, events: Path, flow: Path, size_px: tuple[int, int]) -> None:
        self.path = events / "events.h5"
        self.size_px = size_px
        self.map: np.ndarray = (
            Rows(events / "rectify_map.h5", "rectify_map", [size_px[1], 2], size_px[0])
            .read(0, size_px[0])
            .astype(np.float64)
        )
        self.events = Hdf5Events(self.path)
        self.files, self.spans_us = _flows(flow)
        first_us, last_us = self.ends_us()
        outside = [
            span
            for span in self.spans_us
            if not first_us - SLACK_US <= span[0] < span[1] <= last_us + SLACK_US
        ]
        if outside:
            raise FileFormatError(
                f"{flow} has a flow from {outside[0][0]} to {outside[0][1]} us; the events of {self.path} "
                f"run from {first_us:.0f} to {last_us:.0f} us."
            )

    def flow(self, file: Path) -> tuple[Tensor, Tensor]:
        """What a file holds."""
        flow, valid = read_flow(file)
        if tuple(valid.shape) != self.size_px:
            raise FileFormatError(
                f"{file} has {valid.shape[1]} x {valid.shape[0]} px; {self.size_px[1]} x {self.size_px[0]} "
                "are needed."
            )
        return flow, valid

    def counts(self, bins: int, t0_us: int, t1_us: int) -> Tensor:
        """Of the events on the rectified picture."""
        stream = self.within(t0_us, t1_us)
        place = torch.from_numpy(self.map[stream.y.numpy(), stream.x.numpy()])
        if not bool(torch.isfinite(place).all()):
            raise FileFormatError(
                f"{self.path.parent / 'rectify_map.h5'} is not finite where there are events."
            )
        return splatted(stream.t_us, *place.T, stream.p > 0, t0_us, t1_us, bins, *self.size_px)


def _places(folder):
    """[(folder of the events, folder of the flow)] of the sequences that have both."""
    pairs = ((folder, folder), (folder / "train_events", folder / "train_optical_flow"))
    found = []
    for events, flows in pairs:
        for flow in (
            [flows, *sorted((entry for entry in flows.iterdir() if entry.is_dir()), key=natural)]
            if flows.is_dir()
            else []
        ):
            place = flow / "flow"
            name = "" if flow == flows else flow.name
            if (place / "forward").is_dir() and (place / "forward_timestamps.txt").is_file():
                if not (events / name / "events" / "left").is_dir():
                    raise FileFormatError(
                        f"{flow} has flow but {events / name / 'events' / 'left'} is missing; download the "
                        "events of that sequence too."
                    )
                found.append((events / name / "events" / "left", place))
    if not found:
        raise FileFormatError(
            f"{folder} holds no sequence of DSEC with flow: events/left/events.h5, flow/forward/*.png and "
            "flow/forward_timestamps.txt are needed."
        )
    return found


def _flows(folder):
    """(flow files, [(from, to) us]) of a sequence."""
    files = sorted((folder / "forward").glob("*.png"), key=natural)
    if not files:
        raise FileFormatError(f"{folder / 'forward'} holds no files of flow; download them too.")
    spans = read_spans(folder / "forward_timestamps.txt", len(files))
    for file in files:
        with file.open("rb") as opened:
            if opened.read(8) != PNG_START:
                raise FileFormatError(f"{file} is not a PNG file.")
    return files, [(round(1e6 * first), round(1e6 * last)) for first, last in spans]


def splatted(
    t_us: Tensor,
    x_px: Tensor,
    y_px: Tensor,
    on: Tensor,
    t0_us: int,
    t1_us: int,
    bins: int,
    height_px: int,
    width_px: int,
) -> Tensor:
    """Counts [2, bins, H, W] float32 of events at fractional places, as rectification leaves them,
    shared bilinearly by four pixels and linearly by two bins.

    Args:
      t_us: [N] int64 within t0_us to t1_us.
      x_px, y_px: [N] float.
      on: [N] bool.
    Events, and shares of them, that fall outside the picture are left out; everything else is
    conserved.
    """
    axes = []
    for place in (
        (t_us - t0_us).double() / (t1_us - t0_us) * (bins - 1),
        y_px.double(),
        x_px.double(),
    ):
        low = place.floor()
        axes.append(((low.long(), 1 - (place - low)), (low.long() + 1, place - low)))
    counts = torch.zeros(2 * bins * height_px * width_px, dtype=torch.float64)
    for (bin_, of_time), (row, of_y), (column, of_x) in product(*axes):
        share = of_x * of_y * of_time
        inside = (
            (column >= 0) & (column < width_px) & (row >= 0) & (row < height_px) & (bin_ < bins)
        )
        inside &= share > 0
        cell = (((~on).long() * bins + bin_) * height_px + row) * width_px + column
        counts.index_add_(0, cell[inside], share[inside])
    return counts.reshape(2, bins, height_px, width_px).float()
