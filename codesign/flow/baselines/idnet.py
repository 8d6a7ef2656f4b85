"""A recurrent network that reads the bins of a volume one after the other, and again after deblurring
them."""

import math
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import pad, unfold

from codesign.flow.baselines.parts import Baseline, channels, start
from codesign.flow.checks import check_count
from codesign.flow.layers import Layer
from codesign.flow.warp import along_flow
from codesign.types import EventVolume

STATE = 4  # channels of the recurrent state over the width


class IDNet(Baseline):
    """Iterative deblurring: the bins are moved back along the flow so far, an encoder and a recurrent unit
    read them in turn, and the last state says what to add to the flow; again with the same weights.

    Args:
      bins: bins of the volumes, >= 2.
      width: channels of the first layer, four times as many in the recurrent state; 32 for the
        published small network of some 1.4 million weights; every layer takes the nearest multiple of
        4.
      hidden: channels inside the head, a multiple of 4; None for 8 times ``width``.
      iterations: >= 1, 4 as published.
      seed: of the first weights.
    Gradient: counts and weights; piecewise smooth, as bilinear lookups and rectifiers are.
    Raises: ShapeError, DomainError.
    Source: Wu, Paredes-Valles, de Croon, Lightweight event-based optical flow estimation via iterative
      deblurring, ICRA 2024, sec. III: without correlation volumes, flow at 1/8 resolution brought to
      all pixels by learnt means of nine cells. Here bins are moved in place of single events, and the
      state starts at 0.

    >>> from codesign.flow.export import evenly_timed
    >>> IDNet(bins=4, width=4.0, iterations=2)(evenly_timed(torch.ones(1, 2, 4, 32, 48))).flow_px.shape
    torch.Size([1, 2, 32, 48])
    """

    STRIDE: ClassVar[int] = 8  # of the cells on which flow is found

    def __init__(
        self,
        bins: int = 8,
        width: float = 32.0,
        hidden: int | None = None,
        iterations: int = 4,
        seed: int = 0,
    ) -> None:
        check_count(iterations, "iterations", 1)
        super().__init__(bins, width, hidden, iterations=iterations, seed=seed)
        c, state = channels(width), channels(width, STATE)
        self.encoder = nn.Sequential(
            Layer(2, c, stride=2),
            Layer(c, 2 * c, stride=2),
            Layer(2 * c, 2 * c),
            Layer(2 * c, state, stride=2),
        )
        self.gates = nn.Conv2d(2 * state, 2 * state, 3, 1, 1)
        self.candidate = nn.Conv2d(2 * state, state, 3, 1, 1)
        self.head = nn.Sequential(
            nn.Conv2d(state, self.inside, 3, 1, 1), nn.SiLU(), nn.Conv2d(self.inside, 2, 3, 1, 1)
        )
        self.blend = nn.Conv2d(state, 9 * self.STRIDE**2, 1)
        start(self, seed, 2.0, [self.head[2], self.blend])
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def levels(self, counts: Tensor, volume: EventVolume) -> list[Tensor]:
        """Flow px of all pixels after every iteration."""
        batch = len(counts)
        padded = counts.unflatten(1, (2, -1))
        bins = padded.shape[2]
        time = (volume.centroid_s / volume.collected_s.sum()).to(padded)
        cells = [side // self.STRIDE for side in padded.shape[3:]]
        flow = padded.new_zeros(batch, 2, *cells)  # px on cells
        full = padded.new_zeros(batch, 2, *padded.shape[3:])
        found = []
        for _ in range(self.config["iterations"]):
            moved = along_flow(padded, full, time) if found else padded
            each = moved.transpose(1, 2).flatten(0, 1).contiguous(memory_format=torch.channels_last)
            read = self.encoder(each).unflatten(0, (batch, bins))
            state = self._read(read)
            flow = flow + self.STRIDE * self.head(state)
            full = _blended(flow, self.blend(state))
            found.append(full)
        return found

    def _read(self, read):
        """State [B, S, h, w] of a gated recurrent unit (Ballas et al., ICLR 2016) after all bins [B, T, S, h,
        w]."""
        state = torch.zeros_like(read[:, 0])
        for seen in read.unbind(1):
            update, reset = self.gates(torch.cat([state, seen], 1)).sigmoid().chunk(2, 1)
            new = self.candidate(torch.cat([reset * state, seen], 1)).tanh()
            state = state + update * (new - state)
        return state


def _blended(flow, weights):
    """Every pixel as a learnt mean of the nine cells around its own (Teed and Deng, RAFT, ECCV 2020, section
    3.3)."""
    batch, _, height, width = flow.shape
    side = math.isqrt(weights.shape[1] // 9)
    mix = weights.reshape(batch, 1, 9, side, side, height, width).softmax(2)
    near = unfold(pad(flow, (1, 1, 1, 1), mode="replicate"), 3).reshape(batch, 2, 9, 1, 1, height, width)
    fine = (mix * near).sum(2).permute(0, 1, 4, 2, 5, 3)
    return fine.reshape(batch, 2, side * height, side * width)
