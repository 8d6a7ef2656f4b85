"""From the field at the mean place of the events to flow, covariance and confidence on the pixels
of the start: in drjit, and as operations of torch.

A lane goes down a part of a column with the coefficients of its image at hand; in the adjoint it
sums up their gradients. The adjoint of a pixel, all rounds of its fixed point included, is left to
drjit but for the cells, whose four values around a place are added to at once (as in ``warp``).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from codesign.backend import pull_back
from codesign.exclusive import exclusive
from codesign.flow.lk.cells import CELL, Cells
from codesign.flow.lk.lanes import Form, Grid, Lanes, in_graph, plain_wanted, recorded, tensors
from codesign.flow.lk.polynomials import FIXED_POINT_STEPS, Polynomials
from codesign.flow.warp import read_at

# flow x, y, covariance xx, xy, yy, confidence
OUT = 6
# flow x, y, covariance xx, xy, yy
OF_CELL = 5
# that a lane goes down
ROWS = 64


@dataclass(frozen=True)
class Setting:
    """powers: of x and y in the basis of the flow, and in that of its variances. rows, columns: of
    the cells.
    cell_px: their side. rounds: of the fixed point. joined: whether cells are part of the field."""

    powers: tuple[tuple[int, int], ...]
    of_variance: tuple[tuple[int, int], ...]
    rows: int
    columns: int
    cell_px: int
    rounds: int
    joined: bool

    @property
    def of_flow(self) -> int:
        """Coefficients that the flow depends on: how far an image is from its start, and the
        polynomials' own."""
        return 1 + 2 * len(self.powers)

    @property
    def numbers(self) -> int:
        """All coefficients of an image: then those of xx, xy, yy and the widest trace."""
        return self.of_flow + 4 * len(self.of_variance)


