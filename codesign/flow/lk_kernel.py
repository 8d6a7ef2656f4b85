"""The dear part of the closed form as drjit kernels with adjoints of their own: bins read along a flow and compared
over time (lk_warp_kernel), products of their slopes summed over cells (lk_sums_kernel), and the blur before both
(lk_blur_kernel). They know nothing of the field that the flow comes from."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd import Function
from torch.nn.functional import pad

from codesign.errors import DomainError, ShapeError
from codesign.flow import lk_blur_kernel, lk_plain, lk_sums_kernel, lk_warp_kernel
from codesign.flow.lk_lanes import Grid, first_only


def moving(
    rate: Tensor, flow_px: Tensor, time: Tensor, contrast: Tensor, grid: Grid, fade_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Bins carried back to time 0 along a flow: their mean and their slope over time.

    Args:
      rate: [B, n, h, w] bins on the samples of ``grid``, float32 or float64.
      flow_px: [B, 2, h, w] flow of the samples at time 0, px per unit of time.
      time: [n] of the bins, in order. contrast: [2, n] share of each bin in the mean and in the slope.
      fade_px: the windows below fall smoothly from 1 to 0 over this distance to the border, px.
    Returns:
      mean, slope: [B, h, w]. Bins are read bilinearly; beyond the outermost samples, as there.
      seen: [B, h, w] in [0, 1], product of the windows along x and y where the first and the last bin are read.
    Gradient: rate, flow_px; exact, the first one. The flow has none through bins that it reads beyond the outermost
      samples.
    Raises: ShapeError where shapes do not fit; GradientError for a second derivative.
    Cost: one pass forward, two backward; nothing of n bins is stored forward. Backward four values per sample and
      bin, or ``lk_warp_kernel.MOST_VALUES`` where that is less, in each thread. One kernel for each number of bins,
      whatever the sizes; it is traced once for each size.
    Source: Lucas and Kanade, 1981; Jaderberg et al., Spatial Transformer Networks, NeurIPS 2015, for the reading.
    """
    batch, bins = rate.shape[:2]
    if rate.shape[2:] != grid.shape or flow_px.shape != (batch, 2, *grid.shape):
        raise ShapeError(
            f"bins are {list(rate.shape)}, their flow is {list(flow_px.shape)}, samples are {list(grid.shape)}; give "
            "[B, n, h, w] and [B, 2, h, w]."
        )
    if time.shape != (bins,) or contrast.shape != (2, bins):
        raise ShapeError(
            f"{bins} bins have times {list(time.shape)} and shares {list(contrast.shape)}; give [n] and [2, n]."
        )
    if lk_plain.wanted():
        return lk_plain.moving(rate, flow_px, time, contrast, grid, fade_px)
    return _Moving.apply(rate, flow_px, torch.cat([time[None], contrast]).to(rate), grid, fade_px)


def cell_sums(
    mean: Tensor, slope: Tensor, seen: Tensor, density: Tensor, grid: Grid, cell: int = 1
) -> Tensor:
    """Products of slopes, summed over squares of cell x cell samples.

    Args:
      mean, slope, seen: [B, h, w] as from ``moving``, on the samples of ``grid``. density: [B, h, w].
      cell: side of the squares in samples, >= 1; those at the lower and right border hold what is left.
    Returns: [B, 8, ceil(h / cell), ceil(w / cell)], sums over samples of seen times x x, x y, y y, x s, y s, s s, 1,
      density, where x and y are the slopes of the mean per px (central differences, one-sided at the border; 0 where
      there is one sample) and s is the slope over time.
    Gradient: mean, slope, seen, density; exact, the first one.
    Raises: ShapeError where shapes do not fit; DomainError where cell < 1; GradientError for a second derivative.
    """
    shapes = [list(x.shape) for x in (mean, slope, seen, density)]
    if any(shape != [len(mean), *grid.shape] for shape in shapes):
        raise ShapeError(
            f"mean, slope, seen and density are {', '.join(map(str, shapes))}; give [B, {grid.shape[0]}, "
            f"{grid.shape[1]}] for all."
        )
    if cell < 1:
        raise DomainError(f"cell is {cell}; give a side of at least 1 sample.")
    if lk_plain.wanted():
        return lk_plain.cell_sums(mean, slope, seen, density, grid, cell)
    return _Sums.apply(mean, slope, seen, density, grid, cell)


def blurred(images: Tensor, grid: Grid, taps: Sequence[float]) -> Tensor:
    """Images averaged over the squares of a grid, then blurred along both axes.

    Args:
      images: [B, n, H, W], the image that ``grid`` samples.
      taps: of a symmetric kernel, in samples: the middle one, then those to one side.
    Returns: [B, n, h, w]. Beyond the outermost samples the image is continued by its mirror image, again and again
      where the kernel is longer.
    Gradient: images; exact, the first one.
    Raises: ShapeError where images and grid do not fit; GradientError for a second derivative.
    """
    if images.ndim != 4 or images.shape[2:] != (grid.height, grid.width) or 0 in grid.shape:
        raise ShapeError(
            f"images are {list(images.shape)}, the grid has {grid.height} x {grid.width} pixels and {grid.shape[0]} "
            f"x {grid.shape[1]} samples; give [B, n, {grid.height}, {grid.width}] and at least one sample."
        )
    if lk_plain.wanted():
        return lk_plain.blurred(images, grid, taps)
    return _Blurred.apply(images, grid, tuple(taps))


class _Moving(Function):
    @staticmethod
    def forward(ctx, rate, flow_px, weights, grid, fade_px):
        ctx.save_for_backward(rate, flow_px, weights)
        ctx.rest = grid, fade_px
        return tuple(lk_warp_kernel.forward(rate, flow_px, weights, grid, fade_px))

    @staticmethod
    def backward(ctx, *grads):  # pyright: ignore[reportIncompatibleMethodOverride]
        saved = ctx.saved_tensors
        found = lk_warp_kernel.adjoint(*saved, *ctx.rest, grads, ctx.needs_input_grad[0])
        return *first_only(found, *saved[:2], *grads), None, None, None


class _Sums(Function):
    @staticmethod
    def forward(ctx, mean, slope, seen, density, grid, cell):
        ctx.save_for_backward(mean, slope, seen, density)
        ctx.rest = grid, cell
        columns = lk_sums_kernel.forward(mean, slope, seen, density, grid, cell)
        if cell == 1:
            return columns
        return pad(columns, (0, -columns.shape[3] % cell)).unflatten(3, (-1, cell)).sum(4)

    @staticmethod
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        saved = ctx.saved_tensors
        found = lk_sums_kernel.adjoint(*saved, *ctx.rest, grad)
        return *first_only(found, *saved, grad), None, None


class _Blurred(Function):
    @staticmethod
    def forward(ctx, images, grid, taps):
        ctx.save_for_backward(images)
        ctx.rest = grid, taps
        return lk_blur_kernel.forward(images.flatten(0, 1), grid, taps).unflatten(0, images.shape[:2])

    @staticmethod
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        found = lk_blur_kernel.adjoint(grad.flatten(0, 1), *ctx.rest).unflatten(0, grad.shape[:2])
        return *first_only([found], *ctx.saved_tensors, grad), None, None
