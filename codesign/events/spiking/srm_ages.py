"""The gradient of spikes whose reset fades: that of the mean response of many noisy neurons, by the age of their
last spike.

All neurons of a pixel see one response v; a share P_k of them spiked last k steps ago, and carries the mean states
of its resets. Where u = v + reset comes near theta a neuron spikes at the rate PACE / tau_r ln(1 + exp(x)), x = (u -
theta) / (WIDTH theta): of each age the share F = 1 - exp(-dt rate) spikes in a step and goes to age 0; the others grow
older, into a last age that holds all that are older still. The mean spikes, sum_k P_k F_k, are a smooth function of
the response, and their gradient is exact: the loop backward in time lets drjit differentiate one step after the other,
from states kept at some steps and computed again between.

The equations are those of a population of neurons with escape noise: Gerstner and Kistler, Spiking Neuron Models,
2002, section 6.2, with the resets of earlier spikes as a mean per age. For dt = tau_r / PACE the share is a logistic
function of x.
"""

import math

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.backend import arrays, load
from codesign.events.spiking.srm_kernels import advance
from codesign.exclusive import exclusive

WIDTH = 0.087  # of the noise, in thresholds; a narrower one is nearer to hard spikes, and its gradient more erratic
PACE = 1.2  # spikes per tau_r and x, far above the threshold
MEAN_AGE = 3.0  # of the last spike before the first step, in time constants of the reset
TINY = 1e-9  # share below which an age has no states of its own


def rested(ages: int, states: int, h: Tensor) -> Tensor:
    """[1 + states, ages, ...] shares and reset states of neurons that spiked last at a random time, MEAN_AGE time
    constants ago on average. h: [...] dt/tau of the reset."""
    age = (
        torch.arange(ages, dtype=h.dtype, device=h.device).reshape(-1, *[1] * h.ndim) * h
    )  # in time constants
    older = (-age / MEAN_AGE).exp()
    shares = older - torch.cat((older[1:], torch.zeros_like(older[:1])))
    left = (-age - h / 2).exp()  # spikes come in the middle of a step on average
    return torch.stack((shares, left, (age / h + 0.5) * left)[: 1 + states])


def mean_spikes(
    kind: str, response: Tensor, theta: Tensor, a: Tensor, m: Tensor, pace: Tensor, start: Tensor
) -> tuple[Tensor, Tensor]:
    """Mean spikes of the noisy neurons.

    Args: kind: of recursion of the reset (srm_kernels). response: [T, N] float32 or float64. theta, a, m, pace: [N]
      threshold, decay and amplitude of the reset, PACE dt / tau_r; of the same type. start: [1 + states,
      ages, N] shares and states.
    Returns: [T, N] in 0 to 1; the shares and states after the last step. Gradient: of all but kind.
    """
    return _Mean.apply(kind, response, theta, a, m, pace, start)


class _Mean(Function):
    @staticmethod
    @exclusive
    def forward(ctx, kind, response, theta, a, m, pace, start):
        loop = _Ages(kind, response, theta, a, m, pace, start.shape)
        mean, after, ctx.starts = loop.forward(start)
        ctx.kind = kind
        ctx.save_for_backward(response, theta, a, m, pace, start)
        return mean, after

    @staticmethod
    @once_differentiable
    @exclusive
    def backward(ctx, grad_mean, grad_after):  # pyright: ignore[reportIncompatibleMethodOverride]
        response, theta, a, m, pace, start = ctx.saved_tensors
        loop = _Ages(ctx.kind, response, theta, a, m, pace, start.shape)
        return None, *loop.adjoint([loop.split(start), *ctx.starts], grad_mean, grad_after)


