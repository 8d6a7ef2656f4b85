"""Flow, covariance and confidence of every pixel in drjit: the step to the pixels of the start; forward and adjoint.

A lane goes down a part of a column with the coefficients of its image at hand; in the adjoint it sums up their
gradients. The adjoint of a pixel, all rounds of its fixed point included, is left to drjit but for the cells, whose four
values around a place are added to at once (as in lk_warp_kernel).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from codesign.flow.lk_lanes import Form, Grid, Lanes, recorded, tensors

OUT = 6  # flow x, y, covariance xx, xy, yy, confidence
OF_CELL = 5  # flow x, y, covariance xx, xy, yy
ROWS = 64  # that a lane goes down


@dataclass(frozen=True)
class Setting:
    """powers: of x and y in the basis of the flow, and in that of its variances. rows, columns: of the cells.
    cell_px: their side. rounds: of the fixed point. joined: whether cells are part of the field."""

    powers: tuple[tuple[int, int], ...]
    of_variance: tuple[tuple[int, int], ...]
    rows: int
    columns: int
    cell_px: int
    rounds: int
    joined: bool

    @property
    def numbers(self) -> int:
        """Coefficients of an image: how far it is from its start, those of the flow, xx, xy, yy and the widest trace."""
        return 1 + 2 * len(self.powers) + 4 * len(self.of_variance)


def forward(coefficients: Tensor, cells: Tensor, grid: Grid, setting: Setting) -> Tensor:
    """[B, 6, H, W] of [B, numbers] and cells [B, 5, rows, columns]."""
    form = Form.of(coefficients, grid)
    found = _forward(form, setting, *form.load(coefficients, cells))
    return tensors((len(cells), OUT, *grid.shape), found)[0]


def adjoint(
    coefficients: Tensor, cells: Tensor, grid: Grid, setting: Setting, grad: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients of coefficients and cells."""
    form = Form.of(coefficients, grid)
    sums, slots = _adjoint(form, setting, *form.load(coefficients, cells, grad))
    blocks = -(-grid.height // ROWS)
    (sums,) = tensors((setting.numbers, len(cells), blocks * grid.width), sums)
    rows, columns = max(setting.rows - 1, 1), max(setting.columns - 1, 1)
    (slots,) = tensors((len(cells), OF_CELL, rows, columns, 4), slots)
    of_cells = torch.zeros_like(cells)
    for corner, slot in enumerate(slots.unbind(4)):
        y = min(corner // 2, setting.rows - 1)
        x = min(corner % 2, setting.columns - 1)
        of_cells[:, :, y : y + rows, x : x + columns] += slot
    return sums.sum(2).T, of_cells


@recorded
def _forward(form, setting, coefficients, cells):
    pixels = _Pixels(form, setting, cells)
    dr = pixels.dr
    given = pixels.coefficients(coefficients)
    target = pixels.empty(OUT * pixels.images * pixels.samples)

    def body(y):
        for part, value in enumerate(pixels.outcome(given, pixels.arr.Float(y), None)):
            pixels.put(target, value, pixels.at(part, y))
        return ()

    pixels.loop(pixels.top, pixels.end, body)
    dr.eval(target)
    return target


@recorded
def _adjoint(form, setting, coefficients, cells, grad):
    pixels = _Pixels(form, setting, cells)
    dr = pixels.dr
    given = pixels.coefficients(coefficients)
    slots = dr.zeros(pixels.arr.Float, 4 * OF_CELL * pixels.images * pixels.slots)
    # processors need no locks where each thread has a copy
    mode = dr.ReduceMode.Expand if form.device == "cpu" else dr.ReduceMode.Auto

    def body(y, *sums):
        read = _Read([], [])
        seeds = [pixels.take(grad, pixels.at(part, y)) for part in range(OUT)]

        def outcome(*given):
            return pixels.outcome(given, pixels.arr.Float(y), read)

        found = pixels.back(outcome, given, seeds, read.values)
        of_cells = found[setting.numbers :]
        for number, slot in enumerate(read.slots):
            four = pixels.arr.Array4(*of_cells[4 * number : 4 * number + 4])
            dr.scatter_add(slots, four, slot, mode=mode)
        return [total + more for total, more in zip(sums, found, strict=False)]

    zero = dr.zeros(pixels.arr.Float, pixels.lane_count)
    sums = pixels.loop(pixels.top, pixels.end, body, *[zero] * setting.numbers)
    target = pixels.empty(setting.numbers * pixels.lane_count)
    for number, total in enumerate(sums):
        pixels.put(target, total, pixels.count(number * pixels.lane_count) + pixels.lane)
    dr.eval(target, slots)
    return target, slots


class _Read(NamedTuple):
    """Slots of cells that were read, and the four values of each."""

    slots: list[Any]
    values: list[Any]


class _Pixels(Lanes):
    """Parts of columns of images, and what is found at a pixel of them."""

    def __init__(self, form, setting, cells):
        super().__init__(form)
        self.setting = setting
        self.cells = cells
        blocks = -(-self.rows // ROWS)
        self.lane_count = self.images * blocks * self.columns
        self.lane = self.lanes(self.lane_count)
        block, x = self.split(self.lane, self.columns)
        self.image, block = self.split(block, blocks)
        self.x = self.arr.Float(x)
        self.corner = self.image * self.count(OUT * self.samples) + x
        self.top = block * self.count(ROWS)
        self.end = self.dr.minimum(self.top + self.count(ROWS), self.count(self.rows))
        self.slots = max(setting.rows - 1, 1) * max(setting.columns - 1, 1)
        self.middle = [self.number((size - 1) / 2) for size in (self.columns, self.rows)]
        self.per_half = self.number(2 / max(self.rows, self.columns))
        self.per_cell = self.number(1 / setting.cell_px)
        self.first = self.number((1 - setting.cell_px) / (2 * setting.cell_px))
        self.plane = self.count(setting.rows * setting.columns)
        self.wide = self.count(setting.columns)
        self.slots_wide = self.count(max(setting.columns - 1, 1))
        self.slot_plane = self.count(self.slots)
        self.last = [self.number(size - 1) for size in (setting.columns, setting.rows)]
        self.last_lower = [self.count(max(size, 2) - 2) for size in (setting.columns, setting.rows)]
        right = self.count(min(setting.columns - 1, 1))
        below = self.count(setting.columns if setting.rows > 1 else 0)
        self.corners = 0, right, below, below + right

    def coefficients(self, array):
        start = self.image * self.setting.numbers
        return [self.take(array, start + number) for number in range(self.setting.numbers)]

    def at(self, part, y):
        return self.corner + self.count(part * self.samples) + y * self.across

    def outcome(self, given, y, read):
        """The six values of a pixel; ``read`` takes what cells gave."""
        back, *given = given
        terms = len(self.setting.powers)
        field = given[:terms], given[terms : 2 * terms]
        flow_x = flow_y = 0
        joined = self.setting.joined
        for _ in range(self.setting.rounds):
            place = self.x + back * flow_x, y + back * flow_y
            flow_x, flow_y = self.polynomials(field, self.setting.powers, place)
            if joined:
                part = self.of_cells(place, 2, read)
                flow_x = flow_x + part[0]
                flow_y = flow_y + part[1]
        place = self.x + back * flow_x, y + back * flow_y
        flow_x, flow_y = self.polynomials(field, self.setting.powers, place)
        part_x, part_y, *local = self.of_cells(place, OF_CELL, read)
        size = len(self.setting.of_variance)
        rest = given[2 * terms :]
        rest = [rest[k * size : (k + 1) * size] for k in range(4)]
        xx, xy, yy, widest = self.polynomials(rest, self.setting.of_variance, place)
        xx = xx + local[0]
        xy = xy + local[1]
        yy = yy + local[2]
        if joined:
            flow_x = flow_x + part_x
            flow_y = flow_y + part_y
        else:
            xx = xx + part_x * part_x
            xy = xy + part_x * part_y
            yy = yy + part_y * part_y
        confidence = self.dr.clip(1 - (xx + yy) / widest, 0, 1)
        return flow_x, flow_y, xx, xy, yy, confidence

    def polynomials(self, rows, powers, place):
        """Values of several polynomials with the same powers."""
        u, v = ((at - middle) * self.per_half for at, middle in zip(place, self.middle, strict=True))
        of_u = _powers(u, max(x for x, _ in powers))
        of_v = _powers(v, max(y for _, y in powers))
        found = [row[0] for row in rows]  # of power 0
        for number, (x, y) in list(enumerate(powers))[1:]:
            value = of_v[y] if not x else of_u[x] if not y else of_u[x] * of_v[y]
            found = [self.dr.fma(row[number], value, total) for row, total in zip(rows, found, strict=True)]
        return found

    def of_cells(self, place, parts, read):
        """Bilinear values of the first parts of the cells, beyond the outermost as there."""
        dr = self.dr
        (x, a), (y, b) = (
            self.along(at, last, lower)
            for at, last, lower in zip(place, self.last, self.last_lower, strict=True)
        )
        found = []
        for part in range(parts):
            plane = self.image * OF_CELL + part
            start = plane * self.plane + y * self.wide + x
            four = [self.take(self.cells, start + corner) for corner in self.corners]
            if read is not None:
                four = [dr.detach(value) + 0 for value in four]
                dr.enable_grad(four)
                read.slots.append(plane * self.slot_plane + y * self.slots_wide + x)
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
