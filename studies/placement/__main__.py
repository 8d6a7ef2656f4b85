"""Where to mount the camera on a robot: gradient steps in the six numbers of its pose, beside random search
and a grid over pitch and yaw.

A robot drives over textured ground and reads its planar velocity off event flow (see studies.placement.task
for what is modelled and what is not).
The task error is the root mean square, over motions and textures, of the errors of forward and lateral
velocity in units of 0.1 m/s and of yaw rate in
units of 0.1 rad/s, with hard events; all searches are scored by it on one fixed set of samples. Gradient
steps follow the error that is to be expected
from the events' noise (a Cramér-Rao bound made of the rendered events and the mount's geometry,
differentiated through the chain), because the gradient
of one draw's error changes sign from pixel to pixel.
"""

import math
import sys
from dataclasses import dataclass
from typing import ClassVar

import torch

from codesign import place
from codesign.errors import DomainError
from codesign.place.mount import Mount, yaw_pitch_roll_rad
from scenes import textures, worlds
from studies.frame.run import Run, StudyConfig, main
from studies.placement import figures
from studies.placement.search import RENDERS_PER_STEP, Path, descend, draw_mount, grid_mounts, random_search
from studies.placement.task import HALF_RANGE_M, HELD_OUT, NOMINAL_M, TRAINING, PlacementTask, make_task


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"starts": 3, "steps": 6, "motions": 2, "pitches": 5, "yaws": 8}
    starts: int = 5
    """Searches of each kind; the first takes its start from --seed, and so on."""
    steps: int = 14
    """Gradient steps from each start."""
    motions: int = 6
    """Motions per texture (three textures)."""
    pitches: int = 10
    """Rows of the grid, over pitches from 0 to 90 degrees."""
    yaws: int = 20
    """Columns of the grid, over all yaws."""


def checked(config):
    """The configuration. Raises: DomainError for sizes below 1."""
    for name in ("starts", "steps", "motions", "pitches", "yaws"):
        if getattr(config, name) < 1:
            raise DomainError(f"--{name} is {getattr(config, name)}; at least 1 is needed.")
    return config


def study(run: Run[Config]):
    size = checked(run.config)
    if run.device.type != "cpu":
        run.say("This study computes on the CPU; the device asked for stays unused.")
    task = make_task(TRAINING, size.motions, run.config.seed)
    held_out = make_task(HELD_OUT, size.motions, run.config.seed + 1)
    generator = torch.Generator().manual_seed(run.config.seed)
    starts = [draw_mount(generator) for _ in range(size.starts)]
    found = Found(run)
    with torch.no_grad():
        grid = found.search(
            "grid",
            lambda advance: score_grid(task, grid_mounts(size.pitches, size.yaws), advance),
            size.pitches * size.yaws,
        )
    descents = [
        found.search(
            f"gradient, start {k}",
            lambda advance, m=mount: descend(task, m, size.steps, advance),
            size.steps + 1,
        )
        for k, mount in enumerate(starts, 1)
    ]
    renders = RENDERS_PER_STEP * (size.steps + 1)
    draws = [torch.Generator().manual_seed(1000 * (run.config.seed + 1) + k) for k in range(size.starts)]
    randoms = [
        found.search(
            f"random search {k}",
            lambda advance, m=mount, g=draw: random_search(task, m, renders, g, advance),
            renders,
        )
        for k, (mount, draw) in enumerate(zip(starts, draws, strict=True), 1)
    ]
    report(run, size, task, held_out, grid, descents, randoms)


class Found:
    """Finished searches, kept in the run's state: a resumed run makes only those that are missing."""

    def __init__(self, run):
        self.run = run
        stored = run.load_state()
        self.tensors = dict(stored.tensors) if stored else {}

    def search(self, name, make, total):
        """Path of the search ``name``; ``make`` gets the function to call after each of its ``total``
        mounts."""
        if f"{name}/error" not in self.tensors:
            with self.run.progress(total, name) as bar:
                path = make(lambda error: bar.advance(error=error))
            self.tensors |= {
                f"{name}/T_body_cam": path.T_body_cam,
                f"{name}/error": path.error,
                f"{name}/renders": path.renders,
            }
            self.run.save_state(self.tensors, {})
        return Path(*(self.tensors[f"{name}/{part}"] for part in ("T_body_cam", "error", "renders")))


