"""Many threads at once, each with gradients through every kind of kernel, against the same work
done serially."""

import faulthandler
import gc
import json
import random
import subprocess
import sys
import threading
import time
import timeit
from collections.abc import Callable
from functools import cache, partial

import torch
from torch import Tensor

from codesign import System, events, flow, lens, pose, render
from codesign.errors import CodesignError
from codesign.exclusive import Exclusive, exclusive
from codesign.system import Batch
from codesign.types import EventVolume
from scenes import textures, trajectories, worlds

D = torch.float64
START = pose.look_at((0, -2, 0), (0, 0, 0))
T_S = torch.linspace(0, 0.05, 3, dtype=D)
SEEDS = 4
# of a float32 sum whose order depends on the threads of drjit's own pool
TOLERANCE = 1e-4


def _drawn(seed, *shape):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=D)


def _gradients(found, *leaves):
    weight = _drawn(7, *found.shape).to(found)
    return [found.detach(), *torch.autograd.grad((found * weight).sum(), leaves)]


@cache
def _lens():
    return lens.load("cooke-triplet").scaled(0.22)


@cache
def _ball():
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 100.0}}
    return render.MitsubaScene(
        {"ball": {"type": "sphere", "center": [0, 1, 0.8], "radius": 0.4, "emitter": glow}}
    )


def _wall():
    return worlds.wall(textures.speckle(0, 64), texel_m=0.01)


def _camera(seed):
    return render.Camera(_lens(), 8, 8, 0.148, 4).with_seed(seed)


def _path(seed, start=START):
    return trajectories.translation(start, (0.2 * _drawn(seed, 3)).tolist(), T_S)


def traced(seed: int) -> list[Tensor]:
    bent = (_lens().curvature_per_mm.detach() * (1 + 0.001 * seed)).requires_grad_()
    camera = _camera(seed)
    rays = camera.with_lens(_lens().replace(curvature_per_mm=bent)).rays()
    return _gradients(rays.direction, bent)


def rendered(seed: int) -> list[Tensor]:
    """Of a scene that is built and freed in the thread itself."""
    twist = torch.zeros(6, dtype=D, requires_grad=True)
    frames = render.frames(_camera(seed), _wall(), _path(seed) @ pose.se3_exp(twist))
    return _gradients(frames, twist)


def outlined(seed: int) -> list[Tensor]:
    """Of a scene that all threads share."""
    twist = torch.zeros(6, dtype=D, requires_grad=True)
    poses = _path(seed, pose.look_at((0, -1.2, 1), (0, 1, 0.8))) @ pose.se3_exp(twist)
    return _gradients(render.frames(_camera(seed), _ball(), poses, gradient="boundary"), twist)


def counted(seed: int) -> list[Tensor]:
    frames = (100 + 30 * _drawn(seed, 6, 24, 24)).clamp_min(1).requires_grad_()
    theta = torch.tensor(0.15, dtype=D, requires_grad=True)
    return _gradients(events.memory(frames, theta, 0.2)[0], frames, theta)


def spiked(seed: int) -> list[Tensor]:
    drive = _drawn(seed, 40, 2, 8, 8).requires_grad_()
    theta = torch.tensor(1.0, dtype=D, requires_grad=True)
    found = events.srm(
        drive, theta=theta, tau_r=4.0, tau_s=3.0, response="alpha", through_reset="bounded"
    )
    return _gradients(found[0], drive, theta)


def simulated(seed: int) -> list[Tensor]:
    frames = (100 + 30 * _drawn(seed, 6, 24, 24)).clamp_min(1)
    t_s = torch.linspace(0, 0.1, 6, dtype=D)
    stream = events.simulate(frames, t_s, events.SensorModel(theta_on=0.2))
    return [stream.t_us, stream.x, stream.p]


def estimated(seed: int) -> list[Tensor]:
    counts = _drawn(seed, 1, 2, 3, 16 + 8 * (seed % 2), 16).abs().requires_grad_()
    volume = EventVolume(counts, T_S, torch.full((3,), 0.025, dtype=D))
    found = flow.estimate_lk(volume, levels_px=(1.0,), model=("affine", "local")[seed % 2])
    return _gradients(found.flow_px, counts)


def optimised(seed: int) -> list[Tensor]:
    """The whole chain, to the lens, the mount's place and a threshold."""
    bent = _lens().curvature_per_mm.detach().clone().requires_grad_()
    twist = torch.zeros(6, dtype=D, requires_grad=True)
    system = System(
        camera=_camera(seed).with_lens(_lens().replace(curvature_per_mm=bent)),
        events=events.layer("memory"),
        flow=partial(flow.estimate_lk, levels_px=(1.0,)),
        objectives={"flow": lambda field: field.flow_px.square().mean()},
        scene=_wall(),
    )
    result = system(Batch(_path(seed)[None] @ pose.se3_exp(twist), T_S, seed=seed))
    return _gradients(result.objectives["flow"], bent, twist)


