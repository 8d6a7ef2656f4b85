"""Ways to look for a good mount: gradient steps that go back to the best so far, random search, and a grid
over pitch and yaw."""

import math
from dataclasses import dataclass

import torch

from codesign.optimise import Descent, Loop, SampleGradients
from codesign.place import Mount
from studies.placement.task import HALF_RANGE_M, NOMINAL_M

FIRST_STEP = 0.25
SHRINK = 0.6
MOMENTUM = 0.6
PATIENCE = 2
UNIT = torch.tensor(
    [3.0, 3.0, 3.0, 1.0, 1.0, 1.0], dtype=torch.float64
)  # a step of length 1 in each of the mount's numbers: rotations in radians
RENDERS_PER_STEP = 2  # the backward pass of a gradient step renders once more


@dataclass(frozen=True)
class Path:
    """Mounts that a search tried: T_body_cam [N, 4, 4], error [N], renders [N] spent up to and with each."""

    T_body_cam: torch.Tensor
    error: torch.Tensor
    renders: torch.Tensor

    @property
    def best(self):
        """Index of the smallest error."""
        return int(self.error.argmin())


def draw_mount(generator):
    """A mount anywhere in the box that looks anywhere from 10 to 90 degrees below the horizon, with any
    roll."""
    u = torch.rand(6, generator=generator, dtype=torch.float64).tolist()
    position = [n + h * 0.95 * (2 * v - 1) for n, h, v in zip(NOMINAL_M, HALF_RANGE_M, u[:3], strict=True)]
    yaw = math.pi * (2 * u[3] - 1)
    roll = math.pi * (2 * u[5] - 1)
    return Mount(
        NOMINAL_M,
        HALF_RANGE_M,
        position_m=position,
        yaw_rad=yaw,
        pitch_rad=math.radians(10 + 80 * u[4]),
        roll_rad=roll,
    )


def descend(task, mount, steps, advance=lambda error: None):
    """Steps of set length from ``mount`` along the averaged gradient; after PATIENCE steps without a new best, back
    to the best with shorter ones.

    Steps follow the gradient of the error to be expected (task.expected); what counts as best is the task error
      with hard events. Single samples' gradients are heavy-tailed, so each is cut to the median length.
    Returns: Path of all mounts tried, steps + 1 long. Raises: NonFiniteError when a gradient is not finite.
    """
    here = Here(task, mount)
    optimiser = Descent([here.steps], FIRST_STEP, MOMENTUM, pull=0.0, normalised=True)
    loop = Loop(
        optimiser, here.downhill, clip=None, judge=here.judge, judge_every=1, patience=PATIENCE, shrink=SHRINK
    )
    loop.run(steps, save=lambda: advance(loop.record.score[-1]))
    errors = torch.tensor(loop.record.score, dtype=torch.float64)
    return Path(torch.stack(here.tried), errors, RENDERS_PER_STEP * (torch.arange(steps + 1) + 1))


class Here:
    """A mount at natural steps from its start: error, and gradient of the expected error, out of one render.

    steps: [6] parameter; the mount's numbers are those of the start + UNIT * steps. tried: mounts judged so far.
    """

    def __init__(self, task, mount):
        self.task = task
        self.mount = mount
        self.start = mount.numbers.detach().clone()
        self.steps = torch.nn.Parameter(torch.zeros(6, dtype=torch.float64))
        self.tried = []
        self._rendered = None

    def _render(self):
        """Copies of the steps, one per sample, and the frames behind them; remembered until the steps change."""
        now = self.steps.detach().clone()
        if self._rendered is None or not torch.equal(self._rendered[0], now):
            copies = now.expand(self.task.samples, 6).clone().requires_grad_()
            with torch.enable_grad():
                mounts = self.mount(self.start + UNIT * copies)
                frames = self.task.begin(mounts)["frames"]
            self._rendered = now, copies, mounts, frames
        return self._rendered

    def judge(self):
        """Task error with hard events."""
        _, _, mounts, frames = self._render()
        self.tried.append(mounts[0].detach())
        return self.task.errors(mounts.detach(), frames=frames.detach()).task

    def downhill(self, step):
        """Gradient of every sample's share in the expected error."""
        _, copies, mounts, frames = self._render()
        with torch.enable_grad():
            expected = self.task.expected(mounts, frames=frames)
            loss = expected.square().mean().sqrt()
        (gradients,) = torch.autograd.grad(loss, copies)
        self._rendered = None
        return SampleGradients(expected.detach(), gradients)


def random_search(task, mount, count, generator, advance=lambda error: None):
    """``mount`` and ``count - 1`` drawn ones. Returns: Path."""
    with torch.no_grad():
        poses = torch.stack([mount()] + [draw_mount(generator)() for _ in range(count - 1)])
        errors = []
        for pose in poses:
            errors.append(float(task.errors(pose).task))
            advance(errors[-1])
    return Path(poses, torch.tensor(errors, dtype=torch.float64), torch.arange(count) + 1)


def grid_mounts(pitches, yaws):
    """Mounts [pitches * yaws, 4, 4] in the middle of the box without roll, at the centres of equal cells over
    0 to 90 and -180 to 180 degrees."""
    pitch = (torch.arange(pitches, dtype=torch.float64) + 0.5) * (math.pi / 2 / pitches)
    yaw = (torch.arange(yaws, dtype=torch.float64) + 0.5) * (2 * math.pi / yaws) - math.pi
    with torch.no_grad():
        return torch.stack(
            [
                Mount(NOMINAL_M, HALF_RANGE_M, yaw_rad=float(y), pitch_rad=float(p))()
                for p in pitch
                for y in yaw
            ]
        )
