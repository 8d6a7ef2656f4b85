"""Stages "render", "psf" and "light": what frames cost and how true they are."""

import inspect
import math
import time

import numpy as np
import torch

from codesign import lens, pose, render
from codesign.render import light
from scenes import build, textures, trajectories, worlds
from studies.frame.bench import measure, resident_mb
from studies.frame.run import Run
from studies.frame.show import Asked, Panel, panels, pictures, tabulate
from studies.frame.sweep import column, select, sweep
from studies.speed_error import Config

SIZE_PX = 96
SAMPLES = 8
START = ((0.0, -1.2, 1.3), (0.2, 2.0, 1.2))
WARM = 10  # steps before memory counts: caches fill

PITCH_MM = 18.5e-3
EFL_MM = 11.0
NEAREST_M = 0.4
EACH = 64  # samples of the traced frames whose time counts, and of every part of the reference
EDGES = ("room with crates", "tabletop")  # worlds with depth edges, where the level must guess
EVEN = ("triplet", "triplet at 0.5 m", "thin lens at 0.5 m")  # blur changes slowly over the field

# of light: RMS radiance error, after one brightness factor per frame, that a cheaper level may have
TOLERANCE = 0.05


def render_stage(run: Run[Config]) -> list[Asked]:
    """A step: 20 frames of 96 x 96 pixels, 8 samples, of the room through a triplet, with gradients
    to curvatures, thicknesses and a pose twist; the first, which compiles, is left out."""
    count = 2 * WARM if run.config.quick else 200
    scene = worlds.room(objects=False)
    poses = trajectories.translation(
        pose.look_at(*START), (0.2, 0.05, 0.1), trajectories.times(20, 100.0)
    )
    geo = lens.load("cooke-triplet", torch.float32).freeze("conic", "asphere", "index_offset")
    camera = render.Camera(geo, SIZE_PX, SIZE_PX, 0.15, SAMPLES, run.config.seed)
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    memory = []

    def step():
        images = render.frames(camera, scene, poses @ pose.se3_exp(twist))
        loss = images.diff(dim=0).square().mean()
        torch.autograd.grad(loss, [twist, geo.curvature_per_mm, geo.thickness_mm])

    with run.progress(count, "render steps") as progress:

        def watch():
            memory.append(resident_mb())
            progress.advance(memory_mb=memory[-1])

        timing = measure(step, count, warm=1, after_each=watch)
    times = {"clock": (range(count), timing.wall_s), "processor": (range(count), timing.cpu_s)}
    charts = [Panel(times, "step", "seconds", "", [1.0])]
    charts.append(Panel({"memory": (range(count), memory)}, "step", "memory in use, MB"))
    run.figure(panels(*charts), "render_step", "Every step after the first.")

    @torch.no_grad()
    def cost(optics):
        camera = render.Camera(optics, SIZE_PX, SIZE_PX, 8.0 / SIZE_PX, SAMPLES)
        return measure(lambda: render.frames(camera, scene, poses), run.config.repeats).cpu

    # the pinhole computes in float64 by default; both get float32 rays
    over_pinhole = cost(geo.scaled(0.22).freeze()) / cost(lens.Pinhole(torch.tensor(11.0)))
    return [
        Asked("CPU-s of a render step", timing.cpu, most=1.0),
        Asked("growth of memory over the steps, MB", memory[-1] - memory[WARM - 1], most=50.0),
        Asked("traced triplet over pinhole, frames alone", over_pinhole, most=1.3),
    ]


