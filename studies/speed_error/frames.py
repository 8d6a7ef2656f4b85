"""Stage "render": what a step of frames costs."""

import subprocess
import sys
import tempfile
import time
from statistics import median

import torch

from codesign import lens, pose, render
from scenes import trajectories, worlds
from studies.frame.bench import apart, measure, resident_mb
from studies.frame.run import Run
from studies.frame.show import Asked, Panel, panels
from studies.speed_error import Config

SIZE_PX = 96
SAMPLES = 8
START = ((0.0, -1.2, 1.3), (0.2, 2.0, 1.2))
WARM = 10  # steps before memory counts: caches fill
SEE_FRAMES = ("codesign", "gradient_flow", "lens_opt", "make_dataset", "placement")
# a study as `python -m` starts it, until there are frames
UNTIL_FRAMES = """
import os, runpy, sys
study, sys.argv[0] = sys.argv.pop(1), "-m"
sys.orig_argv = [sys.executable, "-m", study]
import studies
from codesign.render import wavefront
render = wavefront.pixel_means
def tell(*given):
    render(*given)
    print(sum(os.times()[:2]), flush=True)
    os._exit(0)
wavefront.pixel_means = tell
runpy.run_module(study, run_name="__main__", alter_sys=True)
"""


def first_frame_s(study: str, times: int) -> float:
    """Processor seconds of a quick run up to its first frames, imports among them: the median of so many
    times, after one whose kernels are kept."""
    found = []
    for _ in range(times + 1):
        with tempfile.TemporaryDirectory() as out:
            command = ["-c", UNTIL_FRAMES, f"studies.{study}", "--quick", "--out", f"{out}/run"]
            done = subprocess.run([sys.executable, *command], stdout=subprocess.PIPE, check=True)
        found.append(float(done.stdout.split()[-1]))
    return median(found[1:])


def first_gradient_s() -> float:
    """Processor seconds of the first trace of 10,000 rays with gradients through a lens of 80 surfaces,
    whose kinds are drawn: spheres, conics and aspheres."""
    drawn = torch.randint(3, (80,), generator=torch.Generator().manual_seed(0)).tolist()
    kinds = {}, {"conic": -0.5}, {"conic": -0.3, "asphere": (0.0, 1e-8)}
    glass = lens.Glass.named("N-BK7"), None
    bend = 400.0, -400.0
    surfaces = [
        lens.Surface(bend[k % 2], 1.0, glass[k % 2], 20.0, is_stop=k == 40, **kinds[kind])
        for k, kind in enumerate(drawn)
    ]
    made = lens.GeoLens(surfaces, 8.0)
    origin = torch.rand(10_000, 3, generator=torch.Generator().manual_seed(0)).double()
    direction = origin.new_tensor([0.0, 0.0, 1.0]).expand_as(origin)
    since_s = time.process_time()
    made.trace(origin - 2, direction).position_mm.square().mean().backward()
    return time.process_time() - since_s


def render_stage(run: Run[Config]) -> list[Asked]:
    """A step: 20 frames of 96 x 96 pixels, 8 samples, of the room through a triplet, with gradients
    to curvatures, thicknesses and a pose twist; the first, which compiles, is left out."""
    count = 2 * WARM if run.config.quick else 200
    repeats = run.config.repeats
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
        return measure(lambda: render.frames(camera, scene, poses), repeats).cpu

    # the pinhole computes in float64 by default; both get float32 rays
    over_pinhole = cost(geo.scaled(0.22).freeze()) / cost(lens.Pinhole(torch.tensor(11.0)))
    with tempfile.TemporaryDirectory() as home:  # where no kernels are kept
        gradient_s = apart(first_gradient_s, environment={"HOME": home})
    return [
        Asked("CPU-s of the first gradient of 80 unlike surfaces", gradient_s, most=2.0),
        *(
            Asked(
                f"CPU-s from start to the first frames of {study}",
                first_frame_s(study, repeats),
                most=3.0,
            )
            for study in SEE_FRAMES
        ),
        Asked("CPU-s of a render step", timing.cpu, most=1.0),
        Asked("growth of memory over the steps, MB", memory[-1] - memory[WARM - 1], most=50.0),
        Asked("traced triplet over pinhole, frames alone", over_pinhole, most=1.3),
    ]
