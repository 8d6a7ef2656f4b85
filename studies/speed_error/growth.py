"""Stage "growth": how rendering, and finding outlines for gradients, grows with objects and faces,
and the whole chain with pixels, rays, frames and bins."""

import itertools
import math
import time

import numpy as np
import torch

from codesign import backend, lens, pose, render
from codesign.fidelity import Fidelity, Task
from codesign.fidelity.levels import batch_of, system_of
from codesign.fidelity.survey import outcome
from codesign.render.charts import emissive_mesh
from scenes import trajectories, worlds
from studies.frame.run import Run
from studies.frame.show import Asked, tabulate
from studies.frame.sweep import column, select, sweep
from studies.speed_error import Config
from studies.speed_error.select import DURATION_S, IDEAL, triplet

SCENES = {"cubes": (16, 64, 256, 1024), "faces": (128, 512, 2048, 8192, 32768)}
PARTS = ("render", "outlines", "first_step", "step")
CHAIN = {  # numbers of the chain; the others stay at PLAIN
    "pixels": (64**2, 128**2, 256**2, 512**2),
    "rays": (4, 16, 64, 256),  # a pixel
    "frames": (17, 33, 65, 129, 257),
    "bins": (4, 8, 16, 32, 64),
}
PLAIN = {"pixels": 64**2, "rays": 4, "frames": 17, "bins": 4}
CHAIN_PARTS = ("frames", "volume", "field", "gradient")
SIZE_PX = 48
SAMPLES = 4
FRAMES = 2
RENDERS = 8  # of which one takes milliseconds


def stage(run: Run[Config]) -> list[Asked]:
    """Objects: cubes of twelve faces in a square grid, smaller the more there are, so that they fill
    the same part of the view. Faces: one wavy sheet of ever finer triangles. Processor seconds,
    medians of turns: "render" two frames of 48 x 48 px, 4 samples, without gradient; "outlines"
    lists the curves at which radiance may jump, once per scene; "first step" is frames with
    gradient "boundary" and back to the pose, with the check of a new view; "step" the same again.
    The chain: 17 frames of 64 x 64 px through a triplet, 4 rays a pixel, memory layer, volume of 4
    bins, affine flow, and one of these numbers larger and larger; "gradient" is all of it forward,
    and back from the flow to the poses.
    The exponent p of seconds ~ count^p is fitted to the logarithms of all counts, where what does
    not grow hides a part of it; the last is between the two largest counts, where n log n, as
    sorting and trees take, is asked at most."""
    figures, found = [], []
    for name, counts, parts, costs in (
        ("scenes", SCENES, PARTS, scene_seconds),
        ("chain", CHAIN, CHAIN_PARTS, chain_seconds),
    ):
        most = 2 if run.config.quick else None
        cells = {f"{kind} {n}": (kind, n) for kind, each in counts.items() for n in each[:most]}
        rows = _grown(run, name, cells, costs)
        for kind, part in itertools.product(counts, parts):
            n, cpu_s = (np.array(column(select(rows, kind=kind), each)) for each in ("count", part))
            last = fitted(n[-2:], cpu_s[-2:])
            found.append({"of": part, "with": kind, "exponent": fitted(n, cpu_s), "last": last})
            asked = fitted(n[-2:], (n * np.log(n))[-2:])
            what = f"last exponent of {part.replace('_', ' ')}, {kind}"
            figures.append(Asked(what, last, most=asked))
    tabulate(run, "Exponents", found, "of", "with", prefix="growth")
    return figures


def _grown(run, name, cells, costs):
    def timed(scene):
        kind, count = scene
        return {"kind": kind, "count": count} | costs(kind, count)

    rows = sweep(run, timed, name, turns=run.config.repeats, scene=cells)
    tabulate(run, f"Processor seconds, {name}", rows, "scene", prefix="growth_cpu_s")
    return rows


def fitted(counts: np.ndarray, cpu_s: np.ndarray) -> float:
    """The exponent p of cpu_s ~ counts^p, by least squares of the logarithms."""
    return np.polyfit(np.log(counts), np.log(cpu_s), 1)[0]


