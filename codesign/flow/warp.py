"""Pixel grids, bins of an event volume looked up along a flow, and flow over a long window from flows
over parts of it."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from codesign.errors import ShapeError
from codesign.flow.checks import check_mask, check_real

EDGE_PX = 0.75  # flows of the four pixels around a place that differ by more belong to different surfaces


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

    Args:
      bins: [B, T, H, W], or [B, C, T, H, W] with polarities or the like.
      flow_px: [B, 2, H, W] px per window on pixels of the start.
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


def chained(flows_px: Tensor, valid: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Follow every pixel of the first instant through all flows.

    Args:
      flows_px: [K, 2, H, W] px, each on the pixels of the start of its own part.
      valid: [K, H, W] bool.
      hidden: [K, H, W] bool: the point is hidden by something at the end of the part, so that the next
        flow read there would be that of another surface.
    Returns: flow_px [2, H, W] on the pixels of the first instant, 0 where not valid; valid [H, W]: every part
      was, the place stayed in the picture up to the last one, was not hidden before it, and never between
      surfaces whose flows differ by more than 0.75 px.
    Gradient: flows_px.
    """
    check_real(flows_px, "the flows")
    if flows_px.ndim != 4 or flows_px.shape[1] != 2 or 0 in flows_px.shape:
        raise ShapeError(f"the flows are {list(flows_px.shape)}; [K, 2, H, W], no axis empty, is needed.")
    for mask, name in ((valid, "valid"), (hidden, "hidden")):
        if mask is not None or name == "valid":
            check_mask(mask, name, (len(flows_px), *flows_px.shape[2:]))
    height, width = flows_px.shape[2:]
    x, y = pixel_grid(height, width, flows_px)
    total = flows_px[0]
    seen = valid[0]
    before = torch.stack([x, y], -1)
    size = torch.tensor([max(width - 1, 1), max(height - 1, 1)], dtype=flows_px.dtype, device=flows_px.device)
    for k in range(1, len(flows_px)):
        at = torch.stack([x + total[0], y + total[1]], -1)
        inside = ((at >= 0) & (at <= size)).all(-1)
        at = torch.where(inside[..., None], at, torch.zeros_like(at))
        step = grid_sample(
            flows_px[k : k + 1],
            (2 * at / size - 1)[None],
            mode="bilinear",
            padding_mode="border",
            align_corners=True,
        )[0]
        seen = seen & inside & _sure(flows_px[k].detach(), valid[k], at.detach())
        if hidden is not None:
            seen = seen & ~_nearest(hidden[k - 1], before)
        before = at.detach()
        total = total + step
    return torch.where(seen, total, torch.zeros_like(total)), seen


def _nearest(mask, at):
    return mask[at[..., 1].round().long(), at[..., 0].round().long()]


def _sure(flow, valid, at):
    """Whether the four pixels around each place are valid and move alike."""
    columns, rows = (
        (at[..., k].floor().long(), at[..., k].ceil().long()) for k in (0, 1)
    )  # one and the same where the place is on a pixel
    corners = [(row, column) for column in columns for row in rows]
    around = torch.stack([flow[:, r, c] for r, c in corners])
    alike = (around.amax(0) - around.amin(0)).amax(0) <= EDGE_PX
    return alike & torch.stack([valid[r, c] for r, c in corners]).all(0)
