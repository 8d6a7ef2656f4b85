"""A small evenly cascaded network on event volumes."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, pad, silu

from codesign.flow.baselines.rescale import rescale_flow
from codesign.flow.baselines.weights import channels, fill_budget, start
from codesign.flow.entry import check_bins, check_sizes, normalise, pad_to, takes_volume, to_field
from codesign.flow.layers import GROUPS, Layer
from codesign.types import EventVolume, FlowField

STRIDE = 16
INSIDE = 2.0  # channels inside the residual block, over the width


class ECN(nn.Module):
    """Four encoding steps that each keep what came before, pooled and changed a little, and add as many new
    channels; one residual block; four decoding steps that give them back and each add to the flow.

    Args:
      bins: bins of the volumes, >= 2. width: channels that every encoding step adds, 16 for the published
        0.15 million weights; every layer takes the nearest multiple of 4.
      hidden: channels inside the residual block, a multiple of 4; None for twice ``width``. seed: of the
        first weights.
    Called with an EventVolume [B, 2, bins, H, W] of any H, W: FlowField, px per interval at full resolution.
      Its confidence only says whether the sample had events.
    Gradient: counts and weights; smooth, so any order.
    Computed in the type of the weights, returned in that of the counts.
    Raises: ShapeError, DomainError.
    Source: Ye, Mitrokhin, Fermueller, Yorke, Aloimonos, Unsupervised learning of dense optical flow, depth and
      egomotion with event-based sensors, IROS 2020, sec. III: the network of flow alone, with group
      normalisation in place of feature decorrelation, and all bins in place of a time image.

    >>> from codesign.flow.export import evenly_timed
    >>> ECN(bins=4, width=4.0)(evenly_timed(torch.ones(1, 2, 4, 32, 48))).flow_px.shape
    torch.Size([1, 2, 32, 48])
    """

    def __init__(self, bins: int = 8, width: float = 16.0, hidden: int | None = None, seed: int = 0) -> None:
        super().__init__()
        check_bins(bins)
        check_sizes(width, hidden)
        self.config: dict[str, Any] = {"bins": bins, "width": width, "hidden": hidden, "seed": seed}
        inside = channels(width, INSIDE) if hidden is None else hidden
        sizes = [channels(width, factor) for factor in (1, 2, 3, 4)]
        kept = [channels(width, factor) for factor in (3, 2, 1, 0.5)]
        skips = [*reversed(sizes[:3]), 0]
        self.encoder = nn.ModuleList(
            nn.Conv2d(a, b, 3, 2, 1, bias=False) for a, b in zip([2 * bins, *sizes], sizes, strict=False)
        )
        self.encoder_norms = nn.ModuleList(nn.GroupNorm(GROUPS, size) for size in sizes)
        self.residual = nn.Sequential(Layer(sizes[3], inside), Layer(inside, sizes[3], active=False))
        flows = [0, 2, 2, 2]
        self.decoder = nn.ModuleList(
            nn.Conv2d(a + skip + flow, b, 3, 1, 1, bias=False)
            for a, skip, flow, b in zip([sizes[3], *kept], skips, flows, kept, strict=False)
        )
        self.decoder_norms = nn.ModuleList(nn.GroupNorm(GROUPS, size) for size in kept)
        self.heads = nn.ModuleList(nn.Conv2d(size, 2, 1) for size in kept)
        start(self, seed, 2.0, self.heads)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @classmethod
    def with_weights(cls, weights: int, bins: int = 8, seed: int = 0) -> "ECN":
        """The network with the fewest weights that are not below the budget (at most 4 % above it from 0.1 M
        on)."""
        width, hidden = fill_budget(lambda **sizes: cls(bins, **sizes), weights, INSIDE)
        return cls(bins, width, hidden, seed)

    @takes_volume
    def forward(self, volume: EventVolume) -> FlowField:
        return self._finish(volume, self._levels(volume)[-1])

    @takes_volume
    def predictions(self, volume: EventVolume) -> list[FlowField]:
        """Flow of every decoding step at full resolution, in pixels there, coarse first; the last is what a
        call returns."""
        return [self._finish(volume, level) for level in self._levels(volume)]

    def _levels(self, volume) -> list[Tensor]:
        """Flow at 1/8, 1/4, 1/2 and all of the padded resolution, in pixels of each."""
        x = pad_to(normalise(volume.counts).flatten(1, 2), STRIDE)
        x = x.contiguous(memory_format=torch.channels_last)
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

    def _finish(self, volume, flow_px):
        height, width = volume.counts.shape[3:]
        full = (height + -height % STRIDE, width + -width % STRIDE)
        return to_field(rescale_flow(flow_px, full)[..., :height, :width], volume)


def _with_channels(image, count):
    """An image with empty channels added up to a count."""
    return pad(image, (0, 0, 0, 0, 0, count - image.shape[1]))
