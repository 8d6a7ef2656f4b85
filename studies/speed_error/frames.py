"""Stages "render", "psf" and "light": what frames cost and how true they are.

render: a step with lens and pose gradients, and the memory of many; a traced lens against a pinhole; the
wavefront against one differentiable Mitsuba render per frame; events that sampling adds or takes. psf:
frames by point spread functions beside traced ones. light: every world at every light level.
"""

import inspect
import math
import time

import numpy as np
import torch

from codesign import backend, events, lens, pose, render
from codesign.errors import DomainError
from codesign.render import light
from scenes import build, textures, trajectories, worlds
from studies.frame.bench import measure, resident_mb
from studies.frame.run import Run
from studies.frame.show import Asked, Panel, asked, panels, pictures, table
from studies.frame.sweep import column, metrics, select, sweep
from studies.speed_error import Config

FRAMES = 20
SIZE_PX = 96
SAMPLES = 8
START = ((0.0, -1.2, 1.3), (0.2, 2.0, 1.2))
WARM = 10  # steps before memory counts: caches fill

PITCH_MM = 18.5e-3
EFL_MM = 11.0
NEAREST_M = 0.4
EACH = 64  # samples of the traced frames whose time counts, and of every part of the reference
SLOW = ("far wall", "near wall", "leaning wall", "empty room")  # worlds without depth edges
OTHERS = ("far wall", "near wall", "empty room")  # worlds that the other lenses see
EVEN = ("triplet", "triplet at 0.5 m", "triplet, 60 um defocus", "thin lens at 0.5 m")  # blur changes slowly

TOLERANCE = (
    0.05  # of light: RMS radiance error, after one brightness factor per frame, that a cheaper level may have
)


def render_stage(run: Run[Config]) -> str:
    """The render stage by its figures."""
    quick = run.config.quick
    repeats = run.config.repeats
    step, growth = steps(run, 2 * WARM if quick else 200)
    ours, theirs, default = pose_cost(repeats, 2 if quick else 5)
    wrong, total = false_events(256 if quick else 1024)
    figures = [
        Asked("CPU-s of a step: 20 frames of 96 x 96 x 8, lens and pose", step.cpu, most=1.0),
        Asked("growth of memory over the steps, MB", growth, most=50.0),
        Asked("traced triplet over pinhole", lens_cost(repeats), most=1.3),
        Asked("Mitsuba per frame, emission only, over ours", theirs / ours, least=20.0),
        Asked("Mitsuba with its default light paths over ours", default / ours),
        Asked("events of a static camera, threshold 0.1", static_events(), most=0),
        Asked(
            "share of events that differ from those of many samples", wrong / total, most=1e-3, beside=total
        ),
    ]
    return asked(run, figures, "Rendering, processor times", beside="of")


def path(count: int = FRAMES) -> torch.Tensor:
    return trajectories.translation(pose.look_at(*START), (0.2, 0.05, 0.1), trajectories.times(count, 100.0))


def triplet(dtype: torch.dtype = torch.float32) -> lens.GeoLens:
    return lens.load("cooke-triplet", dtype).scaled(0.22).freeze("conic", "asphere", "index_offset")


def steps(run, count):
    """Times of rendering the room with gradients to curvatures, thicknesses and a pose twist, and the
    growth of memory in MB, after the first steps."""
    geo = lens.load("cooke-triplet", torch.float32).freeze("conic", "asphere", "index_offset")
    camera = render.Camera(geo, SIZE_PX, SIZE_PX, 0.15, SAMPLES, run.config.seed)
    scene = worlds.room(objects=False)
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    memory = []

    def step():
        images = render.frames(camera, scene, path() @ pose.se3_exp(twist))
        torch.autograd.grad(
            images.diff(dim=0).square().mean(), [twist, geo.curvature_per_mm, geo.thickness_mm]
        )

    with run.progress(count, "render steps") as progress:

        def watch():
            memory.append(resident_mb())
            progress.advance(memory_mb=memory[-1])

        timing = measure(step, count, warm=1, after_each=watch)
    at = range(count)
    run.figure(
        panels(
            Panel(
                {"clock": (at, timing.wall_s), "processor": (at, timing.cpu_s)}, "step", "seconds", "", [1.0]
            ),
            Panel({"memory": (at, memory)}, "step", "memory in use, MB"),
        ),
        "render_step",
        "Time and memory of every step after the first, which compiles.",
    )
    return timing, memory[-1] - memory[WARM - 1]


