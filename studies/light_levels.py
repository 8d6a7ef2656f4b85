"""How much light transport a world needs: every world at every light level it has, with its cost and its
error against the next finer level.

Levels: emissive (pictures as radiance), baked (Lambertian light worked out once), path (paths traced for
  every camera ray). A camera moves past each world; costs are CPU seconds, errors are shares of the radiance
  with the noise of path tracing taken out.
"""

import inspect
import math
import sys
import time
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
import numpy as np
import torch

from codesign import lens, pose, render
from codesign.errors import DomainError
from codesign.render import light
from scenes import build, worlds
from studies.frame.run import Run, StudyConfig, main

FIELD = 6.4 / 8.0  # width of the image over the focal length


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"width_px": 48, "frames": 1, "paths": 4, "bake_samples": 8}
    world: tuple[str, ...] = ()
    """Worlds to show, by name; all of them when left out."""
    width_px: int = 96
    """Width of the images; their height is three quarters of it."""
    frames: int = 3
    """Frames of the trajectory that errors and costs are measured on."""
    paths: int = 24
    """Paths per camera ray at the level path (4 rays per pixel)."""
    bake_samples: int = 64
    """Paths per light-map texel at the level baked."""
    tolerance: float = 0.05
    """RMS radiance error, after one brightness factor per frame, up to which a cheaper level will do."""


@dataclass(frozen=True)
class Row:
    """One level of one world: CPU seconds to make it and to render the frames, and its error against the next
    finer level (None for the finest)."""

    world: str
    level: str
    made_cpu_s: float
    frames_cpu_s: float
    error: light.LevelError | None
    picture: np.ndarray


def study(run: Run[Config]) -> None:
    config = run.config
    unknown = [name for name in config.world if name not in worlds.WORLDS]
    if unknown:
        raise DomainError(f"there is no world '{unknown[0]}'; choose from {', '.join(worlds.WORLDS)}.")
    if (
        config.width_px < 8
        or config.frames < 1
        or config.paths < 1
        or config.bake_samples < 1
        or not config.tolerance > 0
    ):
        raise DomainError(
            "width_px must be at least 8; frames, paths and bake_samples at least 1; tolerance positive."
        )
    width = config.width_px
    camera = render.Camera(lens.Pinhole(8.0), width, width * 3 // 4, 8.0 * FIELD / width, 4, config.seed)
    options = {
        "emissive": {},
        "baked": {"samples": config.bake_samples, "seed": config.seed},
        "path": {"samples": config.paths, "seed": config.seed},
    }
    names = config.world or tuple(worlds.WORLDS)
    rows: list[Row] = []
    lines = []
    with run.progress(len(names), "worlds") as progress:
        for name in names:
            found, reason = measure(name, camera, options, config.frames, config.tolerance)
            rows += found
            lines.append(f"- **{name}**: {reason}")
            progress.advance()
    for row in rows:
        key = f"{row.world}_{row.level}".replace("-", "_")
        run.record(**{f"{key}_made_cpu_s": row.made_cpu_s, f"{key}_frames_cpu_s": row.frames_cpu_s})
        if row.error is not None:
            run.record(
                **{
                    f"{key}_rms_error": float(row.error.rms.max()),
                    f"{key}_rms_error_after_gain": float(row.error.rms_after_gain.max()),
                    f"{key}_noise": float(row.error.noise.max()),
                }
            )
    show(run, rows, lines)


def path_of(name, frames):
    """Poses [T, 4, 4] of a camera at the world's viewpoint that moves 5 cm to its right and turns by a degree
    per frame."""
    start = pose.look_at(*worlds.VIEWS[name])
    twist = torch.tensor([0.05, 0, 0, 0, math.radians(1), 0], dtype=torch.float64)
    return start @ pose.se3_exp(torch.arange(frames, dtype=torch.float64)[:, None] * twist)


def measure(name, camera, options, frames, tolerance):
    """Rows of a world's levels, and the reason for the level to take."""
    make = worlds.WORLDS[name]
    poses = path_of(name, frames)
    several = "light" in inspect.signature(make).parameters
    scenes = {}
    made = {}
    for level in options if several else ("emissive",):
        start = time.process_time()
        scenes[level] = make(light=_with(build.LEVELS[level], options[level])) if several else make()
        made[level] = time.process_time() - start
    choice = light.choose(scenes, camera, poses, tolerance, after_gain=True)
    levels = list(scenes)
    rows = []
    for level, finer in zip(levels, [*levels[1:], None], strict=True):
        error = light.level_error(scenes[level], scenes[finer], camera, poses) if finer else None
        with torch.no_grad():
            picture = render.frames(camera, scenes[level], poses[:1])[0].numpy()
        rows.append(Row(name, level, made[level], choice.cpu_s[level], error, picture))
    return rows, choice.reason if several else "emissive: the only level it has."


def _with(level, options):
    return lambda world, device: level(world, device, **options)


def show(run, rows, lines):
    """Contact sheet, table and the page."""
    lit = [row for row in rows if row.level != "emissive"]
    run.card("Worlds", str(len(lines)), f"{len(rows)} levels")
    if lit:
        baked = [float(row.error.rms_after_gain.max()) for row in lit if row.error is not None]
        run.card("Baked against path", f"{max(baked):.1%}", "largest RMS error after gain")
    run.section(
        "The worlds",
        "Every world at its levels, cheap to full from left to right, on one scale (gamma 2.2, 255 is "
        "white).",
    )
    run.figure(contact_sheet(rows), "worlds", "First frame of each world and level.", dpi=110)
    run.section(
        "Cost and error",
        "The error of a level is against the level below it in the table: the finer one of the same world.",
    )

    def number(row, part):
        return None if row.error is None else f"{float(getattr(row.error, part).max()):.2%}"

    columns = (
        "world",
        "level",
        "made, CPU-s",
        "frames, CPU-s",
        "RMS error",
        "after gain",
        "95 % of pixels",
        "reference noise",
    )
    run.table(
        "",
        columns,
        [
            (
                row.world,
                row.level,
                f"{row.made_cpu_s:.2f}",
                f"{row.frames_cpu_s:.3f}",
                *(number(row, part) for part in ("rms", "rms_after_gain", "percentile_95", "noise")),
            )
            for row in rows
        ],
        "Errors are shares of the radiance, the largest over the frames. "
        "'After gain': one brightness factor per frame is forgiven, as by a sensor of log intensity. "
        "The RMS errors have the reference's noise taken out, the percentile has not.",
    )
    run.section(
        "The level to take",
        f"The cheapest whose error after gain stays within {run.config.tolerance:g}:\n\n" + "\n".join(lines),
    )
    run.finish(
        "Light levels",
        "Emissive pictures, light baked once, and path tracing on the same camera rays: what each costs and "
        "how far it is from the next.",
    )


def contact_sheet(rows):
    """Figure of the first frames: a row per world, a column per level."""
    names = list(dict.fromkeys(row.world for row in rows))
    levels = list(build.LEVELS)
    figure, axes = plt.subplots(
        len(names),
        len(levels),
        figsize=(3.2 * len(levels), 2.5 * len(names)),
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat:
        axis.axis("off")
    for row in rows:
        axis = axes[names.index(row.world)][levels.index(row.level)]
        axis.imshow(
            (np.clip(row.picture, 0, 255) / 255) ** (1 / 2.2),
            cmap="gray",
            vmin=0,
            vmax=1,
            interpolation="nearest",
        )
        axis.set_title(f"{row.world}, {row.level}", fontsize=9)
    return figure


if __name__ == "__main__":
    sys.exit(main(study, Config))
