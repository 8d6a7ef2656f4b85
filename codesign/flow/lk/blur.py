"""A symmetric kernel along both axes, mirrored at the border: in drjit, and as operations of torch.

A lane goes down four columns: it takes the horizontal sums of each row and keeps the last ones for the
vertical sums, so nothing is stored between the two. It reads what it needs of a row four values at
once, from rows that are continued beforehand; one by one takes three times as long. An even continuation makes the blur A
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
# columns of a lane: of a row they are read at once, with those around
GROUP = 4


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
    if plain_wanted():
        return _along_rows(_along_rows(pooled(images, grid.stride), taps).mT, taps).mT
    return in_graph(_forward, _adjoint, (grid, tuple(taps)), images)[0]


def pooled(images: Tensor, side: int) -> Tensor:
    """Means [..., H // side, W // side] over squares of images [..., H, W]."""
    return avg_pool2d(images, side) if side > 1 else images


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
def _forward(grid, taps, images):
    form = Form.of(images.flatten(0, 1), grid)
    found = _blurred(form, *form.load(images), form.scalars(list(taps)))
    return tensors((*images.shape[:2], *grid.shape), found), ()


@exclusive
def _adjoint(grid, taps, images, grads, wanted):
    form = Form.of(images.flatten(0, 1), grid)
    return tensors(images.shape, _gradient(form, *form.load(grads[0]), form.scalars(list(taps))))


def ends(count: int, like: Tensor) -> Tensor:
    """[count] 2 at either end, 1 within."""
    found = torch.ones(count).to(like)
    found[[0, -1]] = 2
    return found


@recorded
def _blurred(form, images, taps):
    """Means over squares, in the order of rows as torch takes them, and their blur."""
    lanes = Lanes(form)
    side, wide, high = (lanes.count(size) for size in (form.stride, form.width, form.height))

    def mean(line, x):
        if form.stride == 1:
            return lanes.take(images, line * wide + x)
        image, y = lanes.split(line, lanes.rows)
        first = (image * high + y * side) * wide + x * side
        parts = [first + i * wide + j for i in range(form.stride) for j in range(form.stride)]
        return sum(lanes.take(images, part) for part in parts) / lanes.number(form.stride**2)

    return _along_both(lanes, mean, taps)


@recorded
def _gradient(form, grad, taps):
    """Of images."""
    lanes = Lanes(form)
    dr = lanes.dr
    last = lanes.count(lanes.columns - 1), lanes.count(lanes.rows - 1)

    def doubled(line, x):
        y = lanes.split(line, lanes.rows)[1]
        return lanes.take(grad, line * lanes.across + x) * _at_ends(dr, (x, y), last, 2)

    found = _along_both(lanes, doubled, taps, last)
    if form.stride == 1:
        return found
    line, x = lanes.split(lanes.lanes(lanes.images * form.height * form.width), form.width)
    image, y = lanes.split(line, form.height)
    y, x = (lanes.split(at, form.stride)[0] for at in (y, x))
    inside = (y < lanes.count(lanes.rows)) & (x < lanes.across)
    at = image * lanes.area + y * lanes.across + x
    found = dr.gather(lanes.arr.Float, found, at, active=inside) / lanes.number(form.stride**2)
    dr.eval(found)
    return found


def _at_ends(dr, place, last, factor):
    """The factor for either axis at an end of which a sample is."""
    x, y = (
        dr.select((at == 0) | (at == end), factor, 1.0) for at, end in zip(place, last, strict=True)
    )
    return x * y


def _along_both(lanes, sample, taps, last=None):
    """Of samples by row (of all images) and column; halved at both ends of each axis, where these
    are given."""
    dr, arr = lanes.dr, lanes.arr
    radius = len(taps) - 1
    # groups beyond either end that a group's kernel reaches into
    beyond = -(-radius // GROUP)
    groups = -(-lanes.columns // GROUP)
    across = groups + 2 * beyond
    column = _mirrored(lanes, lanes.columns, GROUP * beyond)
    row = _mirrored(lanes, lanes.rows, radius)
    line, x = lanes.split(lanes.lanes(lanes.images * lanes.rows * GROUP * across), GROUP * across)
    source = sample(line, column(x))
    blocks = -(-lanes.rows // ROWS)
    block, group = lanes.split(lanes.lanes(lanes.images * blocks * groups), groups)
    image, block = lanes.split(block, blocks)
    high, wide = lanes.count(lanes.rows), lanes.count(across)
    top = block * lanes.count(ROWS)
    whole, in_row, mode = lanes.columns % GROUP == 0, lanes.count(groups), dr.ReduceMode.NoConflicts
    target = lanes.empty(lanes.images * lanes.samples)
    dr.eval(source)

    def body(k, *above):
        at = (image * high + row(k)) * wide + group
        packets = (dr.gather(arr.Array4, source, at + j) for j in range(2 * beyond + 1))
        values = [value for packet in packets for value in packet][GROUP * beyond - radius :]
        y = k - 2 * radius
        line = image * high + y
        inside = k >= top + 2 * radius
        kept, found = [], []
        for j in range(GROUP):
            here = _weighed(dr, values[j : j + 2 * radius + 1], taps)
            so_far = [*above[2 * radius * j : 2 * radius * (j + 1)], here]
            kept += so_far[1:]
            x = GROUP * group + j
            factor = 1 if last is None else _at_ends(dr, (x, y), last, 0.5)
            found.append(_weighed(dr, so_far, taps) * factor)
            if not whole:
                there = inside & (x < lanes.across)
                dr.scatter(target, found[j], line * lanes.across + x, there, mode=mode)
        if whole:
            dr.scatter(target, arr.Array4(found), line * in_row + group, inside, mode=mode)
        return kept

    end = dr.minimum(top + lanes.count(ROWS), high) + 2 * radius
    none = dr.zeros(arr.Float, lanes.images * blocks * groups)
    lanes.loop(top, end, body, *([none] * (2 * radius * GROUP)))
    dr.eval(target)
    return target


def _weighed(dr, values, taps):
    """Sum of an odd number of values by symmetric taps."""
    radius = len(taps) - 1
    total = taps[0] * values[radius]
    for j, tap in enumerate(taps[1:], 1):
        total = dr.fma(tap, values[radius - j] + values[radius + j], total)
    return total


def _mirrored(lanes, count, before):
    """Function from an index, which counts from ``before`` ahead of the first sample of an axis, to
    the sample; the axis is continued by its mirror image at either end as often as need be."""
    period = max(2 * (count - 1), 1)
    whole, shift = lanes.count(period), lanes.count(-before % period)

    def at(index):
        rest = lanes.split(index + shift, period)[1]
        return lanes.dr.minimum(rest, whole - rest)

    return at
