"""Means over squares and a symmetric kernel along both axes, mirrored at the border, in drjit; forward and adjoint.

A lane goes down a column: it takes the horizontal sum of each row and keeps the last ones for the vertical sum, so
nothing is stored between the two. An even continuation makes the blur A self-adjoint for a product in which the
outermost samples count half: A^T = E A E^-1, E = 1/2 at the ends of an axis, 1 within.
"""

from collections.abc import Sequence

from torch import Tensor

from codesign.exclusive import exclusive
from codesign.flow.lk_lanes import Form, Grid, Lanes, recorded, tensors

ROWS = 64  # that a lane goes down: columns of a whole image are far apart in memory


@exclusive
def forward(images: Tensor, grid: Grid, taps: Sequence[float]) -> Tensor:
    """[N, h, w] of images [N, H, W]; ``taps``: the middle one, then those to one side."""
    form = Form.of(images, grid)
    (source,) = form.load(images)
    if grid.stride > 1:
        source = _pooled(form, source)
    return tensors((len(images), *grid.shape), _blurred(form, False, source, form.scalars(list(taps))))[0]


@exclusive
def adjoint(grad: Tensor, grid: Grid, taps: Sequence[float]) -> Tensor:
    """[N, H, W], of a gradient [N, h, w]."""
    form = Form.of(grad, grid)
    found = _blurred(form, True, *form.load(grad), form.scalars(list(taps)))
    if grid.stride > 1:
        found = _spread(form, found)
    return tensors((len(grad), grid.height, grid.width), found)[0]


@recorded
def _blurred(form, adjoint, source, taps):
    """Of samples; ``adjoint``: its adjoint."""
    lanes = Lanes(form)
    dr = lanes.dr
    arr = lanes.arr
    radius = len(taps) - 1
    blocks = -(-lanes.rows // ROWS)
    width = lanes.images * blocks * lanes.columns
    row = _Mirrored(lanes, lanes.columns, radius)
    column = _Mirrored(lanes, lanes.rows, radius)
    block, x = lanes.split(lanes.lanes(width), lanes.columns)
    image, block = lanes.split(block, blocks)
    start = image * lanes.area
    top = block * lanes.count(ROWS)
    taken = [row.at(x + j) for j in range(2 * radius + 1)]
    counts = [row.ends(at) for at in taken] if adjoint else None
    target = lanes.empty(lanes.images * lanes.samples)

    def body(k, *above):
        y = column.at(k)
        values = [lanes.take(source, start + y * lanes.across + at) for at in taken]
        if adjoint:
            values = [value * count for value, count in zip(values, counts, strict=True)]
        here = _weighed(dr, values, taps)
        if adjoint:
            here *= column.ends(y)
        found = _weighed(dr, [*above, here], taps)
        y = k - 2 * radius
        if adjoint:
            found *= dr.rcp(row.ends(x) * column.ends(y))
        at = start + y * lanes.across + x
        dr.scatter(target, found, at, active=k >= top + 2 * radius, mode=dr.ReduceMode.NoConflicts)
        return *above[1:], here

    end = dr.minimum(top + lanes.count(ROWS), lanes.count(lanes.rows)) + 2 * radius
    lanes.loop(top, end, body, *([dr.zeros(arr.Float, width)] * (2 * radius)))
    dr.eval(target)
    return target


@recorded
def _pooled(form, source):
    """Means over the squares."""
    lanes = Lanes(form)
    dr = lanes.dr
    side = lanes.count(form.stride)
    across = lanes.count(form.width)
    image, place = lanes.split(lanes.lanes(lanes.images * lanes.samples), lanes.samples)
    y, x = lanes.split(place, lanes.columns)
    corner = image * lanes.count(form.height * form.width) + (y * across + x) * side

    def body(k, total, right, down):
        total += lanes.take(source, corner + down * across + right)
        ends = right + 1 == side
        return total, dr.select(ends, 0, right + 1), dr.select(ends, down + 1, down)

    zero = dr.zeros(lanes.arr.UInt32, dr.width(place))
    begun = dr.zeros(lanes.arr.Float, dr.width(place)), zero, zero
    total, *_ = lanes.loop(zero, side * side, body, *begun)
    total *= lanes.number(1 / form.stride**2)
    dr.eval(total)
    return total


@recorded
def _spread(form, source):
    """Adjoint of ``_pooled``."""
    lanes = Lanes(form)
    dr = lanes.dr
    area = form.height * form.width
    image, place = lanes.split(lanes.lanes(lanes.images * area), area)
    row, column = lanes.split(place, form.width)
    y = lanes.split(row, form.stride)[0]
    x = lanes.split(column, form.stride)[0]
    inside = (y < lanes.count(lanes.rows)) & (x < lanes.across)
    at = image * lanes.area + y * lanes.across + x
    found = dr.gather(lanes.arr.Float, source, at, active=inside)
    found *= lanes.number(1 / form.stride**2)
    dr.eval(found)
    return found


def _weighed(dr, values, taps):
    """Sum of an odd number of values by symmetric taps."""
    radius = len(taps) - 1
    total = taps[0] * values[radius]
    for j, tap in enumerate(taps[1:], 1):
        total = dr.fma(tap, values[radius - j] + values[radius + j], total)
    return total


class _Mirrored:
    """Samples of an axis, continued by their mirror image at either end as often as ``radius`` needs."""

    def __init__(self, lanes, count, radius):
        self.lanes = lanes
        self.period = max(2 * (count - 1), 1)
        self.whole = lanes.count(self.period)
        self.shift = lanes.count(-radius % self.period)
        self.last = lanes.count(count - 1)

    def at(self, index):
        """Sample at an index that counts from ``radius`` before the first."""
        rest = self.lanes.split(index + self.shift, self.period)[1]
        return self.lanes.dr.minimum(rest, self.whole - rest)

    def ends(self, at):
        """2 at either end, 1 within."""
        return self.lanes.dr.select((at == 0) | (at == self.last), self.lanes.arr.Float(2), 1)
