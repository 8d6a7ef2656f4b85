"""Stage "events": speed and memory of the event layers beside a memory copy of the frames, in one run.

Frames of a drifting texture at 1,000 frames per second, at two speeds: calm (about 2 events per 100 pixels
and frame) and busy (about 25). What a pixel costs depends on how often it fires, so both are told. Then
frames are streamed through a sensor with every kind of noise while memory is watched, and the times of
float32 frames are set beside those of the same frames in float64.
"""

from collections.abc import Callable

import numpy as np
import torch

from codesign import events
from studies.frame.bench import measure, resident_mb
from studies.frame.run import Run
from studies.frame.show import Asked, Panel, asked, panels, table
from studies.frame.sweep import metrics, sweep
from studies.speed_error import Config

SIZES = {"346x260": (260, 346, 96), "1280x720": (720, 1280, 32)}
SPEED_PX = {"calm": 0.05, "busy": 0.6}
FPS = 1000
THETA = 0.2
NOISE = events.SensorModel(
    theta_sigma=0.03,
    cutoff_hz=300.0,
    leak_rate_hz=0.1,
    leak_jitter=0.1,
    rate_cov_decades=0.1,
    shot_rate_hz=1.0,
    refractory_s=0.5e-3,
)  # every kind that v2e has by default
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
# million pixels per second, two cores
ASKED = {"hard, ideal": 120.0, "hard, full noise": 60.0, "memory, forward + backward": 120.0}
SPEEDS_PER_S = ((0.01, 0.1), (0.1, 1), (1, 100))  # of the log level


def stage(run: Run[Config]) -> str:
    """The event layers: speed, memory, precision."""
    config = run.config
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # the kernels use every core
    sizes = list(SIZES)[:1] if config.quick else list(SIZES)
    rows = sweep(
        run, timed, "events", size=sizes, pace=SPEED_PX, repeats=[config.repeats], seed=[config.seed]
    )
    run.record(**metrics(rows, "layer", "pace", "size"))
    run.section(
        "Event layers",
        "Million pixels per second by the clock and of the processor; cost in copies of the frames in "
        "memory.",
    )
    titles = {"mpixel_per_s": "Mpixel/s", "mpixel_per_cpu_s": "Mpixel per CPU-s", "copies": "copies"}
    titles["events_per_pixel_frame"] = "events per pixel and frame"
    run.table("Speed", *table(rows, size="size", pace="pace", layer="layer", **titles))
    figures = [
        Asked(
            f"{row['layer']}, {row['pace']}, {row['size']}: Mpixel/s",
            row["mpixel_per_s"],
            ASKED[row["layer"]],
        )
        for row in rows
        if row["layer"] in ASKED
    ]
    stream(run, 5_000 if config.quick else 100_000)
    precision(run)
    torch.set_num_threads(threads)
    return asked(run, figures, "Event layers against what was asked")


def texture(height: int, width: int, count: int, speed_px: float, seed: int) -> torch.Tensor:
    """[T, H, W] frames 20 to 220 of a smooth random texture that drifts along x by ``speed_px`` per frame."""
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
    target = torch.empty_like(frames)
    copy = measure(lambda: target.copy_(frames), repeats).wall
    leaf = frames.clone().requires_grad_()
    weight = torch.rand(count - 1, 2, height, width, generator=torch.Generator().manual_seed(0))

    def differentiated(layer):
        leaf.grad = None
        layer(leaf).backward(weight)

    works: dict[str, Callable] = {
        name: lambda sensor=sensor: events.simulate(frames, t_s, sensor) for name, sensor in SENSORS.items()
    }
    works["memory, forward"] = lambda: LAYERS["memory"](frames)
    for name, layer in LAYERS.items():
        works[f"{name}, forward + backward"] = lambda layer=layer: differentiated(layer)
    rows = []
    for name, work in works.items():
        timing = measure(work, repeats, warm=2 if name in ASKED else 1)
        rows.append(
            {
                "layer": name,
                "mpixel_per_s": frames.numel() / 1e6 / timing.wall,
                "mpixel_per_cpu_s": frames.numel() / 1e6 / timing.cpu,
                "copies": timing.wall / copy,
                "events_per_pixel_frame": len(work()) / frames.numel() if name in SENSORS else None,
            }
        )
    return rows


