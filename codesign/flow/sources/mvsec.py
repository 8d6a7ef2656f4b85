"""Windows of MVSEC as published: NAME_data.hdf5 (davis/left/events, image_raw_ts) with
NAME_gt_flow_dist.npz (x_flow_dist, y_flow_dist, timestamps).

A flow of the file leads from its own time to the next one's, on the raw (distorted) pixels of the
left camera; (0, 0) means that nothing was measured. The usual tests take windows between grey
frames: dt = 1 from one to the next, dt = 4 to the fourth. There the flow is followed from its time
on, whole intervals and linear parts of them (``warp.chained``), and is not valid where it leads out
of what was measured.
Sources: Zhu et al., "The Multivehicle Stereo Event Camera Dataset", RA-L 2018; Zhu et al.,
  EV-FlowNet, RSS 2018 (dt = 1, 4).
"""

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign.arrays import open_npz
from codesign.errors import DomainError, FileFormatError
from codesign.events.formats.hdf5 import Hdf5Events
from codesign.events.formats.hdf5_rows import Rows
from codesign.flow.sources.windows import ALIKE, Recording, Windows
from codesign.flow.warp import chained

DATA = "_data.hdf5"
FLOW = "_gt_flow_dist.npz"
COMPONENTS = ("x_flow_dist", "y_flow_dist")
LEAST_S = 1e-9  # of an interval that counts
MOST_BYTES = 2**35  # of one of them: outdoors the file has 9.5 GB


class MvsecWindows(Windows):
    """Windows of the sequences of a folder.

    Args:
      folder: where NAME_data.hdf5 and NAME_gt_flow_dist.npz lie.
      frames: 1 or 4 grey frames per window (the dt of the literature); 0: the intervals of the true
        flow itself.
      bins: of the volumes.
      crop_px: (height, width) of a piece at a random place, or None.
      seed: of that place.
      span_s: (from, to) part of the sequences in seconds after their first true flow, or None;
        published tests leave out the start and the landing.
    Raises: FileFormatError, before anything is read in earnest, for files that are missing, cut, or
      do not fit together. Windows that last longer or shorter than the median by 5 percent are not
      used: ``left_out`` counts them.
    """

    def __init__(
        self,
        folder: str | Path,
        frames: int = 1,
        bins: int = 8,
        crop_px: tuple[int, int] | None = None,
        seed: int = 0,
        span_s: tuple[float, float] | None = None,
    ) -> None:
        if frames < 0:
            raise DomainError(
                f"frames is {frames}; 1 or 4 grey frames per window, or 0 for the intervals of the true "
                "flow, is possible."
            )
        sequences = [Sequence(*files) for files in _places(Path(folder))]
        found = [
            (k, *window)
            for k, sequence in enumerate(sequences)
            for window in sequence.windows(frames, span_s)
        ]
        if not found:
            raise DomainError(
                f"no window of {frames} grey frame(s) in {folder} lies within its true flow and events; is "
                "the part asked for too short?"
            )
        middle = float(np.median([t1 - t0 for _, t0, t1 in found]))
        windows = [
            (k, (round(t0 * 1e6), round(t1 * 1e6)), t0, t1)
            for k, t0, t1 in found
            if abs(t1 - t0 - middle) <= ALIKE * middle
        ]
        self.left_out = len(found) - len(windows)
        super().__init__(sequences, windows, bins, crop_px, seed)


class Sequence(Recording):
    """One sequence. flow_s: [N] times of the true flows. frame_s: [M] times of the grey frames.
    size_px:
    (height, width)."""

    def __init__(self, data: Path, truth: Path) -> None:
        self.truth = truth
        with open_npz(truth) as file:
            heads = [file.header(name) for name in (*COMPONENTS, "timestamps")]
            if any(head.dtype.kind not in "fiu" for head in heads):
                raise FileFormatError(
                    f"{truth} holds {heads[0].dtype}; flows and times are numbers."
                )
            self.flow_s = file.read("timestamps").astype(np.float64)
        shape = heads[0].shape
        if (
            heads[1].shape != shape
            or len(shape) != 3
            or self.flow_s.shape != shape[:1]
            or len(self.flow_s) < 2
            or not _rise(self.flow_s)
        ):
            raise FileFormatError(
                f"{truth} has flows {list(shape)}, {list(heads[1].shape)} and times "
                f"{list(self.flow_s.shape)}; [N, H, W] twice and N rising times are needed."
            )
        self.size_px = shape[1:]
        self.fields = None
        self.events = Hdf5Events(data)
        frames = Rows(data, "davis/left/image_raw_ts", [])
        self.frame_s = frames.read(0, len(frames)).astype(np.float64)
        if len(self.events) < 2 or not _rise(self.frame_s):
            raise FileFormatError(
                f"{data} has {len(self.events)} events, or frame times that do not rise; it is damaged."
            )
        first_us, last_us = self.ends_us()
        self.ends_s = first_us * 1e-6, last_us * 1e-6
        if not all(map(math.isfinite, self.ends_s)):
            raise FileFormatError(
                f"{data}: its events run from {self.ends_s[0]} to {self.ends_s[1]} s."
            )

    def windows(self, frames: int, span_s: tuple[float, float] | None) -> list[tuple[float, float]]:
        """[(from, to)] seconds."""
        ends = (self.flow_s, 1) if frames == 0 else (self.frame_s, frames)
        first = max(self.flow_s[0], self.ends_s[0])
        last = min(self.flow_s[-1], self.ends_s[1])
        if span_s is not None:
            first = max(first, self.flow_s[0] + span_s[0])
            last = min(last, self.flow_s[0] + span_s[1])
        return [
            (float(t0), float(t1))
            for t0, t1 in zip(ends[0][: -ends[1]], ends[0][ends[1] :], strict=True)
            if first <= t0 and t1 <= last
        ]

    def flow(self, t0_s: float, t1_s: float) -> tuple[Tensor, Tensor]:
        """(flow_px [2, H, W], valid [H, W]) on the pixels of t0_s, to t1_s."""
        if self.fields is None:
            with open_npz(self.truth) as file:
                self.fields = [file.mapped(name, MOST_BYTES) for name in COMPONENTS]
        starts, ends = self.flow_s[:-1], self.flow_s[1:]
        common_s = np.minimum(t1_s, ends) - np.maximum(t0_s, starts)
        touched = np.flatnonzero(common_s > LEAST_S)
        shares = torch.from_numpy(common_s[touched] / (ends - starts)[touched])
        fields = np.stack([[component[k] for component in self.fields] for k in touched])
        fields = torch.from_numpy(fields).double()
        seen = fields.isfinite().all(1) & (fields != 0).any(1)
        return chained(torch.where(seen[:, None], fields, 0.0) * shares[:, None, None, None], seen)


def _rise(times):
    return bool(np.isfinite(times).all()) and bool((np.diff(times) > 0).all())


def _places(folder):
    """[(data file, flow file)]."""
    data = sorted(folder.rglob(f"*{DATA}")) if folder.is_dir() else []
    if not data:
        raise FileFormatError(f"{folder} holds no *{DATA} of MVSEC.")
    pairs = []
    for path in data:
        name = path.name.removesuffix(DATA) + FLOW
        found = sorted(folder.rglob(name))
        if not found:
            raise FileFormatError(
                f"{path} has no {name} beside it; download the true flow of that sequence too."
            )
        pairs.append((path, found[0]))
    return pairs
