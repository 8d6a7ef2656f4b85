"""What a search for a mount looks at: a pair of robot and world, a pool of its training worlds and
drives, and the requirements of the mount. A mount is six shares of the pair's ranges."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from codesign import lens, mount, render
from codesign.errors import DomainError
from codesign.mount import (
    Body,
    OwnBody,
    PrecisionTrend,
    Readings,
    Requirement,
    VelocityErrors,
    expected_errors,
    velocity_errors,
)
from codesign.system import System
from scenes.robots import pair as robot_pair
from scenes.robots.pair import Drives, RobotPair, times

DRIVES = 48  # of every world that draws are made from


def check_drives(**told: int) -> None:
    """Raise DomainError for an option that asks for more drives of a world than there are."""
    for name, count in told.items():
        if count > DRIVES:
            raise DomainError(
                f"--{name.replace('_', '-')} is {count}; a world has {DRIVES} drives."
            )


@dataclass(frozen=True)
class Samples:
    """Drives in ``numbers`` of worlds, the same ``which`` of each, and the seed of film samples and
    sensor noise."""

    numbers: tuple[int, ...]
    which: tuple[int, ...]
    seed: int


@dataclass(frozen=True)
class Seen:
    """What is seen of N drives from one mount.

    read: by the depth that the estimator believes in. surfaces: the same with true depths.
      true_rows: [N, P, 2, 6].
    flow_px: [N, P, 2], true. covered: [N, windows] by the robot.
    """

    read: Readings
    surfaces: Readings
    true_rows: Tensor
    flow_px: Tensor
    covered: Tensor


@dataclass
class Problem:
    """pair: robot and worlds. numbers: of the worlds that draws are made from. per_world: drives in
    each of ``spread`` worlds of a draw. camera: in place of the pair's own; another may be put in its
    place to render drives, while requirements are asked of the first (``real``)."""

    pair: RobotPair
    numbers: Sequence[int]
    spread: int = 12
    per_world: int = 2
    camera: render.Camera | None = None

    def __post_init__(self):
        self._worlds: dict[int, tuple] = {}
        self.ranges = self.pair.ranges
        self.trend = PrecisionTrend()
        self.rendered = 0  # samples so far
        if self.camera is None:
            self.camera = self.pair.camera(self.pair.design)
        self.real = self.camera

    @property
    def samples(self) -> int:
        return self.spread * self.per_world

    @property
    def start(self) -> Tensor:
        """Shares [6] of the pair's own design."""
        return self.ranges.share_at(self.pair.design.mount())

    @cached_property
    def requirements(self) -> list[Requirement]:
        return self.pair.requirements()

    def draw(self, number: int) -> Samples:
        """Samples of that number: other worlds and drives for each, until all have been seen."""

        def shuffled(count, seed):
            return torch.randperm(count, generator=torch.Generator().manual_seed(seed)).tolist()

        turns, part = divmod(number, max(1, len(self.numbers) // self.spread))
        chosen = shuffled(len(self.numbers), turns)[part * self.spread : (part + 1) * self.spread]
        which = tuple(shuffled(DRIVES, number)[: self.per_world])
        return Samples(tuple(self.numbers[k] for k in chosen), which, number)

    def batch(self, samples: Samples) -> Drives:
        """Worlds and drives of samples, the robot in them, which count as rendered."""
        self.rendered += self.samples
        return self.scenes(samples)

    def scenes(self, samples: Samples) -> Drives:
        """Worlds and drives of samples; worlds are built once."""
        scenes, poses, twists = [], [], []
        which = list(samples.which)
        for number in samples.numbers:
            if number not in self._worlds:
                self._worlds[number] = (self.pair.world(number), *self.pair.drive(number, DRIVES))
            world, *drives = self._worlds[number]
            driven, twist = (part[which] for part in drives)
            scenes.append(render.MovingScene(world, {"body": (self._body, driven)}))
            poses.append(driven)
            twists.append(twist)
        twist = torch.cat(twists)
        return Drives(torch.stack(poses), times(), tuple(scenes), samples.seed, twist=twist)

    @cached_property
    def own_body(self) -> OwnBody:
        body = Body((mesh.vertices_m, mesh.faces) for mesh in self.pair.bodies.values())
        return OwnBody(body, 1.0)

    @cached_property
    def _body(self):
        return self.pair.body()

    @cached_property
    def _system(self):
        return self.pair.system(self.pair.design)

    def system(self, T_body_cam: Tensor, layer: str = "memory") -> System:
        """The chain behind a mount [4, 4]."""
        return self._system.replaced(
            camera=self.camera, mount=lambda: T_body_cam, events=robot_pair.LAYERS[layer]
        )

    @torch.no_grad()
    def judged(self, T_body_cam: Tensor, samples: Samples, layer: str = "memory") -> VelocityErrors:
        """Errors of a mount [4, 4], hard counts or single events ("sensor")."""
        batch = self.batch(samples)
        return self.pair.errors(self.system(T_body_cam, layer).begin(batch)["estimate"], batch)

    def bounded(self, share: Tensor, samples: Samples) -> float:
        """The mean bounded error of a mount [6] with hard counts."""
        return float(self.judged(self.ranges.pose(share), samples).bounded().mean())

    def error(self, share: Tensor, samples: Samples) -> float:
        """What searches without gradients minimise: the same and the penalty of what is
        required."""
        return self.bounded(share, samples) + self.penalty_of(share)

    @torch.no_grad()
    def penalty_of(self, share: Tensor) -> float:
        return float(self.penalty(self.ranges.pose(share)))

    def penalty(self, T_body_cam: Tensor) -> Tensor:
        """0 where every requirement is kept with a step to spare. Gradient: mount."""
        return mount.penalty(self.requirements, T_body_cam, self.real)

    @torch.no_grad()
    def expected_around(
        self, share: Tensor, samples: Samples, step: float, learn: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Mean bounded error to be expected of a mount [6], and its differences [6] over a step to
        both sides.

        Pictures are taken of the mount itself alone. From the others there is the geometry, with
        its edges:
        surfaces, their true flow, what the robot covers; how well flow is told there is carried
        over by the trend (``mount.PrecisionTrend.carried``). At a wall of the cube the step ends
        there. learn: take these samples into the trend of the flow's precision. What is expected is
        by errors of flow, not by single frames, whose texture would make its slope noise.
        """
        batch = self.batch(samples)
        pose = self.ranges.pose(share)
        field = self.system(pose).begin(batch)["field"]
        here = self._seen(field, batch, pose)
        if learn:
            self.trend.add(here.surfaces, here.flow_px, here.covered)
        value = self._bounded(here.read, here, batch.twist).mean()
        low, high = ((share + sign * step * torch.eye(6).to(share)).clamp(0, 1) for sign in (-1, 1))
        errors = self._carried(field, here, samples, self.ranges.pose(torch.cat([low, high])))
        width = (high - low).diagonal()
        rise = errors[6:] - errors[:6]
        return value, torch.where(self.ranges.held, 0.0, rise / width)

    def _carried(self, field, here, samples, poses):
        """Mean bounded errors [M] to be expected of mounts [M, 4, 4], what was told from one of
        them carried over."""
        worlds, each = len(samples.numbers), len(samples.which)
        batch = self.scenes(replace(samples, which=samples.which * len(poses)))
        drives = torch.arange(worlds * each).reshape(worlds, 1, each)
        which = drives.expand(-1, len(poses), -1).flatten()
        fields = of_bodies(field, which, worlds * each)
        there = self._seen(fields, batch, poses.repeat_interleave(each, 0))
        told, told_there = (
            self.trend.told(seen.surfaces, seen.flow_px, seen.covered) for seen in (here, there)
        )
        read = of_bodies(here.read, which, worlds * each)
        read = self.trend.carried(read, told[which], there.read, told_there)
        errors = self._bounded(read, there, batch.twist)
        return errors.reshape(worlds, len(poses), each).mean((0, 2))

    def _seen(self, field, batch, T_body_cam):
        """What flow in the windows of a batch is of, from a mount [4, 4], or from one for each
        drive of a world."""
        T_world_cam = batch.T_world_body @ T_body_cam[..., None, :, :]
        estimator = self._system.estimate
        given = (field, self.camera, batch.scene, T_body_cam, T_world_cam, batch.t_s)
        read, true = estimator.read_beside_truth(*given)
        flow_px = (true.rows @ batch.twist[:, None, :, None])[..., 0]
        covered = self.own_body.covered(T_body_cam, self.camera)
        covered = covered.expand(*T_world_cam.shape[:2], -1).flatten(0, 1)
        return Seen(read, replace(read, depth_m=true.depth_m), true.rows, flow_px, covered)

    def _bounded(self, read, seen, twist):
        """Bounded error [N] to be expected of readings."""
        expected = expected_errors(self._system.estimate, read, twist, seen.true_rows)
        squared = expected.squared[:, list(self.pair.axes)]
        unit = velocity_errors(torch.zeros_like(squared), twist, self.pair.axes).unit
        squared = (squared / unit**2).mean(1)
        return squared / (1 + squared)


def of_bodies(parts, which, count):
    """A dataclass of tensors over ``count`` bodies, or their windows, of the bodies ``which``
    alone."""
    found = {}
    for each in fields(parts):
        value = getattr(parts, each.name)
        if torch.is_tensor(value):
            found[each.name] = value.unflatten(0, (count, -1))[which].flatten(0, 1)
    return replace(parts, **found)


def traced_camera(pair: RobotPair, name: str, focal_mm: float | None = None) -> render.Camera:
    """The pair's windows behind a traced lens.

    Args:
      name: in the catalogue, or a lens file.
      focal_mm: to which the lens is scaled; None: that of the pair's design. The lens is focused
        where the
    pair's is. Raises: as ``lens.load``; DomainError for a focal length that is not positive, or a
      film that is larger than the image circle.
    """
    design = pair.design
    wanted = design.efl_mm if focal_mm is None else focal_mm
    if not 0 < wanted < math.inf:
        raise DomainError(f"--focal-mm is {wanted:g}; millimetres > 0 are needed.")
    geo = lens.load(name).requires_grad_(False)
    geo = geo.scaled(wanted / float(geo.first_order().efl_mm.detach()))
    focused = geo.focus_at(1 / design.focus_per_m if design.focus_per_m else math.inf).freeze()
    return design.camera().with_lens(focused).check()