def stream(run: Run[Config], count: int, chunk: int = 500) -> None:
    """Resident memory while frames of 32 x 32 pixels go through a sensor with all noise; the events are
    dropped."""
    base = texture(32, 32, chunk, 0.05, run.config.seed)
    state = events.SensorState()
    memory = []
    for first in range(0, count, chunk):
        t_s = torch.arange(first, first + chunk, dtype=torch.float64) / FPS
        events.simulate(base, t_s, NOISE, state=state)
        memory.append(resident_mb())
    grown = max(memory) - memory[len(memory) // 10]
    run.record(
        streamed_frames=count, stream_first_mb=memory[0], stream_last_mb=memory[-1], stream_growth_mb=grown
    )
    run.card("Memory growth of a stream", f"{grown:.1f} MB", f"{count:,} frames, after the first tenth")
    frames = np.linspace(0, count, len(memory))
    run.figure(
        panels(Panel({"memory": (frames, memory)}, "frames", "resident memory, MB"), width=6),
        "memory",
        f"{count:,} frames streamed, {chunk} at a time: flat after the first chunks.",
    )


def precision(run: Run[Config], cases: int = 40, pixels: int = 2048, count: int = 120) -> None:
    """float32 frames beside their float64 copies, ramps and sines of every speed: the share of pixels with
    another count, and for the others |time off| of every event, us, by the speed of the log level there,
    1/s."""
    generator = torch.Generator().manual_seed(run.config.seed)

    def drawn(low, high, *shape):
        uniform = torch.rand(shape or (1,), dtype=torch.float64, generator=generator)
        return low * (high / low) ** uniform

    other, speeds, off_us = 0.0, [], []
    for case in range(cases):
        t_s = torch.arange(count, dtype=torch.float64)[:, None] / drawn(60, 1000)
        per_s = drawn(0.05, 20, 1, pixels)
        phase = drawn(0.01, 6.3, 1, pixels)
        swing = torch.sin(per_s * t_s + phase) if case % 2 else (per_s * t_s).clamp(max=2.9)
        frames = (drawn(20, 5000, 1, pixels).log() + swing).exp().float()[:, None]
        levels = events.lin_log(frames[:, 0].double()).numpy()
        sensor = events.SensorModel(THETA, THETA)
        single, double = (events.simulate(f, t_s[:, 0], sensor) for f in (frames, frames.double()))
        same = torch.bincount(single.x, minlength=pixels) == torch.bincount(double.x, minlength=pixels)
        other += float((~same).sum()) / (cases * pixels)
        first, second = (s.t_us[s.x.argsort(stable=True)][same[s.x.sort().values]] for s in (single, double))
        x = double.x.sort().values[same[double.x.sort().values]].numpy()
        frame = np.clip(np.searchsorted(t_s[:, 0].numpy(), second.numpy() / 1e6), 1, count - 1)
        speeds.append(np.abs(levels[frame, x] - levels[frame - 1, x]) / float(t_s[1]))
        off_us.append((first - second).abs().numpy())
    run.record(float32_other_counts_share=other)
    speed, off = np.concatenate(speeds), np.concatenate(off_us)
    rows = []
    for low, high in SPEEDS_PER_S:
        here = off[(speed >= low) & (speed < high)]
        figures = {
            "p99_us": float(np.quantile(here, 0.99)),
            "max_us": float(here.max()),
            "above_1us_share": float(np.mean(here > 1)),
        }
        rows.append({"level per s": f"{low:g} to {high:g}"} | figures)
    run.record(**metrics(rows, "level per s", prefix="float32_off"))
    run.table(
        "Times of float32 frames beside float64, by the speed of the log level",
        *table(rows),
        f"{other:.1e} of the pixels have another count.",
    )
