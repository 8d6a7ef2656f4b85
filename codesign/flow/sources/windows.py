"""Windows of recordings as samples to learn from: what every source of them shares, samples of a batch
put together, and pieces cut out of large pictures."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.flow.checks import check_count, check_number
from codesign.types import EventVolume, FlowField, FlowWindows

ALIKE = 0.05  # windows of one source may differ in length by this share


@dataclass(frozen=True)
class Sample:
    """counts: [2, bins, H, W]. flow_px: [2, H, W]. valid: [H, W]. seconds: length of the window. frames: [2,
    H, W], or None."""

    counts: Tensor
    flow_px: Tensor
    valid: Tensor
    seconds: float
    frames: Tensor | None = None


@dataclass(frozen=True)
class Crop:
    """A piece of every picture, at a place that depends on the seed and the sample's number alone. size_px:
    (height, width); None: the whole."""

    size_px: tuple[int, int] | None
    seed: int = 0

    def check(self, height_px: int, width_px: int) -> None:
        """Raise ShapeError unless the piece fits."""
        if self.size_px is not None and not (
            0 < self.size_px[0] <= height_px and 0 < self.size_px[1] <= width_px
        ):
            raise ShapeError(
                f"pieces of {self.size_px[1]} x {self.size_px[0]} px were asked for; the pictures have "
                f"{width_px} x {height_px}."
            )

    def __call__(self, index: int, sample: Sample) -> Sample:
        """The piece of sample ``index``."""
        if self.size_px is None:
            return sample
        height, width = sample.valid.shape
        draw = torch.Generator().manual_seed((1_000_003 * self.seed + index) % 2**63)
        top, left = (
            int(torch.randint(n - m + 1, (), generator=draw))
            for n, m in zip((height, width), self.size_px, strict=True)
        )
        cut = (..., slice(top, top + self.size_px[0]), slice(left, left + self.size_px[1]))
        frames = None if sample.frames is None else sample.frames[cut]
        return Sample(
            sample.counts[cut].contiguous(),
            sample.flow_px[cut].contiguous(),
            sample.valid[cut].contiguous(),
            sample.seconds,
            frames,
        )


class Windows:
    """A source of windows: ``len(source)`` and ``source.batch(indices)``.

    Args:
      sequences: each with ``size_px``, (height, width), and ``sample(bins, *window)``, a Sample.
      windows: [(number of the sequence, *window)].
      bins: of the volumes.
      crop_px: (height, width) of a piece at a random place, or None.
      seed: of that place.
    """

    def __init__(
        self,
        sequences: Sequence[Any],
        windows: Sequence[tuple[Any, ...]],
        bins: int,
        crop_px: tuple[int, int] | None,
        seed: int,
    ) -> None:
        self.sequences = sequences
        self.windows = windows
        self.bins = check_count(bins, "bins", 1)
        self.crop = Crop(crop_px, seed)
        for sequence in sequences:
            self.crop.check(*sequence.size_px)

    def __len__(self) -> int:
        return len(self.windows)

    def batch(self, indices: Iterable[int] | Tensor) -> FlowWindows:
        """FlowWindows of these samples; each depends on its index and the seed alone. Frames are None
        where a source has none."""
        chosen = [int(index) for index in indices]
        if wrong := [index for index in chosen if not 0 <= index < len(self)]:
            raise DomainError(
                f"sample {wrong[0]} was asked for; the source has {len(self)} (0 to {len(self) - 1})."
            )
        return collate([self.crop(index, self._sample(*self.windows[index])) for index in chosen])

    def _sample(self, number, *window):
        return self.sequences[number].sample(self.bins, *window)


def collate(samples: Sequence[Sample]) -> FlowWindows:
    """FlowWindows of samples. Flows stay those of each sample's own window; the times of the bins are those
    of the mean window.

    Raises: DomainError without a sample; ShapeError when sizes differ.
    """
    if not samples:
        raise DomainError("a batch of no samples was asked for; give at least one index.")
    if len({sample.counts.shape for sample in samples}) > 1:
        raise ShapeError(
            f"samples of shapes {sorted({tuple(sample.counts.shape) for sample in samples})} do not fit in "
            "one batch; cut pieces of one size (crop_px)."
        )
    bins = samples[0].counts.shape[1]
    seconds = sum(sample.seconds for sample in samples) / len(samples)
    centroid_s, collected_s = bin_times(bins, seconds)
    volume = EventVolume(torch.stack([sample.counts for sample in samples]), centroid_s, collected_s)
    truth = FlowField(
        torch.stack([sample.flow_px for sample in samples]),
        torch.stack([sample.valid for sample in samples]),
        seconds,
    )
    frames = [sample.frames for sample in samples if sample.frames is not None]
    return FlowWindows(volume, truth, torch.stack(frames) if len(frames) == len(samples) else None)


def bin_times(bins: int, seconds: float) -> tuple[Tensor, Tensor]:
    """(centroid_s, collected_s) [bins] of an even event rate, as events.from_stream has them."""
    bins = check_count(bins, "bins", 1)
    seconds = check_number(seconds, "the length of the interval", above=0.0)
    if bins == 1:
        return torch.tensor([seconds / 2], dtype=torch.float64), torch.tensor([seconds], dtype=torch.float64)
    node = torch.arange(bins, dtype=torch.float64) / (bins - 1)
    node[0], node[-1] = 1 / (3 * (bins - 1)), 1 - 1 / (3 * (bins - 1))
    collected = torch.full((bins,), seconds / (bins - 1), dtype=torch.float64)
    collected[[0, -1]] /= 2
    return node * seconds, collected


def check_lengths(seconds: Sequence[float], name: str) -> None:
    """Raise DomainError unless all windows of a source last alike within 5 percent of their median."""
    middle = sorted(seconds)[len(seconds) // 2]
    worst = max(seconds, key=lambda value: abs(value - middle))
    if abs(worst - middle) > ALIKE * middle:
        raise DomainError(
            f"{name} has windows of {middle:.6f} s and one of {worst:.6f} s; all must last alike within "
            f"{100 * ALIKE:g} %."
        )
