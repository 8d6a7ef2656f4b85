"""What every network does around its layers: check the volume, normalise it, pad it to the stride, and fade
the flow in with the events."""

from torch import Tensor
from torch.nn.functional import pad

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.types import EventVolume, FlowField

FEW = 10.0  # events of a sample at which half of the flow is believed


def check_bins(bins: int, even: bool = False) -> None:
    """Raise DomainError unless a network can be built for this many bins."""
    if isinstance(bins, bool) or not isinstance(bins, int) or bins < 2 or (even and bins % 2):
        raise DomainError(f"bins is {bins!r}; {'an even' if even else 'a'} whole number >= 2 is needed.")


def check_sizes(width: float, hidden: int | None) -> None:
    """Raise DomainError unless layers can have these widths."""
    if not width > 0:
        raise DomainError(f"width is {width!r}; a number > 0 is needed.")
    if hidden is not None and (not isinstance(hidden, int) or hidden < 4 or hidden % 4):
        raise DomainError(f"hidden is {hidden!r}; a multiple of 4, or None for 8 times the width, is needed.")


def check_volume(volume: EventVolume, bins: int) -> Tensor:
    """Counts [B, 2, bins, H, W] of a volume that a network built for ``bins`` can take.

    Raises: ShapeError, DomainError.
    """
    counts = volume.counts
    if counts.ndim != 5 or counts.shape[1] != 2 or counts.shape[2] != bins or min(counts.shape) < 1:
        raise ShapeError(
            f"this network takes event volumes [B, 2, {bins}, H, W], got {tuple(counts.shape)}; make the "
            f"volume with {bins} bins or build the network for others."
        )
    return check_finite(counts, "event volume")


def normalise(counts: Tensor) -> Tensor:
    """Counts of each sample over the mean count that an event finds in its own bin: about 1 where there are
    events, whatever contrast and threshold.

    Args: counts [B, ...]. Returns: the same shape. Gradient: counts. One added event keeps it smooth down to
      an empty sample.
    """
    flat = counts.flatten(1)
    usual = (flat.square().sum(1) + 1) / (flat.sum(1) + 1)
    return counts / usual.reshape(-1, *[1] * (counts.ndim - 1))


def presence(counts: Tensor) -> Tensor:
    """n^2 / (n^2 + FEW^2) of the n events of each sample, [B, 1, 1, 1]: flow and gradient are 0 for an empty
    one."""
    square = counts.flatten(1).sum(1).square()
    return (square / (square + FEW**2))[:, None, None, None]


def pad_to(image: Tensor, stride: int) -> Tensor:
    """Zeros to the right and below, up to the next multiple of ``stride``; pixels keep their places. Crop
    with ``[..., :H, :W]``."""
    return pad(image, (0, -image.shape[-1] % stride, 0, -image.shape[-2] % stride))


def to_field(flow_px: Tensor, volume: EventVolume) -> FlowField:
    """FlowField of a network without a confidence of its own: ``presence`` of the sample stands for it."""
    counts = volume.counts
    shown = presence(counts)
    batch, _, height, width = flow_px.shape
    valid = (counts.detach().flatten(1).sum(1) > 0)[:, None, None].expand(batch, height, width)
    return FlowField(
        flow_px * shown, valid, float(volume.collected_s.sum()), shown[:, 0].expand(batch, height, width)
    )
