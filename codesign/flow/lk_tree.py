"""Fields on cells, smooth over many scales: the exact posterior on a quadtree (Luettgen, Karl and Willsky, 1994).

A cell's value is its parent's plus a Gaussian step; the parents of the coarsest scale begin at zero. What the data
say of the cells goes up the tree, each scale adding its doubt; means and covariances come down. All is linear in the
number of cells. Trees see neighbours on two sides of a coarse border as strangers, so several, shifted against each
other, are averaged.
"""

import torch
from torch import Tensor
from torch.autograd import Function
from torch.nn.functional import avg_pool2d, interpolate, pad

from codesign.flow import lk_plain, lk_tree_kernel
from codesign.flow.lk_lanes import first_only

# cells down and right: at each of the finer scales every alignment once
SHIFTS = ((0, 0), (5, 2), (2, 7), (7, 5))


def posterior(precision: Tensor, pull: Tensor, steps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, covariance and evidence of fields on cells, for steps of several sizes.

    Args: precision: [B, 3, h, w] (xx, xy, yy) of what the data say of each cell by themselves, >= 0, float64. pull:
      [B, 2, h, w] precision times the value they say. steps: [scales, S] variances of the steps to each scale, cells
      first.
    Returns: mean [S, B, 2, h, w], covariance [S, B, 3, h, w], and the logarithm [S, B] of the evidence for these
      variances, relative to a field that is zero; covariance includes what the trees differ by.
    Gradient: precision, pull; exact, the first one.
    """
    data = torch.cat([precision, pull], 1)
    values, evidence = _plain(data, steps) if lk_plain.wanted() else _Posterior.apply(data, steps)
    return values[:, :, :2], values[:, :, 2:], evidence


class _Posterior(Function):
    @staticmethod
    def forward(ctx, data, steps):
        ctx.set_materialize_grads(False)
        trees = lk_tree_kernel.Trees(steps.shape[1], len(steps), SHIFTS)
        values, evidence, kept = lk_tree_kernel.forward(data, steps, trees)
        ctx.trees = trees
        ctx.save_for_backward(data, steps, *kept)
        return values, evidence

    @staticmethod
    def backward(ctx, by_values, by_evidence):  # pyright: ignore[reportIncompatibleMethodOverride]
        if by_values is None and by_evidence is None:
            return None, None
        data, steps, *kept = ctx.saved_tensors
        sizes = len(steps[0]), len(data)
        grads = [
            data.new_zeros(shape) if by is None else by
            for by, shape in ((by_values, (*sizes, *data.shape[1:])), (by_evidence, sizes))
        ]
        found = lk_tree_kernel.adjoint(data, steps, ctx.trees, kept, *grads)
        return *first_only([found], data, *grads), None


def _plain(data, steps):
    """As operations of torch: [S, B, 5, h, w] and [S, B]."""
    scales, sizes = steps.shape
    batch, _, height, width = data.shape
    rows, columns = lk_tree_kernel.Trees(sizes, scales, SHIFTS).shape(0, height, width)
    shifted = [pad(data, (x, columns - width - x, y, rows - height - y)) for y, x in SHIFTS]
    trees = torch.stack(shifted, 1).flatten(0, 1).repeat(sizes, 1, 1, 1)
    evidence = data.new_zeros(len(trees))
    passed = []
    for step in steps:
        variance = step.repeat_interleave(batch * len(SHIFTS))[:, None, None]
        xx, xy, yy, px, py = trees.unbind(1)
        a = 1 + variance * xx
        b = variance * xy
        d = 1 + variance * yy
        determinant = a * d - b * b
        gain = d / determinant, -b / determinant, a / determinant  # (1 + variance P)^-1
        up = _times(gain, px, py)
        fit = variance * (px * up[0] + py * up[1])
        evidence = evidence + (fit - determinant.log()).sum((1, 2)) / 2
        passed.append((gain, px, py, variance))
        above = torch.stack(
            [gain[0] * xx + gain[1] * xy, gain[0] * xy + gain[1] * yy, gain[1] * xy + gain[2] * yy, *up], 1
        )
        trees = 4 * avg_pool2d(above, 2) if len(passed) < scales else above
    value = trees.new_zeros(len(trees), 5, *trees.shape[2:])  # mean x, y, covariance xx, xy, yy
    for number, (gain, px, py, variance) in enumerate(reversed(passed)):
        if number:
            value = interpolate(value, scale_factor=2.0)
        x, y, xx, xy, yy = value.unbind(1)
        mean = _times(gain, x + variance * px, y + variance * py)
        first = _times(gain, xx, xy)
        second = _times(gain, xy, yy)
        value = torch.stack(
            [
                *mean,
                gain[0] * first[0] + gain[1] * second[0] + variance * gain[0],
                gain[1] * first[0] + gain[2] * second[0] + variance * gain[1],
                gain[1] * first[1] + gain[2] * second[1] + variance * gain[2],
            ],
            1,
        )
    value = value.unflatten(0, (sizes, batch, len(SHIFTS)))
    each = torch.stack(
        [value[:, :, k, :, y : y + height, x : x + width] for k, (y, x) in enumerate(SHIFTS)], 2
    )
    mean = each.mean(2)
    x, y = (each[:, :, :, :2] - mean[:, :, None, :2]).unbind(3)
    differ = torch.stack([x * x, x * y, y * y], 3).mean(2)
    evidence = evidence.unflatten(0, (sizes, batch, len(SHIFTS))).mean(2)
    return torch.cat([mean[:, :, :2], mean[:, :, 2:] + differ], 2), evidence


def _times(matrix, x, y):
    """A symmetric matrix (xx, xy, yy) times (x, y)."""
    return matrix[0] * x + matrix[1] * y, matrix[1] * x + matrix[2] * y
