"""Events made visible: red and blue pictures, gray pictures, and rates over time."""

import torch
from torch import Tensor

from codesign.errors import ShapeError
from codesign.events.entry import Times, check_counts, check_layout, check_positive, check_times


def picture(counts: Tensor, full_scale: float | None = None) -> Tensor:
    """Event frames as colour pictures: white where nothing happened, red for ON, blue for OFF, purple for
    both.

    Args:
      counts: [..., 2, H, W] counts >= 0, ON first.
      full_scale: count of full colour, > 0; None: the largest count, at least 1.
    Returns: [..., H, W, 3] uint8.
    """
    on, off, full = _scaled(counts, full_scale)
    strength = torch.maximum(on, off).div(full).clamp(max=1)
    red = on / (on + off).clamp(min=torch.finfo(on.dtype).tiny)
    colour = torch.stack((red, torch.zeros_like(red), 1 - red), dim=-1)
    return (255 * (1 - strength[..., None] * (1 - colour))).round().to(torch.uint8)


def gray_picture(counts: Tensor, full_scale: float | None = None) -> Tensor:
    """Event frames as gray pictures: middle gray where ON and OFF balance, white for ON, black for OFF.

    Args: as for ``picture``.
    Returns: [..., H, W] uint8, 128 for no event.
    """
    on, off, full = _scaled(counts, full_scale)
    return (128 + 127 * ((on - off) / full).clamp(-1, 1)).round().to(torch.uint8)


def rates(counts: Tensor, t_s: Times) -> tuple[Tensor, Tensor]:
    """Event rate of the whole picture over time, per polarity.

    Args: counts: [T-1, 2, H, W]. t_s: [T] seconds, strictly increasing.
    Returns: middle of each interval [T-1], seconds, and rate [T-1, 2], events per second, ON first.
    """
    check_counts(counts)
    times_s = check_times(t_s, len(counts) + 1)
    totals = counts.detach().flatten(2).sum(-1).cpu().double()
    return (times_s[1:] + times_s[:-1]) / 2, totals / times_s.diff()[:, None]


def _scaled(counts, full_scale):
    check_layout(counts, 0, name="counts")
    if counts.ndim < 3 or counts.shape[-3] != 2:
        raise ShapeError(f"counts are {list(counts.shape)}; a tensor [..., 2, H, W] is needed (ON first).")
    counts = counts.detach()
    if full_scale is None:
        full_scale = max(1.0, float(counts.max()))
    else:
        full_scale = check_positive(full_scale, "full_scale")
    return counts[..., 0, :, :], counts[..., 1, :, :], full_scale
