"""Derivatives of a layer beside differences of the hard sensor, pooled over blocks: cosine and
scale.

The hard sensor's counts are means over many places where a pixel may have begun inside its
thresholds. The same beginnings serve both ends of a step (common random numbers).
"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor

from codesign import events
from codesign.events.sensor.state import begin
from studies.frame.compare import bootstrap
from studies.gradient_flow.events.case import SECTIONS, Case, Direction, times
from studies.gradient_flow.topic import Row

BEGINNINGS = 32
AT_ONCE = 8  # beginnings that a kernel walks through side by side
PARTS = 4  # of the time, for counts
BLOCKS = 4  # per side of the picture
RESAMPLES = 400

Maps = Callable[[Tensor, Tensor], Tensor]
"""What is differentiated: frames [T, H, W] and times [T] to maps [K, H, W], of a layer or of the
hard sensor."""


@dataclass(frozen=True)
class Pair:
    """Derivative of a layer, averaged over a step, and difference of the hard sensor over the step,
    [K, blocks]."""

    slope: Tensor
    difference: Tensor


def offsets(shape: tuple[int, ...], count: int, seed: int = 0) -> Tensor:
    """[count, *shape] places in [0, 1): evenly spaced over the beginnings, with a random start and
    in random order for every pixel, so that their mean over beginnings is far less noisy than that
    of free draws."""
    generator = Generator().manual_seed(seed)
    first = torch.rand(shape, generator=generator)
    order = torch.rand((count, *shape), generator=generator).argsort(0)
    return (order + first) / count


def distance(place: Tensor, theta_on: Tensor | float, theta_off: Tensor | float) -> Tensor:
    """How far the level lies above the memorised one at the first frame, for a place in [0, 1):
    even over -C_off/2 to C_on/2, which is what the memory layer assumes of a pixel without a
    history."""
    return place * (theta_on + theta_off) / 2 - theta_off / 2


@dataclass(frozen=True)
class Judge:
    """Mean over beginnings of something that the hard sensor gives.

    sensor: SensorModel. count: beginnings. seed: of the beginnings and of what the sensor draws
      itself, the same for every one of them.
    """

    sensor: events.SensorModel
    count: int = BEGINNINGS
    seed: int = 0

    @torch.no_grad()
    def mean(self, frames: Tensor, t_s: Tensor, observe: Callable[[Tensor], Tensor]) -> Tensor:
        """Mean of ``observe(counts)`` over beginnings.

        Args:
          frames: [T, H, W], 0-255 scale.
          t_s: [T].
          observe: counts [T-1, 2, B, H, W] of some beginnings to what is wanted [K, B, H, W].
        Returns: [K, H, W].
        """
        places = offsets(tuple(frames.shape[1:]), self.count, self.seed).to(frames)
        total: Any = 0
        for chosen in places.split(AT_ONCE):
            several = frames[:, None].expand(-1, len(chosen), -1, -1)
            state = self._begun(several[0], float(t_s[0]), chosen)
            counts = events.dense_counts(several[1:], t_s[1:], self.sensor, state=state)
            total = total + observe(counts).sum(1)
        return total / self.count

    def _begun(self, first, start_s, places):
        """SensorState of frames [B, H, W] whose memorised levels lie at these places of the
        thresholds."""
        generator = Generator().manual_seed(self.seed)
        level = events.lin_log(first[:1])[0]
        state = events.SensorState()
        # one draw of the sensor for all
        begin(state, self.sensor, first[0], level, start_s, generator)
        for name, value in state.tensors().items():
            setattr(state, name, value.expand(len(places), *value.shape).contiguous())
        state.generator = generator
        state.reference = level - distance(places, state.theta_on, state.theta_off)
        return state


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


def of_layer(
    layer: Callable[[Tensor, Tensor], Tensor],
    observe: Callable[[Tensor], Tensor] = parts,
) -> Maps:
    """Maps of a layer (frames, t_s) -> counts [T-1, 2, H, W]."""
    return lambda frames, t_s: observe(layer(frames, t_s))


def of_judge(judge: Judge, observe: Callable[[Tensor], Tensor] = parts) -> Maps:
    """Maps of the hard sensor's counts, the mean over beginnings."""
    return lambda frames, t_s: judge.mean(frames, t_s, observe)


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
    """As ``pairs`` for frames [sections + 1, T, H, W] at the ends of the sections of a step of
    2."""
    difference = blocks(truth(ends[-1], t_s) - truth(ends[0], t_s)) / 2
    return Pair(slope(ends, t_s, layer), difference.double())


def slope(ends: Tensor, t_s: Tensor, layer: Maps) -> Tensor:
    """[K, blocks] derivative of a layer along a step of 2, averaged over it; ends as for
    ``pair``."""
    # to second order, the derivative over a section is that at the mean of its ends, along their
    # difference
    slopes = [
        derivative(layer, (first + second) / 2, second - first, t_s)
        for first, second in itertools.pairwise(ends)
    ]
    return torch.stack(slopes).sum(0).double() / 2


def derivative(layer: Maps, frames: Tensor, tangent: Tensor, t_s: Tensor) -> Tensor:
    """[K, blocks] derivative of every map, summed over blocks, along a tangent of the frames.
    Pixels are independent: one backward pass serves all blocks of a map."""
    frames = frames.clone().requires_grad_()
    found = []
    for one in (maps := layer(frames, t_s)):
        (grad,) = torch.autograd.grad(one.sum(), frames, retain_graph=len(found) < len(maps) - 1)
        found.append((grad * tangent).sum(0))
    return blocks(torch.stack(found))


def row(names: Sequence[object], found: Sequence[Pair], seed: int = 0) -> Row:
    """Cosine and scale (length of the derivative along the differences over theirs) of all pairs
    together, with the interval of 90 % of the cosine over draws of cases and blocks."""
    slope = torch.cat([one.slope for one in found], 1)
    difference = torch.cat([one.difference for one in found], 1)
    # [3, units]
    products = torch.stack([(slope * difference).sum(0), (slope**2).sum(0), (difference**2).sum(0)])
    cosine = bootstrap(
        lambda x: _cosine(x.sum(-1)), products, level=0.9, draws=RESAMPLES, seed=seed
    )
    whole = products.sum(1)
    return Row(
        tuple(str(name) for name in names),
        {
            "cosine": cosine.value,
            "scale": float(whole[0] / whole[2]),
            "cosine_low": cosine.low,
            "cosine_high": cosine.high,
        },
    )


def _cosine(products):
    """Of [3, ...] inner products; a derivative that vanishes has cosine 0."""
    return products[0] / (products[1] * products[2]).sqrt().clamp(min=1e-300)
