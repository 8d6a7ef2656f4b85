"""The input of a spiking encoder: the former and the latter half of a window, each in fine time steps."""

from torch import Tensor

from codesign.errors import ShapeError
from codesign.flow.checks import check_real


def to_halves(counts: Tensor) -> Tensor:
    """Bins of a volume as Spike-FlowNet takes them.

    Args:
      counts: [B, 2, 2 k, H, W] events per bin, ON first.
    Returns: [B, 4, H, W, k] view: ON and OFF of the former half, ON and OFF of the latter; nothing is lost or
      added. The bins keep their shared borders, so an event that crosses one, also the middle of the window,
      changes the input continuously.
    Gradient: counts.
    Raises: ShapeError for an odd number of bins.
    Source: Lee et al., Spike-FlowNet, ECCV 2020, sec. 3.1.
    """
    check_real(counts, "the counts")
    if counts.ndim != 5 or counts.shape[1] != 2 or counts.shape[2] % 2 or counts.shape[2] == 0:
        raise ShapeError(
            "two halves need counts [B, 2, bins, H, W] with an even number of bins, got "
            f"{tuple(counts.shape)}."
        )
    batch, _, bins, height, width = counts.shape
    split = counts.unflatten(2, (2, bins // 2)).transpose(1, 2)  # [B, half, polarity, k, H, W]
    return split.flatten(1, 2).permute(0, 1, 3, 4, 2)


def from_halves(halves: Tensor) -> Tensor:
    """Counts [B, 2, 2 k, H, W] of [B, 4, H, W, k]: the inverse of ``to_halves``.

    Raises: ShapeError.
    """
    check_real(halves, "the halves")
    if halves.ndim != 5 or halves.shape[1] != 4:
        raise ShapeError(
            "halves are [B, 4, H, W, steps] (ON, OFF of the former half, ON, OFF of the latter), got "
            f"{tuple(halves.shape)}."
        )
    return halves.permute(0, 1, 4, 2, 3).unflatten(1, (2, 2)).transpose(1, 2).flatten(2, 3)
