"""Fields on cells, smooth over many scales: the exact posterior on a quadtree (Luettgen, Karl and
Willsky, 1994).

A cell's value is its parent's plus a Gaussian step; the parents of the coarsest scale begin at
zero. What the data say of the cells goes up the tree, each scale adding its doubt; means and
covariances come down. All is linear in the number of cells. Trees see neighbours on two sides of a
coarse border as strangers, so several, shifted against each other, are averaged.

In drjit a pass is one kernel for each scale, a lane for each cell. At the cells themselves the
trees of one size of steps have the same data, so what goes up from there is found once for all of
them. The adjoint of a cell is left to drjit; how cells hang together is written down here.
"""

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from codesign.backend import pull_back
from codesign.exclusive import exclusive
from codesign.flow.lk.lanes import Form, Grid, Lanes, in_graph, plain_wanted, recorded, tensors

# of a cell: precision xx, xy, yy and pull x, y; or mean x, y and covariance xx, xy, yy
DATA = 5
# and the logarithm of the evidence
UP = DATA + 1
# cells down and right: at each of the finer scales every alignment once
SHIFTS = ((0, 0), (5, 2), (2, 7), (7, 5))


def posterior(precision: Tensor, pull: Tensor, steps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, covariance and evidence of fields on cells, for steps of several sizes.

    Args:
      precision: [B, 3, h, w] (xx, xy, yy) of what the data say of each cell by themselves, >= 0,
        float64.
      pull: [B, 2, h, w] precision times the value they say.
      steps: [scales, S] variances of the steps to each scale, cells first.
    Returns: mean [S, B, 2, h, w], covariance [S, B, 3, h, w], and the logarithm [S, B] of the
      evidence for these variances, relative to a field that is zero; covariance includes what the
      trees differ by.
    Gradient: precision, pull; exact, the first one.
    """
    data = torch.cat([precision, pull], 1)
    if plain_wanted():
        values, evidence = _plain(data, steps)
    else:
        trees = Trees(steps.shape[1], len(steps), SHIFTS)
        values, evidence = in_graph(_forward, _adjoint, (trees,), data, steps)
    return values[:, :, :2], values[:, :, 2:], evidence


class Trees(NamedTuple):
    """How many sizes of steps are tried, how many scales there are, and the cells (down, right)
    that each tree is shifted by."""

    sizes: int
    scales: int
    shifts: tuple[tuple[int, int], ...]

    def shape(self, scale: int, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of a scale above the cells."""
        side = 2 ** (self.scales - 1)
        reach = max(max(shift) for shift in self.shifts)
        rows, columns = (-(-(size + reach) // side) * side for size in (height, width))
        return rows >> scale, columns >> scale


def _plain(data, steps):
    """As operations of torch: [S, B, 5, h, w] and [S, B]."""
    scales, sizes = steps.shape
    batch, _, height, width = data.shape
    rows, columns = Trees(sizes, scales, SHIFTS).shape(0, height, width)
    shifted = [pad(data, (x, columns - width - x, y, rows - height - y)) for y, x in SHIFTS]
    trees = torch.stack(shifted, 1).flatten(0, 1).repeat(sizes, 1, 1, 1)
    evidence = data.new_zeros(len(trees))
    passed = []
    for step in steps:
        variance = step.repeat_interleave(batch * len(SHIFTS))[:, None, None]
        passed.append((variance, *trees.unbind(1)))
        *above, more = _above(torch.log, *passed[-1])
        evidence = evidence + more.sum((1, 2))
        trees = torch.stack(above, 1)
        if len(passed) < scales:
            trees = 4 * avg_pool2d(trees, 2)
    value = trees.new_zeros(len(trees), 5, *trees.shape[2:])  # mean x, y, covariance xx, xy, yy
    for number, given in enumerate(reversed(passed)):
        if number:
            value = interpolate(value, scale_factor=2.0)
        value = torch.stack(_below(*given, *value.unbind(1)), 1)
    value = value.unflatten(0, (sizes, batch, len(SHIFTS)))
    each = torch.stack(
        [value[:, :, k, :, y : y + height, x : x + width] for k, (y, x) in enumerate(SHIFTS)], 2
    )
    mean = each.mean(2)
    x, y = (each[:, :, :, :2] - mean[:, :, None, :2]).unbind(3)
    differ = torch.stack([x * x, x * y, y * y], 3).mean(2)
    evidence = evidence.unflatten(0, (sizes, batch, len(SHIFTS))).mean(2)
    return torch.cat([mean[:, :, :2], mean[:, :, 2:] + differ], 2), evidence


@exclusive
def _forward(trees, data, steps):
    """Mean and covariance [S, B, 5, h, w] and evidence [S, B] of data [B, 5, h, w], and what the
    adjoint needs."""
    batch, _, height, width = data.shape
    form = Form.of(data, Grid(height, width))
    found = _up_and_down(form, trees, *form.load(data, steps))
    each = trees.sizes, batch, len(trees.shifts)
    shapes = [trees.shape(scale, height, width) for scale in range(1, trees.scales)]
    (values,) = tensors((trees.sizes, *data.shape), found[0])
    (evidence,) = tensors((*each, *shapes[-1]), found[1])
    kept = [
        tensors((*each, DATA, *shape), array)[0]
        for shape, array in zip([*shapes, *shapes], found[2:], strict=True)
    ]
    return [values, evidence.sum((3, 4)).mean(2)], kept


@exclusive
def _adjoint(trees, data, steps, *rest):
    *kept, grads, _ = rest
    shapes = (trees.sizes, *data.shape), (trees.sizes, len(data))
    grads = [
        data.new_zeros(shape) if by is None else by for by, shape in zip(grads, shapes, strict=True)
    ]
    form = Form.of(data, Grid(*data.shape[2:]))
    found = _gradients(form, trees, *form.load(data, steps, *grads, *kept))
    return tensors(shapes[0], found)[0].sum(0), None


@recorded
def _up_and_down(form, trees, data, variances):
    scales = [_Cells(form, trees, variances, scale) for scale in range(trees.scales)]
    dr = scales[0].dr
    summed = []
    up = scales[0].stored(scales[0].above(*scales[0].data(data)))
    dr.eval(up)
    for below, cells in pairwise(scales):
        *given, evidence = cells.of_children(below, up, UP)
        *up, more = cells.above(*given)
        evidence = evidence + more
        summed.append(cells.stored(given))
        up = cells.stored([*up, evidence])
        dr.eval(summed[-1], up, evidence)
    values = []
    for cells in reversed(scales[1:]):
        parent = cells.of_parent(scales[cells.scale + 1], values[0]) if values else [0] * DATA
        found = cells.below(*cells.loaded(summed[cells.scale - 1]), *parent)
        values.insert(0, cells.stored(found))
        dr.eval(values[0])
    cells = scales[0]
    parents = cells.of_parents(scales[1], values[0])
    found = cells.stored(cells.mean_below(*cells.data(data), *parents))
    dr.eval(found)
    return found, evidence, *summed, *values


@recorded
def _gradients(form, trees, data, variances, by_values, by_evidence, *kept):
    scales = [_Cells(form, trees, variances, scale) for scale in range(trees.scales)]
    summed = [data, *kept[: trees.scales - 1]]
    values = [None, *kept[trees.scales - 1 :]]
    cells = scales[0]
    dr = cells.dr
    none = [dr.zeros(cells.arr.Float)] * DATA
    given = [*cells.data(data), *cells.of_parents(scales[1], values[1])]
    found = pull_back(cells.mean_below, given, cells.loaded(by_values))
    grads = [cells.stored(found[:DATA])]
    down = cells.stored(found[DATA:])
    dr.eval(grads[0], down)
    for below, cells in pairwise(scales):
        top = cells is scales[-1]
        parent = none if top else cells.of_parent(scales[cells.scale + 1], values[cells.scale + 1])
        given = [*cells.loaded(summed[cells.scale]), *parent]
        found = pull_back(cells.below, given, cells.of_children(below, down, DATA, apart=True))
        grads.append(cells.stored(found[:DATA]))
        down = cells.stored(found[DATA:])
        dr.eval(grads[-1], down)
    for cells in reversed(scales):
        seeds = none
        if cells is not scales[-1]:
            every = cells.of_parent if cells.scale else cells.of_parents
            seeds = every(scales[cells.scale + 1], grads[cells.scale + 1])
            seeds = [sum(seeds[part::DATA]) for part in range(DATA)]
        given = cells.loaded(summed[cells.scale]) if cells.scale else cells.data(data)
        found = pull_back(cells.above, given, [*seeds, cells.of_evidence(by_evidence)])
        so_far = cells.loaded(grads[cells.scale])
        grads[cells.scale] = cells.stored([a + b for a, b in zip(found, so_far, strict=True)])
        dr.eval(grads[cells.scale])
    return grads[0]


class _Cells(Lanes):
    """The cells of one scale: of all trees, or at scale 0, where their data are the same, of all
    sizes and images."""

    def __init__(self, form, trees, variances, scale):
        super().__init__(form)
        self.scale = scale
        self.trees = len(trees.shifts)
        self.shifts = trees.shifts
        self.sets = trees.sizes * form.images * (self.trees if scale else 1)
        shape = trees.shape(scale, form.height, form.width) if scale else (form.height, form.width)
        self.cells = shape[0] * shape[1]
        self.total = self.sets * self.cells
        self.plane = self.count(self.cells)
        self.high, self.wide = (self.count(size) for size in shape)
        self.set, self.place = self.split(self.lanes(self.total), self.cells)
        self.y, self.x = self.split(self.place, shape[1])
        self.whole, self.tree = self.split(self.set, self.trees) if scale else (self.set, None)
        size, self.image = self.split(self.whole, form.images)
        self.variance = self.take(variances, self.count(scale * trees.sizes) + size)

    def stored(self, parts):
        """[sets, parts, cells]."""
        target = self.empty(len(parts) * self.total)
        for number, part in enumerate(parts):
            self.put(target, part, (self.set * len(parts) + number) * self.plane + self.place)
        return target

    def loaded(self, array):
        """Of [sets, 5, cells]."""
        return [
            self.take(array, (self.set * DATA + part) * self.plane + self.place)
            for part in range(DATA)
        ]

    def data(self, array):
        """Of [B, 5, cells]."""
        return [
            self.take(array, (self.image * DATA + part) * self.plane + self.place)
            for part in range(DATA)
        ]

    def of_evidence(self, array):
        """Of [sizes, B], a mean over trees."""
        return self.take(array, self.whole) * (1 / self.trees if self.scale else 1)

    def of_children(self, below, array, parts, apart=False):
        """Sums over the four children of [sets, parts, cells]; ``apart``: at scale 0 [sets, trees,
        parts, cells]."""
        dr = self.dr
        found = [dr.zeros(self.arr.Float)] * parts
        chosen = self.set if below.scale or apart else self.whole
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
            y = 2 * self.y + down
            x = 2 * self.x + right
            if not below.scale:
                y -= self.shift(0)
                x -= self.shift(1)
            # below 0 whole numbers begin again from the largest
            inside = (y < below.high) & (x < below.wide)
            place = y * below.wide + x
            for part in range(parts):
                at = (chosen * parts + part) * below.plane + place
                found[part] = found[part] + dr.gather(self.arr.Float, array, at, active=inside)
        return found

    def of_parents(self, above, array):
        """At scale 0: ``of_parent`` of one tree after the other."""
        return [part for tree in range(self.trees) for part in self.of_parent(above, array, tree)]

    def of_parent(self, above, array, tree=0):
        """Of [sets, 5, cells] of the scale above; ``tree``: of this one, at scale 0."""
        chosen = self.set
        y = self.y
        x = self.x
        if not self.scale:
            chosen = chosen * self.trees + tree
            y = y + self.shifts[tree][0]
            x = x + self.shifts[tree][1]
        place = (y >> 1) * above.wide + (x >> 1)
        return [
            self.take(array, (chosen * DATA + part) * above.plane + place) for part in range(DATA)
        ]

    def shift(self, axis):
        """Of each lane's tree."""
        found = self.arr.UInt32(0)
        for number, shift in enumerate(self.shifts):
            found = self.dr.select(self.tree == number, shift[axis], found)
        return found

    def above(self, *given):
        return _above(self.dr.log, self.variance, *given)

    def below(self, *given):
        return _below(self.variance, *given)

    def mean_below(self, *given):
        """Mean and covariance over trees with the same data, and what they differ by."""
        data = given[:DATA]
        each = [self.below(*data, *given[k : k + DATA]) for k in range(DATA, len(given), DATA)]
        x, y, xx, xy, yy = (sum(part) / self.trees for part in zip(*each, strict=True))
        for here_x, here_y, *_ in each:
            xx = xx + (here_x - x) ** 2 / self.trees
            xy = xy + (here_x - x) * (here_y - y) / self.trees
            yy = yy + (here_y - y) ** 2 / self.trees
        return x, y, xx, xy, yy


def _above(log, variance, xx, xy, yy, px, py):
    """What cells say of their parents, and the logarithm of their evidence."""
    (a, b, d), scale = _gain(variance, xx, xy, yy)
    x, y = _times((a, b, d), px, py)
    evidence = _fma(variance, _fma(px, x, py * y), log(scale)) / 2
    return _fma(a, xx, b * xy), _fma(a, xy, b * yy), _fma(b, xy, d * yy), x, y, evidence


def _below(variance, xx, xy, yy, px, py, x, y, uu, uv, vv):
    """Mean and covariance of cells, from what is summed up there and the mean and covariance of
    their parents."""
    (a, b, d), _ = _gain(variance, xx, xy, yy)
    mean = _times((a, b, d), _fma(variance, px, x), _fma(variance, py, y))
    first = _times((a, b, d), uu, uv)
    second = _times((a, b, d), uv, vv)
    return (
        *mean,
        _fma(variance, a, _fma(a, first[0], b * second[0])),
        _fma(variance, b, _fma(b, first[0], d * second[0])),
        _fma(variance, d, _fma(b, first[1], d * second[1])),
    )


def _gain(variance, xx, xy, yy):
    """(1 + variance P)^-1 and its determinant."""
    a = 1 + variance * xx
    b = variance * xy
    d = 1 + variance * yy
    scale = 1 / (a * d - b * b)
    return (d * scale, -b * scale, a * scale), scale


def _times(matrix, x, y):
    """A symmetric matrix (xx, xy, yy) times (x, y)."""
    return _fma(matrix[0], x, matrix[1] * y), _fma(matrix[1], x, matrix[2] * y)


def _fma(a, b, c):
    return torch.addcmul(c, a, b) if isinstance(c, Tensor) else a * b + c
