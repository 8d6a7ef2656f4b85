"""Stage "spiking": time and memory of the spike response layer beside a 77-tap convolution, snnTorch's and
norse's two-state cells (pip install "codesign[bench]"), and a memory copy.

2 x 128 x 128 pixels in float32, forward alone and with the gradient of the drive. Every layer runs in
processes of its own, in turns with the others, with two threads; a copy of input, spikes and potential, the
measure of what moving the data costs, is timed between its repeats.
"""

import math
import os
import statistics

import torch

from codesign.events.spiking.srm import srm
from studies.frame.bench import Timing, installed, peak_mb, turns
from studies.frame.run import Run
from studies.frame.show import Asked, asked, bars, table
from studies.frame.sweep import metrics, select, sweep
from studies.speed_error import Config

STEPS = (200, 1000)
KINDS = ("forward", "forward_backward")
PEERS = {"snntorch": "snntorch", "norse": "norse"}
ASKED_COPIES = {"forward": 2.0, "forward_backward": 5.0}  # at most
ASKED_SPEED = {"convolution": 20.0, **dict.fromkeys(PEERS, 4.0)}  # at least, forward and backward
PIXELS = (2, 128, 128)
ARRAY_MB = 4 * 2 * 128 * 128 / 1e6  # one step of one array
THETA = 1.0
TAU_S = 10.0
TAU_R = 1.0


def stage(run: Run[Config]) -> str:
    """The spike response layer beside what else could compute it."""
    config = run.config
    steps = STEPS[:1] if config.quick else STEPS
    peers = installed(PEERS)
    found = sweep(
        run,
        timed,
        "spiking",
        processes=1,
        turn=range(config.rounds),
        steps=steps,
        layer=("codesign", "codesign-segments", "convolution", *peers),
        kind=KINDS,
        repeats=[config.repeats],
        seed=[config.seed],
    )
    rows = []
    for first in select(found, turn=0):
        parts = select(found, **{axis: first[axis] for axis in ("steps", "layer", "kind")})
        work, copy = (
            Timing(
                *(tuple(t for part in parts for t in part[f"{what}_{clock}_s"]) for clock in ("wall", "cpu"))
            )
            for what in ("work", "copy")
        )
        rows.append(
            {axis: first[axis] for axis in ("layer", "kind", "steps")}
            | {
                "wall_s": work.wall,
                "wall_iqr_s": work.wall_iqr,
                "cpu_s": work.cpu,
                "copies": work.wall / copy.wall,
            }
            | {"cpu_copies": work.cpu / copy.cpu, "peak_mb": statistics.median(p["peak_mb"] for p in parts)}
        )
    run.record(**metrics(rows, "layer", "kind", "steps", prefix="spiking"))
    run.section(
        "Spiking layers",
        "Copies: time over that of a copy of input, spikes and potential, timed between the repeats. "
        "Peak: memory of the first call beyond what was in use, input not counted. The convolution is "
        "SLAYER's: finite kernels, a sequential reset, no gradient through it, time last as it lays its "
        "tensors out.",
    )
    titles = {
        "wall_s": "wall, s",
        "cpu_s": "CPU-s",
        "copies": "copies",
        "cpu_copies": "CPU copies",
        "peak_mb": "MB",
    }
    run.table("One call, medians", *table(rows, layer="layer", kind="work", steps="T", **titles))
    both = {f"{r['layer']}, T = {r['steps']}": r["wall_s"] for r in select(rows, kind="forward_backward")}
    run.figure(bars(both, "seconds, forward and backward", log=True), "spiking", "One call, by the clock.")
    missing = sorted(set(PEERS) - set(peers))
    said = asked(run, judged(rows, steps), "Spiking layers, ratios of medians by the clock", beside="CPU")
    return said + (f" Not installed, hence not compared: {', '.join(missing)}." if missing else "")


