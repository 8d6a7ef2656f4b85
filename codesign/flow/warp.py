"""Bins of an event volume looked up along a flow, and pixel grids."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from codesign.errors import ShapeError
from codesign.flow.checks import check_real


def pixel_grid(height: int, width: int, like: Tensor) -> Tensor:
    """Pixel positions [2, H, W], (x, y) with the origin at the first pixel's centre."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=like.dtype, device=like.device),
        torch.arange(width, dtype=like.dtype, device=like.device),
        indexing="ij",
    )
    return torch.stack([x, y])


def along_flow(bins: Tensor, flow_px: Tensor, time: Tensor) -> Tensor:
    """What each bin holds where a point of the start has got to.

    Args: bins: [B, T, H, W], or [B, C, T, H, W] with polarities or the like. flow_px: [B, 2, H, W] px per
      window on pixels of the start.
      time: [T] bin times, 0 at the start of the window, 1 at its end.
    Returns: as bins: bin k at q + time_k flow(q) for every pixel q, bilinear; 0 outside the image.
    Raises: ShapeError, DomainError.
    Gradient: bins and flow; piecewise smooth in the flow, as bilinear lookups are.
    """
    for value, name in ((bins, "the bins"), (flow_px, "the flow"), (time, "the bins' times")):
        check_real(value, name)
    fits = bins.ndim in (4, 5) and 0 not in bins.shape and time.shape == bins.shape[-3:-2]
    if (
        not fits
        or tuple(flow_px.shape) != (bins.shape[0], 2, *bins.shape[-2:])
        or flow_px.dtype != bins.dtype
    ):
        raise ShapeError(
            f"bins {list(bins.shape)} ({bins.dtype}), flow {list(flow_px.shape)} ({flow_px.dtype}) and times "
            f"{list(time.shape)} do not fit; [B, (C,) T, H, W], [B, 2, H, W] of one type and [T] are needed."
        )
    *_, count, height, width = bins.shape
    batch = bins.shape[0]
    at = (
        pixel_grid(height, width, flow_px) + time.to(flow_px)[:, None, None, None] * flow_px[:, None]
    )  # [B, T, 2, H, W]
    half = torch.tensor([width / 2, height / 2], dtype=flow_px.dtype, device=flow_px.device)[:, None, None]
    unit = ((at + 0.5) / half - 1).permute(0, 1, 3, 4, 2).reshape(batch * count, height, width, 2)
    each = bins.reshape(batch, -1, count, height, width).transpose(1, 2)
    found = grid_sample(each.reshape(batch * count, -1, height, width), unit, align_corners=False)
    return found.reshape(each.shape).transpose(1, 2).reshape(bins.shape)
