"""Bins read along a flow, their mean and their slope over time, as one drjit loop over the bins per sample; forward
and adjoint.

The adjoint of reading adds to four neighbours in every bin. A lane adds to all of them at once: to the four values
of the slot of its upper left neighbour. A second pass collects what belongs to a sample. That is a third of the
time of four additions, which processors do one by one.
"""

from collections.abc import Sequence

from torch import Tensor

from codesign.flow.lk_lanes import Grid, Lanes

# values that the adjoint scatters to at a time: larger ones go by groups of bins, at least one bin
MOST_VALUES = 1 << 23


class _Warp(Lanes):
    """Where each sample reads its bins."""

    def __init__(self, rate, flow_px, weights, grid, fade_px):
        """Args: weights: [3, n]: time, share in the mean, share in the slope."""
        super().__init__(rate, grid)
        self.width = self.images * self.samples
        self.grid = grid
        self.bins = rate.shape[1]
        self.n = self.count(self.bins)
        self.rate = self.load(rate)
        self.weights = self.load(weights)
        self.lane = self.lanes(self.width)
        self.image, self.place = self.split(self.lane, self.samples)
        y, x = self.split(self.place, self.columns)
        flow = self.load(flow_px)
        self.at_flow = 2 * self.image * self.area + self.place
        self.right = self.count(min(self.columns - 1, 1))
        self.below = self.count(self.columns if self.rows > 1 else 0)
        self.per_stride = self.number(1 / grid.stride)
        self.per_fade = self.number(1 / fade_px)
        self.x = self.axis(x, self.take(flow, self.at_flow), self.columns)
        self.y = self.axis(y, self.take(flow, self.at_flow + self.area), self.rows)
        modes = self.dr.ReduceMode
        # how additions meet: processors need no locks where each thread has a copy
        self.adding = modes.Expand if rate.device.type == "cpu" else modes.Auto

    def axis(self, place, flow, count):
        """Along one axis: place, flow, the last sample, and the last that is the lower one of two."""
        return self.arr.Float(place), flow, self.number(count - 1), self.count(max(count, 2) - 2)

    def weigh(self, k):
        return (self.take(self.weights, k + row * self.n) for row in range(3))

    def along(self, axis, time):
        """The lower of the two neighbours, the share of the other, whether the place lies inside."""
        dr = self.dr
        start, flow, last, last_lower = axis
        at = dr.fma(time * flow, self.per_stride, start)
        inside = (at > 0) & (at < last)
        at = dr.clip(at, 0, last)
        lower = dr.minimum(self.arr.UInt32(at), last_lower)
        return lower, at - self.arr.Float(lower), inside

    def neighbours(self, k, x, y):
        """Values of bin k at the upper left, upper right, lower left and lower right neighbour."""
        at = (self.image * self.n + k) * self.area + y * self.across + x
        return [
            self.take(self.rate, at + step) for step in (0, self.right, self.below, self.below + self.right)
        ]

    def windows(self):
        """Of x and y at the first bin, then at the last: the window and its slope over the flow."""
        dr = self.dr
        stride = self.number(self.grid.stride)
        first = self.number((self.grid.stride - 1) / 2)
        found = []
        for k in (0, self.n - 1):
            time = self.take(self.weights, k)
            for (start, flow, *_), size in ((self.x, self.grid.width), (self.y, self.grid.height)):
                middle = self.number((size - 1) / 2)
                off = dr.fma(start, stride, first - middle) + time * flow
                part = dr.clip((middle - dr.abs(off)) * self.per_fade, 0, 1)
                inward = dr.select(off < 0, time, dr.select(off > 0, -time, 0))
                found.append((part * part * (3 - 2 * part), 6 * part * (1 - part) * self.per_fade * inward))
        return found


def forward(rate: Tensor, flow_px: Tensor, weights: Tensor, grid: Grid, fade_px: float) -> list[Tensor]:
    """Mean, slope and seen, [B, h, w] each."""
    warp = _Warp(rate, flow_px, weights, grid, fade_px)
    dr = warp.dr
    arr = warp.arr

    def body(k, mean, slope):
        time, in_mean, in_slope = warp.weigh(k)
        x, a, _ = warp.along(warp.x, time)
        y, b, _ = warp.along(warp.y, time)
        v00, v01, v10, v11 = warp.neighbours(k, x, y)
        upper = dr.fma(a, v01 - v00, v00)
        lower = dr.fma(a, v11 - v10, v10)
        value = dr.fma(b, lower - upper, upper)
        return dr.fma(in_mean, value, mean), dr.fma(in_slope, value, slope)

    zero = dr.zeros(arr.Float, warp.width)
    with dr.suspend_grad():
        mean, slope = warp.loop(dr.zeros(arr.UInt32, warp.width), warp.n, body, zero, zero)
        (first_x, _), (first_y, _), (last_x, _), (last_y, _) = warp.windows()
        return warp.tensors((warp.images, *grid.shape), mean, slope, first_x * last_x * first_y * last_y)


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
    warp = _Adjoint(rate, flow_px, weights, grid, fade_px)
    with warp.dr.suspend_grad():
        return warp(grads, wants_rate)


