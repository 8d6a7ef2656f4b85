"""The render stage by its figures: cost of a lens and of pose gradients, false events, and the whole chain in
float64.

- A traced lens against a pinhole in the same wavefront; the wavefront against one differentiable Mitsuba
  render per frame.
- Events that a static camera makes, and events that sampling with 16 rays per pixel adds to or takes from
  those of 1024.
- Lens, plane, soft events, flow and loss in float64, to curvatures, thicknesses and pose, against
  differences.
"""

import math
import sys
from dataclasses import dataclass
from typing import ClassVar

import torch

from codesign import backend, events, flow, lens, pose, render
from codesign.grad import certify
from scenes import textures, trajectories, worlds
from studies.frame.run import Run, StudyConfig, main
from studies.frame.timing import measure

FRAMES = 20
SIZE_PX = 96
SAMPLES = 8
ASKED = {
    "lens_over_pinhole": 1.3,
    "mitsuba_over_wavefront": 20.0,
    "false_events": 1e-3,
    "chain_relative_error": 1e-6,
}
START = ((0.0, -1.2, 1.3), (0.2, 2.0, 1.2))


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"repeats": 3}
    repeats: int = 7
    """Timed repeats."""


def study(run: Run[Config]) -> None:
    quick = run.config.quick
    with run.progress(5, "measuring") as progress:
        run.record(lens_over_pinhole=lens_cost(run.config.repeats))
        progress.advance()
        ours, theirs, default = pose_cost(run.config.repeats, 2 if quick else 5)
        run.record(
            wavefront_cpu_s=ours,
            mitsuba_cpu_s=theirs,
            mitsuba_over_wavefront=theirs / ours,
            mitsuba_default_path_over_wavefront=default / ours,
        )
        progress.advance()
        run.record(static_camera_events=static_events())
        progress.advance()
        wrong, total = false_events(256 if quick else 1024)
        run.record(false_events=wrong / total, reference_events=total)
        progress.advance()
        rows = chain()
        run.record(
            chain_relative_error=max(row.relative_error for row in rows),
            chain_noise_floor=max(row.noise_floor for row in rows),
        )
        progress.advance()
    found = run.metrics
    met = {
        "lens_over_pinhole": found["lens_over_pinhole"] <= ASKED["lens_over_pinhole"],
        "mitsuba_over_wavefront": found["mitsuba_over_wavefront"] >= ASKED["mitsuba_over_wavefront"],
        "static_camera_events": found["static_camera_events"] == 0,
        "false_events": found["false_events"] < ASKED["false_events"],
        "chain_relative_error": found["chain_relative_error"] <= ASKED["chain_relative_error"],
    }
    words = {
        "lens_over_pinhole": "CPU time of frames through the traced triplet over those through a pinhole",
        "mitsuba_over_wavefront": "CPU time of one Mitsuba render with pose gradient per frame over ours, emission only on both sides",
        "static_camera_events": "events of a static camera, threshold 0.1",
        "false_events": "events that differ from those of a reference of many samples, share",
        "chain_relative_error": "whole chain in float64 against differences, relative error",
    }
    run.table(
        "Figures",
        ("what", "found", "asked", "met"),
        [(words[k], found[k], ASKED.get(k, 0), "yes" if met[k] else "NO") for k in words],
    )
    run.table(
        "Chain in float64",
        ("parameters", "relative error", "cosine", "noise floor"),
        [(row.name, row.relative_error, row.cosine, row.noise_floor) for row in rows],
    )
    missed = [words[k] for k in words if not met[k]]
    run.finish("Render stage", "All figures are met." if not missed else f"**Missed:** {'; '.join(missed)}.")


def path(count=FRAMES):
    return trajectories.translation(pose.look_at(*START), (0.2, 0.05, 0.1), trajectories.times(count, 100.0))


def lens_cost(repeats):
    """CPU time of the forward frames of the room, traced lens over pinhole; rays included."""
    scene = worlds.room(objects=False)
    poses = path()
    optics = lens.load("cooke-triplet", torch.float32).scaled(0.22).freeze()
    # the pinhole computes in float64 by default; both get float32 rays
    pinhole = lens.Pinhole(torch.tensor(11.0, dtype=torch.float32))

    def work(lens_):
        camera = render.Camera(lens_, SIZE_PX, SIZE_PX, 8.0 / SIZE_PX, SAMPLES)
        return lambda: render.frames(camera, scene, poses)

    with torch.no_grad():
        return measure(work(optics), repeats).cpu / measure(work(pinhole), repeats).cpu


