"""From the field at the mean place of the events to flow, covariance and confidence on the pixels of the start."""

import torch
from torch import Tensor
from torch.autograd import Function

from codesign.flow import lk_plain, lk_start_kernel
from codesign.flow.lk_cells import CELL, Cells
from codesign.flow.lk_field import FIXED_POINT_STEPS, Polynomials
from codesign.flow.lk_lanes import Grid, first_only


def at_start(
    shape: Polynomials, parameters: Tensor, spread: Tensor, cells: Cells, joined: bool, start: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Flow, its covariance, and confidence.

    Args: parameters: [B, 2K] px per way, and spread: [B, 2K, 2K] their covariance. cells: what is known of the field
      beside the polynomial. joined: whether they are part of the flow; else their mean is error. start: [B] place of
      the start on the way.
    Returns: flow [B, 2, H, W] px per way, by ``Polynomials.at_start``; covariance [B, 3, H, W] of polynomial and cells;
      confidence [B, H, W] in [0, 1], 1 - trace(covariance) / trace(prior covariance).
    Gradient: parameters, spread, cells, start; exact, the first one.
    """
    prior = (shape.unit @ shape.unit.T).to(parameters)[None]
    spread = spread.to(parameters)
    if lk_plain.wanted():
        return _plain(shape, parameters, spread, prior, cells, joined, start)
    xx, xy, yy = shape.squares(spread)
    widest = shape.squares(prior)
    widest = widest[0] + widest[2]
    widest[:, 0] += 2 * cells.widest
    numbers = [-start.to(parameters)[:, None], parameters, xx, xy, yy, widest.expand_as(xx)]
    both = torch.cat([cells.value, cells.covariance], 1).to(parameters)
    powers = tuple(tuple(pair) for pair in shape.powers.tolist())
    setting = lk_start_kernel.Setting(
        powers, shape.of_squares, *both.shape[2:], CELL, FIXED_POINT_STEPS, joined
    )
    found = _AtStart.apply(torch.cat(numbers, 1), both, Grid(shape.height, shape.width), setting)
    return found[:, :2], found[:, 2:5], found[:, 5]


class _AtStart(Function):
    @staticmethod
    def forward(ctx, coefficients, cells, grid, setting):
        ctx.save_for_backward(coefficients, cells)
        ctx.rest = grid, setting
        return lk_start_kernel.forward(coefficients, cells, grid, setting)

    @staticmethod
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        found = lk_start_kernel.adjoint(*ctx.saved_tensors, *ctx.rest, grad)
        return *first_only(found, *ctx.saved_tensors, grad), None, None


def _plain(shape, parameters, spread, prior, cells, joined, start):
    """As operations of torch."""
    flow, places, misfit, doubt = shape.at_start(parameters, start, cells.at, joined)
    covariance = doubt + shape.covariance(spread, places)
    if not joined:
        x, y = misfit.unbind(1)
        covariance = covariance + torch.stack([x * x, x * y, y * y], 1)
    widest = shape.covariance(prior, places)
    widest = widest[:, 0] + widest[:, 2] + 2 * cells.widest
    confidence = 1 - (covariance[:, 0] + covariance[:, 2]) / widest
    return flow, covariance, confidence.clamp(0, 1)