def psf_stage(run: Run[Config]) -> list[Asked]:
    """Frames by point spread functions: lenses of 11 mm on a 346 x 260 sensor of 18.5 um. Errors
    are RMS differences from many traced samples over the picture's contrast, in percent, beside
    those of traced frames of 64 samples (their noise) and of the thin lens; the reference's own
    noise is estimated from its halves.
    Times: processor time of traced frames over that of the level, with everything of the lens ready
    (rays, map), and with the gradient to lens and poses, which makes both anew."""
    scenes = views()
    every = lenses()
    count = 2 if run.config.quick else 4
    names = EVEN[:1] if run.config.quick else tuple(every)
    shown = {}

    def errors(optics, view):
        found, shown[view] = psf_errors(every[optics], *scenes[view], count)
        return found

    def times(view):
        return psf_times(every[EVEN[0]], *scenes[view], run.config.repeats)

    rows = sweep(run, errors, "psf", optics=names, view=list(scenes))
    tabulate(run, "RMS error over contrast, %", rows, "optics", "view", prefix="psf_error_percent")
    ratios = sweep(run, times, "psf_times", view=("far wall", "tabletop"))
    tabulate(run, "Time of 64 traced samples over the level's", ratios, "view", prefix="psf_time")
    if shown:
        run.figure(pictures(shown, signed=["difference"], side=3), "psf_level", "Red: too bright.")
    even = [row for row in rows if row["optics"] in EVEN]
    slow = [row["by_psf"] for row in even if row["view"] not in EDGES]
    edges = [row["by_psf"] for row in even if row["view"] in EDGES]
    return [
        Asked("psf: error where blur changes slowly, %", max(slow), most=2.0),
        Asked("psf: error with depth edges, %", max(edges)),
        Asked("psf: time of 64 samples over the level's", min(column(ratios, "ready")), least=3.0),
    ]


def lenses():
    """Name -> lens of 11 mm."""

    def scaled(name):
        published = lens.load(name, torch.float32)
        return published.scaled(EFL_MM / float(published.first_order().efl_mm.detach())).freeze()

    triplet = scaled("cooke-triplet")
    return {
        "triplet": triplet,
        "triplet at 0.5 m": triplet.focus_at(0.5).freeze(),
        "thin lens at 0.5 m": triplet.thin().focus_at(0.5),
        "double Gauss": scaled("double-gauss"),
    }


def views():
    """Name -> scene and pose [1, 4, 4]."""
    soft = textures.softened(textures.photo("gravel"), 2.0)
    near = worlds.wall(soft, texel_m=0.001)
    found = {
        "far wall": (worlds.wall(soft, texel_m=0.005), (0.1, -3, 0.2), (0.1, 0, 0.2)),
        "leaning wall": (near, (0.1, -0.7, 0.2), (0.6, 0, 0.4)),
        "empty room": (worlds.room(objects=False), *worlds.VIEWS["room"]),
        EDGES[0]: (worlds.room(), (0.1, -0.2, 1.0), (0.0, 1.2, 0.3)),
        EDGES[1]: (worlds.tabletop(), *worlds.VIEWS["tabletop"]),
    }
    return {
        name: (scene, pose.look_at(*at).reshape(1, 4, 4)) for name, (scene, *at) in found.items()
    }


def camera_of(optics, seed=0):
    return render.Camera(optics, 346, 260, PITCH_MM, EACH, seed)


@torch.no_grad()
def psf_errors(optics, scene, at, count):
    """Errors in percent, and the pictures."""
    every = torch.stack(
        [render.frames(camera_of(optics, k + 1), scene, at)[0] for k in range(count)]
    )
    truth = every.mean(0)
    camera = camera_of(optics)
    by_psf = render.psf_frames(camera, scene, at, render.psf_map(camera, NEAREST_M))[0]
    thin = optics.thin() if hasattr(optics, "thin") else optics
    off = {
        "by_psf": by_psf - truth,
        "traced_64": render.frames(camera, scene, at)[0] - truth,
        "thin_lens_64": render.frames(camera_of(thin), scene, at)[0] - truth,
        "reference": (every[::2].mean(0) - every[1::2].mean(0)) / 2,
    }
    percent = {name: 100 * float(d.square().mean().sqrt() / truth.std()) for name, d in off.items()}
    return percent, {"traced": truth, "by PSF": by_psf, "difference": off["by_psf"]}


