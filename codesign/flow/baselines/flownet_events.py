"""A plain convolutional encoder-decoder on event volumes."""

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, silu

from codesign.flow.baselines.parts import Baseline, channels, rescale_flow, start
from codesign.flow.entry import Layer
from codesign.types import EventVolume


class FlowNetEvents(Baseline):
    """Four strided layers, two residual blocks, four decoding layers that each add to the flow and
    hand it on, with skip connections.

    Args:
      bins: bins of the volumes, >= 2.
      width: channels of the first layer (8 times as many in the last); every layer takes the
        nearest multiple of 4.
      hidden: channels inside the residual blocks, a multiple of 4; None for 8 times ``width``.
      seed: of the first weights.
    Gradient: counts and weights; smooth, so any order.
    Raises: ShapeError, DomainError.
    Source: Zhu et al., EV-FlowNet, RSS 2018, fig. 4, with group normalisation
      (Wu and He, ECCV 2018) and SiLU.

    >>> from codesign.flow.export import evenly_timed
    >>> FlowNetEvents(bins=4, width=4.0)(evenly_timed(torch.ones(1, 2, 4, 32, 48))).flow_px.shape
    torch.Size([1, 2, 32, 48])
    """

    def __init__(
        self,
        bins: int = 8,
        width: float = 32.0,
        hidden: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(bins, width, hidden, seed=seed)
        down = [channels(width, factor) for factor in (1, 2, 4, 8)]
        up = [channels(width, factor) for factor in (4, 2, 1, 0.5)]
        self.encoder = nn.ModuleList(
            Layer(a, b, stride=2) for a, b in zip([2 * bins, *down], down, strict=False)
        )
        self.residual = nn.ModuleList(
            nn.Sequential(Layer(down[3], self.inside), Layer(self.inside, down[3], active=False))
            for _ in range(2)
        )
        skipped = [2 * down[3]] + [a + b + 2 for a, b in zip(up, reversed(down[:3]), strict=False)]
        self.decoder = nn.ModuleList(Layer(a, b) for a, b in zip(skipped, up, strict=True))
        self.heads = nn.ModuleList(nn.Conv2d(b, 2, 1) for b in up)
        start(self, seed, 2.0, self.heads)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def levels(self, counts: Tensor, volume: EventVolume) -> list[Tensor]:
        x = counts.contiguous(memory_format=torch.channels_last)
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
            # normalisation takes the mean from what is handed on, so each level adds to the flow
            # instead of saying it anew
            change = head(x)
            flows.append(rescale_flow(flows[-1], change.shape[2:]) + change if flows else change)
        return flows
