"""Many threads at once, each with gradients through every kind of kernel, against the same work done serially."""

import faulthandler
import gc
import random
import sys
import threading
from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor

from codesign import System, events, flow, lens, pose, render
from codesign.errors import CodesignError
from codesign.system import Batch
from codesign.types import EventVolume
from scenes import silhouettes, textures, trajectories, worlds

D = torch.float64
START = pose.look_at((0, -2, 0), (0, 0, 0))
T_S = torch.linspace(0, 0.05, 5, dtype=D)
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
def _cubes():
    return silhouettes.build("cubes")


def _wall():
    return worlds.wall(textures.speckle(0, 64), texel_m=0.01)


def _camera(seed):
    return render.Camera(_lens(), 16, 16, 0.074, 4).with_seed(seed)


def _path(seed, start=START):
    return trajectories.translation(start, (0.2 * _drawn(seed, 3)).tolist(), T_S)


def traced(seed: int) -> list[Tensor]:
    bent = (_lens().curvature_per_mm.detach() * (1 + 0.001 * seed)).requires_grad_()
    camera = _camera(seed)
    return _gradients(camera.with_lens(_lens().replace(curvature_per_mm=bent)).rays().direction, bent)


def rendered(seed: int) -> list[Tensor]:
    """Of a scene that is built and freed in the thread itself."""
    twist = torch.zeros(6, dtype=D, requires_grad=True)
    return _gradients(render.frames(_camera(seed), _wall(), _path(seed) @ pose.se3_exp(twist)), twist)


def outlined(seed: int) -> list[Tensor]:
    """Of a scene that all threads share."""
    twist = torch.zeros(6, dtype=D, requires_grad=True)
    poses = _path(seed, pose.look_at((0, -1.2, 1), (0, 1, 0.8))) @ pose.se3_exp(twist)
    return _gradients(render.frames(_camera(seed), _cubes(), poses, gradient="boundary"), twist)


def counted(seed: int) -> list[Tensor]:
    frames = (100 + 30 * _drawn(seed, 6, 24, 24)).clamp_min(1).requires_grad_()
    theta = torch.tensor(0.15, dtype=D, requires_grad=True)
    return _gradients(events.memory(frames, theta, 0.2)[0], frames, theta)


def spiked(seed: int) -> list[Tensor]:
    drive = _drawn(seed, 40, 2, 8, 8).requires_grad_()
    theta = torch.tensor(1.0, dtype=D, requires_grad=True)
    found = events.srm(drive, theta=theta, tau_r=4.0, tau_s=3.0, response="alpha", through_reset="bounded")
    return _gradients(found[0], drive, theta)


def simulated(seed: int) -> list[Tensor]:
    frames = (100 + 30 * _drawn(seed, 6, 24, 24)).clamp_min(1)
    stream = events.simulate(frames, torch.linspace(0, 0.1, 6, dtype=D), events.SensorModel(theta_on=0.2))
    return [stream.t_us, stream.x, stream.p]


def estimated(seed: int) -> list[Tensor]:
    counts = _drawn(seed, 2, 2, 5, 16 + 8 * (seed % 2), 24).abs().requires_grad_()
    volume = EventVolume(counts, T_S, torch.full((5,), 0.0125, dtype=D))
    found = flow.estimate_lk(volume, levels_px=(2.0, 1.0), model=("affine", "local")[seed % 2])
    return _gradients(found.flow_px, counts)


def optimised(seed: int) -> list[Tensor]:
    """The whole chain, to the lens, the mount's place and a threshold."""
    bent = _lens().curvature_per_mm.detach().clone().requires_grad_()
    twist = torch.zeros(6, dtype=D, requires_grad=True)
    system = System(
        camera=_camera(seed).with_lens(_lens().replace(curvature_per_mm=bent)),
        events=events.layer("memory"),
        flow=flow.estimate_lk,
        objectives={"flow": lambda field: field.flow_px.square().mean()},
        scene=_wall(),
    )
    result = system(Batch(_path(seed)[None] @ pose.se3_exp(twist), T_S, seed=seed))
    return _gradients(result.objectives["flow"], bent, twist)


KINDS: dict[str, Callable[[int], list[Tensor]]] = {
    f.__name__: f for f in (traced, rendered, outlined, counted, spiked, simulated, estimated, optimised)
}


def _difference(found, expected):
    return max(
        float((a - b).double().norm() / b.double().norm().clamp_min(1e-12))
        if a.shape == b.shape
        else float("inf")
        for a, b in zip(found, expected, strict=True)
    )


def run(threads: int, rounds: int, kinds: tuple[str, ...] = tuple(KINDS)) -> dict[str, float]:
    """Every thread does every kind of work ``rounds`` times, in an order of its own, while garbage is collected at
    random in another.

    Returns: by kind, the largest relative difference from the work done serially. Hangs or ends the process where
      threads are not safe: call it in a process with a time limit.
    Raises: what the first thread raised.
    """
    serial = {(kind, seed): KINDS[kind](seed) for kind in kinds for seed in range(SEEDS)}
    worst = dict.fromkeys(kinds, 0.0)
    raised = []
    over = threading.Event()

    def work(number):
        order = random.Random(number)
        try:
            for _ in range(rounds):
                for kind in order.sample(kinds, len(kinds)):
                    seed = order.randrange(SEEDS)
                    worst[kind] = max(worst[kind], _difference(KINDS[kind](seed), serial[kind, seed]))
        except (CodesignError, RuntimeError, ValueError, TypeError, AssertionError) as error:
            raised.append(error)

    def collect():
        order = random.Random(0)
        while not over.wait(order.uniform(0, 0.02)):
            gc.collect(order.randrange(3))

    workers = [threading.Thread(target=work, args=(number,)) for number in range(threads)]
    collector = threading.Thread(target=collect)
    for thread in (collector, *workers):
        thread.start()
    for thread in workers:
        thread.join()
    over.set()
    collector.join()
    if raised:
        raise raised[0]
    return worst


if __name__ == "__main__":
    faulthandler.dump_traceback_later(float(sys.argv[3]), exit=True)
    print(run(int(sys.argv[1]), int(sys.argv[2]), *([tuple(sys.argv[4:])] if sys.argv[4:] else [])))
