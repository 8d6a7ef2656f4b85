"""Bins read along a flow, their mean and their slope over time, in drjit; forward and adjoint.

The adjoint of reading adds to four neighbours in every bin. A lane adds to all of them at once: to the four values
of the slot of its upper left neighbour. A second pass collects what belongs to a sample. That is a third of the
time of four additions, which processors do one by one.
"""

from collections.abc import Sequence

from torch import Tensor

from codesign.exclusive import exclusive
from codesign.flow.lk_lanes import Form, Grid, Lanes, recorded, tensors

BINS = 16  # in one kernel
# values that the adjoint scatters to at a time: larger ones go by groups of bins, at least one bin
MOST_VALUES = 1 << 23


@exclusive
def forward(rate: Tensor, flow_px: Tensor, weights: Tensor, grid: Grid, fade_px: float) -> list[Tensor]:
    """Mean, slope and seen, [B, h, w] each; weights: [3, n]: time, share in the mean, share in the slope."""
    form = Form.of(rate, grid)
    found = _forward(form, fade_px, *form.load(rate, flow_px), form.scalars(weights.T.flatten().tolist()))
    return tensors((len(rate), *grid.shape), *found)


@exclusive
def adjoint(
    rate: Tensor,
    flow_px: Tensor,
    weights: Tensor,
    grid: Grid,
    fade_px: float,
    grads: Sequence[Tensor],
    wants_rate: bool,
) -> tuple[Tensor | None, Tensor]:
    """Gradients of rate (None unless wanted) and flow_px; ``grads``: of mean, slope and seen."""
    form = Form.of(rate, grid)
    rows, columns = grid.shape
    of_bin = 4 * len(rate) * (rows + 1) * (columns + 1) if wants_rate else 1
    together = min(max(MOST_VALUES // of_bin, 1), BINS)
    arrays = form.load(rate, flow_px, *grads)
    numbers = form.scalars(weights.T.flatten().tolist())
    grad_rate, grad_flow = _adjoint(form, fade_px, wants_rate, together, *arrays, numbers)
    (grad_flow,) = tensors(flow_px.shape, grad_flow)
    return (tensors(rate.shape, grad_rate)[0] if wants_rate else None), grad_flow


@recorded
def _forward(form, fade_px, rate, flow, weights):
    warp = _Warp(form, fade_px, rate, flow, weights)
    dr = warp.dr
    mean = slope = dr.zeros(warp.arr.Float, warp.width)
    for start in range(0, warp.bins, BINS):
        for k, (time, in_mean, in_slope) in warp.group(start, BINS):
            _, (a, b), _, (v00, v01, v10, v11) = warp.read(k, time)
            upper = dr.fma(a, v01 - v00, v00)
            lower = dr.fma(a, v11 - v10, v10)
            value = dr.fma(b, lower - upper, upper)
            mean = dr.fma(in_mean, value, mean)
            slope = dr.fma(in_slope, value, slope)
        if start + BINS < warp.bins:
            dr.eval(mean, slope)
    (first_x, _), (first_y, _), (last_x, _), (last_y, _) = warp.windows()
    seen = first_x * last_x * first_y * last_y
    dr.eval(mean, slope, seen)
    return mean, slope, seen


@recorded
def _adjoint(form, fade_px, wants_rate, together, rate, flow, by_mean, by_slope, by_seen, weights):
    warp = _Adjoint(form, fade_px, rate, flow, weights)
    dr = warp.dr
    by_mean, by_slope, by_seen = (warp.take(by, warp.lane) for by in (by_mean, by_slope, by_seen))
    grad_rate = warp.empty(warp.bins * warp.width) if wants_rate else None
    grad_flow = warp.through_windows(by_seen)
    for start in range(0, warp.bins, together):
        bins = min(together, warp.bins - start)
        added = dr.zeros(warp.arr.Float, 4 * warp.images * bins * warp.slots) if wants_rate else None
        grad_flow = warp.through_bins(start, bins, grad_flow, by_mean, by_slope, added)
        if wants_rate:
            warp.collect(start, bins, added, grad_rate)
    target = warp.empty(2 * warp.width)
    warp.put(target, grad_flow[0], warp.at_flow)
    warp.put(target, grad_flow[1], warp.at_flow + warp.area)
    dr.eval(target)
    return grad_rate, target


class _Warp(Lanes):
    """Where each sample reads its bins."""

    def __init__(self, form, fade_px, rate, flow, weights):
        """Args: weights: for each bin its time, share in the mean, share in the slope."""
        super().__init__(form)
        self.rate = rate
        self.weights = [weights[k : k + 3] for k in range(0, len(weights), 3)]
        self.bins = len(self.weights)
        self.n = self.count(self.bins)
        self.lane = self.lanes(self.width)
        self.image, self.place = self.split(self.lane, self.samples)
        y, x = self.split(self.place, self.columns)
        self.at_flow = 2 * self.image * self.area + self.place
        self.right = self.count(min(self.columns - 1, 1))
        self.below = self.count(self.columns if self.rows > 1 else 0)
        self.per_stride = self.number(1 / form.stride)
        self.per_fade = self.number(1 / fade_px)
        self.x = self.axis(x, self.take(flow, self.at_flow), self.columns)
        self.y = self.axis(y, self.take(flow, self.at_flow + self.area), self.rows)

    def axis(self, place, flow, count):
        """Along one axis: place, flow, the last sample, and the last that is the lower one of two."""
        return self.arr.Float(place), flow, self.number(count - 1), self.count(max(count, 2) - 2)

    def group(self, start, count):
        """Bins from ``start`` with their weights; their number is opaque, so that other groups are alike."""
        first = self.count(start)
        return [(first + j, weights) for j, weights in enumerate(self.weights[start : start + count])]

    def read(self, k, time):
        """Along x and y: the lower of two neighbours, the share of the other, whether the place lies inside; and
        bin k at the upper left, upper right, lower left and lower right neighbour."""
        x, a, in_x = self.along(self.x, time)
        y, b, in_y = self.along(self.y, time)
        at = (self.image * self.n + k) * self.area + y * self.across + x
        steps = (0, self.right, self.below, self.below + self.right)
        return (x, y), (a, b), (in_x, in_y), [self.take(self.rate, at + step) for step in steps]

    def along(self, axis, time):
        dr = self.dr
        start, flow, last, last_lower = axis
        at = dr.fma(time * flow, self.per_stride, start)
        inside = (at > 0) & (at < last)
        at = dr.clip(at, 0, last)
        lower = dr.minimum(self.arr.UInt32(at), last_lower)
        return lower, at - self.arr.Float(lower), inside

    def windows(self):
        """Of x and y at the first bin, then at the last: the window and its slope over the flow."""
        dr = self.dr
        stride = self.number(self.form.stride)
        first = self.number((self.form.stride - 1) / 2)
        found = []
        for time, *_ in (self.weights[0], self.weights[-1]):
            for (start, flow, *_), size in ((self.x, self.form.width), (self.y, self.form.height)):
                middle = self.number((size - 1) / 2)
                off = dr.fma(start, stride, first - middle) + time * flow
                part = dr.clip((middle - dr.abs(off)) * self.per_fade, 0, 1)
                inward = dr.select(off < 0, time, dr.select(off > 0, -time, 0))
                found.append((part * part * (3 - 2 * part), 6 * part * (1 - part) * self.per_fade * inward))
        return found


class _Adjoint(_Warp):
    @property
    def slots(self):
        """Of a bin: a row and a column more than samples, so that each sample has upper left neighbours."""
        return (self.rows + 1) * (self.columns + 1)

    def slot(self, image_bin, y, x):
        return image_bin * self.count(self.slots) + (y + 1) * self.count(self.columns + 1) + x + 1

    def through_windows(self, by_seen):
        """Gradient of the flow through ``seen``."""
        (first_x, to_first_x), (first_y, to_first_y), (last_x, to_last_x), (last_y, to_last_y) = (
            self.windows()
        )
        grad_u = (to_first_x * last_x + first_x * to_last_x) * (first_y * last_y)
        grad_v = (to_first_y * last_y + first_y * to_last_y) * (first_x * last_x)
        return by_seen * grad_u, by_seen * grad_v

    def through_bins(self, start, count, grad_flow, by_mean, by_slope, added):
        """Gradient of the flow through ``count`` bins, on top of grad_flow. Adds to the slots of these bins,
        ``added``, unless None."""
        dr = self.dr
        # processors need no locks where each thread has a copy; with several, this kernel is one for each size
        mode = dr.ReduceMode.Expand if self.form.device == "cpu" else dr.ReduceMode.Auto
        image = self.image * self.count(count)
        grad_u, grad_v = grad_flow
        for j, (k, (time, in_mean, in_slope)) in enumerate(self.group(start, count)):
            (x, y), (a, b), (in_x, in_y), (v00, v01, v10, v11) = self.read(k, time)
            grad = dr.fma(in_mean, by_mean, in_slope * by_slope)
            if added is not None:
                lower = grad * b
                upper = grad - lower
                four = self.arr.Array4(upper - upper * a, upper * a, lower - lower * a, lower * a)
                dr.scatter_add(added, four, self.slot(image + j, y, x), mode=mode)
            grad = grad * time * self.per_stride
            along_x = dr.fma(b, (v11 - v10) - (v01 - v00), v01 - v00)
            along_y = dr.fma(a, (v11 - v01) - (v10 - v00), v10 - v00)
            grad_u = grad_u + dr.select(in_x, grad * along_x, 0)
            grad_v = grad_v + dr.select(in_y, grad * along_y, 0)
        dr.eval(grad_u, grad_v, *([] if added is None else [added]))
        return grad_u, grad_v

    def collect(self, start, count, added, grad_rate):
        """Gradient of ``count`` bins from their slots."""
        image_bin, place = self.split(self.lanes(count * self.width), self.samples)
        y, x = self.split(place, self.columns)
        image, k = self.split(image_bin, count)
        here = 4 * self.slot(image_bin, y, x)
        above = here - 4 * self.count(self.columns + 1)
        found = (self.take(added, here) + self.take(added, here - 3)) + (
            self.take(added, above + 2) + self.take(added, above - 1)
        )
        self.put(grad_rate, found, (image * self.n + k + self.count(start)) * self.area + place)
        self.dr.eval(grad_rate)