def lens_cost(repeats):
    """CPU time of the forward frames of the room, traced lens over pinhole; rays included."""
    scene = worlds.room(objects=False)
    # the pinhole computes in float64 by default; both get float32 rays
    both = (triplet().freeze(), lens.Pinhole(torch.tensor(11.0, dtype=torch.float32)))

    def cost(optics):
        camera = render.Camera(optics, SIZE_PX, SIZE_PX, 8.0 / SIZE_PX, SAMPLES)
        return measure(lambda: render.frames(camera, scene, path()), repeats).cpu

    with torch.no_grad():
        traced, pinhole = map(cost, both)
    return traced / pinhole


def pose_cost(repeats, fewer):
    """CPU seconds of 20 frames with the gradient of a loss to the pose: our wavefront; one differentiable
    Mitsuba render per frame, of emission only as ours; the same with Mitsuba's own default of light paths,
    which does more."""
    import drjit as dr

    scene = worlds.room(objects=False)
    poses = path()
    pinhole = lens.Pinhole(torch.tensor(11.0, dtype=torch.float32))
    camera = render.Camera(pinhole, SIZE_PX, SIZE_PX, 8.0 / SIZE_PX, SAMPLES)

    def ours():
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        torch.autograd.grad(render.frames(camera, scene, poses @ pose.se3_exp(twist)).square().mean(), twist)

    mi = backend.mitsuba()
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": 2 * math.degrees(math.atan(4.0 / 11.0)),
            "film": {"type": "hdrfilm", "width": SIZE_PX, "height": SIZE_PX, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": SAMPLES},
        }
    )
    parameters = mi.traverse(sensor)
    # Mitsuba's sensors look along +z with x to the left and y up
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))

    def theirs(integrator):
        for frame in range(FRAMES):
            shift = dr.zeros(mi.Float, 6)
            dr.enable_grad(shift)
            t, r = ([dr.gather(mi.Float, shift, k) for k in part] for part in ((0, 1, 2), (3, 4, 5)))
            small = mi.Transform4f().translate(mi.Vector3f(*t))
            for axis, angle in zip(([1, 0, 0], [0, 1, 0], [0, 0, 1]), r, strict=True):
                small = small @ mi.Transform4f().rotate(axis, angle)
            parameters["to_world"] = mi.Transform4f((poses[frame] @ turn).numpy()) @ small
            parameters.update()
            image = mi.render(
                scene.scene, parameters, sensor=sensor, integrator=integrator, spp=SAMPLES, seed=frame
            )
            dr.backward(dr.mean(dr.square(image), axis=None))
            dr.eval(dr.grad(shift))

    emission = mi.load_dict({"type": "path", "max_depth": 1})
    default = mi.load_dict({"type": "path"})
    return (
        measure(ours, repeats).cpu,
        measure(lambda: theirs(emission), fewer, warm=1).cpu,
        measure(lambda: theirs(default), 2, warm=1).cpu,
    )


def static_events():
    """Events of a camera that stands still before photographs, memory layer, threshold 0.1."""
    camera = render.Camera(triplet(torch.float64).freeze(), 64, 64, 0.03, 16)
    frames = render.frames(camera, worlds.room(), path(2)[:1].expand(20, 4, 4))
    return int(events.memory(frames, 0.1, 0.1)[0].sum())


