"""Stages "events" and "spiking": what event layers and the spike response layer cost."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from codesign import events
from codesign.events.spiking.srm import srm
from studies.frame.bench import cost, installed, measure, resident_mb
from studies.frame.run import Run
from studies.frame.show import Asked, Panel, panels, tabulate
from studies.frame.sweep import select, sweep
from studies.speed_error import Config

SIZES = {"346x260": (260, 346, 96), "1280x720": (720, 1280, 32)}
SPEED_PX = {"calm": 0.05, "busy": 0.6}
FPS = 1000
CHUNK = 500  # frames of the stream at a time
THETA = 0.2
# every kind of noise that v2e has by default
NOISE = events.SensorModel(
    theta_sigma=0.03,
    cutoff_hz=300.0,
    leak_rate_hz=0.1,
    leak_jitter=0.1,
    rate_cov_decades=0.1,
    shot_rate_hz=1.0,
    refractory_s=0.5e-3,
)
SENSORS = {
    "hard, ideal": events.SensorModel(),
    "hard, full noise": NOISE,
    "hard, photoreceptor noise": events.SensorModel(
        theta_sigma=0.03, cutoff_hz=300.0, shot_rate_hz=1.0, photoreceptor_noise=True
    ),
    "hard, v2e timing": events.SensorModel(timing="v2e"),
}
LAYERS: dict[str, Callable] = {
    "memory": lambda frames: events.memory(frames, THETA, THETA)[0],
    "memory of unequal thresholds": lambda frames: events.memory(frames, THETA, 1.2 * THETA)[0],
    "sigmoid": lambda frames: events.soft(frames, THETA),
    "dense": lambda frames: events.dense(frames, THETA, THETA)[0],
}
# million pixels per second by the clock, two cores
ASKED = {"hard, ideal": 120.0, "hard, full noise": 60.0, "memory, forward + backward": 120.0}

STEPS = (200, 1000)
KINDS = ("forward", "forward_backward")
PEERS = {"snntorch": "snntorch", "norse": "norse"}
ASKED_COPIES = {"forward": 2.0, "forward_backward": 5.0}
ASKED_SPEED = {"convolution": 20.0, **dict.fromkeys(PEERS, 4.0)}
PIXELS = (2, 128, 128)
THETA_SPIKE = 1.0
TAU_S = 10.0
TAU_R = 1.0


def stage(run: Run[Config]) -> list[Asked]:
    """Million pixels per second of a drifting texture at 1,000 frames per second, at two speeds:
    what a pixel costs depends on how often it fires. Copies: time over that of a copy of the frames
    in memory."""
    config = run.config
    sizes = list(SIZES)[:1] if config.quick else list(SIZES)
    given = {"repeats": config.repeats, "seed": config.seed}
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    rows = sweep(run, timed, "events", given=given, size=sizes, pace=SPEED_PX)
    tabulate(run, "Speed", rows, "layer", "pace", "size")
    stream(run, 5_000 if config.quick else 100_000)
    torch.set_num_threads(threads)
    return [
        Asked(f"{row['layer']}, {row['pace']}, {row['size']}: Mpixel/s", row["mpixel_per_s"], least)
        for layer, least in ASKED.items()
        for row in select(rows, layer=layer)
    ]


def texture(height: int, width: int, count: int, speed_px: float, seed: int) -> torch.Tensor:
    """[T, H, W] frames 20 to 220 of a smooth random texture that drifts along x by ``speed_px`` per
    frame."""
    generator = torch.Generator().manual_seed(seed)
    wide = width // 4 + 8 + int(count * speed_px) // 4
    coarse = torch.rand(1, 1, height // 4 + 2, wide, generator=generator)
    smooth = torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bicubic")[0, 0]
    fine = smooth.clamp(0, 1) * 200 + 20
    frames = torch.empty(count, height, width)
    for k in range(count):
        whole, part = divmod(k * speed_px, 1.0)
        left = fine[:height, int(whole) : int(whole) + width + 1]
        frames[k] = left[:, :-1] * (1 - part) + left[:, 1:] * part
    return frames


def timed(size: str, pace: float, repeats: int, seed: int) -> list[dict[str, object]]:
    """A row for every sensor and layer on frames of one size and speed (px per frame)."""
    height, width, count = SIZES[size]
    frames = texture(height, width, count, pace, seed)
    t_s = torch.arange(count, dtype=torch.float64) / FPS
    copy = measure(frames.clone, repeats).wall
    leaf = frames.clone().requires_grad_()
    weight = torch.rand(count - 1, 2, height, width, generator=torch.Generator().manual_seed(0))
    rows = []

    def differentiated(layer):
        return torch.autograd.grad(layer(leaf), leaf, weight)

    def add(name, work, **more):
        timing = measure(work, repeats)
        speed = {"mpixel_per_s": timing.wall, "mpixel_per_cpu_s": timing.cpu}
        speed = {clock: frames.numel() / 1e6 / seconds for clock, seconds in speed.items()}
        rows.append({"layer": name, **speed, "copies": timing.wall / copy, **more})

    for name, sensor in SENSORS.items():
        work = partial(events.simulate, frames, t_s, sensor)
        add(name, work, events_per_pixel=len(work()) / frames.numel())
    add("memory, forward", lambda: LAYERS["memory"](frames))
    for name, layer in LAYERS.items():
        add(f"{name}, forward + backward", partial(differentiated, layer))
    return rows


def stream(run: Run[Config], count: int) -> None:
    """Memory in use while frames of 32 x 32 pixels go through a sensor with all noise; events are
    dropped."""
    frames = texture(32, 32, CHUNK, 0.05, run.config.seed)
    state = events.SensorState()
    memory = []
    with run.progress(count // CHUNK, "stream") as progress:
        for first in range(0, count, CHUNK):
            t_s = torch.arange(first, first + CHUNK, dtype=torch.float64) / FPS
            events.simulate(frames, t_s, NOISE, state=state)
            memory.append(resident_mb())
            progress.advance(memory_mb=memory[-1])
    run.record(stream_growth_mb=max(memory) - memory[len(memory) // 10])
    at = np.linspace(0, count, len(memory))
    chart = Panel({"memory": (at, memory)}, "frames", "memory in use, MB")
    caption = f"{count:,} frames, {CHUNK} at a time, through a sensor."
    run.figure(panels(chart, width=6), "memory", caption)


def spiking_stage(run: Run[Config]) -> list[Asked]:
    """The spike response layer beside a convolution of 77 taps, snnTorch's and norse's two-state
    cells, on 2 x 128 x 128 pixels in float32; every layer in processes of its own, in turns.
    Copies: time over that of a copy of input, spikes and potential. Peak: memory of the first call
    beyond what was in use. The convolution is SLAYER's: finite kernels, a sequential reset, no
    gradient through it."""
    config = run.config
    layers = [name for name in SPIKING if name not in PEERS or name in installed(PEERS)]
    steps = STEPS[:1] if config.quick else STEPS
    axes = {"steps": steps, "layer": layers, "kind": KINDS}
    given = {"repeats": config.repeats, "seed": config.seed}
    rows = sweep(run, spiking, "spiking", processes=1, turns=config.rounds, given=given, **axes)
    tabulate(run, "One call, medians", rows, *axes, prefix="spiking")
    figures = []
    for count in steps:
        ours = {row["kind"]: row for row in select(rows, layer="codesign", steps=count)}
        for kind, most in ASKED_COPIES.items():
            figures.append(Asked(f"{kind}, T = {count}: copies", ours[kind]["copies"], most=most))
        both = ours["forward_backward"]["wall_s"]
        for row in select(rows, steps=count, kind="forward_backward"):
            if least := ASKED_SPEED.get(row["layer"]):
                what = f"{row['layer']} over ours, T = {count}: wall"
                figures.append(Asked(what, row["wall_s"] / both, least))
    return figures


def spiking(layer: str, kind: str, steps: int, repeats: int, seed: int) -> dict[str, float]:
    """Cost of one layer, of the drive's gradient too, and of copies; the convolution, which takes
    seconds, is called twice."""
    torch.set_num_threads(2)
    generator = torch.Generator().manual_seed(seed)
    drive, seeds = torch.rand(2, steps, *PIXELS, generator=generator)
    function = SPIKING[layer]

    def work(drive=drive, seeds=seeds):
        if kind == "forward":
            with torch.no_grad():
                return function(drive)
        leaf = drive.detach().requires_grad_()
        return torch.autograd.grad(function(leaf), leaf, seeds)[0]

    # compiles, and loads what the layer needs, without the memory of the whole
    work(drive[:2], seeds[:2])
    found = cost(work, 2 if layer == "convolution" else repeats)
    copy = measure(lambda: (drive.clone(), seeds.clone(), drive.clone()), repeats)
    return found | {"copies": found["wall_s"] / copy.wall, "cpu_copies": found["cpu_s"] / copy.cpu}


def ours(drive):
    return srm(drive, theta=THETA_SPIKE, tau_s=TAU_S, tau_r=TAU_R, response="alpha")[0]


def taps(tau: float, amplitude: float) -> torch.Tensor:
    """SLAYER's finite alpha kernel, down to 0.01: 77 taps for tau = 10."""
    found = []
    while len(found) <= tau or abs(found[-1]) >= 0.01:
        k = len(found)
        found.append(amplitude * k / tau * math.exp(1 - k / tau))
    return torch.tensor(found[:-1])


