"""Speed and memory of the event stage: hard sensor, memory layer and their relatives, beside a memory copy of
the frames, in one run.

Frames of a drifting texture at 1,000 frames per second, at two speeds: calm (about 2 events per 100 pixels
and frame) and busy (about 25). What a pixel costs depends on how often it fires, so both are told. The last
parts stream frames through a sensor with every kind of noise and watch the memory, and set the times of
float32 frames beside those of the same frames in float64.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
import numpy as np
import torch

from codesign import events
from studies.frame.run import Run, StudyConfig, main
from studies.frame.timing import measure, resident_mb

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
}
ASKED = {
    "hard, ideal": 120.0,
    "hard, full noise": 60.0,
    "memory, forward + backward": 120.0,
}  # million pixels per second, two cores


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"repeats": 3, "streamed_frames": 5_000}
    repeats: int = 7
    """Timed repeats of every row; the median counts."""
    streamed_frames: int = 100_000
    """Frames of 32 x 32 pixels streamed in the memory test."""
    threads: int = 2
    """Threads of torch; the kernels use every core."""


def study(run: Run[Config]) -> None:
    torch.set_num_threads(run.config.threads)
    repeats = run.config.repeats
    streamed = run.config.streamed_frames
    sizes = dict(list(SIZES.items())[:1]) if run.config.quick else SIZES
    rows = []
    with run.progress(len(sizes) * len(SPEED_PX) + 1, "timing") as progress:
        for size, (height, width, count) in sizes.items():
            for pace, speed_px in SPEED_PX.items():
                rows += [
                    (size, pace, *row)
                    for row in timed(texture(height, width, count, speed_px, run.config.seed), repeats)
                ]
                progress.advance()
        memory = stream(run.config.seed, streamed)
        progress.advance()
    other, times = precision(run.config.seed)
    run.record(float32_other_counts_share=other)
    for low, high, off_us in times:
        speed = f"{low:g}_to_{high:g}_per_s".replace(".", "p")
        run.record(
            **{
                f"float32_off_{speed}_p99_us": float(np.quantile(off_us, 0.99)),
                f"float32_off_{speed}_max_us": float(off_us.max()),
                f"float32_off_{speed}_above_1us_share": float(np.mean(off_us > 1)),
            }
        )
    missed = []
    for size, pace, name, rate, cpu, copies, fired in rows:
        key = f"{name.replace(',', '').replace(' + ', '_').replace(' ', '_')}_{pace}_{size}"
        run.record(**{f"{key}_mpixel_per_s": rate, f"{key}_mpixel_per_cpu_s": cpu, f"{key}_copies": copies})
        if fired is not None:
            run.record(**{f"{key}_events_per_pixel_frame": fired})
        if name in ASKED and rate < ASKED[name]:
            missed.append(
                f"{name} ({pace}, {size}): {rate:.0f} of {ASKED[name]:.0f} million pixels per second"
            )
    grown = max(memory) - memory[len(memory) // 10]
    run.record(
        streamed_frames=streamed,
        stream_first_mb=memory[0],
        stream_tenth_mb=memory[len(memory) // 10],
        stream_last_mb=memory[-1],
        stream_growth_mb=grown,
    )
    run.section(
        "Speed",
        "Million pixels per second by the clock and per second of the processor; cost in copies of the "
        "frames in memory, timed in the same run.",
    )
    columns = (
        "size",
        "pace",
        "what",
        "Mpixel/s",
        "asked",
        "Mpixel per CPU-second",
        "copies",
        "events per pixel and frame",
    )
    run.table(
        "Event stage",
        columns,
        [
            (size, pace, name, rate, ASKED.get(name), cpu, copies, fired)
            for size, pace, name, rate, cpu, copies, fired in rows
        ],
    )
    run.section(
        "Memory", f"{streamed:,} frames of 32 x 32 pixels through a sensor with all noise, 500 at a time."
    )
    run.figure(
        figure(memory, streamed),
        "memory",
        "Resident memory while frames are streamed: flat after the first chunks.",
    )
    run.card("memory growth", f"{grown:.1f} MB", f"{streamed:,} frames, after the first tenth")
    run.finish(
        "Speed of the event stage",
        "All figures are met." if not missed else f"**Missed:** {'; '.join(missed)}.",
    )


def texture(height, width, count, speed_px, seed):
    """[T, H, W] frames 20 to 220 of a smooth random texture that drifts along x by ``speed_px`` per frame."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(
        1, 1, height // 4 + 2, width // 4 + 8 + int(count * speed_px) // 4, generator=generator
    )
    fine = (
        torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bicubic")[0, 0].clamp(0, 1) * 200 + 20
    )
    frames = torch.empty(count, height, width)
    for k in range(count):
        whole, part = divmod(k * speed_px, 1.0)
        left = fine[:height, int(whole) : int(whole) + width + 1]
        frames[k] = left[:, :-1] * (1 - part) + left[:, 1:] * part
    return frames


