"""How fast: tracing rays through a double Gauss, and one step of the render with lens and pose gradients.

Tracing goes through the public interface and is set beside a copy of the same arrays in the same run, since
machines differ and are shared; processor time stands beside the clock. The render step is timed after the
first one, which compiles, and its memory is watched over many steps.
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
import torch

from codesign import lens, pose, render
from codesign.errors import DomainError
from scenes import trajectories, worlds
from studies.frame.run import Run, StudyConfig, main
from studies.frame.timing import measure, resident_mb
from studies.lens_bench.tracers import tracing_work

PRECISIONS = {"float32": torch.float32, "float64": torch.float64}
ASKED = {
    "forward": 300.0,
    "forward_backward": 90.0,
}  # million ray-surfaces per second, float32, two quiet cores
ASKED_CPU_S = 1.0
ASKED_GROWTH_MB = 50.0
SETTLED = 10  # steps before memory counts: caches fill


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"steps": 2 * SETTLED}
    rays: int = 1_000_000
    """Rays of the tracing benchmark."""
    repeats: int = 11
    """Timed repeats of everything that is traced; at least 9."""
    steps: int = 200
    """Steps of the render benchmark."""


def study(run: Run[Config]) -> None:
    config = run.config
    if config.rays < 1 or config.repeats < 9 or config.steps < 2 * SETTLED:
        raise DomainError(
            f"rays {config.rays}, repeats {config.repeats}, steps {config.steps}: give at least 1, 9 and "
            f"{2 * SETTLED}."
        )
    kinds = [(p, k) for p in ("float32",) if config.quick for k in ASKED] or [
        (p, k) for p in PRECISIONS for k in ASKED
    ]
    copies = {}
    traced = {}
    with run.progress(len(kinds) + config.steps, "benchmark") as progress:
        for precision, kind in kinds:
            work, copy, surfaces = tracing(kind, PRECISIONS[precision], config.rays, config.seed)
            copies[precision] = measure(copy, config.repeats)
            traced[precision, kind] = timing = measure(work, config.repeats, warm=1)
            million = surfaces * config.rays / 1e6
            name = f"trace_{kind}_{precision}"
            run.record(
                **{
                    f"{name}_million_ray_surfaces_per_s": million / timing.wall,
                    f"{name}_million_ray_surfaces_per_cpu_s": million / timing.cpu,
                    f"{name}_wall_s": timing.wall,
                    f"{name}_wall_iqr_s": timing.wall_iqr,
                    f"{name}_cpu_s": timing.cpu,
                    f"{name}_second_over_tenth": timing.wall_s[0] / timing.wall_s[8],
                    f"{name}_cpu_over_copy": timing.cpu / copies[precision].cpu,
                    f"copy_{precision}_cpu_s": copies[precision].cpu,
                }
            )
            progress.advance(million_per_s=million / timing.wall)
        step = render_step(config.seed)
        memory = []
        step()

        def watch():
            memory.append(resident_mb())
            progress.advance(memory_mb=memory[-1])

        rendering = measure(step, config.steps, warm=0, after_each=watch)
    growth = memory[-1] - memory[SETTLED - 1]
    run.record(
        render_cpu_s_per_step=rendering.cpu,
        render_wall_s_per_step=rendering.wall,
        render_wall_iqr_s=rendering.wall_iqr,
        render_steps=config.steps,
        render_second_over_tenth=rendering.wall_s[0] / rendering.wall_s[8],
        memory_growth_mb=growth,
        memory_mb=memory[-1],
    )
    show(run, traced, copies, rendering, memory)


def tracing(kind, dtype, count, seed):
    """The work of one repeat, a copy of the same arrays, and the number of surfaces.

    Returns: function that traces ``count`` rays once ("forward") or traces them and goes back to all
      curvatures and thicknesses ("forward_backward"); function that copies origins and directions; surfaces
      of the lens.
    """
    geo = lens.load("double-gauss", dtype).freeze("conic", "asphere", "index_offset")
    across = 20 * torch.rand(count, 2, generator=torch.Generator().manual_seed(seed), dtype=dtype) - 10
    origin = torch.cat([across, torch.full_like(across[:, :1], -5.0)], 1)
    direction = torch.tensor([0.0, 0.1, 0.99**0.5], dtype=dtype).expand(count, 3).contiguous()
    return (
        tracing_work(geo, kind, origin, direction),
        lambda: (origin.clone(), direction.clone()),
        len(geo.surfaces),
    )


def render_step(seed, frames=20, size_px=96, samples=8):
    """A function that renders ``frames`` frames of the room and goes back to the lens's curvatures and
    thicknesses and to a pose twist."""
    geo = lens.load("cooke-triplet", torch.float32).freeze("conic", "asphere", "index_offset")
    camera = render.Camera(geo, size_px, size_px, 0.15, samples, seed)
    scene = worlds.room(objects=False)
    path = trajectories.translation(
        pose.look_at((0.0, -1.2, 1.3), (0.2, 2.0, 1.2)), (0.2, 0.05, 0.1), trajectories.times(frames, 100.0)
    )
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    learned = [twist, geo.curvature_per_mm, geo.thickness_mm]

    def step():
        images = render.frames(camera, scene, path @ pose.se3_exp(twist))
        loss = images.diff(dim=0).square().mean()
        torch.autograd.grad(loss, learned)

    return step


def show(run, traced, copies, rendering, memory):
    """Cards, tables, figure and the page."""
    found = run.metrics
    missed = []
    for kind, asked in ASKED.items():
        speed = found[f"trace_{kind}_float32_million_ray_surfaces_per_s"]
        run.card(
            f"Tracing, {kind.replace('_', ' + ')}",
            f"{speed:.0f} M/s",
            f"ray-surfaces, float32; asked on two quiet cores: {asked:.0f}",
        )
        if speed < asked:
            two_cores = 2 * found[f"trace_{kind}_float32_million_ray_surfaces_per_cpu_s"]
            missed.append(
                f"tracing {kind.replace('_', ' + ')} {speed:.0f} of {asked:.0f} million ray-surfaces/s "
                f"({two_cores:.0f} per two processor seconds)"
            )
    run.card(
        "Render step", f"{rendering.cpu:.2f} CPU-s", f"20 frames, 96 x 96, 8 samples; asked: {ASKED_CPU_S:g}"
    )
    run.card(
        "Memory growth",
        f"{found['memory_growth_mb']:.1f} MB",
        f"over {len(memory)} steps; asked: below {ASKED_GROWTH_MB:g}",
    )
    if rendering.cpu > ASKED_CPU_S:
        missed.append(f"render step {rendering.cpu:.2f} CPU-s of {ASKED_CPU_S:g}")
    if found["memory_growth_mb"] >= ASKED_GROWTH_MB:
        missed.append(f"memory growth {found['memory_growth_mb']:.0f} MB of {ASKED_GROWTH_MB:g}")
    run.section(
        "Tracing",
        "Double Gauss, eleven surfaces, through `GeoLens.trace`; backward reaches all curvatures and "
        "thicknesses. On a shared machine the clock also counts the waiting; processor seconds do not.",
    )
    rows = [
        (
            f"{kind.replace('_', ' + ')}, {precision}",
            t.wall,
            t.wall_iqr,
            t.cpu,
            found[f"trace_{kind}_{precision}_million_ray_surfaces_per_s"],
            t.wall_s[0] / t.wall_s[8],
        )
        for (precision, kind), t in traced.items()
    ]
    rows += [
        (f"copy of origins and directions, {precision}", t.wall, t.wall_iqr, t.cpu, None, None)
        for precision, t in copies.items()
    ]
    columns = ("work", "wall median", "wall IQR", "CPU median", "million ray-surfaces/s", "2nd / 10th step")
    run.table(
        "Seconds of one repeat",
        columns,
        rows,
        "A second step much slower than the tenth would mean that kernels are compiled again.",
    )
    run.section(
        "Render step",
        "Cooke triplet before the textured room: rays, 20 frames, a loss on frame differences, and "
        "gradients to curvatures, thicknesses and six pose components.",
    )
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    left.plot(range(2, len(memory) + 2), rendering.wall_s, label="clock", color="tab:orange")
    left.plot(range(2, len(memory) + 2), rendering.cpu_s, label="processor", color="tab:blue")
    left.axhline(ASKED_CPU_S, color="firebrick", linewidth=1)
    left.set(xlabel="step", ylabel="seconds", ylim=(0, None))
    left.legend(frameon=False)
    right.plot(range(2, len(memory) + 2), [m - memory[SETTLED - 1] for m in memory])
    right.axhline(ASKED_GROWTH_MB, color="firebrick", linewidth=1)
    right.set(xlabel="step", ylabel=f"memory in use since step {SETTLED + 1}, MB")
    run.figure(
        figure, "render_step", "Time and memory of every step after the first. Red: the most that is allowed."
    )
    lead = "All figures are met." if not missed else f"**Missed in this run:** {'; '.join(missed)}."
    run.finish("Benchmark", f"Ray tracing and rendering on this machine, with gradients. {lead}")


if __name__ == "__main__":
    sys.exit(main(study, Config))
