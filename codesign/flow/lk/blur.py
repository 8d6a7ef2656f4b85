"""A symmetric kernel along both axes, mirrored at the border: in drjit, and as operations of torch.

A lane goes down a column: it takes the horizontal sum of each row and keeps the last ones for the
vertical sum, so nothing is stored between the two. An even continuation makes the blur A
self-adjoint for a product in which the outermost samples count half: A^T = E A E^-1, E = 1/2 at the
ends of an axis, 1 within.
"""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from codesign.exclusive import exclusive
from codesign.flow.lk.lanes import Form, Grid, Lanes, in_graph, plain_wanted, recorded, tensors

# that a lane goes down: columns of a whole image are far apart in memory
ROWS = 64


def blurred(images: Tensor, grid: Grid, taps: Sequence[float]) -> Tensor:
    """Images averaged over the squares of a grid, then blurred along both axes.

    Args:
      images: [B, n, H, W], the image that ``grid`` samples.
      taps: of a symmetric kernel, in samples: the middle one, then those to one side.
    Returns: [B, n, h, w]. Beyond the outermost samples the image is continued by its mirror image,
      again and again where the kernel is longer.
    Gradient: images; exact, the first one.
    Raises: GradientError for a second derivative.
    """
    samples = pooled(images, grid.stride)
    if plain_wanted():
        return _along_rows(_along_rows(samples, taps).mT, taps).mT
    return in_graph(_forward, _adjoint, (grid, tuple(taps)), samples)[0]


def pooled(images: Tensor, side: int) -> Tensor:
    """Means [..., H // side, W // side] over squares of images [..., H, W]."""
    if side != 2:
        return avg_pool2d(images, side) if side > 1 else images
    rows, columns = (size // 2 * 2 for size in images.shape[-2:])
    # the same numbers in a third of the time
    parts = (images[..., i:rows:2, j:columns:2] for i in (0, 1) for j in (0, 1))
    return sum(parts) / 4


def _along_rows(images, taps):
    """A symmetric kernel along the last axis, mirrored about the outermost samples as often as need
    be."""
    radius = len(taps) - 1
    size = images.shape[-1]
    place = torch.arange(-radius, size + radius) % max(2 * size - 2, 1)
    images = images[..., torch.minimum(place, 2 * size - 2 - place)]
    found = taps[0] * images.narrow(-1, radius, size)
    for shift, tap in enumerate(taps[1:], 1):
        before, after = (images.narrow(-1, radius + side, size) for side in (-shift, shift))
        found = found.add(before + after, alpha=tap)
    return found


@exclusive
def _forward(grid, taps, samples):
    form = Form.of(samples.flatten(0, 1), grid)
    found = _blurred(form, *form.load(samples), form.scalars(list(taps)))
    return tensors(samples.shape, found), ()


def _adjoint(grid, taps, samples, grads, wanted):
    rows, columns = (ends(count, samples) for count in grid.shape)
    both = rows[:, None] * columns
    ((found,), _) = _forward(grid, taps, grads[0] * both)
    return (found / both,)


def ends(count: int, like: Tensor) -> Tensor:
    """[count] 2 at either end, 1 within."""
    found = torch.ones(count).to(like)
    found[[0, -1]] = 2
    return found


@recorded
def _blurred(form, source, taps):
    """Of samples."""
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
    target = lanes.empty(lanes.images * lanes.samples)

    def body(k, *above):
        y = column.at(k)
        values = [lanes.take(source, start + y * lanes.across + at) for at in taken]
        here = _weighed(dr, values, taps)
        found = _weighed(dr, [*above, here], taps)
        y = k - 2 * radius
        at = start + y * lanes.across + x
        dr.scatter(target, found, at, active=k >= top + 2 * radius, mode=dr.ReduceMode.NoConflicts)
        return *above[1:], here

    end = dr.minimum(top + lanes.count(ROWS), lanes.count(lanes.rows)) + 2 * radius
    lanes.loop(top, end, body, *([dr.zeros(arr.Float, width)] * (2 * radius)))
    dr.eval(target)
    return target


def _weighed(dr, values, taps):
    """Sum of an odd number of values by symmetric taps."""
    radius = len(taps) - 1
    total = taps[0] * values[radius]
    for j, tap in enumerate(taps[1:], 1):
        total = dr.fma(tap, values[radius - j] + values[radius + j], total)
    return total


class _Mirrored:
    """Samples of an axis, continued by their mirror image at either end as often as ``radius``
    needs."""

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