def timed(frames, repeats):
    """Rows (what, Mpixel/s, Mpixel per CPU-second, copies, events per pixel and frame) of every layer."""
    t_s = torch.arange(len(frames), dtype=torch.float64) / FPS
    pixels = frames.numel() / 1e6
    rows = []
    target = torch.empty_like(frames)
    copy = measure(lambda: target.copy_(frames), repeats).wall
    leaf = frames.clone().requires_grad_()
    weight = torch.rand(len(frames) - 1, 2, *frames.shape[1:], generator=torch.Generator().manual_seed(0))

    def differentiated(layer):
        leaf.grad = None
        layer(leaf).backward(weight)

    works: dict[str, Callable] = {
        name: lambda sensor=sensor: events.simulate(frames, t_s, sensor) for name, sensor in SENSORS.items()
    }
    works["hard, v2e timing"] = lambda: events.simulate(frames, t_s, events.SensorModel(timing="v2e"))
    works["memory, forward"] = lambda: events.memory(frames, THETA, THETA)
    works["memory, forward + backward"] = lambda: differentiated(lambda f: events.memory(f, THETA, THETA)[0])
    works["memory of unequal thresholds, forward + backward"] = lambda: differentiated(
        lambda f: events.memory(f, THETA, 1.2 * THETA)[0]
    )
    works["sigmoid, forward + backward"] = lambda: differentiated(lambda f: events.soft(f, THETA))
    works["dense, forward + backward"] = lambda: differentiated(lambda f: events.dense(f, THETA, THETA)[0])
    for name, work in works.items():
        timing = measure(work, repeats if name in ASKED else 3, warm=2 if name in ASKED else 1)
        fired = len(work()) / frames.numel() if name.startswith("hard") else None
        rows.append((name, pixels / timing.wall, pixels / timing.cpu, timing.wall / copy, fired))
    return rows


def stream(seed, count, chunk=500):
    """Resident memory after every chunk, MB; the events are dropped."""
    base = texture(32, 32, chunk, 0.05, seed)
    state = events.SensorState()
    memory = []
    for first in range(0, count, chunk):
        t_s = torch.arange(first, first + chunk, dtype=torch.float64) / FPS
        events.simulate(base, t_s, NOISE, state=state)
        memory.append(resident_mb())
    return memory


def precision(seed, cases=40, pixels=2048, count=120):
    """float32 frames beside their float64 copies: the share of pixels with another count, and for the others
    (speed from, to, |time off| of every event, us) by the speed of the log level at the event, 1/s."""
    generator = torch.Generator().manual_seed(seed)

    def drawn(low, high, *shape):
        uniform = torch.rand(shape or (1,), dtype=torch.float64, generator=generator)
        return low * (high / low) ** uniform

    other, speeds, off_us = 0, [], []
    for case in range(cases):
        t_s = torch.arange(count, dtype=torch.float64)[:, None] / drawn(60, 1000)
        per_s = drawn(0.05, 20, 1, pixels)
        swing = (
            torch.sin(per_s * t_s + drawn(0.01, 6.3, 1, pixels)) if case % 2 else (per_s * t_s).clamp(max=2.9)
        )
        frames = (drawn(20, 5000, 1, pixels).log() + swing).exp().float()[:, None]
        levels = events.lin_log(frames[:, 0].double()).numpy()
        single, double = (
            events.simulate(f, t_s[:, 0], events.SensorModel(THETA, THETA)) for f in (frames, frames.double())
        )
        same = torch.bincount(single.x, minlength=pixels) == torch.bincount(double.x, minlength=pixels)
        other += int((~same).sum()) / (cases * pixels)
        first, second = (s.t_us[s.x.argsort(stable=True)][same[s.x.sort().values]] for s in (single, double))
        x = double.x.sort().values[same[double.x.sort().values]].numpy()
        frame = np.clip(np.searchsorted(t_s[:, 0].numpy(), second.numpy() / 1e6), 1, count - 1)
        speeds.append(np.abs(levels[frame, x] - levels[frame - 1, x]) / float(t_s[1]))
        off_us.append((first - second).abs().numpy())
    speeds, off_us = np.concatenate(speeds), np.concatenate(off_us)
    return other, [
        (low, high, off_us[(speeds >= low) & (speeds < high)])
        for low, high in ((0.01, 0.1), (0.1, 1), (1, 100))
    ]


def figure(memory, count):
    chart, axis = plt.subplots(figsize=(6, 3), layout="constrained")
    axis.plot(np.linspace(0, count, len(memory)), memory)
    axis.set(xlabel="frames", ylabel="resident memory (MB)", ylim=(0, 1.2 * max(memory)))
    return chart


if __name__ == "__main__":
    sys.exit(main(study, Config))
