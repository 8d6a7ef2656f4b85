"""Bins read along a flow, their mean and their slope over time: in drjit, and as operations of
torch.

The adjoint of a bin is left to drjit, but for what is read: it belongs to four neighbours. A lane
adds to all of them at once, to the four values of the slot of its upper left neighbour; a second
pass collects what belongs to a sample. That is a third of the time of four additions, which
processors do one by one.
"""

from typing import Any

import torch
from torch import Tensor

from codesign.backend import pull_back
from codesign.exclusive import exclusive
from codesign.flow.lk.lanes import Form, Grid, Lanes, in_graph, plain_wanted, recorded, tensors
from codesign.flow.warp import pixel_grid, read_at

# in one kernel
BINS = 16
# values that the adjoint scatters to at a time: larger ones go by groups of bins, at least one bin
MOST_VALUES = 1 << 23


def moving(
    rate: Tensor, flow_px: Tensor, time: Tensor, contrast: Tensor, grid: Grid, fade_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Bins carried back to time 0 along a flow: their mean and their slope over time.

    Args:
      rate: [B, n, h, w] bins on the samples of ``grid``, float32 or float64.
      flow_px: [B, 2, h, w] flow of the samples at time 0, px per unit of time.
      time: [n] of the bins, in order.
      contrast: [2, n] share of each bin in the mean and in the slope.
      fade_px: the windows below fall smoothly from 1 to 0 over this distance to the border, px.
    Returns:
      mean, slope: [B, h, w]. Bins are read bilinearly; beyond the outermost samples, as there.
      seen: [B, h, w] in [0, 1], product of the windows along x and y where the first and the last
        bin are read.
    Gradient: rate, flow_px; exact, the first one. The flow has none through bins that it reads
      beyond the outermost samples.
    Raises: GradientError for a second derivative.
    Cost: one pass forward, two backward; nothing of n bins is stored forward. Backward four values
      per sample and bin, or ``MOST_VALUES`` where that is less, in each thread. One kernel for each
      number of bins, whatever the sizes; it is traced once for each size.
    Source: Lucas and Kanade, 1981; Jaderberg et al., Spatial Transformer Networks, NeurIPS 2015,
      for the reading.
    """
    if plain_wanted():
        return _plain(rate, flow_px, time, contrast, grid, fade_px)
    weights = numbers(time, contrast, rate)
    return in_graph(_forward, _adjoint, (grid, fade_px, weights), rate, flow_px)


def numbers(time: Tensor, contrast: Tensor, like: Tensor) -> list[float]:
    """For each bin its time, share in the mean, share in the slope, in the precision of ``like``."""
    return torch.cat([time[None], contrast]).to(like).T.flatten().tolist()


def _plain(rate, flow_px, time, contrast, grid, fade_px):
    place = pixel_grid(*grid.shape, rate)
    shift = time.to(rate)[:, None, None, None] * flow_px[:, None]
    at = place.add(shift, alpha=1 / grid.stride)  # [B, n, 2, h, w]
    warped = read_at(rate.flatten(0, 1)[:, None], at.flatten(0, 1)).view(*rate.shape[:2], -1)
    of_bins = contrast.to(rate).expand(len(rate), -1, -1)
    mean, slope = torch.bmm(of_bins, warped).unflatten(2, grid.shape).unbind(1)
    reach = (torch.tensor([grid.width, grid.height]).to(rate)[:, None, None] - 1) / 2
    off = (place * grid.stride + (grid.stride - 1) / 2 - reach) + shift[:, [0, -1]]
    inside = ((reach - off.abs()) / fade_px).clamp(0, 1)
    window = inside.square() * (3 - 2 * inside)
    return mean, slope, window.flatten(1, 2).prod(1)


@exclusive
def _forward(grid, fade_px, weights, rate, flow_px):
    form = Form.of(rate, grid)
    found = read(form, fade_px, *form.load(rate, flow_px), form.scalars(weights))
    return tensors((len(rate), *grid.shape), *found), ()


@exclusive
def _adjoint(grid, fade_px, weights, rate, flow_px, grads, wanted):
    form = Form.of(rate, grid)
    grads = [torch.zeros_like(flow_px[:, 0]) if grad is None else grad for grad in grads]
    arrays = form.load(rate, flow_px, *grads)
    found = gradients(form, fade_px, together(form, wanted[0]), *arrays, form.scalars(weights))
    return given_back(rate, flow_px, *found)


def together(form: Form, wants_rate: bool) -> int:
    """How many bins the adjoint takes at a time; 0 where the rate wants no gradient."""
    rows, columns = Grid(*form[3:]).shape
    of_bin = 4 * form.images * (rows + 1) * (columns + 1)
    return min(max(MOST_VALUES // of_bin, 1), BINS) if wants_rate else 0


def given_back(rate: Tensor, flow_px: Tensor, by_rate: Any, by_flow: Any) -> list[Tensor | None]:
    """What ``gradients`` found, as tensors."""
    by_rate = [None] if by_rate is None else tensors(rate.shape, by_rate)
    return [*by_rate, *tensors(flow_px.shape, by_flow)]


@recorded
def read(form: Form, fade_px: float, rate: Any, flow: Any, weights: Any) -> Any:
    """Mean, slope and windows, as of ``moving``."""
    warp = _Warp(form, fade_px, rate, flow, weights)
    dr = warp.dr
    mean = slope = dr.zeros(warp.arr.Float, warp.width)
    for start in range(0, warp.bins, BINS):
        for k, (time, in_mean, in_slope) in warp.group(start, BINS):
            value = warp.value(k, time, *warp.flow)
            mean = dr.fma(in_mean, value, mean)
            slope = dr.fma(in_slope, value, slope)
        if start + BINS < warp.bins:
            dr.eval(mean, slope)
    seen = warp.seen(*warp.flow)
    dr.eval(mean, slope, seen)
    return mean, slope, seen


@recorded
def gradients(
    form: Form,
    fade_px: float,
    together: int,
    rate: Any,
    flow: Any,
    by_mean: Any,
    by_slope: Any,
    by_seen: Any,
    weights: Any,
) -> Any:
    """Of rate (None where not wanted) and flow, from those of mean, slope and windows."""
    warp = _Warp(form, fade_px, rate, flow, weights)
    dr = warp.dr
    wants_rate = together > 0
    together = together or BINS
    grad_rate = None
    if together < warp.bins:
        dr.eval(by_mean, by_slope, by_seen)
        grad_rate = warp.empty(warp.bins * warp.width) if wants_rate else None
    grad_flow = pull_back(lambda *flow: [warp.seen(*flow)], warp.flow, [by_seen])
    # processors need no locks where each thread has a copy; with several, this kernel is one for
    # each size
    mode = dr.ReduceMode.Expand if form.device == "cpu" else dr.ReduceMode.Auto
    for start in range(0, warp.bins, together):
        bins = min(together, warp.bins - start)
        added = (
            dr.zeros(warp.arr.Float, 4 * warp.images * bins * warp.slots) if wants_rate else None
        )
        image = warp.image * warp.count(bins)
        for j, (k, (time, in_mean, in_slope)) in enumerate(warp.group(start, bins)):
            u, v, *four = warp.pulled(k, time, dr.fma(in_mean, by_mean, in_slope * by_slope))
            grad_flow = grad_flow[0] + u, grad_flow[1] + v
            if added is not None:
                slot = warp.slot(image + j, *reversed(warp.corner(time)))
                dr.scatter_add(added, warp.arr.Array4(*four), slot, mode=mode)
        dr.eval(*grad_flow, *([] if added is None else [added]))
        if wants_rate:
            grad_rate = warp.collect(start, bins, added, grad_rate)
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
        self.flow = [self.take(flow, self.at_flow), self.take(flow, self.at_flow + self.area)]
        self.right = self.count(min(self.columns - 1, 1))
        self.below = self.count(self.columns if self.rows > 1 else 0)
        self.per_stride = self.number(1 / form.stride)
        self.per_fade = self.number(1 / fade_px)
        self.axes = [self.axis(x, self.columns, form.width), self.axis(y, self.rows, form.height)]
        # of a bin: a row and a column more than samples, so that each sample has upper left
        # neighbours
        self.slots = (self.rows + 1) * (self.columns + 1)

    def axis(self, place, count, size):
        """Along one axis: place, the last sample, the last that is the lower one of two, the middle
        in px."""
        last_lower = self.count(max(count, 2) - 2)
        return (
            self.arr.Float(place),
            self.number(count - 1),
            last_lower,
            self.number((size - 1) / 2),
        )

    def group(self, start, count):
        """Bins from ``start`` with their weights; their number is opaque, so that other groups are
        alike."""
        first = self.count(start)
        return [
            (first + j, weights) for j, weights in enumerate(self.weights[start : start + count])
        ]

    def value(self, k, time, u, v, read=None):
        """Bin k where the flow (u, v) leads; ``read`` takes the four values around it, which then
        have gradients."""
        dr = self.dr
        (x, a), (y, b) = (self.along(*pair, time) for pair in zip(self.axes, (u, v), strict=True))
        at = (self.image * self.n + k) * self.area + y * self.across + x
        steps = (0, self.right, self.below, self.below + self.right)
        four = [self.take(self.rate, at + step) for step in steps]
        if read is not None:
            dr.enable_grad(four)
            read.extend(four)
        upper = dr.fma(a, four[1] - four[0], four[0])
        lower = dr.fma(a, four[3] - four[2], four[2])
        return dr.fma(b, lower - upper, upper)

    def pulled(self, k, time, seed):
        """Gradients of the flow and of the four values around, from that of a bin's value."""
        four = []
        return pull_back(lambda *flow: [self.value(k, time, *flow, four)], self.flow, [seed], four)

    def along(self, axis, flow, time):
        """The lower of two neighbours, and the share of the other; no gradient beyond the outermost
        samples."""
        dr = self.dr
        start, last, last_lower, _ = axis
        at = dr.fma(time * flow, self.per_stride, start)
        at = dr.select((at > 0) & (at < last), at, dr.detach(dr.clip(at, 0, last)))
        lower = dr.minimum(self.arr.UInt32(dr.detach(at)), last_lower)
        return lower, at - self.arr.Float(lower)

    def corner(self, time):
        """Column and row of the upper left neighbour."""
        return [self.along(*pair, time)[0] for pair in zip(self.axes, self.flow, strict=True)]

    def seen(self, u, v):
        """Product of the windows along x and y, at the first bin and at the last."""
        dr = self.dr
        stride = self.number(self.form.stride)
        first = self.number((self.form.stride - 1) / 2)
        found = []
        for time, *_ in (self.weights[0], self.weights[-1]):
            for (start, *_, middle), flow in zip(self.axes, (u, v), strict=True):
                off = dr.fma(start, stride, first - middle) + time * flow
                away = dr.select(off < 0, -off, dr.select(off > 0, off, 0))
                part = dr.clip((middle - away) * self.per_fade, 0, 1)
                found.append(part * part * (3 - 2 * part))
        first_x, first_y, last_x, last_y = found
        return first_x * last_x * first_y * last_y

    def slot(self, image_bin, y, x):
        return image_bin * self.count(self.slots) + (y + 1) * self.count(self.columns + 1) + x + 1

    def collect(self, start, count, added, grad_rate):
        """Gradient of the rate from the slots of ``count`` bins; where these are not all, put into
        that of the others."""
        image_bin, place = self.split(self.lanes(count * self.width), self.samples)
        y, x = self.split(place, self.columns)
        here = 4 * self.slot(image_bin, y, x)
        above = here - 4 * self.count(self.columns + 1)
        found = (self.take(added, here) + self.take(added, here - 3)) + (
            self.take(added, above + 2) + self.take(added, above - 1)
        )
        if grad_rate is None:
            grad_rate = found
        else:
            image, k = self.split(image_bin, count)
            at = (image * self.n + k + self.count(start)) * self.area + place
            self.put(grad_rate, found, at)
        self.dr.eval(grad_rate)
        return grad_rate
