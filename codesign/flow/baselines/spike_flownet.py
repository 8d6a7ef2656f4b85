"""A network with a spiking encoder and an analogue decoder, in the form of Spike-FlowNet."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import conv_transpose2d, leaky_relu

from codesign.errors import ShapeError
from codesign.events.spiking.surrogate import FastSigmoid
from codesign.flow.baselines.halves import to_halves
from codesign.flow.baselines.neuron import integrate_and_fire
from codesign.flow.baselines.rescale import rescale_flow
from codesign.flow.baselines.weights import channels, fill_budget, start
from codesign.flow.checks import check_number, check_real
from codesign.flow.entry import check_bins, check_sizes, normalise, pad_to, takes_volume, to_field
from codesign.types import EventVolume, FlowField

STRIDE = 16
LEAK = 0.1  # slope of the decoder's rectifiers for negative input


class SpikeFlowNet(nn.Module):
    """Four strided layers of integrate-and-fire neurons, sums of what flowed into them, two residual blocks,
    a decoder with four flow scales that each add to the coarser one.

    Args:
      bins: bins of the volumes, even; half of them are the time steps of the encoder (10 as published).
        width: channels of the first layer, 64 as published;
        every layer takes the nearest multiple of 4. hidden: channels inside the residual blocks; None for 8
          times ``width``.
      threshold: potential at which a neuron fires, in normalised counts. surrogate_width: of the fast sigmoid
        that stands for the derivative of the step, in potential.
      seed: of the first weights.
    Called with an EventVolume [B, 2, bins, H, W] of any H, W: FlowField, px per interval at full resolution.
      Its confidence only says whether the sample had events.
    Gradient: counts and weights, through spikes by the surrogate. First derivatives only.
    Computed in the type of the weights, returned in that of the counts.
    Raises: ShapeError, DomainError.
    Source: Lee et al., Spike-FlowNet, ECCV 2020, sec. 3 and fig. 4.

    >>> from codesign.flow.export import evenly_timed
    >>> SpikeFlowNet(bins=4, width=4.0)(evenly_timed(torch.ones(1, 2, 4, 32, 48))).flow_px.shape
    torch.Size([1, 2, 32, 48])
    """

    def __init__(
        self,
        bins: int = 8,
        width: float = 64.0,
        hidden: int | None = None,
        threshold: float = 0.75,
        surrogate_width: float = 0.75,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_bins(bins, even=True)
        check_sizes(width, hidden)
        threshold = check_number(threshold, "threshold", above=0.0)
        surrogate_width = check_number(surrogate_width, "surrogate_width", above=0.0)
        self.config: dict[str, Any] = {
            "bins": bins,
            "width": width,
            "hidden": hidden,
            "threshold": threshold,
            "surrogate_width": surrogate_width,
            "seed": seed,
        }
        self.surrogate = FastSigmoid.unit(surrogate_width)
        inside = channels(width, 8) if hidden is None else hidden
        down = [channels(width, factor) for factor in (1, 2, 4, 8)]
        up = [channels(width, 2), channels(width), 4]
        self.neck = channels(width, 0.5)  # channels between a level and its flow
        levels = [down[3], up[0] + down[2] + 2, up[1] + down[1] + 2, up[2] + down[0] + 2]
        self.encoder = nn.ModuleList(
            nn.Conv2d(a, b, 3, 2, 1, bias=False) for a, b in zip([4, *down], down, strict=False)
        )
        self.residual = nn.ModuleList(
            nn.ModuleList(
                [
                    nn.Conv2d(down[3], inside, 3, 1, 1, bias=False),
                    nn.Conv2d(inside, down[3], 3, 1, 1, bias=False),
                ]
            )
            for _ in range(2)
        )
        self.decoder = nn.ModuleList(
            nn.ConvTranspose2d(a, b, 4, 2, 1, bias=False) for a, b in zip(levels, up, strict=False)
        )
        self.necks = nn.ModuleList(nn.ConvTranspose2d(a, self.neck, 4, 2, 1, bias=False) for a in levels)
        self.heads = nn.ModuleList(nn.Conv2d(self.neck, 2, 1, bias=False) for _ in levels)
        start(self, seed, 3.0, self.heads)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    @classmethod
    def with_weights(cls, weights: int, bins: int = 8, seed: int = 0) -> "SpikeFlowNet":
        """The network with the fewest weights that are not below the budget (at most 4 % above it from 0.3 M
        on)."""
        width, hidden = fill_budget(lambda **sizes: cls(bins, **sizes), weights)
        return cls(bins, width, hidden, seed=seed)

    @takes_volume
    def forward(self, volume: EventVolume) -> FlowField:
        return self._finish(volume, self._levels(volume)[-1])

    @takes_volume
    def predictions(self, volume: EventVolume) -> list[FlowField]:
        """Flow of every decoding layer at full resolution, in pixels there, coarse first; the last is what a
        call returns."""
        return [self._finish(volume, level) for level in self._levels(volume)]

    def encode(self, halves: Tensor) -> list[Tensor]:
        """Sums over the steps of what flowed into each layer's neurons: [B, width, H/2, W/2] to [B, 8 width,
        H/16, W/16].

        Args: halves: [B, 4, H, W, steps], ON and OFF of the former half of the window, then of the latter; H
          and W multiples of 16.
        """
        check_real(halves, "the encoder's input")
        if (
            halves.ndim != 5
            or halves.shape[1] != 4
            or 0 in halves.shape
            or halves.shape[2] % STRIDE
            or halves.shape[3] % STRIDE
        ):
            raise ShapeError(
                f"the encoder takes [B, 4, H, W, steps] with H and W multiples of {STRIDE}, got "
                f"{tuple(halves.shape)}."
            )
        steps = halves.shape[4]
        halves = halves.to(next(self.parameters()).dtype)
        x = halves.permute(4, 0, 1, 2, 3).flatten(0, 1).contiguous(memory_format=torch.channels_last)
        sums = []
        for layer in (
            self.encoder
        ):  # every layer runs over all steps at once: nothing flows back, so this is the same as step by step
            current = layer(x).permute(0, 2, 3, 1)
            # rows in the order of memory, which sums 15 times faster
            shape = current.shape
            current = current.reshape(steps, -1)
            sums.append(current.sum(0).reshape(-1, *shape[1:]).permute(0, 3, 1, 2))
            if len(sums) < len(self.encoder):
                x = (
                    integrate_and_fire(current, self.config["threshold"], self.surrogate)
                    .reshape(shape)
                    .permute(0, 3, 1, 2)
                )
        return sums

    def decode(self, sums: list[Tensor]) -> list[Tensor]:
        """Flow at 1/8, 1/4, 1/2 and all of the resolution, each in pixels of its own grid, from what
        ``encode`` returns."""
        x = sums[-1]
        flows = []
        for first, second in self.residual:  # pyright: ignore[reportGeneralTypeIssues]
            x = x + leaky_relu(second(leaky_relu(first(x), LEAK)), LEAK)
        for level in range(4):
            # neck and head are linear, one after the other: their product is one transposed convolution to 2
            # channels
            head = torch.einsum(
                "on,inhw->iohw",
                self.heads[level].weight[:, :, 0, 0],  # pyright: ignore[reportIndexIssue, reportArgumentType]
                self.necks[level].weight,  # pyright: ignore[reportArgumentType]
            )
            change = conv_transpose2d(x, head, stride=2, padding=1)
            flows.append(rescale_flow(flows[-1], change.shape[2:]) + change if flows else change)
            if level < 3:
                x = torch.cat([sums[2 - level], leaky_relu(self.decoder[level](x), LEAK), flows[-1]], 1)
        return flows

    def _levels(self, volume):
        counts = volume.counts
        halves = to_halves(pad_to(normalise(counts), STRIDE))
        with torch.autocast(
            halves.device.type, enabled=False
        ):  # rounding to half precision makes other neurons fire
            sums = self.encode(halves)
        return self.decode(sums)

    def _finish(self, volume, flow_px):
        height, width = volume.counts.shape[3:]
        full = (height + -height % STRIDE, width + -width % STRIDE)
        return to_field(rescale_flow(flow_px, full)[..., :height, :width], volume)