def score_grid(task, mounts, advance):
    errors = []
    for mount in mounts:
        errors.append(float(task.errors(mount).task))
        advance(errors[-1])
    return Path(mounts, torch.tensor(errors, dtype=torch.float64), torch.arange(len(mounts)) + 1)


@torch.no_grad()
def judge(task, held_out, mount):
    """Errors of one mount: on the samples that the searches saw, and with single events of the physical
    sensor on these and on samples never seen."""
    return {
        "seen": task.errors(mount),
        "seen_sensor": task.errors(mount, "sensor"),
        "held_out_sensor": held_out.errors(mount, "sensor"),
    }


@torch.no_grad()
def controls(task, best):
    """Task errors where there is nothing to see: the best mount above ground without texture, and a mount
    that looks at the sky."""
    blank = worlds.ground(0 * textures.checkerboard() + 60)
    plain = PlacementTask((blank,) * len(task.worlds), task.velocity, task.patch, task.seed)
    sky = Mount(NOMINAL_M, HALF_RANGE_M, pitch_rad=math.radians(-60))()
    try:
        place.information(task.camera, task.depth_m(sky), sky)
        sentence = ""
    except DomainError as error:
        sentence = str(error)
    return {
        "no_texture": float(plain.errors(best).task),
        "sky": float(task.errors(sky).task),
        "zero_velocity": float((task.velocity / 0.1).square().mean().sqrt()),
    }, sentence


def report(run, size, task, held_out, grid, descents, randoms):
    best = float(grid.error.min())
    finals = [float(p.error.min()) for p in descents]
    random_finals = [float(p.error.min()) for p in randoms]
    chosen = {"best of the grid": grid.T_body_cam[grid.best]}
    chosen |= {f"gradient {k}": p.T_body_cam[p.best] for k, p in enumerate(descents, 1)}
    chosen |= {f"random search {k}": p.T_body_cam[p.best] for k, p in enumerate(randoms, 1)}
    judged = {}
    with run.progress(len(chosen), "judging with single events") as bar:
        for name, mount in chosen.items():
            judged[name] = judge(task, held_out, mount)
            bar.advance(error=judged[name]["held_out_sensor"].task)
    leader = int(torch.tensor(finals).argmin())
    nothing, sentence = controls(task, descents[leader].T_body_cam[descents[leader].best])
    within = sum(e <= 1.1 * best for e in finals)
    grid_held = float(judged["best of the grid"]["held_out_sensor"].task)
    held_within = sum(
        float(judged[f"gradient {k}"]["held_out_sensor"].task) <= 1.1 * grid_held
        for k in range(1, len(finals) + 1)
    )
    run.record(
        grid_best_error=best,
        grid_mounts=len(grid.error),
        starts_within_10_percent=within,
        starts=len(finals),
        starts_within_10_percent_held_out_sensor=held_within,
        random_within_10_percent=sum(e <= 1.1 * best for e in random_finals),
        seconds=run.seconds,
        renders_per_search=int(descents[0].renders[-1]),
        samples=task.samples,
        renders=int(grid.renders[-1] + sum(p.renders[-1] for p in descents + randoms)),
        **{f"control_{name}_error": value for name, value in nothing.items()},
    )
    for k, (path, error, other) in enumerate(zip(descents, finals, random_finals, strict=True), 1):
        run.record(
            **{
                f"start_{k}_error_first": path.error[0],
                f"start_{k}_error_final": error,
                f"random_search_error_{k}": other,
            }
        )
    for name, errors in judged.items():
        label = name.replace(" ", "_")
        for where, each in errors.items():
            forward, lateral, turn = each.rms.tolist()
            run.record(
                **{
                    f"{label}_{where}_error": each.task,
                    f"{label}_{where}_forward_m_s": forward,
                    f"{label}_{where}_lateral_m_s": lateral,
                    f"{label}_{where}_yaw_rate_rad_s": turn,
                }
            )
    write_page(run, size, held_out, grid, descents, randoms, judged, chosen, nothing, sentence, leader)