def pose_cost(repeats, fewer):
    """CPU seconds of 20 frames with the gradient of a loss to the pose: our wavefront; one differentiable
    Mitsuba render per frame, of emission only as ours; the same with Mitsuba's own default of light paths,
    which does more than ours."""
    import drjit as dr

    scene = worlds.room(objects=False)
    poses = path()
    camera = render.Camera(
        lens.Pinhole(torch.tensor(11.0, dtype=torch.float32)), SIZE_PX, SIZE_PX, 8.0 / SIZE_PX, SAMPLES
    )

    def ours():
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        frames = render.frames(camera, scene, poses @ pose.se3_exp(twist))
        torch.autograd.grad(frames.square().mean(), twist)

    mi = backend.mitsuba()
    field_deg = 2 * math.degrees(math.atan(4.0 / 11.0))
    film = {"type": "hdrfilm", "width": SIZE_PX, "height": SIZE_PX, "rfilter": {"type": "box"}}
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": field_deg,
            "film": film,
            "sampler": {"type": "independent", "sample_count": SAMPLES},
        }
    )
    parameters = mi.traverse(sensor)
    turn = torch.diag(
        torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64)
    )  # Mitsuba's sensors look along +z with x to the left and y up

    def theirs(integrator):
        for frame in range(FRAMES):
            shift = dr.zeros(mi.Float, 6)
            dr.enable_grad(shift)
            t, r = ([dr.gather(mi.Float, shift, k) for k in part] for part in ((0, 1, 2), (3, 4, 5)))
            small = (
                mi.Transform4f().translate(mi.Vector3f(*t))
                @ mi.Transform4f().rotate([1, 0, 0], r[0])
                @ mi.Transform4f().rotate([0, 1, 0], r[1])
                @ mi.Transform4f().rotate([0, 0, 1], r[2])
            )
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
    camera = render.Camera(lens.load("cooke-triplet").scaled(0.22).freeze(), 64, 64, 0.03, 16)
    frames = render.frames(camera, worlds.room(), path(2)[:1].expand(20, 4, 4))
    counts, _ = events.memory(frames, 0.1, 0.1)
    return int(counts.sum())


def false_events(many):
    """Events per pixel, polarity and frame that differ between 16 and ``many`` samples per pixel, and all
    events of the latter: a moving camera before a softened photograph.

    An event that comes one frame earlier or later counts twice; the sum over the whole sequence, which counts
    each place once, is what is returned.
    """
    texture = textures.softened(textures.photo("gravel"), 6.0)
    wall = worlds.wall(texture, texel_m=0.004)
    poses = trajectories.translation(
        pose.look_at((0, -2, 0), (0, 0, 0)), (0.3, 0.1, 0.0), trajectories.times(41, 200.0)
    )
    found = []
    for samples in (16, many):
        camera = render.Camera(
            lens.load("cooke-triplet", torch.float32).scaled(0.22).freeze(), 64, 64, 0.03, samples
        )
        frames = torch.cat([render.frames(camera, wall, part) for part in poses.split(4)])
        counts, _ = events.memory(frames, 0.1, 0.1)
        found.append(counts.sum(0))
    return int((found[0] - found[1]).abs().sum()), int(found[1].sum())


def chain():
    """Certificate of the loss of the whole chain, all in float64."""
    optics = lens.load("cooke-triplet").scaled(0.22).freeze("conic", "asphere", "index_offset")
    scene = worlds.smooth_plane(3, pose.look_at((0, 0, 0), (0, -1, 0)))
    t_s = torch.linspace(0, 0.05, 8, dtype=torch.float64)
    base = trajectories.translation(pose.look_at((0.1, -2, 0.05), (0, 0, 0)), (0.4, 0.1, 0.2), t_s)

    def loss(p):
        geo = optics.replace(curvature_per_mm=p["curvature"], thickness_mm=p["thickness"])
        camera = render.Camera(geo, 24, 24, 0.1, 8)
        frames = render.frames(camera, scene, base @ pose.se3_exp(p["pose"]))
        field = flow.estimate_lk(events.from_counts(events.soft_counts(frames, 0.2, 0.2), t_s, bins=5))
        truth, valid = render.true_flow(camera, scene, (base @ pose.se3_exp(p["pose"]))[[0, -1]])
        return flow.metrics.aee(field.flow_px, truth, valid)

    start = {
        "curvature": optics.curvature_per_mm.detach(),
        "thickness": optics.thickness_mm.detach(),
        "pose": torch.zeros(6, dtype=torch.float64),
    }
    scales = {
        "curvature": 0.002,
        "thickness": 0.1,
        "pose": torch.tensor([0.01, 0.01, 0.02, 0.005, 0.005, 0.01], dtype=torch.float64),
    }
    return certify(
        loss,
        start,
        scales=scales,
        ladder=(3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5),
        tolerance=ASKED["chain_relative_error"],
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