KINDS: dict[str, Callable[[int], list[Tensor]]] = {
    f.__name__: f
    for f in (traced, rendered, outlined, counted, spiked, simulated, estimated, optimised)
}


def _difference(found, expected):
    return max(
        float((a - b).double().norm() / b.double().norm().clamp_min(1e-12))
        if a.shape == b.shape
        else float("inf")
        for a, b in zip(found, expected, strict=True)
    )


def run(threads: int, rounds: int, kinds: tuple[str, ...] = tuple(KINDS)) -> dict[str, float]:
    """Every thread does every kind of work ``rounds`` times, in an order of its own, while garbage
    is collected at random in another.

    Returns: by kind, the largest relative difference from the work done serially, and rounds of a
      thread per second, serially and threaded. Hangs or ends the process where threads are not
      safe: call it in a process with a time limit.
    Raises: what the first thread raised.
    """
    # else every thread gets a pool of torch's, and they wait for one another's cores
    torch.set_num_threads(1)
    serial = {(kind, seed): KINDS[kind](seed) for kind in kinds for seed in range(SEEDS)}
    serial_s = min(timeit.repeat(lambda: [KINDS[kind](0) for kind in kinds], number=1, repeat=3))
    worst = dict.fromkeys(kinds, 0.0)
    raised = []
    over = threading.Event()

    def work(number):
        order = random.Random(number)
        try:
            for _ in range(rounds):
                for kind in order.sample(kinds, len(kinds)):
                    seed = order.randrange(SEEDS)
                    away = _difference(KINDS[kind](seed), serial[kind, seed])
                    worst[kind] = max(worst[kind], away)
        except (CodesignError, RuntimeError, ValueError, TypeError, AssertionError) as error:
            raised.append(error)

    def collect():
        order = random.Random(0)
        while not over.wait(order.uniform(0, 0.02)):
            gc.collect(order.randrange(3))

    workers = [threading.Thread(target=work, args=(number,)) for number in range(threads)]
    collector = threading.Thread(target=collect)
    began = time.monotonic()
    for thread in (collector, *workers):
        thread.start()
    for thread in workers:
        thread.join()
    rate = threads * rounds / (time.monotonic() - began)
    over.set()
    collector.join()
    if raised:
        raise raised[0]
    return {**worst, "rounds_per_second_serial": 1 / serial_s, "rounds_per_second_threaded": rate}


def lock() -> dict[str, float]:
    """What the lock costs one thread: nanoseconds, and the time of a small kernel with it over that
    without it."""

    def least_s(work, number):
        return min(timeit.repeat(work, number=number, repeat=7)) / number

    def entered():
        with exclusive:
            pass

    held = least_s(lambda: counted(0), 20)
    enter, leave = Exclusive.__enter__, Exclusive.__exit__
    Exclusive.__enter__, Exclusive.__exit__ = (lambda self: self), (lambda self, *error: None)
    bare = least_s(lambda: counted(0), 20)
    Exclusive.__enter__, Exclusive.__exit__ = enter, leave
    return {
        "lock_ns": 1e9 * least_s(entered, 10_000),
        "small_kernel_with_over_without_lock": held / bare,
    }


def measure(
    count: int, seed: int, say=print, threads: int = 30
) -> tuple[dict[str, float], list[str]]:
    """``count`` rounds of all kinds in every thread, in a process that is ended where they do
    not."""
    limit_s = 120 + 3.0 * threads * count
    numbers = map(str, (threads, count, limit_s))
    command = [sys.executable, "-m", "tests.hostile.threads", *numbers]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = f"{threads} threads, {count} rounds"
    say(f"{told}: exit code {done.returncode}")
    if done.returncode:
        return {}, [f"{told}: ends with {done.returncode}: {done.stderr[-300:]}"]
    found = json.loads(done.stdout)
    wrong = [f"{name} differs by {found[name]}" for name in KINDS if found[name] > TOLERANCE]
    figures = {f"threads_{name}": value for name, value in found.items()}
    return {**figures, "threads": threads, "threads_rounds": count, **lock()}, wrong


if __name__ == "__main__":
    faulthandler.dump_traceback_later(float(sys.argv[3]), exit=True)
    chosen = tuple(sys.argv[4:]) or tuple(KINDS)
    print(json.dumps(run(int(sys.argv[1]), int(sys.argv[2]), chosen)))
