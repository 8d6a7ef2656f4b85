"""Event volumes of events that lie between pixels, as rectification leaves them."""

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.events.entry import check_whole
from codesign.flow.checks import check_count, check_mask, check_real, check_size


def splatted(
    t_us: Tensor,
    x_px: Tensor,
    y_px: Tensor,
    on: Tensor,
    t0_us: int,
    t1_us: int,
    bins: int,
    height_px: int,
    width_px: int,
) -> Tensor:
    """Counts [2, bins, H, W] float32 of events at fractional places, shared bilinearly by four pixels and
    linearly by two bins.

    Args: t_us: [N] int64 within t0_us to t1_us. x_px, y_px: [N] float. on: [N] bool.
    Events, and shares of them, that fall outside the picture are left out; everything else is conserved.
    """
    bins = check_count(bins, "bins", 1)
    height_px, width_px = check_size((height_px, width_px), "the picture")
    if check_whole(t1_us, "t1_us") <= check_whole(t0_us, "t0_us"):
        raise DomainError(f"the window is {t0_us} to {t1_us} us; a start before its end is needed.")
    for values, name in ((x_px, "x_px"), (y_px, "y_px")):
        check_real(values, name)
    if not isinstance(t_us, Tensor) or t_us.dtype != torch.int64 or t_us.ndim != 1:
        raise DomainError("t_us must be a list [N] of int64 microseconds.")
    check_mask(on, "on", t_us.shape)
    if not t_us.shape == x_px.shape == y_px.shape == on.shape:
        raise ShapeError(
            f"times, places and polarities have shapes {[list(v.shape) for v in (t_us, x_px, y_px, on)]}; "
            "four alike are needed."
        )
    place = (t_us - t0_us).double() / (t1_us - t0_us) * (bins - 1)
    column = x_px.double().floor()
    row = y_px.double().floor()
    node = place.floor()
    counts = torch.zeros(2 * bins * height_px * width_px, dtype=torch.float64)
    for dx in (0, 1):
        for dy in (0, 1):
            for dt in (0, 1):
                share = torch.ones_like(place)
                for value, low, step in (
                    (x_px.double(), column, dx),
                    (y_px.double(), row, dy),
                    (place, node, dt),
                ):
                    share = share * (value - low if step else 1 - (value - low))
                at_x = (column + dx).long()
                at_y = (row + dy).long()
                at_t = (node + dt).long()
                inside = (
                    (at_x >= 0)
                    & (at_x < width_px)
                    & (at_y >= 0)
                    & (at_y < height_px)
                    & (at_t < bins)
                    & (share > 0)
                )
                cell = (((~on).long() * bins + at_t) * height_px + at_y) * width_px + at_x
                counts.index_add_(0, cell[inside], share[inside])
    return counts.reshape(2, bins, height_px, width_px).float()
