"""Products of the slopes of bins along a flow, summed over cells: in drjit, and as operations of torch."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from codesign.backend import pull_back
from codesign.exclusive import exclusive
from codesign.flow.lk import warp
from codesign.flow.lk.blur import ends
from codesign.flow.lk.lanes import Form, Grid, Lanes, in_graph, plain_wanted, recorded, tensors

PRODUCTS = 8


def sums_along(
    rate: Tensor,
    flow_px: Tensor,
    density: Tensor,
    time: Tensor,
    contrast: Tensor,
    grid: Grid,
    fade_px: float,
    gain: Tensor | None = None,
    cell: int = 1,
) -> Tensor:
    """Products of the slopes of bins carried back along a flow, summed over squares of cell x cell
    samples.

    Args:
      rate, flow_px, time, contrast, grid, fade_px: as of ``warp.moving``, which gives mean, slope
        over time and ``seen``.
      density: [B, h, w].
      gain: [B] that the slope over time is multiplied by; 1 where None.
      cell: side of the squares in samples, >= 1; those at the lower and right border hold what is
        left.
    Returns: [B, 8, ceil(h / cell), ceil(w / cell)], sums over samples of seen times x x, x y, y y,
      x s, y s, s s, 1, density, where x and y are the slopes of the mean per px (central
      differences, one-sided at the border; 0 where there is one sample) and s is the slope over
      time.
    Gradient: rate, flow_px, density, gain; exact, the first one, as of ``warp.moving``.
    Raises: GradientError for a second derivative.
    """
    if gain is None:
        gain = rate.new_ones(len(rate))
    if plain_wanted():
        mean, slope, seen = warp.moving(rate, flow_px, time, contrast, grid, fade_px)
        return _plain(mean, gain[:, None, None] * slope, seen, density, grid, cell)
    settings = grid, fade_px, cell, warp.numbers(time, contrast, rate)
    return in_graph(_forward, _adjoint, settings, rate, flow_px, gain, density)[0]


def _plain(mean, slope, seen, density, grid, cell):
    rows, columns = grid.shape
    around = pad(mean, (1, 1, 1, 1), mode="replicate")
    per_row, per_column = (ends(count, mean) / (2 * grid.stride) for count in grid.shape)
    x = (around[:, 1:-1, 2:] - around[:, 1:-1, :-2]) * per_column
    y = (around[:, 2:, 1:-1] - around[:, :-2, 1:-1]) * per_row[:, None]
    ones = torch.ones_like(seen)
    parts = [x * x, x * y, y * y, x * slope, y * slope, slope * slope, ones, density]
    terms = seen[:, None] * torch.stack(parts, 1)
    if cell == 1:
        return terms
    padded = pad(terms, (0, -columns % cell, 0, -rows % cell))
    return padded.unflatten(3, (-1, cell)).unflatten(2, (-1, cell)).sum((3, 5))


@exclusive
def _forward(grid, fade_px, cell, weights, rate, flow_px, gain, density):
    form = Form.of(rate, grid)
    rows, columns = grid.shape
    # twice: a kernel of one image would be another
    arrays = form.load(rate, flow_px, gain.expand(2, -1), density)
    sums, *read = _sums(form, fade_px, cell, *arrays, form.scalars(weights))
    (sums,) = tensors((form.images, PRODUCTS, -(-rows // cell), columns), sums)
    if cell > 1:
        sums = pad(sums, (0, -columns % cell)).unflatten(3, (-1, cell)).sum(4)
    wanted = any(given.requires_grad for given in (rate, flow_px, gain, density))
    return [sums], tensors((form.images, *grid.shape), *read) if wanted else []


@exclusive
def _adjoint(grid, fade_px, cell, weights, rate, flow_px, gain, density, *rest):
    *read, grads, wanted = rest
    form = Form.of(rate, grid)
    arrays = form.load(rate, flow_px, gain.expand(2, -1), density, *read, *grads)
    bins = warp.together(form, wanted[0])
    settings = form, fade_px, cell, bins, wanted[2]
    *of_bins, by_gain, by_density = _gradients(*settings, *arrays, form.scalars(weights))
    (by_density,) = tensors(density.shape, by_density)
    by_gain = tensors(density.shape, by_gain)[0].sum((1, 2)) if wanted[2] else None
    return *warp.given_back(rate, flow_px, *of_bins), by_gain, by_density


@recorded
def _sums(form, fade_px, cell, rate, flow, gain, density, weights):
    """[B, 8, ceil(h / cell), w]; mean, slope and windows."""
    mean, slope, seen = warp.read(form, fade_px, rate, flow, weights)
    image = _Slopes(form, cell, mean)
    dr = image.dr
    rows = image.cell_rows
    width = image.images * rows * image.columns
    number, place = image.split(image.lanes(width), rows * image.columns)
    row, x = image.split(place, image.columns)
    start = number * image.area
    first = row * image.count(cell)
    end = dr.minimum(first + image.count(cell), image.count(image.rows))

    def body(y, *sums):
        at = start + y * image.across + x
        maps = slope, seen, density  # of a square of one sample, lanes are samples
        over_time, *maps = maps if cell == 1 else (image.take(values, at) for values in maps)
        terms = _products(*image.slopes(start, y, x), gain * over_time, *maps)
        return [dr.fma(a, b, total) for (a, b), total in zip(terms, sums, strict=True)]

    gain = image.take(gain, number)
    none = [image.number(0) if cell == 1 else dr.zeros(image.arr.Float, width)] * PRODUCTS
    sums = body(row, *none) if cell == 1 else image.loop(first, end, body, *none)
    target = image.empty(PRODUCTS * width)
    plane = image.count(rows * image.columns)
    for k, total in enumerate(sums):
        image.put(target, total, (number * PRODUCTS + k) * plane + place)
    dr.eval(target)
    return target, mean, slope, seen


def _products(x, y, slope, seen, density):
    """The eight products of a sample, as pairs of factors."""
    by_x = seen * x
    by_y = seen * y
    by_slope = seen * slope
    return (
        (by_x, x),
        (by_x, y),
        (by_y, y),
        (by_x, slope),
        (by_y, slope),
        (by_slope, slope),
        (seen, 1),
        (seen, density),
    )


@recorded
def _gradients(form, fade_px, cell, bins, wants_gain, *arrays):
    """Of rate, flow, gain (parts of it, of each sample) and density."""
    rate, flow, gain, density, mean, slope, seen, grad, weights = arrays
    image = _Slopes(form, cell, mean)
    dr = image.dr
    across = -(-image.columns // cell)
    at = image.lanes(image.width)
    number, place = image.split(at, image.samples)
    y, x = image.split(place, image.columns)
    start = number * image.area
    plane = image.count(image.cell_rows * across)
    of_cell = (
        number * PRODUCTS * plane
        + image.split(y, cell)[0] * image.count(across)
        + image.split(x, cell)[0]
    )
    seeds = [image.take(grad, of_cell + k * plane) for k in range(PRODUCTS)]
    gain = image.take(gain, number)
    grad_x, grad_y, by_slope, by_seen, by_density = pull_back(
        lambda *given: [a * b for a, b in _products(*given)],
        [*image.slopes(start, y, x), gain * slope, seen, density],
        seeds,
    )
    by_gain = by_slope * slope if wants_gain else None
    by_slope *= gain
    grad_x *= image.factor(x, image.edge)
    grad_y *= image.factor(y, image.bottom)
    dr.eval(grad_x, grad_y, by_slope, by_seen, by_density, by_gain)
    grad_mean = _back(image, grad_x, start + y * image.across, x, image.edge, 1) + _back(
        image, grad_y, start + x, y, image.bottom, image.across
    )
    found = warp.gradients(form, fade_px, bins, rate, flow, grad_mean, by_slope, by_seen, weights)
    return *found, by_gain, by_density


class _Slopes(Lanes):
    """The slopes of the mean at a sample, and the other values there."""

    def __init__(self, form, cell, mean):
        super().__init__(form)
        self.mean = mean
        self.cell_rows = -(-self.rows // cell)
        self.bottom = self.count(self.rows - 1)
        self.edge = self.count(self.columns - 1)
        # of a slope between two neighbours of the sample, and of one at the border
        self.per_two = self.number(1 / (2 * form.stride))
        self.per_one = self.number(1 / form.stride)

    def slopes(self, start, y, x):
        """Central differences of the mean, one-sided at the border; ``start``: index of the image's
        first sample."""
        return (
            self.difference(start + y * self.across, x, self.edge, 1),
            self.difference(start + x, y, self.bottom, self.across),
        )

    def difference(self, start, at, last, step):
        dr = self.dr
        before = dr.select(at > 0, at - 1, at)
        after = dr.minimum(at + 1, last)
        change = self.take(self.mean, start + after * step) - self.take(
            self.mean, start + before * step
        )
        return change * self.factor(at, last)

    def factor(self, at, last):
        return self.dr.select((at > 0) & (at < last), self.per_two, self.per_one)


def _back(image, grad, start, at, last, step):
    """Adjoint of ``difference`` without its factor: a sample is the upper end of the difference at
    the one before, or at itself at the end, and the lower end of that at the next, or at itself at
    the beginning."""
    dr = image.dr
    inner = at > 0
    before = image.take(grad, start + dr.select(inner, at - 1, 0) * step)
    after = image.take(grad, start + dr.minimum(at + 1, last) * step)
    here = image.take(grad, start + at * step)
    ends = dr.select(at == last, here, 0) - dr.select(inner, 0, here)
    return dr.select(inner, before, 0) - dr.select(at < last, after, 0) + ends
