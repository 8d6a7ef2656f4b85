"""Batches by step out of sources of windows: shares of a mix, showings in sixteen ways, finite
sources in another order every time.

A source has ``batch(indices) -> FlowWindows``; its sample i depends on i and the source's seed
alone. Sources with an end have ``__len__`` too.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch

from codesign.checks import check_number, check_positive
from codesign.errors import DomainError
from codesign.system.contents import mapped
from codesign.types import EventVolume, FlowField, FlowWindows

GOLDEN = 0.6180339887498949


class Source(Protocol):
    """Windows by number."""

    def batch(self, indices: Sequence[int]) -> Any:
        """The samples of these numbers, as one batch."""
        ...


def pick(parts: Sequence[tuple[float, Any]], group: int) -> Any:
    """The source of a batch: shares are kept to within one batch at any time (multiples of the
    golden ratio, modulo 1, are spread evenly)."""
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
    """Batches by step: each group of windows is made once and shown ``reuse`` times, turned,
    mirrored and with polarities exchanged in between.

    Groups are shown in turns of ``pool``, so the same windows do not follow each other. A batch
    depends on its step and the arguments alone: after a resume, groups that are still needed are
    made again. Args:
      parts: list of (share, source).
      batch: windows per step.
      reuse: times, >= 1; above 1 the sources give FlowWindows.
      pool: groups shown in turns.
      mine: function that selects this process's sample numbers (Ranks.mine).
    """

    def __init__(
        self,
        parts: Sequence[tuple[float, Source]],
        batch: int,
        reuse: int = 1,
        pool: int = 16,
        mine: Callable[[Sequence[int]], Sequence[int]] = _all,
    ):
        shares = (check_number(share, "a share of the mix", 0.0) for share, _ in parts)
        check_positive(sum(shares), "the sum of the mix's shares")
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
    """The same windows seen in a mirror or turned: way 0 to 15, bits: mirror x, mirror y, exchange
    x and y, exchange polarities. Exact."""
    counts = _image(windows.volume.counts, way)
    frames = windows.frames
    return FlowWindows(
        replace(windows.volume, counts=(counts.flip(1) if way & 8 else counts).contiguous()),
        _field(windows.truth, way),
        None if frames is None else _image(frames, way).contiguous(),
        None if windows.start is None else _field(windows.start, way),
    )


def _image(image, way):
    """Rows and columns [..., H, W] turned."""
    for bit, axis in ((1, -1), (2, -2)):
        image = image.flip(axis) if way & bit else image
    return image.transpose(-1, -2) if way & 4 else image


def _field(field, way):
    """A FlowField turned: components of the flow and of the covariance change places and signs with
    the pixels."""
    x = -1.0 if way & 1 else 1.0
    y = -1.0 if way & 2 else 1.0

    def turn(components, signs):
        if components is None:
            return None
        turned = _image(components, way) * torch.tensor(signs).to(components)[:, None, None]
        return (turned.flip(1) if way & 4 else turned).contiguous()

    confidence = field.confidence
    return replace(
        field,
        flow_px=turn(field.flow_px, [x, y]),
        valid=_image(field.valid, way).contiguous(),
        confidence=None if confidence is None else _image(confidence, way).contiguous(),
        covariance_px2=turn(field.covariance_px2, [1.0, x * y, 1.0]),
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
        """The samples of these numbers, counted from the first. Raises: DomainError beyond the
        last."""
        if beyond := [index for index in indices if not 0 <= index < len(self)]:
            raise DomainError(f"window {beyond[0]} of {len(self)}; give 0 to {len(self) - 1}.")
        return self.source.batch([self.first + index for index in indices])


class Started:
    """Windows of a source together with what a network begins from, estimated once however often
    they are shown.

    Args:
      source: of the windows.
      start: EventVolume -> FlowField with covariance, equivariant to turns and mirrors.
      foreign: share of the samples that begin elsewhere, as from the window before: with half to
        one and a fifth of the start's flow, and a covariance of 1 px^2 along both axes.
    It has an end where the source has one.
    """

    def __new__(cls, source: Source, *_: Any, **__: Any) -> "Started":
        return super().__new__(_Finite if hasattr(source, "__len__") else cls)

    def __init__(
        self,
        source: Source,
        start: Callable[[EventVolume], FlowField],
        foreign: float = 0.0,
    ):
        self.source = source
        self.start = start
        self.foreign = foreign

    def batch(self, indices: Sequence[int]) -> FlowWindows:
        """The samples of these numbers."""
        windows = self.source.batch(indices)
        with torch.no_grad():
            start = self.start(windows.volume)
        claimed = start.covariance_px2
        assert claimed is not None
        unknown = torch.tensor([1.0, 0.0, 1.0]).to(claimed)[:, None, None].expand_as(claimed[0])
        flows = []
        covariances = []
        for index, flow, covariance in zip(indices, start.flow_px, claimed, strict=True):
            draw = torch.rand(2, generator=torch.Generator().manual_seed(int(index)))
            elsewhere = bool(draw[0] < self.foreign)
            flows.append(flow * (0.5 + 0.7 * float(draw[1])) if elsewhere else flow)
            covariances.append(unknown if elsewhere else covariance)
        return replace(
            windows,
            start=replace(
                start, flow_px=torch.stack(flows), covariance_px2=torch.stack(covariances)
            ),
        )


class _Finite(Started):
    """That of a source with an end."""

    def __len__(self) -> int:
        source: Any = self.source
        return len(source)


def probe(source: Source) -> Any:
    """A few samples to look at before a training: the first, middle and last of a finite source,
    else the first."""
    sized: Any = source
    if not hasattr(source, "__len__"):
        return source.batch([0])
    return source.batch(sorted({0, len(sized) // 2, len(sized) - 1}))


def to_device(value: Any, device: torch.device) -> Any:
    """A batch on a device: tensors inside dataclasses, tuples, lists and dictionaries are moved."""
    return mapped(value, lambda tensor: tensor.to(device))


def without_truth(batch: Any) -> int:
    """How many windows of a batch have no pixel with known flow; 0 for batches of another kind."""
    if not isinstance(batch, FlowWindows):
        return 0
    return int((~batch.truth.valid.flatten(1).any(1)).sum())
