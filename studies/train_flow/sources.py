"""What flow networks are trained on and judged on: windows made on the fly, or a folder of a data set.

A source has ``batch(indices) -> FlowWindows``; its sample i depends on i and the source's seed alone. Sources
with an end have ``__len__`` too.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch

from codesign.errors import DomainError
from codesign.types import EventVolume, FlowField, FlowWindows
from scenes.flow_windows import Draws, RenderedWindows, planes

UNSEEN = 1_000_000  # added to the seed of what networks are judged on
GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class Shape:
    """Size of a window."""

    height_px: int
    width_px: int
    bins: int

    def __call__(self, draws, seed, height_px=None, width_px=None):
        """Rendered windows of this size, or of another."""
        return RenderedWindows(
            draws,
            seed=seed,
            height_px=height_px or self.height_px,
            width_px=width_px or self.width_px,
            bins=self.bins,
        )


DENSE = Draws(flow_px=(0.5, 7.0), contrast=(0.8, 1.8), theta=(0.08, 0.25))
FLAT = Draws(motion="similarity", layers=(0, 0), flow_px=(0.0, 7.0), contrast=(0.7, 1.6), theta=(0.08, 0.25))
WIDE = Draws(layers=(1, 4), flow_px=(1.0, 9.0), contrast=(0.8, 1.8), theta=(0.08, 0.25))

TRAINING: dict[str, Callable[[Shape, int], list]] = {
    "delivered": lambda shape, seed: [
        (0.55, shape(DENSE, seed)),
        (0.25, shape(FLAT, seed + 1)),
        (0.2, shape(WIDE, seed + 2, 96, 96)),
    ],
    "layers": lambda shape, seed: [(1.0, shape(Draws(), seed))],
    "planes": lambda shape, seed: [(1.0, shape(Draws(layers=(0, 0)), seed))],
}
"""Name -> function (shape, seed) -> list of (share of the batches, source)."""

VALIDATION: dict[str, Callable[[Shape, int], Any]] = {
    "fine_theta_0.1": lambda shape, seed: shape(planes("fine", 0.1), seed + UNSEEN),
    "fine_theta_0.2": lambda shape, seed: shape(planes("fine", 0.2), seed + UNSEEN),
    "mixed_theta_0.1": lambda shape, seed: shape(planes("mixed", 0.1), seed + UNSEEN),
    "mixed_theta_0.2": lambda shape, seed: shape(planes("mixed", 0.2), seed + UNSEEN),
    "layers": lambda shape, seed: shape(replace(DENSE, textures="mixed", layers=(1, 3)), seed + UNSEEN),
}
"""Name -> function (shape, seed) -> source; textures and seeds that no training mix uses."""


def pick(parts, group):
    """The source of a batch: shares are kept to within one batch at any time (multiples of the golden ratio,
    modulo 1, are spread evenly)."""
    total = sum(share for share, _ in parts)
    place = (group * GOLDEN % 1.0) * total
    for share, source in parts:
        if place < share:
            return source
        place -= share
    return parts[-1][1]


class Batches:
    """Batches by step: each group of windows is made once and shown ``reuse`` times, turned, mirrored and
    with polarities exchanged in between.

    Groups are shown in turns of ``pool``, so the same windows do not follow each other. A batch depends on
    its step and the arguments alone: after a resume,
    groups that are still needed are made again.
    Args: parts: list of (share, source). batch: windows per step. reuse: times, >= 1. mine: function that
      selects this process's sample numbers.
    """

    def __init__(self, parts, batch, reuse=1, pool=16, mine=lambda indices: indices):
        self.parts = parts
        self.batch = batch
        self.reuse = reuse
        self.pool = pool
        self.mine = mine
        self._block = -1
        self._kept = {}

    def __call__(self, step):
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
        return turned(
            self._kept[group], (5 * showing % 16) ^ (group % 16)
        )  # 5 is odd: sixteen showings, sixteen ways

    def _make(self, group):
        source: Any = pick(self.parts, group)
        indices = list(range(group * self.batch, (group + 1) * self.batch))
        if hasattr(source, "__len__"):
            indices = shuffled(indices, len(source))
        return source.batch(self.mine(indices))


def shuffled(indices, length):
    """Sample numbers of a finite source: every pass over it in another order."""
    found = []
    for index in indices:
        turn, place = divmod(index, length)
        order = torch.randperm(length, generator=torch.Generator().manual_seed(turn))
        found.append(int(order[place]))
    return found


def turned(windows, way):
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

    def __init__(self, source, first, last):
        self.source = source
        self.first = first
        self.last = last

    def __len__(self):
        return self.last - self.first

    def batch(self, indices):
        """FlowWindows of these samples, counted from the first."""
        return self.source.batch([self.first + index for index in indices])


def to_device(windows, device):
    """Windows on a device; bin times stay as they are where nothing has to move."""
    if windows.volume.counts.device == device:
        return windows
    volume = EventVolume(
        windows.volume.counts.to(device),
        windows.volume.centroid_s.to(device),
        windows.volume.collected_s.to(device),
    )
    truth = FlowField(
        windows.truth.flow_px.to(device), windows.truth.valid.to(device), windows.truth.interval_s
    )
    return FlowWindows(volume, truth, None if windows.frames is None else windows.frames.to(device))


def training_parts(name, shape, seed):
    """The mix called ``name``.

    Raises: DomainError for an unknown name.
    """
    if name not in TRAINING:
        raise DomainError(f"--mix {name} is unknown; choose one of {', '.join(TRAINING)}.")
    return TRAINING[name](shape, seed)
