"""A recursion over time of every pixel in drjit, and its exact gradient: the loop backward lets drjit
differentiate one step after the other, from states kept at some steps and computed again between."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.backend import arrays, load, pull_back
from codesign.exclusive import exclusive


def recursion(
    step: Callable[..., tuple[Any, list[Any]]], values: Tensor, numbers: Tensor, start: Tensor
) -> tuple[Tensor, Tensor]:
    """Carry states over time.

    Args: step: (drjit, value, numbers, states) -> (output, states), of arrays of all pixels; it may hold no
      others.
      values: [T, N] one per step. numbers: [K, N] that stay. start: [S, N] states; all of one floating type.
    Returns: outputs [T, N]; states [S, N] after the last step. Gradient: values, numbers, start.
    """
    return _Recursion.apply(step, values, numbers, start)


class _Recursion(Function):
    @staticmethod
    @exclusive
    def forward(ctx, step, values, numbers, start):
        loops = _Loops(step, values, numbers, len(start))
        output, after, ctx.starts, ctx.kept = loops.forward(start, any(ctx.needs_input_grad))
        ctx.step = step
        ctx.save_for_backward(values, numbers, start)
        return output, after

    @staticmethod
    @once_differentiable
    @exclusive
    def backward(ctx, grad_output, grad_after):  # pyright: ignore[reportIncompatibleMethodOverride]
        values, numbers, start = ctx.saved_tensors
        loops = _Loops(ctx.step, values, numbers, len(start))
        return None, *loops.backward(start, ctx.starts, ctx.kept, grad_output, grad_after)


class _Loops:
    """The loops over time of every pixel, in spans whose states all take as much memory as the values, or as
    few as there are spans."""

    def __init__(self, step, values, numbers, states):
        import drjit as dr

        self.dr = dr
        self.step = step
        self.arr = arrays(values.device.type, values.dtype)
        self.steps, self.width = values.shape
        self.lane = dr.arange(self.arr.UInt32, self.width)
        self.pixels = dr.opaque(self.arr.UInt32, self.width)
        self.states = states
        self.values = load(self.arr.Float, values)
        self.numbers = self.rows(numbers)
        size = max(4, math.isqrt(self.steps), self.steps // states)
        self.spans = [(first, min(first + size, self.steps)) for first in range(0, self.steps, size)]

    def rows(self, tensor):
        return [load(self.arr.Float, row) for row in tensor]

    def memory(self):
        """For the states before every step of a span."""
        longest = max(end - first for first, end in self.spans)
        return self.dr.empty(self.arr.Float, longest * self.states * self.width)

    def forward(self, start, differentiated):
        """Outputs; states after the last step; those before every span but the first, as lanes; where there
        is one span alone, and it is to be differentiated, those before every step."""
        dr = self.dr
        output = dr.empty(self.arr.Float, self.steps * self.width)
        kept = self.memory() if differentiated and len(self.spans) == 1 else None
        states = self.rows(start)
        starts = []
        with dr.suspend_grad():
            for span in self.spans:
                starts.append(states)
                states = self.run(span, states, output, kept)
        dr.sync_thread()
        after = torch.stack([state.torch() for state in states])
        return output.torch().reshape(self.steps, self.width), after, starts[1:], kept

    def run(self, span, states, output=None, kept=None):
        """The steps of a span; the outputs and the states before every step, where wanted."""
        dr = self.dr
        first, end = self.bounds(span)

        def body(t, states):
            if kept is not None:
                for j, state in enumerate(states):
                    self.put(kept, state, self.place((t - first) * self.states + j))
            value, states = self.step(dr, self.at(self.values, t), self.numbers, states)
            if output is not None:
                self.put(output, value, self.place(t))
            return t + 1, states

        start = first + dr.zeros(self.arr.UInt32, self.width)
        _, states = dr.while_loop((start, states), lambda t, _: t < end, body, mode="symbolic")
        dr.eval(states, output, kept)
        return states

    def backward(self, start, starts, known, grad_output, grad_after):
        """Gradients of values, numbers and start."""
        dr = self.dr
        target = dr.empty(self.arr.Float, self.steps * self.width)
        kept = self.memory() if known is None else known
        seeds = load(self.arr.Float, grad_output)
        gathered = [dr.zeros(self.arr.Float, self.width) for _ in self.numbers]
        carried = self.rows(grad_after)
        with dr.suspend_grad():
            for span, states in reversed(list(zip(self.spans, [self.rows(start), *starts], strict=True))):
                if known is None:
                    self.run(span, states, kept=kept)
                gathered, carried = self.run_back(span, gathered, carried, kept, seeds, target)
        dr.sync_thread()
        grads = [torch.stack([row.torch() for row in rows]) for rows in (gathered, carried)]
        return target.torch().reshape(self.steps, self.width), *grads

    def run_back(self, span, gathered, carried, kept, seeds, target):
        """Gradients before a span, of numbers and states, from those after it; of the values into target."""
        dr = self.dr
        first, end = self.bounds(span)
        count = len(self.numbers)

        def step(value, *others):
            output, states = self.step(dr, value, others[:count], others[count:])
            return output, *states

        def body(t, gathered, carried):
            t = t - 1
            before = [self.at(kept, (t - first) * self.states + j) for j in range(self.states)]
            given = [self.at(self.values, t), *self.numbers, *before]
            value, *found = pull_back(step, given, [self.at(seeds, t), *carried])
            numbers, states = found[:count], found[count:]
            self.put(target, value, self.place(t))
            return t, [total + more for total, more in zip(gathered, numbers, strict=True)], states

        last = end + dr.zeros(self.arr.UInt32, self.width)
        _, gathered, carried = dr.while_loop(
            (last, gathered, carried), lambda t, *_: t > first, body, mode="symbolic"
        )
        dr.eval(target, gathered, carried)
        return gathered, carried

    def bounds(self, span):
        return [self.dr.opaque(self.arr.UInt32, value) for value in span]

    def place(self, row):
        return row * self.pixels + self.lane

    def at(self, flat, row):
        return self.dr.gather(self.arr.Float, flat, self.place(row))

    def put(self, target, value, place):
        self.dr.scatter(target, value, place, mode=self.dr.ReduceMode.NoConflicts)
