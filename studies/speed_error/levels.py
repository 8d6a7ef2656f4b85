"""Stage "levels": every stage's cheaper and finer levels on one small scene, a camera that passes a
textured wall, and the cheapest that is good enough."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import torch

from codesign import events, flow, lens, pose, render
from codesign.errors import DomainError
from scenes import textures, trajectories, worlds
from studies.frame.bench import measure
from studies.frame.run import Run
from studies.frame.show import Asked, Panel, panels, tabulate
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
class Part:
    """A stage of the chain: ways to compute it from cheap to fine, the error of what one returns,
    what that error measures, and how much of it is tolerated."""

    levels: Mapping[str, Callable[[], Any]]
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
        at = (
            torch.arange(round(2 * half_m / texel_m), dtype=torch.float64) + 0.5
        ) * texel_m - half_m
        frequency, amplitude, phase = self.waves
        total = torch.zeros(at.numel(), at.numel(), dtype=torch.float64)
        for (fx, fy), a, shift in zip(
            frequency.tolist(), amplitude.tolist(), phase.tolist(), strict=True
        ):
            total += a * (2 * torch.pi * (fx * at[None] + fy * at[:, None]) + shift).cos()
        # the first row of a bitmap is the top
        return worlds.wall(100 * total.exp().flip(0).numpy(), texel_m, half_m)

    def plane(self, dtype):
        """The same texture in closed form, in the plane of the wall."""
        stand = torch.eye(4, dtype=torch.float64)
        stand[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
        return render.TexturedPlane(*self.waves, T_world_plane=stand, dtype=dtype)

    def path(self, rate_hz):
        """Times and poses over the interval at a frame rate."""
        t_s = torch.linspace(0, DURATION_S, round(DURATION_S * rate_hz) + 1, dtype=torch.float64)
        start = pose.look_at((0.0, -DISTANCE_M, 0.0), (0.0, 0.0, 0.0))
        return t_s, trajectories.translation(start, VELOCITY_M_S, t_s)

    def camera(self, optics, samples):
        return render.Camera(optics, self.size_px, self.size_px, PITCH_MM, samples, self.seed)

    @torch.no_grad()
    def frames(self, rate_hz=60, optics=None, samples=8, world=None):
        """[T, H, W] frames at a rate, traced lens and wall unless others are given."""
        camera = self.camera(optics or self.lens, samples)
        return render.frames(camera, world or self.wall, self.path(rate_hz)[1])

    @cached_property
    def stream(self):
        """Hard events of the physical sensor at the finest rate."""
        return events.simulate(self.frames(FINEST_HZ), self.path(FINEST_HZ)[0], SENSOR)

    @cached_property
    def true_flow(self):
        """[1, 2, H, W] px over the whole interval, through the traced lens."""
        ends = self.path(60)[1][[0, -1]]
        return render.true_flow(
            self.camera(lens.load("cooke-triplet").freeze(), 1), self.wall, ends
        )[0]

    def volume(self, bins):
        return events.from_stream(self.stream, 0, round(DURATION_S * 1e6), bins)


def stage(run: Run[Config]) -> list[Asked]:
    """Every level of every stage, and the cheapest whose error is tolerated."""
    found = parts(Setup(32 if run.config.quick else 64, run.config.seed))

    def cell(part):
        rows = []
        for name, work in part.levels.items():
            timing = measure(work, run.config.repeats, warm=1)
            error = part.error(work())
            rows.append({"level": name, "cpu_s": timing.cpu, "wall_s": timing.wall, "error": error})
        return rows

    rows = sweep(run, cell, "levels", part=found)
    for name, part in found.items():
        levels = select(rows, part=name)
        best, enough = cheapest(levels, part.tolerance)
        run.record(**metrics([{**best, "within_tolerance": int(enough)}], "part", prefix="chosen"))
        verdict = "is the cheapest level within" if enough else "comes closest; none is within"
        figures = f"({best['error']:.2g}, {1e3 * best['cpu_s']:.3g} CPU-ms)"
        tabulate(run, name.capitalize(), levels, "part", "level")
        run.text(f"**{best['level']}** {verdict} an error of {part.tolerance:g} {figures}.")
        floor = min([part.tolerance, *(row["error"] for row in levels if row["error"] > 0)]) / 5
        points = {
            row["level"]: ([1e3 * row["cpu_s"]], [max(row["error"], floor)]) for row in levels
        }
        chart = Panel(points, "processor time, ms (median)", "error", "xy", [part.tolerance])
        caption = f"Error: {part.measure}. Dashed: the tolerance. A level without error stands at the bottom."
        run.figure(panels(chart, width=7), f"speed_error_{plain(name)}", caption)
    return []


def cheapest(levels: list[dict[str, Any]], tolerance: float) -> tuple[dict[str, Any], bool]:
    """The level of least processor time whose error is within ``tolerance``; where none is, the one
    of least error.

    Returns: the level, and whether it is within the tolerance. Raises: DomainError when there is no
      level.
    """
    if not levels:
        raise DomainError("there is no level to choose from; give at least one.")
    enough = [level for level in levels if level["error"] <= tolerance]
    if enough:
        return min(enough, key=lambda level: level["cpu_s"]), True
    return min(levels, key=lambda level: level["error"]), False


def parts(setup: Setup) -> dict[str, Part]:
    """All stages of the chain with their levels."""
    optics = {
        "pinhole": lens.Pinhole(setup.lens.first_order().efl_mm.detach()),
        "thin lens": setup.lens.thin(),
        "traced": setup.lens,
    }
    scenes = {
        "Mitsuba bitmap, float32": setup.wall,
        "analytic, float32": setup.plane(torch.float32),
        "analytic, float64": setup.plane(torch.float64),
    }
    layers = {
        "sigmoid": lambda frames: events.soft(frames, THETA),
        "soft counts": lambda frames: events.soft_counts(frames, THETA, THETA),
        "memory": lambda frames: events.memory(frames, THETA, THETA)[0],
    }
    through = {name: partial(setup.frames, optics=o, samples=16) for name, o in optics.items()}
    sampled = {f"{n} samples": partial(setup.frames, samples=n) for n in (1, 2, 4, 8, 16, 32, 64)}
    seen = {name: partial(setup.frames, world=world) for name, world in scenes.items()}
    counted = {
        f"{name}, {rate} fps": lambda layer=layer, rate=rate: layer(setup.frames(rate)).sum(0)
        for name, layer in layers.items()
        for rate in RATES_HZ
    }
    binned = {f"{n} bins": lambda n=n: flow.estimate_lk(setup.volume(n)) for n in range(2, 10)}
    models = {
        f"{model}, {len(blurs)} levels": partial(
            flow.estimate_lk, setup.volume(5), model, levels_px=blurs
        )
        for model in ("constant", "affine", "quadratic")
        for blurs in ((1.0,), (2.0, 1.0), (4.0, 2.0, 1.0))
    }
    truth = events.to_counts(setup.stream, setup.path(60)[0][[0, -1]])[0]
    of_frames = "RMS difference over contrast, from "
    of_flow = "endpoint error from hard events, px"

    def wrong(found):
        return float((found - truth).abs().sum() / truth.sum())

    def endpoint(field):
        return float(flow.metrics.aee(field.flow_px.double(), setup.true_flow))

    return {
        "lens": Part(through, _off(through["traced"]()), f"{of_frames}the traced lens", 0.05),
        "sampling": Part(sampled, _off(setup.frames(samples=256)), f"{of_frames}256 samples", 0.01),
        "scene": Part(
            seen, _off(seen["analytic, float64"]()), f"{of_frames}analytic float64", 0.01
        ),
        "events": Part(
            counted, wrong, f"wrong counts per true one, hard events at {FINEST_HZ} fps", 0.1
        ),
        "time bins": Part(binned, endpoint, f"affine, {of_flow}", 0.5),
        "flow": Part(models, endpoint, f"5 bins, {of_flow}", 0.5),
    }


def _off(truth):
    """RMS difference from ``truth`` over its RMS contrast."""
    truth = truth.double()
    return lambda found: float((found.double() - truth).square().mean().sqrt() / truth.std())
