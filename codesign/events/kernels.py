"""Kernels over pixels: one lane per pixel, memory by rows of lanes, loops over time; and a
recursion over time whose loop backward lets drjit differentiate one step after the other.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.backend import arrays, load, pull_back
from codesign.exclusive import exclusive


class Lanes:
    """drjit, its array types, and a lane for every pixel of a frame; flat arrays hold rows of
    pixels. With ``packs`` a lane has that many neighbours, where they divide, and values an axis
    for them: a processor then reads and writes them at once, in half the time."""

    def __init__(self, like, width, packs=0):
        import drjit as dr

        self.dr = dr
        self.arr = arrays(like.device.type, like.dtype)
        self.width = width
        self.device = like.device
        self.packs = packs
        # a GPU reads at once what neighbouring lanes read
        count = math.gcd(packs, width) if like.is_cpu else 1
        self.extent = (count, width // count) if packs else (width,)
        self.lane = dr.arange(self.arr.UInt32, self.extent[-1])
        self.pixels = dr.opaque(self.arr.UInt32, self.extent[-1])

    def opaque(self, value):
        """A whole number that may change from call to call without a new kernel."""
        return self.dr.opaque(self.arr.UInt32, value)

    def load(self, tensor):
        return load(self.arr.Float, tensor)

    def load_row(self, tensor):
        """Values of all pixels, or one number for all."""
        flat = self.load(tensor)
        if self.packs and tensor.numel() == 1:  # a quotient by it alone would be a rounded product
            return self.of_lanes(self.arr.Float)([flat] * self.extent[0])
        return self.at(flat, 0) if self.packs else flat

    def rows(self, tensor):
        return [self.load_row(row) for row in tensor]

    def full(self, value, kind):
        return self.dr.full(self.of_lanes(kind), value, self.extent)

    def of_lanes(self, kind) -> Any:
        """The type of values whose flat arrays are of that kind."""
        packed = self.dr.replace_type_t(self.arr.ArrayX, self.dr.type_v(kind))
        return packed if self.packs else kind

    def fresh(self, rows, kind=None):
        """Rows to be filled by kernels. The memory is drjit's, which hands the same pages out again
        and
        again: new pages from the system cost more than the kernel."""
        target = self.dr.empty(kind or self.arr.Float, rows * self.width)
        self.dr.eval(target)
        return target

    def zeros(self, rows):
        """Rows to be added to, or that kernels fill in part."""
        target = self.dr.zeros(self.arr.Float, rows * self.width)
        self.dr.eval(target)
        return target

    def place(self, row):
        return row * self.pixels + self.lane

    def at(self, flat, row, active=True):
        kind = self.of_lanes(type(flat))
        return self.dr.gather(kind, flat, self.place(row), active, shape=self.extent)

    def put(self, flat, value, row, active=True):
        self.dr.scatter(flat, value, self.place(row), active, mode=self.dr.ReduceMode.NoConflicts)

    def loop(self, first, end, body, *carried) -> Any:
        """body(index, *carried) -> carried, for index from ``first`` to ``end`` - 1."""

        def step(index, *carried):
            return index + 1, *body(index, *carried)

        start = first + self.dr.zeros(self.arr.UInt32, self.extent[-1])
        return self.dr.while_loop(
            (start, *carried), lambda index, *_: index < end, step, mode="symbolic"
        )[1:]

    def loop_back(self, first, end, body, *carried) -> Any:
        """The same from ``end`` - 1 down to ``first``."""

        def step(index, *carried):
            return index - 1, *body(index - 1, *carried)

        start = end + self.dr.zeros(self.arr.UInt32, self.extent[-1])
        return self.dr.while_loop(
            (start, *carried), lambda index, *_: index > first, step, mode="symbolic"
        )[1:]

    def tensor(self, value, shape):
        """A tensor with memory of its own."""
        return value.torch().reshape(shape).clone()

    def stack(self, values, shape, kind=None):
        """A tensor of several values, in memory of drjit (``fresh``)."""
        target = self.fresh(len(values), kind)
        for k, value in enumerate(values):
            self.put(target, value, k)
        self.dr.eval(target)
        self.dr.sync_thread()
        return target.torch().reshape(len(values), *shape)


def beyond(dr, level, centre, theta_on, theta_off):
    """How far a level lies above and below a play as wide as the mean threshold, >= 0 each: what
    the mean of hard counts, and the play's centre, move by (docs/events.md)."""
    half = (theta_on + theta_off) * 0.25
    above, below = level - centre - half, centre - half - level
    return dr.select(above > 0, above, 0), dr.select(below > 0, below, 0)


