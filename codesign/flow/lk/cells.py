"""The local part of a flow field: values on cells of 8 px that a polynomial leaves, as smooth as
the data ask.

What the data say of a cell is weighed as the whole image is in level: by what scattered events
alone would add to the slopes, and by the noise that a fit leaves, both over the 3 x 3 cells around.
The field is a tree of steps (quadtree) whose variance grows sixfold from a scale to the next
coarser one. How large it is, is not known: several sizes are tried, and their fields averaged with
the weights that the evidence gives them (empirical Bayes). So the local part vanishes where one
polynomial explains the image.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from codesign.flow.lk import quadtree
from codesign.flow.lk.level import CALIBRATION, DOUBT, OVERLAP, RIDGE, TINY, Level

CELL = 8  # px
SIZES = (0.005, 0.025, 0.1, 0.33)  # standard deviations of the cells' own steps, over the prior's
RARER = 2.0  # logarithm of how much rarer each size is than the one before
GROWTH = 6.0  # of the variance, from a scale to the next coarser one
# events whose slopes are as the whole image's are, and whose noise, added to those of the cells
# around
FEW_EVENTS = 30.0
FEW_OF_NOISE = 10.0
CLAIM = 0.7  # of the calibration of the whole image: sums over cells share fewer events


class Cells:
    """The local part over an image of height x width pixels, and what is known of it.

    value, covariance: [B, 2 or 3, rows, columns] px per way, float64. widest: variance of each
    component before anything is seen.
    """

    def __init__(
        self,
        batch: int,
        height: int,
        width: int,
        prior_px: float,
        device: torch.device,
    ) -> None:
        rows, columns = -(-height // CELL), -(-width // CELL)
        self.prior_px = prior_px
        self.scales = 1 + max(1, int(math.log2(max(height, width, 2 * CELL) / (2 * CELL))))
        self.value = torch.zeros(batch, 2, rows, columns, dtype=torch.float64, device=device)
        self.covariance = self.value.new_zeros(batch, 3, rows, columns)
        self.prior = (-RARER * torch.arange(len(SIZES), device=device).double()).softmax(0)
        variances = (self.value.new_tensor(SIZES) * prior_px) ** 2
        self.widest = float(self.prior @ variances) * sum(
            GROWTH**scale for scale in range(self.scales)
        )

    def on(self, level: Level) -> Tensor:
        """Flow [B, 2, h, w] on the samples of a level."""
        rows, columns = level.grid.shape
        found = interpolate(self.value, scale_factor=CELL / level.stride, mode="bilinear")
        return found[:, :, :rows, :columns]

    def step(self, level: Level, products: Tensor, change: Tensor) -> None:
        """Moves to the posterior mean.

        Args:
          products: [B, 8, h, w] of a level's samples.
          change: [B, 2, h, w] what the polynomial moved since they were taken.
        """
        precision, pull = self._evidence(
            level, self._summed(products, CELL // level.stride, change)
        )
        pull = pull + _apply(precision, self.value)
        growth = GROWTH ** torch.arange(self.scales).to(pull)
        variances = (pull.new_tensor(SIZES) * self.prior_px) ** 2
        means, covariances, evidence = quadtree.posterior(
            precision, pull, growth[:, None] * variances
        )
        weights = (evidence + self.prior.log()[:, None]).softmax(0)
        whole = weights[:, :, None, None, None]
        mean = (whole * means).sum(0)
        x, y = (means - mean).unbind(2)
        apart = torch.stack([x * x, x * y, y * y], 2)
        self.covariance = (whole * (covariances + apart)).sum(0)
        change = mean - self.value
        far = change.square().sum(1, keepdim=True) / (2 * level.sigma) ** 2
        self.value = self.value + change * (1 + far).rsqrt()

    def _summed(self, products, step, change):
        """[B, 8, rows, columns] products summed over cells of step x step samples, as they are once
        the flow has changed by the cell's mean of ``change``: V_t grows by the slopes times the
        change."""
        rows, columns = (
            step * cells - samples
            for cells, samples in zip(self.value.shape[2:], products.shape[2:], strict=True)
        )
        beyond = (0, columns, 0, rows)
        if rows or columns:
            products = pad(products, beyond)
            change = pad(change, beyond, mode="replicate")
        sums = step**2 * avg_pool2d(products, step).double()
        xx, xy, yy, xs, ys, ss, seen, events = sums.unbind(1)
        u, v = avg_pool2d(change, step).double().unbind(1)
        by_x = xx * u + xy * v
        by_y = xy * u + yy * v
        ss = ss + 2 * (xs * u + ys * v) + by_x * u + by_y * v
        return torch.stack([xx, xy, yy, xs + by_x, ys + by_y, ss, seen, events], 1)

    def _evidence(self, level, sums):
        """Precision [B, 3, rows, columns] and pull [B, 2, rows, columns] of each cell."""
        xx, xy, yy, xs, ys, _, _, events = sums.unbind(1)
        around = 9 * avg_pool2d(pad(sums, (1, 1, 1, 1), mode="replicate"), 3, 1)
        near = around[:, :3]
        scattered = around[:, 7] * level.texture_noise
        whole = sums[:, [0, 1, 2, 7]].sum((2, 3))[:, :, None, None]
        few = FEW_EVENTS / level.stride**2
        texture = near + few * whole[:, :3] / (whole[:, 3:] + few)
        scattered_too = scattered + few * level.texture_noise
        ridge = (
            RIDGE * (xx + yy + 2 * events * level.texture_noise).mean((1, 2), keepdim=True) + TINY
        )
        square = _commuting(texture, texture)
        doubt = (DOUBT * scattered_too).square() + ridge.square()
        trust = _commuting(square, _inverse(_plus(square, doubt)))
        own = torch.stack([xx, xy, yy], 1)
        noise = self._noise(level, around, _plus(near, scattered + ridge), near)[:, None]
        scale = CLAIM * CALIBRATION * OVERLAP * level.sigma**2 / level.stride**2 * noise
        pull = _apply(trust, _apply(trust, -torch.stack([xs, ys], 1)))
        return _around(trust, own) / scale, pull / scale

    def _noise(self, level, around, damped, near):
        """Variance [B, rows, columns] of the temporal slopes per sample: what a fit to the cells
        around leaves."""
        right = -around[:, 3:5]
        fit = _apply(_inverse(damped), right)
        explained = (fit * (2 * right - _apply(near, fit))).sum(1)
        energy = around[:, 5]
        left = torch.sqrt((energy - explained).square() + (1e-3 * energy).square() + TINY)
        expected = around[:, 7] * level.slope_noise[:, None, None]
        few = FEW_OF_NOISE / level.stride**2 * level.slope_noise[:, None, None]
        least = level.noise_floor * expected
        everywhere = ((left + least).sum((1, 2), keepdim=True) + few) / (
            expected.sum((1, 2), keepdim=True) + few
        )
        return (
            level.slope_noise[:, None, None] * (left + least + everywhere * few) / (expected + few)
        )


def _plus(matrix, number):
    """A symmetric matrix [B, 3, h, w] (xx, xy, yy) plus a number [B, h, w] times the unit."""
    xx, xy, yy = matrix.unbind(1)
    return torch.stack([xx + number, xy, yy + number], 1)


def _apply(matrix, vector):
    """A symmetric matrix [B, 3, h, w] times vectors [B, 2, h, w]."""
    xx, xy, yy = matrix.unbind(1)
    x, y = vector.unbind(1)
    return torch.stack([xx * x + xy * y, xy * x + yy * y], 1)


def _inverse(matrix):
    xx, xy, yy = matrix.unbind(1)
    return torch.stack([yy, -xy, xx], 1) / (xx * yy - xy * xy)[:, None]


def _commuting(one, other):
    """Product of two symmetric matrices that commute."""
    xx, xy, yy = one.unbind(1)
    uu, uv, vv = other.unbind(1)
    return torch.stack([xx * uu + xy * uv, xx * uv + xy * vv, xy * uv + yy * vv], 1)


def _around(outer, inner):
    """M N M of symmetric matrices."""
    xx, xy, yy = inner.unbind(1)
    a, b, d = outer.unbind(1)
    first = a * xx + b * xy, a * xy + b * yy
    second = b * xx + d * xy, b * xy + d * yy
    return torch.stack(
        [first[0] * a + first[1] * b, first[0] * b + first[1] * d, second[0] * b + second[1] * d], 1
    )
