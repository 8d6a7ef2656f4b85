"""Batches by step out of sources of windows: shares of a mix, showings in sixteen ways, finite sources in
another order every time.

A source has ``batch(indices) -> FlowWindows``; its sample i depends on i and the source's seed alone. Sources
with an end have ``__len__`` too.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch

from codesign.types import EventVolume, FlowField, FlowWindows

GOLDEN = 0.6180339887498949


class Source(Protocol):
    """Windows by number."""

    def batch(self, indices: Sequence[int]) -> Any:
        """The samples of these numbers, as one batch."""
        ...


def pick(parts: Sequence[tuple[float, Any]], group: int) -> Any:
    """The source of a batch: shares are kept to within one batch at any time (multiples of the golden ratio,
    modulo 1, are spread evenly)."""
    total = sum(share for share, _ in parts)
    place = (group * GOLDEN % 1.0) * total
    for share, source in parts:
        if place < share:
            return source
        place -= share
    return parts[-1][1]


def _all(indices):
    return indices


class Batches:
    """Batches by step: each group of windows is made once and shown ``reuse`` times, turned, mirrored and
    with polarities exchanged in between.

    Groups are shown in turns of ``pool``, so the same windows do not follow each other. A batch depends on
    its step and the arguments alone: after a resume, groups that are still needed are made again.
    Args: parts: list of (share, source). batch: windows per step. reuse: times, >= 1; above 1 the sources
      give FlowWindows. mine: function that selects this process's sample numbers (Ranks.mine).
    """

    def __init__(
        self,
        parts: Sequence[tuple[float, Source]],
        batch: int,
        reuse: int = 1,
        pool: int = 16,
        mine: Callable[[Sequence[int]], Sequence[int]] = _all,
    ):
        self.parts = parts
        self.batch = batch
        self.reuse = reuse
        self.pool = pool
        self.mine = mine
        self._block = -1
        self._kept = {}

    def __call__(self, step: int) -> Any:
        """The batch of a step."""
        if self.reuse == 1:
            return self._make(step)
        block, at = divmod(step, self.pool * self.reuse)
        showing, place = divmod(at, self.pool)
        group = block * self.pool + place
        if block != self._block:
            self._block = block
            self._kept = {}
        if group not in self._kept:
            self._kept[group] = self._make(group)
        # 5 is odd: sixteen showings, sixteen ways
        return turned(self._kept[group], (5 * showing % 16) ^ (group % 16))

    def _make(self, group):
        source: Any = pick(self.parts, group)
        indices = list(range(group * self.batch, (group + 1) * self.batch))
        if hasattr(source, "__len__"):
            indices = shuffled(indices, len(source))
        return source.batch(self.mine(indices))


def shuffled(indices: Sequence[int], length: int) -> list[int]:
    """Sample numbers of a finite source: every pass over it in another order."""
    found = []
    for index in indices:
        turn, place = divmod(index, length)
        order = torch.randperm(length, generator=torch.Generator().manual_seed(turn))
        found.append(int(order[place]))
    return found


def turned(windows: FlowWindows, way: int) -> FlowWindows:
    """The same windows seen in a mirror or turned: way 0 to 15, bits: mirror x, mirror y, exchange x and y,
    exchange polarities. Exact."""
    counts = windows.volume.counts
    frames = windows.frames
    flow = windows.truth.flow_px
    valid = windows.truth.valid
    for bit, axis in ((1, -1), (2, -2)):
        if way & bit:
            sign = torch.tensor(
                [-1.0, 1.0] if axis == -1 else [1.0, -1.0], dtype=flow.dtype, device=flow.device
            )
            counts = counts.flip(axis)
            flow = flow.flip(axis) * sign[:, None, None]
            valid = valid.flip(axis)
            frames = None if frames is None else frames.flip(axis)
    if way & 4:
        counts = counts.transpose(-1, -2)
        flow = flow.flip(1).transpose(-1, -2)
        valid = valid.transpose(-1, -2)
        frames = None if frames is None else frames.transpose(-1, -2)
    if way & 8:
        counts = counts.flip(1)
    volume = EventVolume(counts.contiguous(), windows.volume.centroid_s, windows.volume.collected_s)
    return FlowWindows(
        volume,
        FlowField(flow.contiguous(), valid.contiguous(), windows.truth.interval_s),
        None if frames is None else frames.contiguous(),
    )


class Part:
    """Windows ``first`` to ``last`` (not included) of a finite source."""

    def __init__(self, source: Source, first: int, last: int):
        self.source = source
        self.first = first
        self.last = last

    def __len__(self) -> int:
        return self.last - self.first

    def batch(self, indices: Sequence[int]) -> Any:
        """The samples of these numbers, counted from the first."""
        return self.source.batch([self.first + index for index in indices])


def probe(source: Source) -> Any:
    """A few samples to look at before a training: the first, middle and last of a finite source, else the
    first."""
    sized: Any = source
    if not hasattr(source, "__len__"):
        return source.batch([0])
    return source.batch(sorted({0, len(sized) // 2, len(sized) - 1}))


def to_device(value: Any, device: torch.device) -> Any:
    """A batch on a device: tensors inside dataclasses, tuples, lists and dictionaries are moved."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = (field.name for field in dataclasses.fields(value))
        return dataclasses.replace(
            value, **{name: to_device(getattr(value, name), device) for name in fields}
        )
    if isinstance(value, list | tuple) and type(value) in (list, tuple):
        return type(value)(to_device(each, device) for each in value)
    if isinstance(value, dict):
        return {name: to_device(each, device) for name, each in value.items()}
    return value


def without_truth(batch: Any) -> int:
    """How many windows of a batch have no pixel with known flow; 0 for batches of another kind."""
    if not isinstance(batch, FlowWindows):
        return 0
    return int((~batch.truth.valid.flatten(1).any(1)).sum())
