"""Windows of recordings as samples to learn from: what a recording has to tell, whatever its
layout, pieces cut out of large pictures, and samples of a batch put together."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check_positive, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.events.volumes.volume import from_stream
from codesign.flow.checks import MOST_STEPS
from codesign.types import EventStream, EventVolume, FlowField, FlowWindows

ALIKE = 0.05  # windows of one source may differ in length by this share


@dataclass(frozen=True)
class Sample:
    """counts: [2, bins, H, W]. flow_px: [2, H, W]. valid: [H, W]. seconds: length of the window.
    frames: [2, H, W], or None."""

    counts: Tensor
    flow_px: Tensor
    valid: Tensor
    seconds: float
    frames: Tensor | None = None


class Recording:
    """Events and true flow of one recording, by window. Layouts say ``flow``, and what else is not
    as here.

    size_px: (height, width). events: with ``window(t0_us, t1_us, size_px)``, an EventStream.
    """

    size_px: tuple[int, int]
    events: Any

    def sample(self, bins: int, ends_us: tuple[int, int], *which: Any) -> Sample:
        """The window of these times; ``which`` tells it to ``flow`` and ``frames``."""
        flow, valid = self.flow(*which)
        counts = self.counts(bins, *ends_us)
        return Sample(
            counts, flow.float(), valid, (ends_us[1] - ends_us[0]) * 1e-6, self.frames(*which)
        )

    def flow(self, *which: Any) -> tuple[Tensor, Tensor]:
        """(flow_px [2, H, W] on the pixels of the window's start, valid [H, W])."""
        raise NotImplementedError

    def frames(self, *which: Any) -> Tensor | None:
        """[2, H, W] at both ends, or None."""
        return None

    def ends_us(self) -> tuple[float, float]:
        """Times of the first and of the last event of a file."""
        first, last = (float(self.events.packet(k, k + 1)[0][0]) for k in (0, len(self.events) - 1))
        return first, last

    @cached_property
    def last_us(self) -> float:
        """Time of the last event."""
        return self.ends_us()[1]

    def within(self, t0_us: int, t1_us: int) -> EventStream:
        """Events of a window, from its start, included, to its end, which belongs to the next one
        (the last of a recording is included)."""
        return self.events.window(t0_us, t1_us - (t1_us < self.last_us), self.size_px)

    def counts(self, bins: int, t0_us: int, t1_us: int) -> Tensor:
        """[2, bins, H, W]."""
        return from_stream(self.within(t0_us, t1_us), t0_us, t1_us, bins).counts[0]


class Windows:
    """A source of windows: ``len(source)`` and ``source.batch(indices)``.

    Args:
      recordings: what the windows are of.
      windows: [(number of the recording, (t0_us, t1_us), *which)], as ``Recording.sample`` takes
        them.
      bins: of the volumes.
      crop_px: (height, width) of a piece at a random place, or None.
      seed: of that place.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        windows: Sequence[tuple[Any, ...]],
        bins: int,
        crop_px: tuple[int, int] | None,
        seed: int,
    ) -> None:
        self.recordings = recordings
        self.windows = windows
        self.bins = check_whole(bins, "bins", 1, MOST_STEPS)
        self.crop_px = crop_px
        self.seed = seed
        for height, width in (recording.size_px for recording in recordings):
            if crop_px is not None and not (0 < crop_px[0] <= height and 0 < crop_px[1] <= width):
                raise ShapeError(
                    f"pieces of {crop_px[1]} x {crop_px[0]} px were asked for; the pictures have "
                    f"{width} x {height}."
                )

    def __len__(self) -> int:
        return len(self.windows)

    def batch(self, indices: Iterable[int] | Tensor) -> FlowWindows:
        """FlowWindows of these samples; each depends on its index and the seed alone. Frames are
        None where a source has none."""
        chosen = [int(index) for index in indices]
        if wrong := [index for index in chosen if not 0 <= index < len(self)]:
            raise DomainError(
                f"sample {wrong[0]} was asked for; the source has {len(self)} (0 to {len(self) - 1})."
            )
        return collate([self._sample(index) for index in chosen])

    def _sample(self, index):
        """Sample ``index``, or a piece of it at a place that depends on the seed and the number
        alone."""
        number, *window = self.windows[index]
        sample = self.recordings[number].sample(self.bins, *window)
        if self.crop_px is None:
            return sample
        draw = torch.Generator().manual_seed((1_000_003 * self.seed + index) % 2**63)
        cut = [...]
        for size, piece in zip(sample.valid.shape, self.crop_px, strict=True):
            first = int(torch.randint(size - piece + 1, (), generator=draw))
            cut.append(slice(first, first + piece))
        cut = tuple(cut)
        return Sample(
            sample.counts[cut].contiguous(),
            sample.flow_px[cut].contiguous(),
            sample.valid[cut].contiguous(),
            sample.seconds,
            None if sample.frames is None else sample.frames[cut],
        )


def collate(samples: Sequence[Sample]) -> FlowWindows:
    """FlowWindows of samples. Flows stay those of each sample's own window; the times of the bins
    are those of the mean window.

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
    volume = EventVolume(
        torch.stack([sample.counts for sample in samples]), centroid_s, collected_s
    )
    truth = FlowField(
        torch.stack([sample.flow_px for sample in samples]),
        torch.stack([sample.valid for sample in samples]),
        seconds,
    )
    frames = [sample.frames for sample in samples if sample.frames is not None]
    return FlowWindows(volume, truth, torch.stack(frames) if len(frames) == len(samples) else None)


def bin_times(bins: int, seconds: float) -> tuple[Tensor, Tensor]:
    """(centroid_s, collected_s) [bins] of an even event rate, as events.from_stream has them."""
    bins = check_whole(bins, "bins", 1, MOST_STEPS)
    seconds = check_positive(seconds, "the length of the interval")
    if bins == 1:
        return torch.tensor([seconds / 2], dtype=torch.float64), torch.tensor(
            [seconds], dtype=torch.float64
        )
    node = torch.arange(bins, dtype=torch.float64) / (bins - 1)
    node[0], node[-1] = 1 / (3 * (bins - 1)), 1 - 1 / (3 * (bins - 1))
    collected = torch.full((bins,), seconds / (bins - 1), dtype=torch.float64)
    collected[[0, -1]] /= 2
    return node * seconds, collected


def check_lengths(seconds: Sequence[float], name: str) -> None:
    """Raise DomainError unless all windows of a source last alike within 5 percent of their
    median."""
    middle = sorted(seconds)[len(seconds) // 2]
    worst = max(seconds, key=lambda value: abs(value - middle))
    if abs(worst - middle) > ALIKE * middle:
        raise DomainError(
            f"{name} has windows of {middle:.6f} s and one of {worst:.6f} s; all must last alike within "
            f"{100 * ALIKE:g} %."
        )
