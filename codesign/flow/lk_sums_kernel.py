"""Products of the slopes of an image, summed along the columns of its cells; forward and adjoint."""

from torch import Tensor

from codesign.exclusive import exclusive
from codesign.flow.lk_lanes import Form, Grid, Lanes, recorded, tensors

PRODUCTS = 8


@exclusive
def forward(mean: Tensor, slope: Tensor, seen: Tensor, density: Tensor, grid: Grid, cell: int) -> Tensor:
    """[B, 8, ceil(h / cell), w]: sums along the columns of each cell."""
    form = Form.of(mean, grid)
    rows, columns = grid.shape
    found = _forward(form, cell, *form.load(mean, slope, seen, density))
    return tensors((len(mean), PRODUCTS, -(-rows // cell), columns), found)[0]


@exclusive
def adjoint(
    mean: Tensor, slope: Tensor, seen: Tensor, density: Tensor, grid: Grid, cell: int, grad: Tensor
) -> list[Tensor]:
    """Gradients of mean, slope, seen, density from that of the cells' sums [B, 8, ceil(h / cell), ceil(w /
    cell)]."""
    form = Form.of(mean, grid)
    return tensors(mean.shape, *_adjoint(form, cell, *form.load(mean, slope, seen, density, grad)))


@recorded
def _forward(form, cell, mean, slope, seen, density):
    image = _Slopes(form, cell, mean)
    dr = image.dr
    arr = image.arr
    rows = image.cell_rows
    width = image.images * rows * image.columns
    number, place = image.split(image.lanes(width), rows * image.columns)
    row, x = image.split(place, image.columns)
    start = number * image.area
    first = row * image.count(cell)
    end = dr.minimum(first + image.count(cell), image.count(image.rows))

    def body(y, *sums):
        at = start + y * image.across + x
        by_x, by_y = image.slopes(start, y, x)
        s = image.take(slope, at)
        weight = image.take(seen, at)
        sx = weight * by_x
        sy = weight * by_y
        ss = weight * s
        terms = (
            (sx, by_x),
            (sx, by_y),
            (sy, by_y),
            (sx, s),
            (sy, s),
            (ss, s),
            (weight, 1),
            (weight, image.take(density, at)),
        )
        return [dr.fma(a, b, total) for (a, b), total in zip(terms, sums, strict=True)]

    sums = image.loop(first, end, body, *([dr.zeros(arr.Float, width)] * PRODUCTS))
    target = image.empty(PRODUCTS * width)
    plane = image.count(rows * image.columns)
    for k, total in enumerate(sums):
        image.put(target, total, (number * PRODUCTS + k) * plane + place)
    dr.eval(target)
    return target


@recorded
def _adjoint(form, cell, mean, slope, seen, density, grad):
    image = _Slopes(form, cell, mean)
    dr = image.dr
    across = -(-image.columns // cell)
    at = image.lanes(image.width)
    number, place = image.split(at, image.samples)
    y, x = image.split(place, image.columns)
    start = number * image.area
    plane = image.count(image.cell_rows * across)
    of_cell = (
        number * PRODUCTS * plane + image.split(y, cell)[0] * image.count(across) + image.split(x, cell)[0]
    )
    by_xx, by_xy, by_yy, by_xs, by_ys, by_ss, by_one, by_density = (
        image.take(grad, of_cell + k * plane) for k in range(PRODUCTS)
    )
    by_x, by_y = image.slopes(start, y, x)
    s = image.take(slope, at)
    seen = image.take(seen, at)
    density = image.take(density, at)
    on_x = by_xx * by_x + by_xy * by_y + by_xs * s  # twice, less what is quadratic once
    on_y = by_yy * by_y + by_ys * s
    on_s = by_ss * s
    grad_seen = on_x * by_x + on_y * by_y + on_s * s + by_one + by_density * density
    grad_x = seen * (on_x + by_xx * by_x)
    grad_y = seen * (on_y + by_yy * by_y + by_xy * by_x)
    grad_slope = seen * (by_xs * by_x + by_ys * by_y + 2 * on_s)
    grad_x *= image.factor(x, image.edge)
    grad_y *= image.factor(y, image.bottom)
    dr.eval(grad_x, grad_y, grad_slope, grad_seen)
    grad_density = by_density * seen
    grad_mean = _back(image, grad_x, start + y * image.across, x, image.edge, 1) + _back(
        image, grad_y, start + x, y, image.bottom, image.across
    )
    dr.eval(grad_mean, grad_density)
    return grad_mean, grad_slope, grad_seen, grad_density


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
        """Central differences of the mean, one-sided at the border; ``start``: index of the image's first
        sample."""
        return (
            self.difference(start + y * self.across, x, self.edge, 1),
            self.difference(start + x, y, self.bottom, self.across),
        )

    def difference(self, start, at, last, step):
        dr = self.dr
        before = dr.select(at > 0, at - 1, at)
        after = dr.minimum(at + 1, last)
        change = self.take(self.mean, start + after * step) - self.take(self.mean, start + before * step)
        return change * self.factor(at, last)

    def factor(self, at, last):
        return self.dr.select((at > 0) & (at < last), self.per_two, self.per_one)


def _back(image, grad, start, at, last, step):
    """Adjoint of ``difference`` without its factor: a sample is the upper end of the difference at the one before,
    or at itself at the end, and the lower end of that at the next, or at itself at the beginning."""
    dr = image.dr
    inner = at > 0
    before = image.take(grad, start + dr.select(inner, at - 1, 0) * step)
    after = image.take(grad, start + dr.minimum(at + 1, last) * step)
    here = image.take(grad, start + at * step)
    ends = dr.select(at == last, here, 0) - dr.select(inner, 0, here)
    return dr.select(inner, before, 0) - dr.select(at < last, after, 0) + ends
