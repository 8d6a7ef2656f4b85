"""Fields on cells, smooth over many scales: the exact posterior on a quadtree (Luettgen, Karl and Willsky, 1994).

A cell's value is its parent's plus a Gaussian step; the parents of the coarsest scale begin at zero. What the data
say of the cells goes up the tree, each scale adding its doubt; means and covariances come down. All is linear in the
number of cells. Trees see neighbours on two sides of a coarse border as strangers, so several, shifted against each
other, are averaged.
"""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

# cells down and right: at each of the finer scales every alignment once
SHIFTS = ((0, 0), (5, 2), (2, 7), (7, 5))
REACH = 7


def posterior(precision: Tensor, pull: Tensor, steps: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, covariance and evidence of fields on cells.

    Args: precision: [B, 3, h, w] (xx, xy, yy) of what the data say of each cell by themselves, >= 0. pull: [B, 2, h, w]
      precision times the value they say. steps: [B] variance of the step to each scale, cells first.
    Returns: mean [B, 2, h, w], covariance [B, 3, h, w], and the logarithm [B] of the evidence for these variances,
      relative to a field that is zero; covariance includes what the trees differ by.
    """
    scales = len(steps)
    side = 2 ** (scales - 1)
    rows, columns = (-(-(size + REACH) // side) * side for size in precision.shape[2:])
    height, width = precision.shape[2:]
    both = torch.cat([precision, pull], 1)
    trees = torch.stack(
        [pad(both, (x, columns - width - x, y, rows - height - y)) for y, x in SHIFTS], 1
    ).flatten(0, 1)
    variances = [step.repeat_interleave(len(SHIFTS))[:, None, None] for step in steps]
    evidence = precision.new_zeros(len(trees))
    passed = []
    for variance in variances:
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
    value = value.unflatten(0, (-1, len(SHIFTS)))
    each = torch.stack([value[:, k, :, y : y + height, x : x + width] for k, (y, x) in enumerate(SHIFTS)], 1)
    mean = each.mean(1)
    apart = each[:, :, :2] - mean[:, None, :2]
    differ = torch.stack(
        [apart[:, :, 0].square(), apart[:, :, 0] * apart[:, :, 1], apart[:, :, 1].square()], 2
    )
    return mean[:, :2], mean[:, 2:] + differ.mean(1), evidence.unflatten(0, (-1, len(SHIFTS))).mean(1)


def _times(matrix, x, y):
    """A symmetric matrix (xx, xy, yy) times (x, y)."""
    return matrix[0] * x + matrix[1] * y, matrix[1] * x + matrix[2] * y