def at_start(
    shape: Polynomials,
    parameters: Tensor,
    spread: Tensor,
    cells: Cells,
    joined: bool,
    start: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Flow, its covariance, and confidence.

    Args:
      parameters: [B, 2K] px per way, and spread: [B, 2K, 2K] their covariance.
      cells: what is known of the field beside the polynomial.
      joined: whether they are part of the flow; else their mean is error.
      start: [B] place of the start on the way.
    Returns: flow [B, 2, H, W] px per way, by ``Polynomials.at_start``; covariance [B, 3, H, W] of
      polynomial and cells; confidence [B, H, W] in [0, 1], 1 - trace(covariance) /
      trace(prior covariance).
    Gradient: parameters, spread, cells, start; exact, the first one.
    """
    prior = (shape.unit @ shape.unit.T).to(parameters)[None]
    xx, xy, yy = shape.squares(spread.to(parameters))
    widest = shape.squares(prior)
    widest = widest[0] + widest[2]
    widest[:, 0] += 2 * cells.widest
    of_flow = torch.cat([-start.to(parameters)[:, None], parameters], 1)
    of_rest = torch.cat([xx, xy, yy, widest.expand_as(xx)], 1)
    powers = tuple(tuple(pair) for pair in shape.powers.tolist())
    setting = Setting(
        powers, shape.of_squares, *cells.value.shape[2:], CELL, FIXED_POINT_STEPS, joined
    )
    of_cells = cells.value.to(parameters), cells.covariance.to(parameters)
    grid = Grid(shape.height, shape.width)
    if plain_wanted():
        images = _PlainPixels(grid, setting, torch.cat(of_cells, 1))
        given = torch.cat([of_flow, of_rest], 1)[:, :, None, None].unbind(1)
        found = torch.stack(torch.broadcast_tensors(*images.outcome(given, images.y, None)), 1)
        return found[:, :2], found[:, 2:5], found[:, 5]
    flow, rest = in_graph(_forward, _adjoint, (grid, setting), of_flow, of_rest, *of_cells)
    return flow, rest[:, :3], rest[:, 3]


@exclusive
def _forward(grid, setting, of_flow, of_rest, value, covariance):
    form = Form.of(of_flow, grid)
    cells = torch.cat([value, covariance], 1)
    corners = torch.stack([cells[part] for part in _corners(setting)], 4)
    given = torch.cat([of_flow, of_rest], 1), corners
    flow, rest = _outcomes(form, setting, *form.load(*given))
    shapes = [(form.images, parts, *grid.shape) for parts in (2, OUT - 2)]
    return [*tensors(shapes[0], flow), *tensors(shapes[1], rest)], given


@exclusive
def _adjoint(
    grid, setting, of_flow, of_rest, value, covariance, coefficients, corners, grads, wanted
):
    """Most who follow a gradient follow that of the flow alone: what it does not depend on has
    none."""
    by_flow, by_rest = grads
    by_flow = torch.zeros_like(by_rest[:, :2]) if by_flow is None else by_flow
    form = Form.of(of_flow, grid)
    live = form.load(by_flow) if by_rest is None else form.load(by_flow, by_rest)
    sums, slots = _gradients(form, setting, *form.load(coefficients, corners), *live)
    numbers = setting.of_flow if by_rest is None else setting.numbers
    (sums,) = tensors((numbers, form.images, -(-grid.height // ROWS) * grid.width), sums)
    (slots,) = tensors(corners.shape, slots)
    of_cells = corners.new_zeros(form.images, OF_CELL, setting.rows, setting.columns)
    for part, slot in zip(_corners(setting), slots.unbind(4), strict=True):
        of_cells[part] += slot
    by_coefficients = sums.sum(2).T
    if by_rest is None:
        return by_coefficients, None, of_cells[:, :2] if setting.joined else None, None
    return *by_coefficients.tensor_split([setting.of_flow], 1), *of_cells.tensor_split([2], 1)


def _corners(setting):
    """Where the four cells around places are: the upper left one's neighbours as slices."""
    sizes = setting.rows, setting.columns
    first, second = ((slice(0, max(size - 1, 1)), slice(min(1, size - 1), size)) for size in sizes)
    return [(..., y, x) for y in first for x in second]


@recorded
def _outcomes(form, setting, coefficients, cells):
    pixels = _Pixels(form, setting, cells)
    dr = pixels.dr
    given = pixels.coefficients(coefficients)
    flow, rest = (pixels.empty(parts * pixels.images * pixels.samples) for parts in (2, OUT - 2))

    def body(y):
        values = pixels.outcome(given, pixels.arr.Float(y), None)
        for part, value in enumerate(values[:2]):
            pixels.put(flow, value, pixels.at(part, y, 2))
        for part, value in enumerate(values[2:]):
            pixels.put(rest, value, pixels.at(part, y, OUT - 2))
        return ()

    pixels.loop(pixels.top, pixels.end, body)
    dr.eval(flow, rest)
    return flow, rest


@recorded
def _gradients(form, setting, coefficients, cells, by_flow, by_rest=None):
    pixels = _Pixels(form, setting, cells)
    dr = pixels.dr
    numbers = setting.of_flow if by_rest is None else setting.numbers
    given = pixels.coefficients(coefficients)[:numbers]
    slots = dr.zeros(pixels.arr.Float, 4 * OF_CELL * pixels.images * pixels.slots)
    # processors need no locks where each thread has a copy
    mode = dr.ReduceMode.Expand if form.device == "cpu" else dr.ReduceMode.Auto

    def body(y, *sums):
        read = _Read([], [])
        seeds = [pixels.take(by_flow, pixels.at(part, y, 2)) for part in range(2)]
        if by_rest is not None:
            seeds += [pixels.take(by_rest, pixels.at(part, y, OUT - 2)) for part in range(OUT - 2)]

        def outcome(*given):
            row = pixels.arr.Float(y)
            return (
                pixels.flow(given, row, read)[0]
                if by_rest is None
                else pixels.outcome(given, row, read)
            )

        found = pull_back(outcome, given, seeds, read.values)
        of_cells = found[numbers:]
        for number, slot in enumerate(read.slots):
            four = pixels.arr.Array4(*of_cells[4 * number : 4 * number + 4])
            dr.scatter_add(slots, four, slot, mode=mode)
        return [total + more for total, more in zip(sums, found, strict=False)]

    sums = pixels.loop(
        pixels.top, pixels.end, body, *[dr.zeros(pixels.arr.Float, pixels.lane_count)] * numbers
    )
    target = pixels.empty(numbers * pixels.lane_count)
    for number, total in enumerate(sums):
        pixels.put(target, total, pixels.count(number * pixels.lane_count) + pixels.lane)
    dr.eval(target, slots)
    return target, slots


class _Read(NamedTuple):
    """Slots of cells that were read, and the four values of each."""

    slots: list[Any]
    values: list[Any]


class _Outcome:
    """What is found at pixels, by the numbers ``x``, ``middle``, ``per_half`` and ``setting`` and
    the operations ``fma``, ``share`` (cut off at 0 and 1) and ``of_cells`` of its kinds."""

    def flow(self, given, y, read):
        """Flow on a pixel of the start, and where that is at the mean place. ``read`` takes what
        cells gave."""
        back, *given = given
        terms = len(self.setting.powers)
        field = given[:terms], given[terms : 2 * terms]
        joined = self.setting.joined
        flow = 0, 0
        for _ in range(self.setting.rounds + 1):
            place = self.x + back * flow[0], y + back * flow[1]
            flow = self.polynomials(field, self.setting.powers, place)
            if joined:
                flow = [
                    a + b for a, b in zip(flow, self.of_cells(place, (0, 1), read), strict=True)
                ]
        return flow, place

    def outcome(self, given, y, read):
        """The six values of a pixel; ``read`` takes what cells gave."""
        flow, place = self.flow(given, y, read)
        size = len(self.setting.of_variance)
        rest = given[self.setting.of_flow :]
        rest = [rest[k * size : (k + 1) * size] for k in range(4)]
        xx, xy, yy, widest = self.polynomials(rest, self.setting.of_variance, place)
        of_xx, of_xy, of_yy = self.of_cells(place, (2, 3, 4), read)
        xx = xx + of_xx
        xy = xy + of_xy
        yy = yy + of_yy
        if not self.setting.joined:
            part_x, part_y = self.of_cells(place, (0, 1), read)
            xx = xx + part_x * part_x
            xy = xy + part_x * part_y
            yy = yy + part_y * part_y
        return *flow, xx, xy, yy, self.share(1 - (xx + yy) / widest)

    def polynomials(self, rows, powers, place):
        """Values of several polynomials with the same powers."""
        u, v = (
            (at - middle) * self.per_half for at, middle in zip(place, self.middle, strict=True)
        )
        of_u = _powers(u, max(x for x, _ in powers))
        of_v = _powers(v, max(y for _, y in powers))
        found = [row[0] for row in rows]  # of power 0
        for number, (x, y) in list(enumerate(powers))[1:]:
            value = of_v[y] if not x else of_u[x] if not y else of_u[x] * of_v[y]
            found = [
                self.fma(row[number], value, total) for row, total in zip(rows, found, strict=True)
            ]
        return found


class _PlainPixels(_Outcome):
    """All pixels of images, as tensors."""

    def __init__(self, grid, setting, cells):
        """Args: cells: [B, 5, rows, columns]."""
        self.setting = setting
        self.cells = cells
        self.y, self.x = torch.meshgrid(
            torch.arange(grid.height).to(cells), torch.arange(grid.width).to(cells), indexing="ij"
        )
        self.middle = (grid.width - 1) / 2, (grid.height - 1) / 2
        self.per_half = 2 / max(grid.height, grid.width)

    def fma(self, a, b, c):
        return torch.addcmul(c, a, b)

    def share(self, value):
        return value.clamp(0, 1)

    def of_cells(self, place, parts, read):
        at = (torch.stack(place, 1) + 0.5) / CELL - 0.5
        return read_at(self.cells[:, parts], at).unbind(1)


class _Pixels(_Outcome, Lanes):
    """Parts of columns of images, and what is found at a pixel of them."""

    def __init__(self, form, setting, cells):
        """Args: cells: [B, 5, slots, 4], the four values around a place of each slot."""
        super().__init__(form)
        self.setting = setting
        self.cells = cells
        blocks = -(-self.rows // ROWS)
        self.lane_count = self.images * blocks * self.columns
        self.lane = self.lanes(self.lane_count)
        block, x = self.split(self.lane, self.columns)
        self.image, block = self.split(block, blocks)
        self.x = self.arr.Float(x)
        self.column = x
        self.top = block * self.count(ROWS)
        self.end = self.dr.minimum(self.top + self.count(ROWS), self.count(self.rows))
        self.slots = max(setting.rows - 1, 1) * max(setting.columns - 1, 1)
        self.middle = [self.number((size - 1) / 2) for size in (self.columns, self.rows)]
        self.per_half = self.number(2 / max(self.rows, self.columns))
        self.per_cell = self.number(1 / setting.cell_px)
        self.first = self.number((1 - setting.cell_px) / (2 * setting.cell_px))
        self.slots_wide = self.count(max(setting.columns - 1, 1))
        self.slot_plane = self.count(self.slots)
        self.last = [self.number(size - 1) for size in (setting.columns, setting.rows)]
        self.last_lower = [self.count(max(size, 2) - 2) for size in (setting.columns, setting.rows)]

    def coefficients(self, array):
        start = self.image * self.setting.numbers
        return [self.take(array, start + number) for number in range(self.setting.numbers)]

    def at(self, part, y, parts):
        """Of [B, parts, H, W]."""
        return (self.image * parts + part) * self.area + y * self.across + self.column

    def fma(self, a, b, c):
        return self.dr.fma(a, b, c)

    def share(self, value):
        return self.dr.clip(value, 0, 1)

    def of_cells(self, place, parts, read):
        """Bilinear values of the cells' ``parts``, beyond the outermost as there."""
        dr = self.dr
        (x, a), (y, b) = (
            self.along(at, last, lower)
            for at, last, lower in zip(place, self.last, self.last_lower, strict=True)
        )
        found = []
        for part in parts:
            slot = (self.image * OF_CELL + part) * self.slot_plane + y * self.slots_wide + x
            four = list(dr.gather(self.arr.Array4, self.cells, slot))
            if read is not None:
                four = [dr.detach(value) + 0 for value in four]
                dr.enable_grad(four)
                read.slots.append(slot)
                read.values.extend(four)
            upper = dr.fma(a, four[1] - four[0], four[0])
            lower = dr.fma(a, four[3] - four[2], four[2])
            found.append(dr.fma(b, lower - upper, upper))
        return found

    def along(self, at, last, last_lower):
        dr = self.dr
        at = dr.clip(dr.fma(at, self.per_cell, self.first), 0, last)
        lower = dr.minimum(self.arr.UInt32(dr.detach(at)), last_lower)
        return lower, at - self.arr.Float(lower)


def _powers(value, most):
    """[1, value, value^2, ...]; the 1 is not used."""
    found = [1, value]
    while len(found) <= most:
        found.append(found[-1] * value)
    return found