def false_events(many):
    """Events of a moving camera before a softened photograph that differ between 16 and ``many`` samples
    per pixel, and all events of the latter. Pixels and polarities are compared over the whole sequence, so
    that an event that comes a frame earlier or later is none."""
    wall = worlds.wall(textures.softened(textures.photo("gravel"), 6.0), texel_m=0.004)
    poses = trajectories.translation(
        pose.look_at((0, -2, 0), (0, 0, 0)), (0.3, 0.1, 0.0), trajectories.times(41, 200.0)
    )
    found = []
    for samples in (16, many):
        camera = render.Camera(triplet().freeze(), 64, 64, 0.03, samples)
        frames = torch.cat([render.frames(camera, wall, part) for part in poses.split(4)])
        found.append(events.memory(frames, 0.1, 0.1)[0].sum(0))
    return int((found[0] - found[1]).abs().sum()), int(found[1].sum())


def psf_stage(run: Run[Config]) -> str:
    """Frames by point spread functions: lenses on a 346 x 260 sensor of 18.5 um before walls and rooms, and
    before depth edges where the level must guess.

    Errors are RMS differences from many traced samples over the picture's RMS contrast, beside those of
    traced frames of 16 and 64 samples (their noise) and of the thin lens. Times are processor times with
    everything of the lens ready (rays, map), as in many frames of one lens, and with the gradient to lens
    and poses, which makes both anew.
    """
    scenes = views()
    optics = lenses()
    parts = 2 if run.config.quick else 4
    shown = {}

    def cell(case):
        name, view = case
        found, shown_now = psf_errors(optics[name], *scenes[view], parts)
        if name == EVEN[1]:
            shown[view] = shown_now
        return {"lens": name, "world": view, **found}

    cases = [(name, view) for name in optics for view in scenes]
    cases = [c for c in cases if c[0] in EVEN[:2] or (not run.config.quick and c[1] in OTHERS)]
    rows = sweep(run, cell, "psf", case={" before ".join(case): case for case in cases})
    ratios = {
        view: psf_times(optics[EVEN[0]], *scenes[view], run.config.repeats)
        for view in ("far wall", "tabletop")
    }
    even = [row for row in rows if row["lens"] in EVEN]
    worst = {
        "psf_level": [row for row in even if row["world"] in SLOW],
        "psf_level_edges": [row for row in even if row["world"] not in SLOW],
        "psf_level_hard_lenses": [row for row in rows if row["lens"] not in EVEN],
    }
    errors = {name: max(column(of, "by PSF")) for name, of in worst.items() if of}
    run.record(
        **{f"{name}_rms_error_percent": error for name, error in errors.items()},
        psf_level_reference_noise_percent=max(column(worst["psf_level"], "of the reference")),
    )
    run.table(
        "RMS error over contrast, %",
        *table([{name: value for name, value in row.items() if name != "case"} for row in rows]),
        "The reference's own noise is estimated from its halves.",
    )
    times = [{"world": view, **found} for view, found in ratios.items()]
    run.record(**metrics(times, "world"))
    run.table(
        "Processor time of 64 traced samples over that of the level",
        *table(times),
    )
    if chosen := {
        view: shown[view] for view in ("leaning wall", "room with crates", "tabletop") if view in shown
    }:
        run.figure(
            pictures(chosen, signed=["difference"], side=3), "psf_level", f"{EVEN[1]}; red: too bright."
        )
    figures = [
        Asked("error where blur changes slowly, %", errors["psf_level"], most=2.0),
        Asked("error with depth edges, %", errors["psf_level_edges"]),
        Asked(
            "time of 64 samples over the level's",
            min(r["speed_ratio_64"] for r in ratios.values()),
            least=3.0,
        ),
        Asked("the same with gradients", min(r["gradient_speed_ratio_64"] for r in ratios.values())),
    ]
    return asked(run, figures, "Frames by point spread functions against what was asked")