def write_page(run, size, held_out, grid, descents, randoms, judged, chosen, nothing, sentence, leader):
    metrics = run.metrics
    run.card(
        "starts within 10 % of the grid's best",
        f"{metrics['starts_within_10_percent']} of {len(descents)}",
        f"random search: {metrics['random_within_10_percent']} of {len(randoms)}",
    )
    run.card(
        "task error",
        f"{min(float(p.error.min()) for p in descents):.3f}",
        f"best of {len(grid.error)} mounts on the grid: {metrics['grid_best_error']:.3f}",
    )
    run.card(
        "nothing to see",
        f"{nothing['no_texture']:.2f}",
        f"ground without texture; answering 0 always: {nothing['zero_velocity']:.2f}",
    )
    run.section(
        "Where the camera looks",
        "Task errors count 0.1 m/s and 0.1 rad/s as 1. All mounts are scored on the same samples with the "
        "same noise.",
    )
    run.figure(
        figures.map_of(grid, size, descents),
        "task_error_map",
        "Task error over yaw (angle: forward is up, left is left) and pitch (distance from the middle, "
        "where the camera looks straight down), with the other "
        "four numbers nominal. Lines: the mounts that led from each start (ring) to the best one found "
        "(star); they also move in roll and position, "
        "which the map does not show.",
    )
    run.figure(
        figures.curves(grid, descents, randoms),
        "error_over_renders",
        "Best task error so far over rendered sample sets; a gradient step counts two. The band ends 10 % "
        "above the best of the grid.",
    )
    rows = []
    for name, mount in chosen.items():
        yaw, pitch, roll = torch.rad2deg(yaw_pitch_roll_rad(mount)).tolist()
        seen = judged[name]["seen"]
        hard = judged[name]["held_out_sensor"]
        rows.append(
            [
                name,
                pitch,
                yaw,
                roll,
                *(100 * mount[:3, 3]).tolist(),
                float(seen.task),
                float(judged[name]["seen_sensor"].task),
                float(hard.task),
                *hard.rms.tolist(),
            ]
        )
    columns = [
        "mount",
        "pitch °",
        "yaw °",
        "roll °",
        "x cm",
        "y cm",
        "z cm",
        "error",
        "single events",
        "unseen samples",
        "forward m/s",
        "lateral m/s",
        "yaw rate rad/s",
    ]
    run.section("The mounts found")
    run.table(
        "Mounts and their errors",
        columns,
        rows,
        "error: on the samples searched on, counts per frame interval. single events: the same samples, "
        "physical sensor with timestamps. unseen samples and the last three "
        "columns (RMS): other textures and motions, physical sensor. Near straight down only yaw plus or "
        "minus roll means something.",
    )
    run.figure(
        figures.scatter(held_out, descents[leader], chosen[f"gradient {leader + 1}"]),
        "velocities",
        "Velocities estimated on unseen textures and motions with single events, before and after the "
        "search that ended best.",
    )
    run.section(
        "Where there is nothing to see",
        f"Ground without texture leaves {nothing['no_texture']:.2f} and a camera that looks at the sky "
        f"{nothing['sky']:.2f}; always answering zero velocity leaves "
        f"{nothing['zero_velocity']:.2f}. Without a prior the sky is refused: *{sentence}*",
    )
    run.finish(
        "Where to mount the camera",
        f"Gradient steps from {len(descents)} random mounts: {metrics['starts_within_10_percent']} end "
        f"within 10 % of the best of {len(grid.error)} mounts on a grid "
        f"over pitch and yaw ({metrics['grid_best_error']:.3f}). Of as many random searches at the same "
        f"number of renders, {metrics['random_within_10_percent']} do.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