def judged(rows, steps) -> list[Asked]:
    figures = []
    for count in steps:
        for kind, most in ASKED_COPIES.items():
            (ours,) = select(rows, layer="codesign", kind=kind, steps=count)
            what = f"{kind.replace('_', ' + ')} in copies, T = {count}"
            figures.append(Asked(what, ours["copies"], most=most, beside=ours["cpu_copies"]))
        # output: spikes, potential and the gradient of the drive; the potential is the one array kept between
        figures.append(
            Asked(f"arrays beside the input, T = {count}", ours["peak_mb"] / (ARRAY_MB * count), most=3.1)
        )
        for layer, least in ASKED_SPEED.items():
            for peer in select(rows, layer=layer, kind="forward_backward", steps=count):
                what = f"speed over {layer}, T = {count}"
                figures.append(
                    Asked(
                        what,
                        peer["wall_s"] / ours["wall_s"],
                        least=least,
                        beside=peer["cpu_s"] / ours["cpu_s"],
                    )
                )
    return figures


def timed(layer: str, kind: str, steps: int, repeats: int, seed: int, turn: int) -> dict[str, object]:
    """Seconds of calls and of copies in turns, and peak memory of the first call; the convolution, which
    takes seconds, is called twice."""
    torch.set_num_threads(min(2, os.cpu_count() or 1))
    generator = torch.Generator().manual_seed(seed)
    drive = torch.rand(steps, *PIXELS, generator=generator)
    seeds = torch.rand(steps, *PIXELS, generator=generator)
    function = LAYERS[layer]

    def gradient(drive, seeds):
        leaf = drive.detach().requires_grad_()
        return torch.autograd.grad(function(leaf), leaf, seeds)[0]

    def work():
        if kind == "forward":
            with torch.no_grad():
                return function(drive)
        return gradient(drive, seeds)

    with torch.no_grad():
        function(drive[:2])  # compiles, and loads what the layer needs, without the memory of the whole
    gradient(drive[:2], seeds[:2])
    peak = peak_mb(work)
    found = turns(
        {"copy": lambda: (drive.clone(), seeds.clone(), drive.clone()), "work": work},
        2 if layer == "convolution" else repeats,
        warm=0,
    )
    return {
        "peak_mb": peak,
        **{f"{name}_wall_s": timing.wall_s for name, timing in found.items()},
        **{f"{name}_cpu_s": timing.cpu_s for name, timing in found.items()},
    }


def ours(drive):
    return srm(drive, theta=THETA, tau_s=TAU_S, tau_r=TAU_R, response="alpha")[0]


def ours_in_segments(drive):
    """Segments of the square root of 8 T steps: float64 states of both kernels weigh as much as 8
    potentials."""
    segment = math.isqrt(8 * drive.shape[0])
    return srm(drive, theta=THETA, tau_s=TAU_S, tau_r=TAU_R, response="alpha", segment=segment)[0]


def taps(tau: float, amplitude: float, cut: float = 0.01) -> torch.Tensor:
    """SLAYER's finite alpha kernel: 77 taps for tau = 10."""
    found = []
    k = 0
    while k <= tau or abs(found[-1]) >= cut:
        found.append(amplitude * k / tau * math.exp(1 - k / tau))
        k += 1
    return torch.tensor(found[:-1])


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
    rows = drive.reshape(drive.shape[0], -1).T.unsqueeze(1)
    padded = torch.nn.functional.pad(rows, (kernel.numel() - 1, 0))
    response = torch.conv1d(padded, kernel.flip(0).reshape(1, 1, -1))
    return SequentialReset.apply(response[:, 0].T.contiguous(), taps(TAU_R, -2 * THETA)).reshape(drive.shape)


def snntorch_cell(drive):
    """snnTorch's two-state cell (synaptic current and membrane, reset by subtraction), step by step."""
    import snntorch  # pyright: ignore[reportMissingImports]

    decay = math.exp(-1 / TAU_S)
    cell = snntorch.Synaptic(alpha=decay, beta=decay, threshold=THETA, reset_mechanism="subtract")
    current, membrane = cell.reset_mem()
    spikes = []
    for x in drive:
        spike, current, membrane = cell(x, current, membrane)
        spikes.append(spike)
    return torch.stack(spikes)


def norse_cell(drive):
    """norse's two-state leaky integrate-and-fire cell, step by step."""
    from norse.torch import LIFCell  # pyright: ignore[reportMissingImports]

    cell = LIFCell()
    state = None
    spikes = []
    for x in drive:
        spike, state = cell(x, state)
        spikes.append(spike)
    return torch.stack(spikes)


LAYERS = {
    "codesign": ours,
    "codesign-segments": ours_in_segments,
    "convolution": convolution,
    "snntorch": snntorch_cell,
    "norse": norse_cell,
}
