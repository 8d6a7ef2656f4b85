"""Two published networks that the refiner is raced with: ECN, small and evenly cascaded, and IDNet,
recurrent, which deblurs. ``--network`` and files know them as "ecn" and "idnet" where this is
imported."""

from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, pad, silu

from codesign.checks import check_whole
from codesign.flow import checkpoint
from codesign.flow.baselines.parts import Baseline, channels, rescale_flow, start
from codesign.flow.entry import GROUPS, Layer
from codesign.flow.refiner import mixed
from codesign.flow.warp import pixel_grid, read_at
from codesign.types import EventVolume

STATE = 4  # channels of IDNet's recurrent state over the width


class ECN(Baseline):
    """Four encoding steps that each keep what came before, pooled and changed a little, and add as
    many new channels; one residual block; four decoding steps that give them back and each add to
    the flow.

    Args:
      bins: bins of the volumes, >= 2.
      width: channels that every encoding step adds, 16 for the published 0.15 million weights;
        every layer takes the nearest multiple of 4.
      hidden: channels inside the residual block, a multiple of 4; None for twice ``width``.
      seed: of the first weights.
    Gradient: counts and weights; smooth, so any order.
    Raises: ShapeError, DomainError.
    Source: Ye, Mitrokhin, Fermueller, Yorke, Aloimonos, Unsupervised learning of dense optical
      flow, depth and egomotion with event-based sensors, IROS 2020, sec. III: the network of flow
      alone, with group normalisation in place of feature decorrelation, and all bins in place of a
      time image.
    """

    INSIDE: ClassVar[float] = 2.0

    def __init__(
        self,
        bins: int = 8,
        width: float = 16.0,
        hidden: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(bins, width, hidden, seed=seed)
        sizes = [channels(width, factor) for factor in (1, 2, 3, 4)]
        kept = [channels(width, factor) for factor in (3, 2, 1, 0.5)]
        skips = [*reversed(sizes[:3]), 0]
        self.encoder = nn.ModuleList(
            nn.Conv2d(a, b, 3, 2, 1, bias=False)
            for a, b in zip([2 * bins, *sizes], sizes, strict=False)
        )
        self.encoder_norms = nn.ModuleList(nn.GroupNorm(GROUPS, size) for size in sizes)
        self.residual = nn.Sequential(
            Layer(sizes[3], self.inside), Layer(self.inside, sizes[3], active=False)
        )
        flows = [0, 2, 2, 2]
        self.decoder = nn.ModuleList(
            nn.Conv2d(a + skip + flow, b, 3, 1, 1, bias=False)
            for a, skip, flow, b in zip([sizes[3], *kept], skips, flows, kept, strict=False)
        )
        self.decoder_norms = nn.ModuleList(nn.GroupNorm(GROUPS, size) for size in kept)
        self.heads = nn.ModuleList(nn.Conv2d(size, 2, 1) for size in kept)
        start(self, seed, 2.0, self.heads)
        self.to(memory_format=torch.channels_last)

    def levels(self, counts: Tensor, volume: EventVolume) -> list[Tensor]:
        x = counts.contiguous(memory_format=torch.channels_last)
        skips = []
        for layer, norm in zip(self.encoder, self.encoder_norms, strict=True):
            new = layer(x)
            if skips:  # the events themselves are no features to keep
                new = new + _with_channels(avg_pool2d(x, 2), new.shape[1])
            x = silu(norm(new))
            skips.append(x)
        x = silu(skips.pop() + self.residual(x))
        flows = []
        for layer, norm, head in zip(self.decoder, self.decoder_norms, self.heads, strict=True):
            grown = interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
            held = [rescale_flow(flow, grown.shape[2:]) for flow in flows[-1:]]
            new = layer(torch.cat([grown, *skips[-1:], *held], 1))
            if skips:
                skips.pop()
            x = silu(norm(new + grown[:, : new.shape[1]]))
            change = head(x)
            flows.append(held[0] + change if held else change)
        return flows


def _with_channels(image, count):
    return pad(image, (0, 0, 0, 0, 0, count - image.shape[1]))


class IDNet(Baseline):
    """Iterative deblurring: the bins are moved back along the flow so far, an encoder and a
    recurrent unit read them in turn, and the last state says what to add to the flow; again with
    the same weights.

    Args:
      bins: bins of the volumes, >= 2.
      width: channels of the first layer, four times as many in the recurrent state; 32 for the
        published small network of some 1.4 million weights; every layer takes the nearest multiple
        of 4.
      hidden: channels inside the head, a multiple of 4; None for 8 times ``width``.
      iterations: >= 1, 4 as published.
      seed: of the first weights.
    Gradient: counts and weights; piecewise smooth, as bilinear lookups and rectifiers are.
    Raises: ShapeError, DomainError.
    Source: Wu, Paredes-Valles, de Croon, Lightweight event-based optical flow estimation via
      iterative deblurring, ICRA 2024, sec. III: without correlation volumes, flow at 1/8 resolution
      brought to all pixels by learnt means of nine cells. Here bins are moved in place of single
      events, and the state starts at 0.
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
        check_whole(iterations, "iterations")
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
        self.to(memory_format=torch.channels_last)

    def levels(self, counts: Tensor, volume: EventVolume) -> list[Tensor]:
        """Flow px of all pixels after every iteration."""
        batch = len(counts)
        padded = counts.unflatten(1, (2, -1))
        bins = padded.shape[2]
        time = (volume.centroid_s / volume.collected_s.sum()).to(padded)
        flow = padded.new_zeros(
            batch, 2, *[side // self.STRIDE for side in padded.shape[3:]]
        )  # px on cells
        full = padded.new_zeros(batch, 2, *padded.shape[3:])
        found = []
        for _ in range(self.config["iterations"]):
            each = padded.transpose(1, 2).flatten(0, 1)
            if found:  # bin k is read at q + time_k flow(q), empty beyond the image
                at = pixel_grid(*full.shape[2:], full) + time[:, None, None, None] * full[:, None]
                each = read_at(each, at.flatten(0, 1), "zeros")
            each = each.contiguous(memory_format=torch.channels_last)
            state = self._read(self.encoder(each).unflatten(0, (batch, bins)))
            flow = flow + self.STRIDE * self.head(state)
            full = mixed(flow, self.blend(state))
            found.append(full)
        return found

    def _read(self, read):
        """State [B, S, h, w] of a gated recurrent unit (Ballas et al., ICLR 2016) after all bins
        [B, T, S, h, w]."""
        state = torch.zeros_like(read[:, 0])
        for seen in read.unbind(1):
            update, reset = self.gates(torch.cat([state, seen], 1)).sigmoid().chunk(2, 1)
            new = self.candidate(torch.cat([reset * state, seen], 1)).tanh()
            state = state + update * (new - state)
        return state


checkpoint.NETWORKS |= {"ecn": f"{__name__}:ECN", "idnet": f"{__name__}:IDNet"}
