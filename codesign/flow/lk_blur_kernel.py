"""Means over squares and a symmetric kernel along both axes, mirrored at the border, in drjit; forward and adjoint.

A lane goes down a column: it takes the horizontal sum of each row and keeps the last ones for the vertical sum, so
nothing is stored between the two. An even continuation makes the blur A self-adjoint for a product in which the
outermost samples count half: A^T = E A E^-1, E = 1/2 at the ends of an axis, 1 within.
"""

from collections.abc import Sequence

from torch import Tensor

from codesign.flow.lk_lanes import Grid, Lanes

ROWS = 64  # that a lane goes down: columns of a whole image are far apart in memory


def forward(images: Tensor, grid: Grid, taps: Sequence[float]) -> Tensor:
    """[N, h, w] of images [N, H, W]; ``taps``: the middle one, then those to one side."""
    return _blurred(_pooled(images, grid) if grid.stride > 1 else images, grid, taps, adjoint=False)


def adjoint(grad: Tensor, grid: Grid, taps: Sequence[float]) -> Tensor:
    """[N, H, W], of a gradient [N, h, w]."""
    found = _blurred(grad, grid, taps, adjoint=True)
    return _spread(found, grid) if grid.stride > 1 else found


def _blurred(images, grid, taps, adjoint):
    lanes = Lanes(images, grid)
    dr = lanes.dr
    arr = lanes.arr
    radius = len(taps) - 1
    blocks = -(-lanes.rows // ROWS)
    width = lanes.images * blocks * lanes.columns
    with dr.suspend_grad():
        source = lanes.load(images)
        taps = [lanes.number(tap) for tap in taps]
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
        return lanes.tensors((lanes.images, *grid.shape), target)[0]


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


def _pooled(images, grid):
    """Means over the squares."""
    lanes = Lanes(images, grid)
    dr = lanes.dr
    with dr.suspend_grad():
        source = lanes.load(images)
        side = lanes.count(grid.stride)
        across = lanes.count(grid.width)
        image, place = lanes.split(lanes.lanes(lanes.images * lanes.samples), lanes.samples)
        y, x = lanes.split(place, lanes.columns)
        corner = image * lanes.count(grid.height * grid.width) + (y * across + x) * side

        def body(k, total, right, down):
            total += lanes.take(source, corner + down * across + right)
            ends = right + 1 == side
            return total, dr.select(ends, 0, right + 1), dr.select(ends, down + 1, down)

        zero = dr.zeros(lanes.arr.UInt32, dr.width(place))
        begun = dr.zeros(lanes.arr.Float, dr.width(place)), zero, zero
        total, *_ = lanes.loop(zero, side * side, body, *begun)
        total *= lanes.number(1 / grid.stride**2)
        return lanes.tensors((lanes.images, *grid.shape), total)[0]


def _spread(grad, grid):
    """Adjoint of ``_pooled``."""
    lanes = Lanes(grad, grid)
    dr = lanes.dr
    area = grid.height * grid.width
    with dr.suspend_grad():
        image, place = lanes.split(lanes.lanes(lanes.images * area), area)
        row, column = lanes.split(place, grid.width)
        y = lanes.split(row, grid.stride)[0]
        x = lanes.split(column, grid.stride)[0]
        inside = (y < lanes.count(lanes.rows)) & (x < lanes.across)
        at = image * lanes.area + y * lanes.across + x
        found = dr.gather(lanes.arr.Float, lanes.load(grad), at, active=inside)
        found *= lanes.number(1 / grid.stride**2)
        return lanes.tensors((lanes.images, grid.height, grid.width), found)[0]
