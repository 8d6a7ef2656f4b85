"""What the networks that event flow is compared with share: from volume to fields of flow, layers,
how many weights they have, where these start, and the widths that fill a budget."""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from codesign.checks import check_seed, check_whole
from codesign.errors import DomainError
from codesign.flow.entry import (
    WIDEST,
    check_bins,
    check_sizes,
    normalise,
    pad_to,
    takes_volume,
    to_field,
)
from codesign.types import EventVolume, FlowField

MOST_WEIGHTS = 10**9


class Baseline(nn.Module):
    """A network on the counts of a volume, normalised and padded with emptiness to multiples of
    STRIDE.

    Called with an EventVolume [B, 2, bins, H, W] of any H, W: FlowField, px per interval at full
    resolution. Its confidence only says whether the sample had events. Computed in the type of the
    weights, returned in that of the counts.
    """

    STRIDE: ClassVar[int] = 16
    INSIDE: ClassVar[float] = 8.0  # channels inside the residual blocks, over the width

    def __init__(
        self,
        bins: int,
        width: float,
        hidden: int | None,
        even: bool = False,
        **rest: Any,
    ) -> None:
        super().__init__()
        check_bins(bins, even)
        check_sizes(width, hidden)
        self.config: dict[str, Any] = {"bins": bins, "width": width, "hidden": hidden, **rest}
        self.inside = channels(width, self.INSIDE) if hidden is None else hidden

    @classmethod
    def with_weights(cls, weights: int, bins: int = 8, seed: int = 0, **rest: Any) -> Self:
        """The network with the fewest weights that are not below the budget (at most 4 % above it
        from 0.3 M on)."""
        width, hidden = fill_budget(lambda **sizes: cls(bins=bins, **sizes), weights, cls.INSIDE)
        return cls(bins=bins, width=width, hidden=hidden, seed=seed, **rest)

    @takes_volume
    def forward(self, volume: EventVolume) -> FlowField:
        return self._finished(volume, self._found(volume)[-1:])[0]

    @takes_volume
    def predictions(self, volume: EventVolume) -> list[FlowField]:
        """Flow of every level or iteration at full resolution, in pixels there, coarse or early
        first; the last is what a call returns."""
        return self._finished(volume, self._found(volume))

    def _found(self, volume):
        return self.levels(pad_to(normalise(volume.counts).flatten(1, 2), self.STRIDE), volume)

    def levels(self, counts: Tensor, volume: EventVolume) -> list[Tensor]:
        """Flows [B, 2, h, w] of the padded image, each in pixels of its own grid, from coarse or
        early ones to the last.

        Args:
          counts: [B, 2 bins, H', W'] normalised and padded, ON first.
          volume: for its times.
        """
        raise NotImplementedError

    def _finished(self, volume, flows):
        height, width = volume.counts.shape[3:]
        full = (height + -height % self.STRIDE, width + -width % self.STRIDE)
        return [to_field(rescale_flow(flow, full)[..., :height, :width], volume) for flow in flows]


def rescale_flow(flow_px: Tensor, size: Sequence[int]) -> Tensor:
    """The same motion on a grid of ``size`` (height, width) pixels over the same image.

    Args:
      flow_px: [B, 2, H, W] in pixels of its own grid.
      size: (height, width) of the new grid, >= 1.
    Returns: [B, 2, height, width] in pixels of the new grid: resampled bilinearly between pixel
      centres (constant beyond the outermost), x times width / W, y times height / H.
    Gradient: flow_px.
    """
    height, width = size
    if (height, width) == tuple(flow_px.shape[2:]):
        return flow_px
    factor = flow_px.new_tensor([width / flow_px.shape[3], height / flow_px.shape[2]])
    return (
        interpolate(flow_px, (height, width), mode="bilinear", align_corners=False)
        * factor[:, None, None]
    )


def channels(width: float, factor: float = 1.0) -> int:
    """Channels of a layer ``factor`` times as wide as the first: the nearest multiple of 4, at
    least 4."""
    return max(4, 4 * round(width * factor / 4))


def count_weights(module: nn.Module) -> int:
    """Number of learned numbers of a module."""
    return sum(p.numel() for p in module.parameters())


def start(module: nn.Module, seed: int, variance: float, heads: Iterable[nn.Module] = ()) -> None:
    """Draw convolutions from a normal distribution of variance ``variance`` / inputs of a weight (a
    hundredth of that in ``heads``), biases 0.

    The generator's seed is the only source. Modules on the meta device, built to be counted, are
    left alone.
    """
    generator = torch.Generator().manual_seed(check_seed(seed, "seed"))
    for part in module.modules():
        if (
            isinstance(part, (torch.nn.Conv2d, torch.nn.ConvTranspose2d))
            and part.weight.device.type != "meta"
        ):
            inputs = part.in_channels * part.kernel_size[0] * part.kernel_size[1]
            small = 0.1 if any(part is head for head in heads) else 1.0
            with torch.no_grad():
                part.weight.copy_(
                    torch.randn(part.weight.shape, generator=generator)
                    * (small * (variance / inputs) ** 0.5)
                )
                if part.bias is not None:
                    part.bias.zero_()


def fill_budget(
    build: Callable[..., nn.Module],
    weights: int,
    inside: float = 8.0,
) -> tuple[float, int]:
    """Arguments (width, hidden) of the network with the fewest weights that is not below the
    budget.

    Args:
      build: function of width and hidden (channels inside the residual blocks, None for the usual
        number) that makes the network.
      weights: the budget.
      inside: the usual ``hidden`` over the width.
    Raises: DomainError when even the narrowest network is above the budget.
    """

    def counted(width, hidden=None):
        with torch.device("meta"):
            return count_weights(build(width=width, hidden=hidden))

    check_whole(weights, "weights", 1, MOST_WEIGHTS)
    # widths in quarters
    quarters = bisect_right(range(4 * WIDEST), weights, 4, key=lambda width: counted(width / 4)) - 1
    if quarters < 4:
        raise DomainError(
            f"a budget of {weights} weights is too small; the narrowest network has {counted(1.0)}."
        )
    width = quarters / 4
    hidden = channels(width, inside)
    while counted(width, hidden) < weights:
        hidden += 4
    return width, hidden
