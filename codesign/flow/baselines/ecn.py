"""A small evenly cascaded network on event volumes."""

from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, pad, silu

from codesign.flow.baselines.parts import Baseline, channels, rescale_flow, start
from codesign.flow.layers import GROUPS, Layer
from codesign.types import EventVolume


class ECN(Baseline):
    """Four encoding steps that each keep what came before, pooled and changed a little, and add as many new
    channels; one residual block; four decoding steps that give them back and each add to the flow.

    Args:
      bins: bins of the volumes, >= 2.
      width: channels that every encoding step adds, 16 for the published 0.15 million weights; every
        layer takes the nearest multiple of 4.
      hidden: channels inside the residual block, a multiple of 4; None for twice ``width``.
      seed: of the first weights.
    Gradient: counts and weights; smooth, so any order.
    Raises: ShapeError, DomainError.
    Source: Ye, Mitrokhin, Fermueller, Yorke, Aloimonos, Unsupervised learning of dense optical flow,
      depth and egomotion with event-based sensors, IROS 2020, sec. III: the network of flow alone, with group
      normalisation in place of feature decorrelation, and all bins in place of a time image.

    >>> from codesign.flow.export import evenly_timed
    >>> ECN(bins=4, width=4.0)(evenly_timed(torch.ones(1, 2, 4, 32, 48))).flow_px.shape
    torch.Size([1, 2, 32, 48])
    """

    INSIDE: ClassVar[float] = 2.0

    def __init__(self, bins: int = 8, width: float = 16.0, hidden: int | None = None, seed: int = 0) -> None:
        super().__init__(bins, width, hidden, seed=seed)
        sizes = [channels(width, factor) for factor in (1, 2, 3, 4)]
        kept = [channels(width, factor) for factor in (3, 2, 1, 0.5)]
        skips = [*reversed(sizes[:3]), 0]
        self.encoder = nn.ModuleList(
            nn.Conv2d(a, b, 3, 2, 1, bias=False) for a, b in zip([2 * bins, *sizes], sizes, strict=False)
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
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

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
    """An image with empty channels added up to a count."""
    return pad(image, (0, 0, 0, 0, 0, count - image.shape[1]))
