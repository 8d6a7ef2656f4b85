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


def read_at(images: Tensor, at_px: Tensor, padding: str = "border") -> Tensor:
    """Images read bilinearly between pixels.

    Args:
      images: [N, C, H, W].
      at_px: [N, 2, h, w] places (x, y), px.
      padding: what there is beyond the outermost pixels: "border", as there, or "zeros".
    Returns: [N, C, h, w].
    Gradient: images, and places within the outermost pixels; piecewise smooth in the places.
    """
    size = at_px.new_tensor([images.shape[3], images.shape[2]])[:, None, None]
    unit = ((2 * at_px + 1) / size - 1).movedim(1, 3)
    return grid_sample(images, unit, padding_mode=padding, align_corners=False)


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
    # [B, T, 2, H, W]
    at = pixel_grid(height, width, flow_px) + time.to(flow_px)[:, None, None, None] * flow_px[:, None]
    each = bins.reshape(batch, -1, count, height, width).transpose(1, 2)
    found = read_at(each.flatten(0, 1), at.flatten(0, 1), "zeros")
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
    total = flows_px[0]
    seen = valid[0]
    place = pixel_grid(height, width, flows_px)
    before = place
    last = flows_px.new_tensor([width - 1, height - 1])[:, None, None]
    for k in range(1, len(flows_px)):
        at = place + total
        inside = ((at >= 0) & (at <= last)).all(0)
        at = torch.where(inside, at, 0)
        step = read_at(flows_px[k : k + 1], at[None])[0]
        seen = seen & inside & _sure(flows_px[k].detach(), valid[k], at.detach())
        if hidden is not None:
            seen = seen & ~_nearest(hidden[k - 1], before)
        before = at.detach()
        total = total + step
    return torch.where(seen, total, torch.zeros_like(total)), seen


def _nearest(mask, at):
    column, row = at.round().long()
    return mask[row, column]


def _sure(flow, valid, at):
    """Whether the four pixels around each place are valid and move alike."""
    # one and the same where the place is on a pixel
    columns, rows = zip(at.floor().long(), at.ceil().long(), strict=True)
    corners = [(row, column) for column in columns for row in rows]
    around = torch.stack([flow[:, r, c] for r, c in corners])
    alike = (around.amax(0) - around.amin(0)).amax(0) <= EDGE_PX
    return alike & torch.stack([valid[r, c] for r, c in corners]).all(0)