class _Ages:
    """The loops over time of every pixel."""

    def __init__(self, kind, response, theta, a, m, pace, shape):
        import drjit as dr

        self.dr = dr
        self.kind = kind
        self.arr = arrays(response.device.type, response.dtype)
        self.steps, self.width = response.shape
        self.states, self.ages = shape[0] - 1, shape[1]
        self.count = (1 + self.states) * self.ages
        self.lane = dr.arange(self.arr.UInt32, self.width)
        self.pixels = dr.opaque(self.arr.UInt32, self.width)
        self.response = self.load(response)
        self.numbers = [self.load(value) for value in (theta, a, m, pace)]
        size = max(4, math.isqrt(self.steps))
        self.spans = [(first, min(first + size, self.steps)) for first in range(0, self.steps, size)]

    def load(self, tensor):
        return load(self.arr.Float, tensor)

    def split(self, tensor):
        """Lanes of shares and states [1 + states, ages, N], one after the other."""
        return [self.load(row) for row in tensor.flatten(0, 1)]

    def join(self, values):
        return torch.stack([value.torch() for value in values]).reshape(1 + self.states, self.ages, -1)

    def step(self, response, theta, a, m, pace, *flat):
        """Mean spikes of one step; shares and states after it."""
        dr = self.dr
        ages = self.ages
        sharpness = 1 / (WIDTH * theta)
        rows = [flat[ages * j : ages * (j + 1)] for j in range(1 + self.states)]
        fired, kept, carried = [], [], []
        for share, *states in zip(*rows, strict=True):
            reset, states = advance(self.kind, states, a, m)
            x = (response + reset - theta) * sharpness
            hazard = pace * (dr.maximum(x, 0) + dr.log(1 + dr.exp(-dr.abs(x))))
            kept.append(share * dr.exp(-hazard))
            fired.append(share - kept[-1])
            carried.append(states)
        spikes = sum(fired)
        new = self.mixed(fired, carried)
        new[0] = new[0] + 1
        old = self.mixed(kept[-2:], carried[-2:])
        after = [spikes, *kept[:-2], kept[-2] + kept[-1]]
        for j in range(self.states):
            after += [new[j], *(states[j] for states in carried[:-2]), old[j]]
        return spikes, *after

    def mixed(self, shares, carried):
        """Mean states of some ages."""
        total = sum(shares) + TINY * len(shares)
        return [
            sum((share + TINY) * states[j] for share, states in zip(shares, carried, strict=True)) / total
            for j in range(self.states)
        ]

    def forward(self, start):
        """Mean spikes; shares and states after the last step; those before every span but the first, as lanes."""
        dr = self.dr
        mean = dr.empty(self.arr.Float, self.steps * self.width)
        flat = self.split(start)
        starts = []
        with dr.suspend_grad():
            for span in self.spans:
                starts.append(flat)
                flat = self.run(span, flat, mean=mean)
        dr.sync_thread()
        return mean.torch().reshape(self.steps, self.width), self.join(flat), starts[1:]

    def run(self, span, flat, mean=None, kept=None):
        """The steps of a span; the mean spikes and the states before every step, where wanted."""
        dr = self.dr
        first, end = self.bounds(span)

        def body(t, *flat):
            if kept is not None:
                for j, value in enumerate(flat):
                    self.put(kept, value, self.place((t - first) * self.count + j))
            response = dr.gather(self.arr.Float, self.response, self.place(t))
            spikes, *flat = self.step(response, *self.numbers, *flat)
            if mean is not None:
                self.put(mean, spikes, self.place(t))
            return t + 1, *flat

        start = first + dr.zeros(self.arr.UInt32, self.width)
        _, *flat = dr.while_loop((start, *flat), lambda t, *_: t < end, body, mode="symbolic")
        dr.eval(flat, mean, kept)
        return flat

    def adjoint(self, starts, grad_mean, grad_after):
        """Gradients of response, theta, a, m, pace and the start."""
        dr = self.dr
        Float = self.arr.Float
        target = dr.empty(Float, self.steps * self.width)
        longest = max(end - first for first, end in self.spans)
        kept = dr.empty(Float, longest * self.count * self.width)
        seeds = self.load(grad_mean)
        carried = [dr.zeros(Float, self.width) for _ in self.numbers] + self.split(grad_after)
        with dr.suspend_grad():
            for span, flat in reversed(list(zip(self.spans, starts, strict=True))):
                self.run(span, flat, kept=kept)
                carried = self.run_back(span, carried, kept, seeds, target)
        dr.sync_thread()
        numbers = [value.torch() for value in carried[: len(self.numbers)]]
        start = self.join(carried[len(self.numbers) :])
        return target.torch().reshape(self.steps, self.width), *numbers, start

    def run_back(self, span, carried, kept, seeds, target):
        """Gradients before a span of numbers, shares and states, from those after it; of the response into target."""
        dr = self.dr
        Float = self.arr.Float
        first, end = self.bounds(span)
        numbers = len(self.numbers)

        def body(t, *carried):
            t = t - 1
            before = [
                dr.gather(Float, kept, self.place((t - first) * self.count + j)) for j in range(self.count)
            ]
            seed = dr.gather(Float, seeds, self.place(t))
            given = [dr.gather(Float, self.response, self.place(t)), *self.numbers, *before]
            response, *found = self.step_back(given, [seed, *carried[numbers:]])
            self.put(target, response, self.place(t))
            gathered = [total + more for total, more in zip(carried, found[:numbers], strict=False)]
            return t, *gathered, *found[numbers:]

        last = end + dr.zeros(self.arr.UInt32, self.width)
        _, *carried = dr.while_loop((last, *carried), lambda t, *_: t > first, body, mode="symbolic")
        dr.eval(target, carried)
        return carried

    def step_back(self, given, seeds):
        """Gradients of what a step is given, from those of what it gives."""
        dr = self.dr
        with dr.resume_grad():
            given = [dr.detach(value) + 0 for value in given]
            dr.enable_grad(given)
            found = self.step(*given)
            products = [value * dr.detach(seed) for value, seed in zip(found, seeds, strict=True)]
            dr.backward_from(sum(products[1:], products[0]))
            return [dr.grad(value) for value in given]

    def bounds(self, span):
        return [self.dr.opaque(self.arr.UInt32, value) for value in span]

    def place(self, row):
        return row * self.pixels + self.lane

    def put(self, target, value, place):
        self.dr.scatter(target, value, place, mode=self.dr.ReduceMode.NoConflicts)