class _Adjoint(_Warp):
    def __call__(self, grads, wants_rate):
        dr = self.dr
        self.by_mean, self.by_slope, by_seen = (self.take(self.load(grad), self.lane) for grad in grads)
        # of slots: a row and a column more than samples, so that each sample has upper left neighbours
        self.slots_across = self.count(self.columns + 1)
        slots = (self.rows + 1) * (self.columns + 1)
        self.slots = self.count(slots)
        most = max(MOST_VALUES // (4 * self.images * slots), 1) if wants_rate else self.bins
        grad_rate = self.empty(self.bins * self.width) if wants_rate else None
        grad_flow = self.through_windows(by_seen)
        for start in range(0, self.bins, most):
            end = min(start + most, self.bins)
            added = dr.zeros(self.arr.Float, (end - start) * self.images * 4 * slots) if wants_rate else None
            grad_flow = self.through_bins(start, end, grad_flow, added)
            if wants_rate:
                self.collect(start, end, added, grad_rate)
        target = self.empty(2 * self.width)
        self.put(target, grad_flow[0], self.at_flow)
        self.put(target, grad_flow[1], self.at_flow + self.area)
        (found,) = self.tensors((self.images, 2, self.rows, self.columns), target)
        if not wants_rate:
            return None, found
        return *self.tensors((self.images, self.bins, self.rows, self.columns), grad_rate), found

    def through_windows(self, by_seen):
        (first_x, to_first_x), (first_y, to_first_y), (last_x, to_last_x), (last_y, to_last_y) = (
            self.windows()
        )
        grad_u = (to_first_x * last_x + first_x * to_last_x) * (first_y * last_y)
        grad_v = (to_first_y * last_y + first_y * to_last_y) * (first_x * last_x)
        return by_seen * grad_u, by_seen * grad_v

    def through_bins(self, start, end, grad_flow, added):
        """Gradient of the flow through bins from ``start`` to ``end``, on top of grad_flow. Adds to the slots of
        these bins, ``added``, unless None."""
        dr = self.dr
        first = self.count(start)
        group = self.count(end - start)

        def body(k, grad_u, grad_v):
            time, in_mean, in_slope = self.weigh(k)
            x, a, in_x = self.along(self.x, time)
            y, b, in_y = self.along(self.y, time)
            v00, v01, v10, v11 = self.neighbours(k, x, y)
            grad = dr.fma(in_mean, self.by_mean, in_slope * self.by_slope)
            if added is not None:
                lower = grad * b
                upper = grad - lower
                four = self.arr.Array4(upper - upper * a, upper * a, lower - lower * a, lower * a)
                slot = (self.image * group + (k - first)) * self.slots + (y + 1) * self.slots_across + x + 1
                dr.scatter_add(added, four, slot, mode=self.adding)
            grad = grad * time * self.per_stride
            along_x = dr.fma(b, (v11 - v10) - (v01 - v00), v01 - v00)
            along_y = dr.fma(a, (v11 - v01) - (v10 - v00), v10 - v00)
            return grad_u + dr.select(in_x, grad * along_x, 0), grad_v + dr.select(in_y, grad * along_y, 0)

        begin = dr.zeros(self.arr.UInt32, self.width) + first
        grad_flow = self.loop(begin, self.count(end), body, *grad_flow)
        dr.eval(grad_flow, *([] if added is None else [added]))
        return grad_flow

    def collect(self, start, end, added, grad_rate):
        """Gradient of the bins from ``start`` to ``end`` from their slots."""
        lane = self.lanes((end - start) * self.width)
        image_bin, place = self.split(lane, self.samples)
        y, x = self.split(place, self.columns)
        image, k = self.split(image_bin, end - start)
        slot = 4 * (image_bin * self.slots + (y + 1) * self.slots_across + x + 1)
        above = slot - 4 * self.slots_across
        found = (self.take(added, slot) + self.take(added, slot - 3)) + (
            self.take(added, above + 2) + self.take(added, above - 1)
        )
        self.put(grad_rate, found, (image * self.n + k + self.count(start)) * self.area + place)
        self.dr.eval(grad_rate)
