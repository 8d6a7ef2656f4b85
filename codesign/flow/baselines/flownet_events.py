"""A plain convolutional encoder-decoder on event volumes."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, silu

from codesign.flow.baselines.rescale import rescale_flow
from codesign.flow.baselines.weights import channels, fill_budget, start
from codesign.flow.entry import check_bins, check_sizes, normalise, pad_to, takes_volume, to_field
from codesign.flow.layers import Layer
from codesign.types import EventVolume, FlowField

STRIDE = 16


class FlowNetEvents(nn.Module):
    """Four strided layers, two residual blocks, four decoding layers that each add to the flow and hand it
    on, with skip connections.

    Args:
      bins: bins of the volumes, >= 2. width: channels of the first layer (8 times as many in the last); every
        layer takes the nearest multiple of 4.
      hidden: channels inside the residual blocks, a multiple of 4; None for 8 times ``width``. seed: of the
        first weights.
    Called with an EventVolume [B, 2, bins, H, W] of any H, W: FlowField, px per interval at full resolution.
      Its confidence only says whether the sample had events.
    Gradient: counts and weights; smooth, so any order.
    Computed in the type of the weights, returned in that of the counts.
    Raises: ShapeError, DomainError.
    Source: Zhu et al., EV-FlowNet, RSS 2018, fig. 4, with group normalisation (Wu and He, ECCV 2018) and
      SiLU.

    >>> from codesign.flow.export import evenly_timed
    >>> FlowNetEvents(bins=4, width=4.0)(evenly_timed(torch.ones(1, 2, 4, 32, 48))).flow_px.shape
    torch.Size([1, 2, 32, 48])
    """

    def __init__(self, bins: int = 8, width: float = 32.0, hidden: int | None = None, seed: int = 0) -> None:
        super().__init__()
        check_bins(bins)
        check_sizes(width, hidden)
        self.config: dict[str, Any] = {"bins": bins, "width": width, "hidden": hidden, "seed": seed}
        inside = channels(width, 8) if hidden is None else hidden
        down = [channels(width, factor) for factor in (1, 2, 4, 8)]
        up = [channels(width, factor) for factor in (4, 2, 1, 0.5)]
        self.encoder = nn.ModuleList(
            Layer(a, b, stride=2) for a, b in zip([2 * bins, *down], down, strict=False)
        )
        self.residual = nn.ModuleList(
            nn.Sequential(Layer(down[3], inside), Layer(inside, down[3], active=False)) for _ in range(2)
        )
        skipped = [2 * down[3]] + [a + b + 2 for a, b in zip(up, reversed(down[:3]), strict=False)]
        self.decoder = nn.ModuleList(Layer(a, b) for a, b in zip(skipped, up, strict=True))
        self.heads = nn.ModuleList(nn.Conv2d(b, 2, 1) for b in up)
        start(self, seed, 2.0, self.heads)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @classmethod
    def with_weights(cls, weights: int, bins: int = 8, seed: int = 0) -> "FlowNetEvents":
        """The network with the fewest weights that are not below the budget (at most 4 % above it from 0.3 M
        on)."""
        width, hidden = fill_budget(lambda **sizes: cls(bins, **sizes), weights)
        return cls(bins, width, hidden, seed)

    @takes_volume
    def forward(self, volume: EventVolume) -> FlowField:
        return self._finish(volume, self._levels(volume)[-1])

    @takes_volume
    def predictions(self, volume: EventVolume) -> list[FlowField]:
        """Flow of every decoding layer at full resolution, in pixels there, coarse first; the last is what a
        call returns."""
        return [self._finish(volume, level) for level in self._levels(volume)]

    def _levels(self, volume) -> list[Tensor]:
        """Flow at 1/8, 1/4, 1/2 and all of the padded resolution, in pixels of each."""
        counts = volume.counts
        x = pad_to(normalise(counts).flatten(1, 2), STRIDE).contiguous(memory_format=torch.channels_last)
        skips = []
        flows = []
        for layer in self.encoder:
            x = layer(x)
            skips.append(x)
        for block in self.residual:
            x = silu(x + block(x))
        for layer, head in zip(self.decoder, self.heads, strict=True):
            x = torch.cat([x, skips.pop(), *flows[-1:]], 1)
            x = layer(interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False))
            change = head(
                x
                # normalisation takes the mean from what is handed on, so each level adds to the flow instead of
                # saying it anew
            )
            flows.append(rescale_flow(flows[-1], change.shape[2:]) + change if flows else change)
        return flows

    def _finish(self, volume, flow_px):
        height, width = volume.counts.shape[3:]
        full = (height + -height % STRIDE, width + -width % STRIDE)
        return to_field(rescale_flow(flow_px, full)[..., :height, :width], volume)
