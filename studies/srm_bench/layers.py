"""One spiking layer timed in a process of its own: python -m studies.srm_bench.layers LAYER KIND STEPS
REPEATS SEED. Prints JSON.

Every repeat is preceded by a timed copy of the layer's input and outputs, so that both meet the same load.
"""

import json
import math
import os
import sys
import time

import codesign  # noqa: F401  (first: it sets OpenMP's wait policy before torch is imported)

import torch  # isort: skip

from codesign.events.spiking.srm import srm
from studies.lens_bench.tracers import forget_peak, peak

PIXELS = (2, 128, 128)
THETA = 1.0
TAU_S = 10.0
TAU_R = 1.0


def ours(drive):
    return srm(drive, theta=THETA, tau_s=TAU_S, tau_r=TAU_R, response="alpha")[0]


def ours_in_segments(drive):
    """Segments of the square root of 8 T steps: float64 states of both kernels weigh as much as 8
    potentials."""
    return srm(
        drive, theta=THETA, tau_s=TAU_S, tau_r=TAU_R, response="alpha", segment=math.isqrt(8 * drive.shape[0])
    )[0]


def taps(tau, amplitude, cut=0.01):
    """SLAYER's finite alpha kernel: 77 taps for tau = 10."""
    found = []
    k = 0
    while k <= tau or abs(amplitude * k / tau * math.exp(1 - k / tau)) >= cut:
        found.append(amplitude * k / tau * math.exp(1 - k / tau))
        k += 1
    return torch.tensor(found)


class SequentialReset(torch.autograd.Function):
    """SLAYER's spike function: threshold, add the reset kernel to the steps to come; backward multiplies by
    the surrogate."""

    @staticmethod
    def forward(ctx, response, reset):
        u = response.clone()
        spikes = torch.empty_like(u)
        later = reset[1:, None]
        for t in range(u.shape[0]):
            spikes[t] = u[t] >= THETA
            rest = u[t + 1 : t + 1 + later.shape[0]]
            rest.addcmul_(later[: rest.shape[0]], spikes[t])
        ctx.save_for_backward(u)
        return spikes

    @staticmethod
    def backward(ctx, *grads):
        (u,) = ctx.saved_tensors
        return grads[0] * torch.exp(-(u - THETA).abs() / THETA) / (2 * THETA), None


def convolution(drive):
    """The layer by a 77-tap convolution over time and the sequential reset, in torch; time is last while
    convolving, as SLAYER lays its tensors out (and 5 times faster)."""
    kernel = taps(TAU_S, 1.0)
    steps = drive.shape[0]
    rows = drive.reshape(steps, -1).T.unsqueeze(1)
    response = torch.conv1d(
        torch.nn.functional.pad(rows, (kernel.numel() - 1, 0)), kernel.flip(0).reshape(1, 1, -1)
    )
    return SequentialReset.apply(response[:, 0].T.contiguous(), taps(TAU_R, -2 * THETA)).reshape(drive.shape)


def snntorch_cell(drive):
    """snnTorch's two-state cell (synaptic current and membrane, reset by subtraction), step by step."""
    import snntorch  # pyright: ignore[reportMissingImports]

    cell = snntorch.Synaptic(
        alpha=math.exp(-1 / TAU_S), beta=math.exp(-1 / TAU_S), threshold=THETA, reset_mechanism="subtract"
    )
    current, membrane = cell.reset_mem()
    spikes = []
    for x in drive:
        s, current, membrane = cell(x, current, membrane)
        spikes.append(s)
    return torch.stack(spikes)


def norse_cell(drive):
    """norse's two-state leaky integrate-and-fire cell, step by step."""
    from norse.torch import LIFCell  # pyright: ignore[reportMissingImports]

    cell = LIFCell()
    state = None
    spikes = []
    for x in drive:
        s, state = cell(x, state)
        spikes.append(s)
    return torch.stack(spikes)


LAYERS = {
    "codesign": ours,
    "codesign-segments": ours_in_segments,
    "convolution": convolution,
    "snntorch": snntorch_cell,
    "norse": norse_cell,
}


def run(layer, kind, steps, repeats, seed):
    """Seconds and peak memory of ``repeats`` calls after one that warms up, and of copies of input and
    outputs in between."""
    generator = torch.Generator().manual_seed(seed)
    drive = torch.rand(steps, *PIXELS, generator=generator)
    seed_of_gradient = torch.rand(steps, *PIXELS, generator=generator)
    function = LAYERS[layer]

    def work():
        if kind == "forward":
            with torch.no_grad():
                return function(drive)
        leaf = drive.detach().requires_grad_()
        return torch.autograd.grad(function(leaf), leaf, seed_of_gradient)[0]

    def copy():
        """Three arrays: input, spikes and potential."""
        return drive.clone(), seed_of_gradient.clone(), drive.clone()

    timings = {"work": ([], []), "copy": ([], [])}
    with torch.no_grad():
        function(drive[:2])  # compiles, and loads what the layer needs, without the memory of the whole
    leaf = drive[:2].detach().requires_grad_()
    torch.autograd.grad(function(leaf), leaf, seed_of_gradient[:2])
    before = forget_peak()
    work()
    used = peak() - before
    copy()
    for _ in range(repeats):
        for name, call in (("copy", copy), ("work", work)):
            wall = time.perf_counter()
            cpu = time.process_time()
            result = call()
            timings[name][0].append(time.perf_counter() - wall)
            timings[name][1].append(time.process_time() - cpu)
            del result
    return {
        "wall_s": timings["work"][0],
        "cpu_s": timings["work"][1],
        "copy_wall_s": timings["copy"][0],
        "copy_cpu_s": timings["copy"][1],
        "peak_bytes": used,
    }


if __name__ == "__main__":
    torch.set_num_threads(min(2, os.cpu_count() or 1))
    print(json.dumps(run(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), int(sys.argv[5]))))
