"""Flow over a long window from flows over the parts of it, one after the other."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from codesign.errors import ShapeError
from codesign.flow.checks import check_mask, check_real

EDGE_PX = 0.75  # flows of the four pixels around a place that differ by more belong to different surfaces


def chained(flows_px: Tensor, valid: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Follow every pixel of the first instant through all flows.

    Args:
      flows_px: [K, 2, H, W] px, each on the pixels of the start of its own part.
      valid: [K, H, W] bool.
      hidden: [K, H, W] bool: the point is hidden by something at the end of the part, so that the next flow
        read there would be that of another surface.
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
    y, x = torch.meshgrid(
        *(torch.arange(n, dtype=flows_px.dtype, device=flows_px.device) for n in (height, width)),
        indexing="ij",
    )
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