def chain_seconds(kind: str, count: int) -> dict[str, float]:
    """Processor seconds of every part of the chain with so much of one of its numbers."""
    sizes = {**PLAIN, kind: count}
    side = math.isqrt(sizes["pixels"])
    camera = render.Camera(triplet(11.0), side, side, 1.2 / side, sizes["rays"])
    t_s = torch.linspace(0, DURATION_S, sizes["frames"], dtype=torch.float64)
    start = pose.look_at((0.0, -0.01, 2.0), (0.0, 0.0, 0.0))
    twist = torch.tensor([0.4, 0.25, 0.5, 0.0, 0.0, 0.0], dtype=torch.float64)
    drive = trajectories.body_twist(start, twist, t_s)[None].requires_grad_()
    task, world = Task(camera, IDEAL, drive, t_s), worlds.smooth_plane()
    chosen = Fidelity("traced", sizes["rays"], sizes["frames"], "memory", sizes["bins"], "affine")
    cpu_s = outcome(world, task, chosen, turns=2).cpu_s
    system, batch = system_of(world, task, chosen), batch_of(task, chosen)
    begun = time.process_time()
    torch.autograd.grad(system.begin(batch)["field"].flow_px.square().mean(), drive)
    del cpu_s["judged"]  # nothing is asked beside the flow
    return {**cpu_s, "gradient": time.process_time() - begun}


def scene_seconds(kind: str, count: int) -> dict[str, float]:
    """Processor seconds of every part on a fresh scene of "cubes" or "faces"."""
    scene = {"cubes": cubes, "faces": sheet}[kind](count)
    camera = render.Camera(lens.Pinhole(8.0), SIZE_PX, SIZE_PX, 6.4 / SIZE_PX, SAMPLES)
    poses = pose.look_at((0.05, -3.0, 0.1), (0.0, 0.0, 0.0)).expand(FRAMES, 4, 4)
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)

    def step():
        images = render.frames(camera, scene, poses @ pose.se3_exp(twist), "boundary")
        torch.autograd.grad(images.square().mean(), twist)

    def renders():
        for _ in range(RENDERS):
            render.frames(camera, scene, poses)

    renders()
    clock = [time.process_time()]
    for work in (renders, scene.outline, step, step):
        work()
        clock.append(time.process_time())
    return dict(zip(PARTS, (np.diff(clock) / (RENDERS, 1, 1, 1)).tolist(), strict=True))


def cubes(count: int) -> render.MitsubaScene:
    """So many cubes in a square grid of 2 x 2 m about the origin, across y, each turned its own way
    and of a grey of its own; smaller the more there are."""
    mi = backend.mitsuba("cpu")
    side, random = math.isqrt(count), np.random.default_rng(count)
    axes, greys = random.standard_normal((count, 3)), random.uniform(20, 220, count)
    pitch_m, shapes = 2.0 / side, {}
    for k, (axis, grey) in enumerate(zip(axes.tolist(), greys.tolist(), strict=True)):
        at = [pitch_m * (k % side + 0.5) - 1, 0.0, pitch_m * (k // side + 0.5) - 1]
        place = mi.ScalarTransform4f().translate(at).rotate(axis, 50).scale(0.25 * pitch_m)
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": grey}}
        shapes[f"cube{k}"] = {"type": "cube", "to_world": place, "emitter": emitter}
    return render.MitsubaScene(shapes, merge=False)


def sheet(faces: int) -> render.MitsubaScene:
    """A wavy sheet of 2 x 2 m of so many faces, each as bright as it looks up."""
    side = math.isqrt(faces // 2)
    x, z = np.meshgrid(*2 * [np.linspace(-1, 1, side + 1)], indexing="ij")
    vertices = np.stack([x, 0.3 * np.sin(5 * x) * np.sin(5 * z), z], -1).reshape(-1, 3)
    a = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    b, c, d = a + 1, a + side + 1, a + side + 2
    corners = np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)])
    normal = np.cross(*(vertices[corners[:, k]] - vertices[corners[:, 0]] for k in (1, 2)))
    grey = 100 + 50 * normal[:, 2] / np.linalg.norm(normal, axis=1)
    mesh = emissive_mesh(backend.mitsuba("cpu"), vertices, corners, grey)
    return render.MitsubaScene({"sheet": mesh})
