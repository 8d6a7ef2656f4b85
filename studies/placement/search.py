"""Ways to look for a good mount: gradient steps that go back to the best so far, random search, and a grid
over pitch and yaw."""

import math
from dataclasses import dataclass

import torch

from codesign.errors import NonFiniteError
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
    """Gradient steps of set length with momentum from ``mount``; after PATIENCE steps without a new best,
    back to the best with half the length.

    Steps follow the gradient of the error to be expected (task.expected); what counts as best is the task
    error with hard events.
    Returns: Path of all mounts tried, steps + 1 long. Raises: NonFiniteError when a gradient is not finite.
    """
    now = mount.numbers.detach().clone()
    best = now
    best_error = math.inf
    best_way = torch.zeros_like(now)
    momentum = torch.zeros_like(now)
    length = FIRST_STEP
    since = 0
    poses = []
    errors = []
    for _ in range(steps + 1):
        error, way = downhill(task, mount, now)
        poses.append(mount(now).detach())
        errors.append(error)
        if error < best_error:
            best = now
            best_error = error
            best_way = way
            since = 0
        else:
            since += 1
        if since > PATIENCE:
            now, way, momentum, length, since = best, best_way, torch.zeros_like(now), SHRINK * length, 0
        momentum = MOMENTUM * momentum + way
        now = now + length * torch.nn.functional.normalize(momentum, dim=0) * UNIT
        advance(error)
    return Path(
        torch.stack(poses),
        torch.tensor(errors, dtype=torch.float64),
        RENDERS_PER_STEP * (torch.arange(steps + 1) + 1),
    )


def downhill(task, mount, numbers):
    """Task error with hard events, and the direction [6] of steepest descent of the expected error, per UNIT
    (length about 1, or 0 where no sample feels the mount).

    Single samples' gradients are heavy-tailed, so each is cut to the median length before they are averaged.
    """
    copies = numbers.expand(task.samples, 6).clone().requires_grad_()
    poses = mount(copies)
    frames = task.frames(poses)
    expected = task.expected(poses, frames=frames)
    (grads,) = torch.autograd.grad(expected.square().mean().sqrt(), copies)
    if not bool(grads.isfinite().all()):
        raise NonFiniteError(
            "the gradient of the expected error became infinite or NaN at junction 'mount'; finished "
            "searches are kept."
        )
    grads = grads * UNIT
    lengths = grads.norm(dim=1)
    limit = lengths[lengths > 0].median() if bool((lengths > 0).any()) else 1.0
    cut = grads * (limit / lengths.clamp(min=1e-300)).clamp(max=1)[:, None]
    with torch.no_grad():
        error = float(task.errors(mount(numbers), frames=frames.detach()).task)
    way = -torch.nn.functional.normalize(cut.sum(0), dim=0)
    return (
        error,
        (16 * way).round() / 16,
    )  # the backward pass sums in any order (1e-5): without rounding no run would repeat another's path


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