def psf_times(optics, scene, at, repeats):
    """Processor time of traced frames over that of frames by PSF."""
    camera = camera_of(optics)
    with torch.no_grad():
        rays = camera.rays()
        psf = render.psf_map(camera, NEAREST_M)
        by_psf = measure(lambda: render.psf_frames(camera, scene, at, psf), repeats).cpu
        traced = measure(lambda: render.frames(camera, scene, at, rays=rays), repeats).cpu

    def back(make):
        def step():
            changed = optics.replace(thickness_mm=optics.thickness_mm.detach().requires_grad_())
            make(camera.with_lens(changed), at.clone().requires_grad_()).square().mean().backward()

        return measure(step, max(2, repeats // 2), warm=1).cpu

    back_psf = back(lambda c, p: render.psf_frames(c, scene, p, render.psf_map(c, NEAREST_M)))
    back_traced = back(lambda c, p: render.frames(c, scene, p))
    return {
        "ready": traced / by_psf,
        "with_gradients": back_traced / back_psf,
        "by_psf_cpu_s": by_psf,
    }


def light_stage(run: Run[Config]) -> list[Asked]:
    """Worlds by their levels of light: emissive (pictures as radiance), baked (Lambertian light
    worked out once), path (paths traced for every camera ray). The error of a level is against the
    next finer one of the same world: shares of the radiance, the largest over the frames. After
    gain: one brightness factor per frame is forgiven, as by a sensor of log intensity. RMS errors
    have the reference's noise taken out, the percentile has not."""
    quick = run.config.quick
    width, frames, paths, texels = (48, 1, 4, 8) if quick else (96, 3, 24, 64)
    camera = render.Camera(
        lens.Pinhole(8.0), width, width * 3 // 4, 6.4 / width, 4, run.config.seed
    )
    options = {
        "emissive": {},
        "baked": {"samples": texels, "seed": run.config.seed},
        "path": {"samples": paths, "seed": run.config.seed},
    }
    shown: dict[str, dict[str, np.ndarray]] = {}
    rows = sweep(
        run,
        lambda world: light_levels(world, camera, options, frames, shown),
        "light",
        world=list(worlds.WORLDS),
    )
    figures = [{name: value for name, value in row.items() if name != "choice"} for row in rows]
    tabulate(run, "Levels of light", figures, "world", "level", prefix="light")
    choices = "\n".join(dict.fromkeys(column(rows, "choice")))
    run.text(f"The cheapest level within {TOLERANCE:g} after gain:\n\n{choices}")
    if shown:
        run.figure(
            pictures(shown, side=2.5), "worlds", "First frame of each world and level.", dpi=110
        )
    baked = column(select(rows, level="baked"), "rms_after_gain")
    return [Asked("light: baked against path after gain, largest RMS", max(baked))]


def light_levels(name, camera, options, frames, shown):
    """Rows of a world's levels, seen by a camera that moves 5 cm to its right and turns by a degree
    per frame."""
    make = worlds.WORLDS[name]
    twist = torch.tensor([0.05, 0, 0, 0, math.radians(1), 0], dtype=torch.float64)
    poses = pose.look_at(*worlds.VIEWS[name]) @ pose.se3_exp(
        torch.arange(frames).double()[:, None] * twist
    )
    several = "light" in inspect.signature(make).parameters
    scenes = {}
    made = {}
    for level in options if several else ("emissive",):
        start = time.process_time()
        scenes[level] = (
            make(light=_with(build.LEVELS[level], options[level])) if several else make()
        )
        made[level] = time.process_time() - start
    choice = light.choose(scenes, camera, poses, TOLERANCE, after_gain=True)
    reason = choice.reason if several else "emissive: the only level it has."
    rows = []
    for level, finer in zip(scenes, [*list(scenes)[1:], None], strict=True):
        error = light.level_error(scenes[level], scenes[finer], camera, poses) if finer else None
        row = {"level": level, "made_cpu_s": made[level], "frames_cpu_s": choice.cpu_s[level]}
        for part in ("rms", "rms_after_gain", "percentile_95", "noise"):
            row[part] = float(getattr(error, part).max()) if error else None
        rows.append(row | {"choice": f"- **{name}**: {reason}"})
        with torch.no_grad():
            shown.setdefault(name, {})[level] = render.frames(camera, scenes[level], poses[:1])[
                0
            ].numpy()
    return rows


def _with(level, options):
    return lambda world, device: level(world, device, **options)
