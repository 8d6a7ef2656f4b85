"""Stage "levels": every stage's cheaper and finer levels on one small scene, a camera that passes a
textured wall, and the cheapest that is good enough.

Lens (pinhole, thin, traced), samples per pixel, scene (bitmap, analytic), event layers and frame rates,
time bins, flow models. A level's error is measured against the finest level or against the truth.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from codesign import events, flow, lens, pose, render
from codesign.errors import DomainError
from scenes import textures, trajectories, worlds
from studies.frame.bench import measure
from studies.frame.run import Run
from studies.frame.show import Panel, panels, table
from studies.frame.sweep import metrics, plain, select, sweep
from studies.speed_error import Config

DURATION_S = 0.1
THETA = 0.2
PITCH_MM = 0.15
DISTANCE_M = 2.0
VELOCITY_M_S = (0.4, 0.25, 0.5)
RATES_HZ = (60, 240, 1000)
FINEST_HZ = 4000
SENSOR = events.SensorModel(THETA, THETA)


@dataclass(frozen=True)
class Level:
    """One way to compute a stage: ``work`` does it and is timed."""

    name: str
    work: Callable[[], Any]


@dataclass(frozen=True)
class Part:
    """A stage of the chain: levels from cheap to fine, the error of what a level returns, what that error
    measures, and how much of it is tolerated."""

    name: str
    levels: tuple[Level, ...]
    error: Callable[[Any], float]
    measure: str
    tolerance: float


@dataclass(frozen=True)
class Setup:
    """Size of the common scene and the seed of its texture and samples."""

    size_px: int
    seed: int

    @cached_property
    def lens(self):
        return lens.load("cooke-triplet", torch.float32).freeze()

    @cached_property
    def waves(self):
        return textures.waves(self.seed, finest_period_m=0.03, coarsest_period_m=0.3)

    @cached_property
    def wall(self):
        """A Mitsuba wall whose bitmap holds the analytic texture at 2.5 mm per texel."""
        texel_m = 0.0025
        half_m = 1.5
        at = (torch.arange(round(2 * half_m / texel_m), dtype=torch.float64) + 0.5) * texel_m - half_m
        frequency, amplitude, phase = self.waves
        total = torch.zeros(at.numel(), at.numel(), dtype=torch.float64)
        for (fx, fy), a, shift in zip(frequency.tolist(), amplitude.tolist(), phase.tolist(), strict=True):
            total += a * (2 * torch.pi * (fx * at[None] + fy * at[:, None]) + shift).cos()
        return worlds.wall(
            100 * total.exp().flip(0).numpy(), texel_m, half_m
        )  # the first row of a bitmap is the top

    def plane(self, dtype):
        """The same texture in closed form, in the plane of the wall."""
        stand = torch.eye(4, dtype=torch.float64)
        stand[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
        return render.TexturedPlane(*self.waves, T_world_plane=stand, dtype=dtype)

    def path(self, rate_hz):
        """Times and poses over the interval at a frame rate."""
        t_s = trajectories.times(round(DURATION_S * rate_hz) + 1, rate_hz) * (
            DURATION_S * rate_hz / round(DURATION_S * rate_hz)
        )
        return t_s, trajectories.translation(
            pose.look_at((0.0, -DISTANCE_M, 0.0), (0.0, 0.0, 0.0)), VELOCITY_M_S, t_s
        )

    def camera(self, optics, samples):
        return render.Camera(optics, self.size_px, self.size_px, PITCH_MM, samples, self.seed)

    @torch.no_grad()
    def frames(self, rate_hz, optics=None, samples=8, world=None):
        """[T, H, W] frames at a rate, traced lens and wall unless others are given."""
        return render.frames(
            self.camera(optics or self.lens, samples), world or self.wall, self.path(rate_hz)[1]
        )

    @cached_property
    def stream(self):
        """Hard events of the physical sensor at the finest rate."""
        return events.simulate(self.frames(FINEST_HZ), self.path(FINEST_HZ)[0], SENSOR)

    @cached_property
    def true_flow(self):
        """[1, 2, H, W] px over the whole interval, through the traced lens."""
        ends = self.path(60)[1][[0, -1]]
        return render.true_flow(self.camera(lens.load("cooke-triplet").freeze(), 1), self.wall, ends)[0]


def stage(run: Run[Config]) -> str:
    """Time against error of every level, and the choice."""
    setup = Setup(32 if run.config.quick else 64, run.config.seed)
    found = {part.name: part for part in parts(setup)}

    def cell(part):
        rows = []
        for level in part.levels:
            error = part.error(level.work())
            timing = measure(level.work, run.config.repeats, warm=1)
            rows.append({"level": level.name, "cpu_s": timing.cpu, "wall_s": timing.wall, "error": error})
        return rows

    rows = sweep(run, cell, "levels", part=found)
    lines = []
    for name, part in found.items():
        levels = select(rows, part=name)
        best, enough = cheapest(levels, part.tolerance)
        run.record(**metrics(levels, "part", "level"))
        run.record(**metrics([{**best, "within_tolerance": int(enough)}], "part", prefix="chosen"))
        verdict = (
            f"**{best['level']}** is the cheapest level with an error of at most {part.tolerance:g}"
            if enough
            else f"no level stays within {part.tolerance:g}; **{best['level']}** comes closest"
        )
        lines.append(f"{name}: {verdict} ({best['error']:.2g}, {1e3 * best['cpu_s']:.3g} CPU-ms).")
        run.text(lines[-1])
        floor = min([part.tolerance, *(row["error"] for row in levels if row["error"] > 0)]) / 5
        points = {row["level"]: ([1e3 * row["cpu_s"]], [max(row["error"], floor)]) for row in levels}
        chart = Panel(points, "processor time, ms (median)", "error", "xy", [part.tolerance])
        run.figure(
            panels(chart, width=7),
            f"speed_error_{plain(name)}",
            f"Error: {part.measure}. Dashed: the tolerance. A level without error stands at the bottom.",
        )
        run.table("", *table(levels, level="level", cpu_s="CPU-s", wall_s="wall s", error="error"))
    return " ".join(lines)


def cheapest(levels: list[dict[str, Any]], tolerance: float) -> tuple[dict[str, Any], bool]:
    """The level of least processor time whose error is within ``tolerance``; where none is, the one of
    least error.

    Returns: the level, and whether it is within the tolerance. Raises: DomainError when there is no level.
    """
    if not levels:
        raise DomainError("there is no level to choose from; give at least one.")
    enough = [level for level in levels if level["error"] <= tolerance]
    if enough:
        return min(enough, key=lambda level: level["cpu_s"]), True
    return min(levels, key=lambda level: level["error"]), False


def parts(setup: Setup) -> list["Part"]:
    """All stages of the chain with their levels."""
    return [_lens(setup), _samples(setup), _scene(setup), _events(setup), _bins(setup), _flow(setup)]


def _contrast_error(truth):
    """RMS difference from ``truth`` over its RMS contrast."""
    return lambda found: float(
        (found.double() - truth.double()).square().mean().sqrt() / truth.double().std()
    )


def _lens(setup):
    optics = {
        "pinhole": lens.Pinhole(setup.lens.first_order().efl_mm.detach()),
        "thin lens": setup.lens.thin(),
        "traced": setup.lens,
    }
    levels = tuple(Level(name, lambda o=o: setup.frames(60, o, 16)) for name, o in optics.items())
    return Part(
        "lens",
        levels,
        _contrast_error(levels[-1].work()),
        "RMS difference of frames from the traced lens, over their contrast",
        0.05,
    )


def _samples(setup):
    levels = tuple(
        Level(f"{n} samples", lambda n=n: setup.frames(60, samples=n)) for n in (1, 2, 4, 8, 16, 32, 64)
    )
    return Part(
        "sampling",
        levels,
        _contrast_error(setup.frames(60, samples=256)),
        "RMS difference of frames from 256 samples, over their contrast",
        0.01,
    )


def _scene(setup):
    made = {
        "Mitsuba bitmap, float32": setup.wall,
        "analytic, float32": setup.plane(torch.float32),
        "analytic, float64": setup.plane(torch.float64),
    }
    levels = tuple(
        Level(name, lambda world=world: setup.frames(60, world=world)) for name, world in made.items()
    )
    return Part(
        "scene",
        levels,
        _contrast_error(levels[-1].work()),
        "RMS difference of frames from the analytic scene in float64, over their contrast",
        0.01,
    )


def _events(setup):
    truth = events.to_counts(setup.stream, setup.path(60)[0][[0, -1]])[0]
    layers = {
        "sigmoid": lambda frames: events.soft(frames, THETA),
        "soft counts": lambda frames: events.soft_counts(frames, THETA, THETA),
        "memory": lambda frames: events.memory(frames, THETA, THETA)[0],
    }
    levels = tuple(
        Level(f"{name}, {rate} fps", lambda layer=layer, rate=rate: layer(setup.frames(rate)).sum(0))
        for name, layer in layers.items()
        for rate in RATES_HZ
    )
    return Part(
        "events",
        levels,
        lambda found: float((found - truth).abs().sum() / truth.sum()),
        f"wrong counts per true event; truth: hard events at {FINEST_HZ} fps",
        0.1,
    )


def _flow_error(setup):
    return lambda field: float(flow.metrics.aee(field.flow_px.double(), setup.true_flow))


def _volume(setup, bins):
    return events.from_stream(setup.stream, 0, round(DURATION_S * 1e6), bins)


def _bins(setup):
    levels = tuple(Level(f"{n} bins", lambda n=n: flow.estimate_lk(_volume(setup, n))) for n in range(2, 10))
    return Part(
        "time bins", levels, _flow_error(setup), "endpoint error of affine flow from hard events, px", 0.5
    )


def _flow(setup):
    volume = _volume(setup, 5)
    blurs = ((1.0,), (2.0, 1.0), (4.0, 2.0, 1.0))
    chosen = [(model, blur) for model in ("constant", "affine", "quadratic") for blur in blurs]
    levels = tuple(
        Level(
            f"{model}, {len(blur)} level{'s' * (len(blur) > 1)}",
            lambda m=model, b=blur: flow.estimate_lk(volume, m, levels_px=b),
        )
        for model, blur in chosen
    )
    return Part("flow", levels, _flow_error(setup), "endpoint error from hard events in 5 bins, px", 0.5)