class SequentialReset(torch.autograd.Function):
    """SLAYER's spike function: threshold, add the reset kernel to the steps to come; backward
    multiplies by the surrogate."""

    @staticmethod
    def forward(ctx, response, reset):
        u = response.clone()
        spikes = torch.empty_like(u)
        later = reset[1:, None]
        for t in range(u.shape[0]):
            spikes[t] = u[t] >= THETA_SPIKE
            rest = u[t + 1 : t + 1 + later.shape[0]]
            rest.addcmul_(later[: rest.shape[0]], spikes[t])
        ctx.save_for_backward(u)
        return spikes

    @staticmethod
    def backward(ctx, *grads):
        (u,) = ctx.saved_tensors
        theta = THETA_SPIKE
        return grads[0] * torch.exp(-(u - theta).abs() / theta) / (2 * theta), None


def convolution(drive):
    """The layer by a 77-tap convolution over time and the sequential reset, in torch; time is last
    while convolving, as SLAYER lays its tensors out (and 5 times faster)."""
    kernel = taps(TAU_S, 1.0)
    rows = drive.reshape(drive.shape[0], -1).T.unsqueeze(1)
    padded = torch.nn.functional.pad(rows, (kernel.numel() - 1, 0))
    response = torch.conv1d(padded, kernel.flip(0).reshape(1, 1, -1))
    reset = taps(TAU_R, -2 * THETA_SPIKE)
    return SequentialReset.apply(response[:, 0].T.contiguous(), reset).reshape(drive.shape)


def snntorch_cell(drive):
    """snnTorch's two-state cell (synaptic current and membrane, reset by subtraction), step by
    step."""
    import snntorch  # pyright: ignore[reportMissingImports]

    decay = math.exp(-1 / TAU_S)
    cell = snntorch.Synaptic(decay, decay, threshold=THETA_SPIKE, reset_mechanism="subtract")
    return _stepped(cell, cell.reset_mem(), drive)


def _stepped(cell, states, drive):
    spikes = []
    for x in drive:
        spike, *states = cell(x, *states)
        spikes.append(spike)
    return torch.stack(spikes)


def norse_cell(drive):
    """norse's two-state leaky integrate-and-fire cell, step by step."""
    from norse.torch import LIFCell  # pyright: ignore[reportMissingImports]

    return _stepped(LIFCell(), [None], drive)


SPIKING: dict[str, Callable] = {
    "codesign": ours,
    "convolution": convolution,
    "snntorch": snntorch_cell,
    "norse": norse_cell,
}
