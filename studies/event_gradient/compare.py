"""Derivatives of a layer beside differences of the hard sensor, pooled over blocks: cosine and scale."""

import itertools
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from studies.event_gradient.case import SECTIONS, Case, Direction, times
from studies.event_gradient.judge import Judge

PARTS = 4  # of the time, for counts
BLOCKS = 4  # per side of the picture
RESAMPLES = 400
LEAD = 2  # frames of a history
LEAD_S = 1.0  # between them: longer than any dead time or time constant

Maps = Callable[[Tensor, Tensor], Tensor]
"""What is differentiated: frames [T, H, W] and times [T] to maps [K, H, W], of a layer or of the hard sensor."""


@dataclass(frozen=True)
class Pair:
    """Derivative of a layer, averaged over a step, and difference of the hard sensor over the step, [K, blocks]."""

    slope: Tensor
    difference: Tensor


@dataclass(frozen=True)
class Row:
    """A line of a table. names: what tells it from the others. numbers: figures by name, such as cosine and scale."""

    names: tuple[str, ...]
    numbers: dict[str, float]

    def metrics(self, prefix: str = "") -> dict[str, float]:
        """Figures by the names that they have in metrics.json: cosine_memory_contrast_240fps."""
        words = [prefix, *self.names]
        name = "_".join(
            filter(None, (re.sub(r"[^a-z0-9.]+", "_", word.lower()).strip("_") for word in words))
        )
        return {f"{key}_{name}": value for key, value in self.numbers.items()}


def parts(counts: Tensor) -> Tensor:
    """Counts [T-1, 2, ...] summed over quarters of the time, [PARTS * 2, ...]."""
    time = torch.arange(len(counts)) * PARTS // len(counts)
    summed = torch.zeros(PARTS, *counts.shape[1:], dtype=counts.dtype).index_add(0, time, counts)
    return summed.flatten(0, 1)


def blocks(maps: Tensor) -> Tensor:
    """Maps [K, H, W] summed over blocks, [K, BLOCKS * BLOCKS]."""
    count, height, width = maps.shape
    split = maps.reshape(count, BLOCKS, height // BLOCKS, BLOCKS, width // BLOCKS)
    return split.sum((2, 4)).flatten(1)


def of_layer(layer: Callable[[Tensor, Tensor], Tensor], observe: Callable[[Tensor], Tensor] = parts) -> Maps:
    """Maps of a layer (frames, t_s) -> counts [T-1, 2, H, W]."""
    return lambda frames, t_s: observe(layer(frames, t_s))


def of_judge(judge: Judge, observe: Callable[[Tensor], Tensor] = parts) -> Maps:
    """Maps of the hard sensor's counts, the mean over beginnings."""
    return lambda frames, t_s: judge.mean(frames, t_s, observe)


def led_in(frames: Tensor, t_s: Tensor, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Frames and times with a history of LEAD frames before: half of the pixels come from far above, half from far
    below, turn anywhere around their first level, and go to it. It moves with the first frame."""
    generator = torch.Generator().manual_seed(seed)
    draws = torch.rand(3, *frames.shape[1:], generator=generator, dtype=frames.dtype)
    far = (1 + draws[0]) * (draws[1] - 0.5).sign()
    near = 1.2 * (draws[2] - 0.5)
    lead_s = t_s[0] + LEAD_S * torch.arange(-LEAD, 0, dtype=t_s.dtype)
    return torch.cat((frames[0] * torch.stack((far, near)).exp(), frames)), torch.cat((lead_s, t_s))


def with_history(maps_of: Callable[[Callable[[Tensor], Tensor]], Maps]) -> Maps:
    """Maps of counts behind a history that is not counted itself. maps_of: from observe to maps."""
    maps = maps_of(lambda counts: parts(counts[LEAD:]))
    return lambda frames, t_s: maps(*led_in(frames, t_s))


def pairs(
    cases: Iterable[Case],
    rate_hz: float,
    direction: Direction,
    layer: Maps,
    truth: Maps,
    sections: int = SECTIONS,
) -> list[Pair]:
    """The derivative over a step beside the difference, for every case. sections: of the step, in
    each of which the derivative is taken once."""
    t_s = times(rate_hz)
    found = []
    for case in cases:
        ends = case.along(rate_hz, direction, sections)
        found.append(pair(ends, t_s, layer, truth))
    return found


def pair(ends: Tensor, t_s: Tensor, layer: Maps, truth: Maps) -> Pair:
    """As ``pairs`` for frames [sections + 1, T, H, W] at the ends of the sections of a step of 2."""
    difference = blocks(truth(ends[-1], t_s) - truth(ends[0], t_s)) / 2
    return Pair(slope(ends, t_s, layer), difference.double())


def slope(ends: Tensor, t_s: Tensor, layer: Maps) -> Tensor:
    """[K, blocks] derivative of a layer along a step of 2, averaged over it; ends as for ``pair``."""
    # to second order, the derivative over a section is that at the mean of its ends, along their difference
    slopes = [
        derivative(layer, (first + second) / 2, second - first, t_s)
        for first, second in itertools.pairwise(ends)
    ]
    return torch.stack(slopes).sum(0).double() / 2


def derivative(layer: Maps, frames: Tensor, tangent: Tensor, t_s: Tensor) -> Tensor:
    """[K, blocks] derivative of every map, summed over blocks, along a tangent of the frames. Pixels are independent:
    one backward pass serves all blocks of a map."""
    frames = frames.clone().requires_grad_()
    found = []
    for one in (maps := layer(frames, t_s)):
        (grad,) = torch.autograd.grad(one.sum(), frames, retain_graph=len(found) < len(maps) - 1)
        found.append((grad * tangent).sum(0))
    return blocks(torch.stack(found))


def row(names: Sequence[object], found: Sequence[Pair], seed: int = 0) -> Row:
    """Cosine and scale (length of the derivative along the differences over theirs) of all pairs together, with the
    interval of 90 % of the cosine over draws of cases and blocks."""
    slope = torch.cat([one.slope for one in found], 1)
    difference = torch.cat([one.difference for one in found], 1)
    products = torch.stack(
        [(slope * difference).sum(0), (slope**2).sum(0), (difference**2).sum(0)]
    )  # [3, units]
    units = products.shape[1]
    drawn = torch.randint(units, (RESAMPLES, units), generator=torch.Generator().manual_seed(seed))
    low, high = _cosine(products[:, drawn].sum(-1)).quantile(torch.tensor([0.05, 0.95], dtype=torch.float64))
    whole = products.sum(1)
    return Row(
        tuple(str(name) for name in names),
        {
            "cosine": float(_cosine(whole)),
            "scale": float(whole[0] / whole[2]),
            "cosine_low": float(low),
            "cosine_high": float(high),
        },
    )


def _cosine(products):
    """Of [3, ...] inner products; a derivative that vanishes has cosine 0."""
    return products[0] / (products[1] * products[2]).sqrt().clamp(min=1e-300)
