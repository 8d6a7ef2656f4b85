"""Pixel grids, images read between pixels, and flow over a long window from flows over parts of
it."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

# flows of the four pixels around a place that differ by more belong to different surfaces
EDGE_PX = 0.75


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


def chained(flows_px: Tensor, valid: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Follow every pixel of the first instant through all flows.

    Args:
      flows_px: [K, 2, H, W] px, each on the pixels of the start of its own part.
      valid: [K, H, W] bool.
      hidden: [K, H, W] bool: the point is hidden by something at the end of the part, so that the
        next flow read there would be that of another surface.
    Returns: flow_px [2, H, W] on the pixels of the first instant, 0 where not valid; valid [H, W]:
      every part was, the place stayed in the picture up to the last one, was not hidden before it,
      and never between surfaces whose flows differ by more than 0.75 px.
    Gradient: flows_px.
    """
    height, width = flows_px.shape[2:]
    # NaN beside a place would reach what is read there with weight 0
    flows_px = torch.where(valid[:, None], flows_px, 0)
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
