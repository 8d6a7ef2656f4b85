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
    of_flow = torch.cat([-start.to(parameters)[:, None], parameters], 1)
    of_rest = torch.cat([xx, xy, yy, widest.expand_as(xx)], 1)
    powers = tuple(tuple(pair) for pair in shape.powers.tolist())
    rows, columns = cells.value.shape[2:]
    setting = lk_start_kernel.Setting(
        powers, shape.of_squares, rows, columns, CELL, FIXED_POINT_STEPS, joined
    )
    grid = Grid(shape.height, shape.width)
    of_cells = cells.value.to(parameters), cells.covariance.to(parameters)
    flow, rest = _AtStart.apply(of_flow, of_rest, *of_cells, grid, setting)
    return flow, rest[:, :3], rest[:, 3]


class _AtStart(Function):
    @staticmethod
    def forward(ctx, of_flow, of_rest, value, covariance, grid, setting):
        ctx.set_materialize_grads(False)
        coefficients = torch.cat([of_flow, of_rest], 1)
        cells = torch.cat([value, covariance], 1)
        ctx.save_for_backward(coefficients, cells)
        ctx.rest = grid, setting
        found = lk_start_kernel.forward(coefficients, cells, grid, setting)
        return found[:, :2].clone(), found[:, 2:].clone()

    @staticmethod
    def backward(ctx, by_flow, by_rest):  # pyright: ignore[reportIncompatibleMethodOverride]
        """Most who follow a gradient follow that of the flow alone: what it does not depend on has none."""
        if by_flow is None and by_rest is None:
            return (None,) * 6
        coefficients, cells = ctx.saved_tensors
        grid, setting = ctx.rest
        if by_flow is None:
            by_flow = torch.zeros_like(by_rest[:, :2])
        grad, of_cells = lk_start_kernel.adjoint(coefficients, cells, grid, setting, by_flow, by_rest)
        found = [grad[:, : setting.of_flow], None, None, None]
        if by_rest is not None:
            found[1:] = grad[:, setting.of_flow :], of_cells[:, :2], of_cells[:, 2:]
        elif setting.joined:
            found[2] = of_cells[:, :2]
        live = [by for by in (by_flow, by_rest) if by is not None]
        return *first_only(found, coefficients, cells, *live), None, None


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