def recursion(
    step: Callable[..., tuple[Any, list[Any]]], values: Tensor, numbers: Tensor, start: Tensor
) -> tuple[Tensor, Tensor]:
    """Carry states over time.

    Args:
      step: (drjit, value, numbers, states) -> (output, states), of arrays of all pixels; it may
        hold no others.
      values: [T, N] one per step.
      numbers: [K, N] that stay.
      start: [S, N] states; all of one floating type.
    Returns: outputs [T, N]; states [S, N] after the last step. Gradient: values, numbers, start.
    """
    return _Recursion.apply(step, values, numbers, start)


class _Recursion(Function):
    @staticmethod
    @exclusive
    def forward(ctx, step, values, numbers, start):
        steps = _Steps(step, values, numbers, len(start))
        output = steps.fresh(len(values))
        # of one span alone the states before every step are kept, of several those before each span
        ctx.kept = steps.memory() if any(ctx.needs_input_grad) and len(steps.spans) == 1 else None
        states = [steps.rows(start)]
        for span in steps.spans:
            states.append(steps.run(span, states[-1], output, ctx.kept))
        steps.dr.sync_thread()
        ctx.step = step
        ctx.starts = states[1:-1]
        ctx.save_for_backward(values, numbers, start)
        return output.torch().reshape(values.shape), torch.stack(
            [state.torch() for state in states[-1]]
        )

    @staticmethod
    @once_differentiable
    @exclusive
    def backward(ctx, grad_output, grad_after):  # pyright: ignore[reportIncompatibleMethodOverride]
        values, numbers, start = ctx.saved_tensors
        steps = _Steps(ctx.step, values, numbers, len(start))
        target = steps.fresh(len(values))
        kept = steps.memory() if ctx.kept is None else ctx.kept
        seeds = steps.load(grad_output)
        gathered = [steps.dr.zeros(steps.arr.Float, steps.width) for _ in numbers]
        carried = steps.rows(grad_after)
        for span, states in reversed(
            list(zip(steps.spans, [steps.rows(start), *ctx.starts], strict=True))
        ):
            if ctx.kept is None:
                steps.run(span, states, None, kept)
            gathered, carried = steps.run_back(span, gathered, carried, kept, seeds, target)
        steps.dr.sync_thread()
        grads = [torch.stack([row.torch() for row in rows]) for rows in (gathered, carried)]
        return None, target.torch().reshape(values.shape), *grads


class _Steps(Lanes):
    """The loops over time, in spans whose states all take as much memory as the values, or as few
    as there are spans."""

    def __init__(self, step, values, numbers, states):
        super().__init__(values, values.shape[1])
        self.step = step
        self.states = states
        self.values = self.load(values)
        self.numbers = self.rows(numbers)
        steps = len(values)
        size = max(4, math.isqrt(steps), steps // states)
        self.spans = [(first, min(first + size, steps)) for first in range(0, steps, size)]

    def memory(self):
        """For the states before every step of a span."""
        return self.fresh(max(end - first for first, end in self.spans) * self.states)

    def run(self, span, states, output, kept):
        """The steps of a span; the outputs and the states before every step, where wanted."""
        first, end = map(self.opaque, span)

        def body(t, states):
            if kept is not None:
                for j, state in enumerate(states):
                    self.put(kept, state, (t - first) * self.states + j)
            value, states = self.step(self.dr, self.at(self.values, t), self.numbers, states)
            if output is not None:
                self.put(output, value, t)
            return (states,)

        with self.dr.suspend_grad():
            (states,) = self.loop(first, end, body, states)
        self.dr.eval(states, output, kept)
        return states

    def run_back(self, span, gathered, carried, kept, seeds, target):
        """Gradients before a span, of numbers and states, from those after it; of the values into
        target."""
        first, end = map(self.opaque, span)
        count = len(self.numbers)

        def step(value, *others):
            output, states = self.step(self.dr, value, others[:count], others[count:])
            return output, *states

        def body(t, gathered, carried):
            before = [self.at(kept, (t - first) * self.states + j) for j in range(self.states)]
            given = [self.at(self.values, t), *self.numbers, *before]
            value, *found = pull_back(step, given, [self.at(seeds, t), *carried])
            self.put(target, value, t)
            return [total + more for total, more in zip(gathered, found, strict=False)], found[
                count:
            ]

        with self.dr.suspend_grad():
            gathered, carried = self.loop_back(first, end, body, gathered, carried)
        self.dr.eval(target, gathered, carried)
        return gathered, carried