def lenses():
    """Name -> lens of 11 mm."""

    def scaled(name):
        published = lens.load(name, torch.float32)
        return published.scaled(EFL_MM / float(published.first_order().efl_mm.detach())).freeze()

    triplet = scaled("cooke-triplet")
    behind = triplet.thickness_mm.detach().clone()
    behind[-1] += 0.06
    crown = lens.Glass.from_indices(1.6074, 1.62041, 1.6268, "crown")
    single = [
        lens.Surface(7.0, 1.5, crown, 3.0),
        lens.Surface(-200.0, 0.3, None, 3.0),
        lens.Surface(float("inf"), 10.0, None, 2.0, is_stop=True),
    ]
    singlet = lens.GeoLens(single, 2.2, dtype=torch.float32, name="singlet").focus_at(1.0)
    return {
        "triplet": triplet,
        "triplet at 0.5 m": triplet.focus_at(0.5).freeze(),
        "triplet, 60 um defocus": triplet.replace(thickness_mm=behind).freeze(),
        "thin lens at 0.5 m": triplet.thin().focus_at(0.5),
        "double Gauss": scaled("double-gauss"),
        "singlet": singlet.freeze(),
    }


def views():
    """Name -> scene and pose [1, 4, 4]."""
    soft = textures.softened(textures.photo("gravel"), 2.0)
    far = worlds.wall(soft, texel_m=0.005)
    near = worlds.wall(soft, texel_m=0.001)
    grain = worlds.wall(textures.photo("gravel"), 0.005)
    found = {
        "far wall": (far, (0.1, -3, 0.2), (0.1, 0, 0.2)),
        "near wall": (near, (0.1, -0.6, 0.2), (0.1, 0, 0.2)),
        "leaning wall": (near, (0.1, -0.7, 0.2), (0.6, 0, 0.4)),
        "empty room": (worlds.room(objects=False), *worlds.VIEWS["room"]),
        "grain of one pixel": (grain, (0.1, -3, 0), (0.1, 0, 0)),
        "room with crates": (worlds.room(), (0.1, -0.2, 1.0), (0.0, 1.2, 0.3)),
        "tabletop": (worlds.tabletop(), *worlds.VIEWS["tabletop"]),
    }
    return {name: (scene, pose.look_at(*at).reshape(1, 4, 4)) for name, (scene, *at) in found.items()}


def camera_of(optics, samples=EACH, seed=0):
    return render.Camera(optics, 346, 260, PITCH_MM, samples, seed)


@torch.no_grad()
def psf_errors(optics, scene, at, parts):
    """Errors in percent, and the pictures."""
    every = torch.stack([render.frames(camera_of(optics, seed=k + 1), scene, at)[0] for k in range(parts)])
    reference = every.mean(0)
    near = render.psf_frames(camera_of(optics), scene, at, render.psf_map(camera_of(optics), NEAREST_M))[0]
    thin = optics.thin() if hasattr(optics, "thin") else optics
    off = {
        "by PSF": near - reference,
        "traced, 16": render.frames(camera_of(optics, 16), scene, at)[0] - reference,
        "traced, 64": render.frames(camera_of(optics), scene, at)[0] - reference,
        "thin lens, 64": render.frames(camera_of(thin), scene, at)[0] - reference,
        "of the reference": (every[::2].mean(0) - every[1::2].mean(0)) / 2,
    }
    percent = {name: 100 * float(d.square().mean().sqrt() / reference.std()) for name, d in off.items()}
    return percent, {"traced": reference, "by PSF": near, "difference": near - reference}


