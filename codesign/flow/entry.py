"""The layer that networks are made of, and what each does around its layers: check the volume and
bring it to the weights' type, normalise it, pad it to the stride, and fade the flow in with the
events."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

from torch import Tensor, nn
from torch.nn.functional import pad, silu

from codesign.checks import check_kind, check_number, check_whole
from codesign.errors import DomainError, shown
from codesign.flow.checks import check_volume
from codesign.types import EventVolume, FlowField

Given = ParamSpec("Given")
Found = TypeVar("Found")
WIDEST = 4096  # channels of a first layer
MOST_BINS = 1024
GROUPS = 4  # of the normalisation
FEW = 10.0  # events of a sample at which half of the flow is believed


class Layer(nn.Module):
    """3 x 3 convolution, group normalisation, SiLU; ``active=False`` leaves the last out."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1, active: bool = True) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm = nn.GroupNorm(GROUPS, outputs)
        self.active = active

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(self.convolution(x))
        return silu(x) if self.active else x


def check_bins(bins: int, even: bool = False) -> None:
    """Raise DomainError unless a network can be built for this many bins."""
    check_whole(check_kind(bins, int, "bins"), "bins", 2, MOST_BINS)
    if even and bins % 2:
        raise DomainError(f"bins is {bins}; an even number is needed.")


def check_sizes(width: float, hidden: int | None) -> None:
    """Raise DomainError unless layers can have these widths."""
    check_number(width, "width", above=0.0, most=WIDEST)
    if hidden is not None and (
        not isinstance(hidden, int) or not 4 <= hidden <= 8 * WIDEST or hidden % 4
    ):
        raise DomainError(
            f"hidden is {shown(hidden)}; a multiple of 4, or None for 8 times the width, is needed."
        )


def takes_volume(
    method: Callable[Concatenate[Any, EventVolume, Given], Found],
) -> Callable[Concatenate[Any, EventVolume, Given], Found]:
    """Make a network's method of an EventVolume refuse what is none, and compute in the type of the
    weights.

    The counts are converted to the weights' type, float32 as delivered; the flow, confidence and
    covariance that come back have the type of the counts, so a chain in float64 stays in float64,
    to the precision of the weights.
    Raises: as check_volume, for another number of bins than ``config["bins"]`` too; DomainError for
      events and weights on different devices.
    """

    @wraps(method)
    def checked(
        network: Any,
        volume: EventVolume,
        *more: Given.args,
        **named: Given.kwargs,
    ) -> Found:
        counts = check_volume(volume, network.config["bins"])
        weight = next(network.parameters())
        if weight.device != counts.device:
            raise DomainError(
                f"the events are on {counts.device}, the weights of the network on {weight.device}; move one "
                "with .to()."
            )

        own = replace(volume, counts=counts.to(weight.dtype))
        found = cast(Any, method)(network, own, *more, **named)
        return cast(Found, _in_type(found, counts.dtype))

    return checked


def _in_type(found, dtype):
    """A FlowField, or a list of them, in a floating-point type."""
    if isinstance(found, list):
        return [_in_type(field, dtype) for field in found]
    parts = {name: getattr(found, name) for name in ("flow_px", "confidence", "covariance_px2")}
    return replace(
        found, **{name: part.to(dtype) for name, part in parts.items() if part is not None}
    )


@contextmanager
def modes_kept(network: nn.Module) -> Iterator[None]:
    """Every part of a network is afterwards in training or evaluation as it was."""
    modes = {module: module.training for module in network.modules()}
    try:
        yield
    finally:
        for module, training in modes.items():
            module.training = training


def normalise(counts: Tensor) -> Tensor:
    """Counts of each sample over the mean count that an event finds in its own bin: about 1 where
    there are events, whatever contrast and threshold.

    Args: counts [B, ...].
    Returns: the same shape.
    Gradient: counts. One added event keeps it smooth down to an empty sample.
    """
    flat = counts.flatten(1)
    usual = (flat.square().sum(1) + 1) / (flat.sum(1) + 1)
    return counts / usual.reshape(-1, *[1] * (counts.ndim - 1))


def presence(counts: Tensor) -> Tensor:
    """n^2 / (n^2 + FEW^2) of the n events of each sample, [B, 1, 1, 1]: flow and gradient are 0 for
    an empty one."""
    square = counts.flatten(1).sum(1).square()
    return (square / (square + FEW**2))[:, None, None, None]


def pad_to(image: Tensor, stride: int) -> Tensor:
    """Zeros to the right and below, up to the next multiple of ``stride``; pixels keep their
    places. Crop with ``[..., :H, :W]``."""
    beyond = 0, -image.shape[-1] % stride, 0, -image.shape[-2] % stride
    return pad(image, beyond) if any(beyond) else image  # no copy


def to_field(flow_px: Tensor, volume: EventVolume) -> FlowField:
    """FlowField of a network without a confidence of its own: ``presence`` of the sample stands for
    it."""
    counts = volume.counts
    shown = presence(counts)
    batch, _, height, width = flow_px.shape
    valid = (counts.detach().flatten(1).sum(1) > 0)[:, None, None].expand(batch, height, width)
    return FlowField(
        flow_px * shown,
        valid,
        float(volume.collected_s.sum()),
        shown[:, 0].expand(batch, height, width),
    )