def psf_times(optics, scene, at, repeats):
    """Processor time of traced frames over that of frames by PSF, with the lens ready and with gradients;
    and the two times with the lens ready, s."""
    cam = camera_of(optics)
    with torch.no_grad():
        rays = cam.rays()
        psf = render.psf_map(cam, NEAREST_M)
        by_psf = measure(lambda: render.psf_frames(cam, scene, at, psf), repeats).cpu
        traced = measure(lambda: render.frames(cam, scene, at, rays=rays), repeats).cpu

    def back(make):
        def step():
            changed = optics.replace(thickness_mm=optics.thickness_mm.detach().requires_grad_())
            make(cam.with_lens(changed), at.clone().requires_grad_()).square().mean().backward()

        return measure(step, max(2, repeats // 2), warm=1).cpu

    back_psf = back(lambda c, p: render.psf_frames(c, scene, p, render.psf_map(c, NEAREST_M)))
    back_traced = back(lambda c, p: render.frames(c, scene, p))
    return {
        "speed_ratio_64": traced / by_psf,
        "gradient_speed_ratio_64": back_traced / back_psf,
        "psf_cpu_s": by_psf,
        "traced_64_cpu_s": traced,
    }


def light_stage(run: Run[Config]) -> str:
    """How much light transport a world needs: its levels (emissive: pictures as radiance; baked: Lambertian
    light worked out once; path: paths traced for every camera ray), their cost and their error against the
    next finer one."""
    names = run.config.world or tuple(worlds.WORLDS)
    unknown = [name for name in names if name not in worlds.WORLDS]
    if unknown:
        raise DomainError(f"there is no world '{unknown[0]}'; choose from {', '.join(worlds.WORLDS)}.")
    quick = run.config.quick
    width, frames, paths, texels = (48, 1, 4, 8) if quick else (96, 3, 24, 64)
    camera = render.Camera(lens.Pinhole(8.0), width, width * 3 // 4, 6.4 / width, 4, run.config.seed)
    options = {
        "emissive": {},
        "baked": {"samples": texels, "seed": run.config.seed},
        "path": {"samples": paths, "seed": run.config.seed},
    }
    shown: dict[str, dict[str, np.ndarray]] = {}
    rows = sweep(run, lambda world: light_levels(world, camera, options, frames, shown), "light", world=names)
    run.record(**metrics(rows, "world", "level", prefix="light"))
    run.section(
        "Light",
        "The error of a level is against the next finer one of the same world: shares of the radiance, "
        "the largest over the frames. After gain: one brightness factor per frame is forgiven, as by a "
        "sensor of log intensity. RMS errors have the reference's noise taken out, the percentile has "
        "not.",
    )
    run.table("Levels of light", *table({k: v for k, v in row.items() if k != "reason"} for row in rows))
    run.text(
        f"The cheapest level within {TOLERANCE:g} after gain:\n\n"
        + "\n".join(dict.fromkeys(column(rows, "reason")))
    )
    if shown:
        run.figure(pictures(shown, side=2.5), "worlds", "First frame of each world and level.", dpi=110)
    baked = column(select(rows, level="baked"), "rms_after_gain")
    return (
        asked(run, [Asked("baked against path after gain, largest RMS", max(baked))], "Light")
        if baked
        else "."
    )


def light_levels(name, camera, options, frames, shown):
    """Rows of a world's levels, seen by a camera that moves 5 cm to its right and turns by a degree per
    frame."""
    make = worlds.WORLDS[name]
    twist = torch.tensor([0.05, 0, 0, 0, math.radians(1), 0], dtype=torch.float64)
    poses = pose.look_at(*worlds.VIEWS[name]) @ pose.se3_exp(torch.arange(frames).double()[:, None] * twist)
    several = "light" in inspect.signature(make).parameters
    scenes = {}
    made = {}
    for level in options if several else ("emissive",):
        start = time.process_time()
        scenes[level] = make(light=_with(build.LEVELS[level], options[level])) if several else make()
        made[level] = time.process_time() - start
    choice = light.choose(scenes, camera, poses, TOLERANCE, after_gain=True)
    reason = choice.reason if several else "emissive: the only level it has."
    rows = []
    for level, finer in zip(scenes, [*list(scenes)[1:], None], strict=True):
        error = light.level_error(scenes[level], scenes[finer], camera, poses) if finer else None
        parts = ("rms", "rms_after_gain", "percentile_95", "noise")
        rows.append(
            {"level": level, "made_cpu_s": made[level], "frames_cpu_s": choice.cpu_s[level]}
            | {part: float(getattr(error, part).max()) if error else None for part in parts}
            | {"reason": f"- **{name}**: {reason}"}
        )
        with torch.no_grad():
            shown.setdefault(name, {})[level] = render.frames(camera, scenes[level], poses[:1])[0].numpy()
    return rows


def _with(level, options):
    return lambda world, device: level(world, device, **options)
