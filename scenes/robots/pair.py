"""A robot and the world it moves through: what the design of its camera is judged by.

A pair says where a camera may sit on a robot's body, which lens and mount it starts from, which
velocities of the body count, and makes worlds and drives by number. Numbers below ``UNSEEN_FROM``
are for training, those from there on for judging; they share neither photographs nor random
patterns, places or motions.

All pairs move in one hard regime: speeds from 0.05 to 3 m/s, evenly in their logarithm, unknown
roll, pitch and yaw rates, half of the contrast of photographs, a slow sensor with high thresholds.
There is no velocity at which flow is always within the estimator's reach, so that focal length,
focus, height and attitude all matter.

Body axes: x forward, y left, z up. The body is drawn in front of its camera
(``render.MovingScene``).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign import events, flow, lens, render
from codesign.errors import DomainError
from codesign.mount import (
    FREE,
    CableSide,
    Clearance,
    EgoVelocity,
    Housing,
    LookAhead,
    Motion,
    Mount,
    MountRanges,
    OwnBody,
    Requirement,
    VelocityErrors,
    velocity_errors,
    yaw_pitch_roll_rad,
)
from codesign.mount import Body as SolidBody
from codesign.mount.pose import NAMES
from codesign.pose import se3_exp
from codesign.system import Batch, System
from scenes import textures
from scenes.bodies import Body
from scenes.build import Paint, World, emissive

# nine windows of a DAVIS346: the whole field of view for a tenth of its pixels
SENSOR_PX = (346, 260)
PITCH_MM = 0.0185
WINDOW_PX = 32
LEFTS_PX, TOPS_PX = ((0, (size - WINDOW_PX) // 2, size - WINDOW_PX) for size in SENSOR_PX)
FILM = render.Film(
    *SENSOR_PX,
    WINDOW_PX,
    WINDOW_PX,
    PITCH_MM,
    tuple((left, top) for top in TOPS_PX for left in LEFTS_PX),
)
RAYS_PER_PX = 8
DURATION_S = 0.02
FRAMES = 9
# before the window, for the sensor to settle: its events are not read
LEAD_S = 2 * DURATION_S / (FRAMES - 2)
MIDDLE_S = LEAD_S + DURATION_S / 2
BINS = 5
SENSOR = events.SensorModel(
    theta_on=0.25, theta_off=0.25, theta_sigma=0.03, cutoff_hz=200.0, shot_rate_hz=5.0
)
PRIOR_PX = 4.0  # of the flow over the interval
SPEED_M_S = (0.05, 3.0)
RATE_RAD_S = 0.7  # standard deviation of roll, pitch and yaw rates
CONTRAST = 0.6  # exponent of radiance
LIGHT = (70.0, 180.0)  # mean radiance of surfaces
UNSEEN_FROM = 1_000_000
INSIDE = 1 - 1e-9  # of a box that a mount approaches by a hyperbolic tangent
# by whether unseen
PHOTOS = {False: ("gravel", "grass", "coffee"), True: ("brick", "astronaut", "chelsea")}


@dataclass(frozen=True)
class Design:
    """A lens and where it looks from: focal length, f-number, 1 / distance in focus; position, yaw
    to the left, pitch downwards and roll in body axes; bending of a family's lens."""

    efl_mm: float
    fno: float
    focus_per_m: float
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    bending: float = 0.0

    def mount(self) -> Tensor:
        """T_body_cam [4, 4]."""
        at = (self.x_m, self.y_m, self.z_m)
        attitude = {name: getattr(self, name) for name in ("yaw_rad", "pitch_rad", "roll_rad")}
        return Mount(at, (0.0, 0.0, 0.0), **attitude)().detach()

    def camera(self, family: str | None = None) -> render.Camera:
        """Nine windows behind a thin lens, or behind a traced one of a family (``lens.family``),
        whose image is darker and less sharp towards the corners; numbers of the lens may then be
        tensors, whose gradients its rays carry."""
        if family is None:
            image_mm = 1 / (1 / self.efl_mm - 1e-3 * self.focus_per_m)
            optics = lens.ThinLens(self.efl_mm, self.efl_mm / self.fno, image_mm)
        else:
            optics = lens.family(family).lens(self.efl_mm, self.fno, self.focus_per_m, self.bending)
        falloff = family is not None
        return render.Camera(
            optics, WINDOW_PX, WINDOW_PX, PITCH_MM, RAYS_PER_PX, 0, FILM, falloff=falloff
        )


@dataclass(frozen=True)
class Drives(Batch):
    """A batch that knows the truth. twist: [N, 6] of the body over the interval, m/s and rad/s in
    its own axes."""

    twist: Any = None


@dataclass(frozen=True)
class RobotPair:
    """A robot, its worlds and its drives.

    name: of the pair. bodies: link -> mesh in body axes. low, high: bounds of the design. design:
      where to start, inside them.
    axes: which of the six velocities count (``mount.PLANAR`` or ``mount.FREE``); all six are
      estimated.
    prior: standard deviations expected of the six, m/s and rad/s.
    depth: how depth is known, "ground" or "scene" (``mount.EgoVelocity``).
    look_ahead: distance in metres, and the share of the image that must see beyond it; None where
      nothing must.
    world: number -> what stands still. drive: (number, how many) -> T_world_body [M, T, 4, 4],
      twist [M, 6].
    housing_radius_m, margin_m: of the camera, and by how much it must stay clear of the body.
      own_body_share: of the image, that the body may cover. cable: direction in body axes and half
      angle in radians of a cone into which the camera's back must not point; None where it may
      point anywhere. ground_z_m: height of the ground in body axes.
    frame: name of the body's axes (REP 105). one_world: whether all numbers are the same world,
      with other drives. files: of which the pair was made, where a user gave them; page: what they
      wrote of it.
    family: of traced lenses (``lens.family``), which every design has its camera from; None is a
      thin lens.
    """

    name: str
    bodies: Mapping[str, Body]
    low: Design
    high: Design
    design: Design
    axes: tuple[int, ...]
    prior: tuple[float, ...]
    depth: str
    look_ahead: tuple[float, float] | None
    world: Callable[[int], render.MitsubaScene]
    drive: Callable[[int, int], tuple[Tensor, Tensor]]
    housing_radius_m: float = 0.02
    margin_m: float = 0.005
    own_body_share: float = 0.3
    cable: tuple[tuple[float, float, float], float] | None = None
    ground_z_m: float = 0.0
    frame: str = "base_footprint"
    one_world: bool = False
    files: tuple[Path, ...] = ()
    page: str = ""
    family: str | None = None

    def check(self, design: Design) -> Design:
        """The design. Raises: DomainError where a number of it lies outside the bounds."""
        for field in fields(Design):
            low, value, high = (getattr(each, field.name) for each in (self.low, design, self.high))
            if not low <= value <= high:
                raise DomainError(
                    f"pair '{self.name}': {field.name} = {value:g} lies outside its bounds, {low:g} to {high:g}."
                )
        return design

    def camera(self, design: Design) -> render.Camera:
        """That of a design, with a lens of the pair's family."""
        return design.camera(self.family)

    @property
    def ranges(self) -> MountRanges:
        """Bounds of the mount."""
        low, high = ([getattr(each, name) for name in NAMES] for each in (self.low, self.high))
        return MountRanges(low, high)

    def requirements(self) -> list[Requirement]:
        """What a mount of this robot has to keep, the cheap ones first."""
        body = SolidBody((mesh.vertices_m, mesh.faces) for mesh in self.bodies.values())
        found: list[Requirement] = []
        if self.cable is not None:
            found.append(CableSide(*self.cable))
        if self.look_ahead is not None:
            found.append(LookAhead(*self.look_ahead, ground_z_m=self.ground_z_m))
        found.append(Clearance(body, Housing(self.housing_radius_m), self.margin_m))
        return [*found, OwnBody(body, self.own_body_share)]

    def body(self) -> render.MitsubaScene:
        """The robot in its own axes, grey in the light of a plain sky that turns with it."""
        grey = Paint(np.full((1, 1), 90.0))
        return emissive(
            World({name: (mesh, grey) for name, mesh in self.bodies.items()}, two_sided=True)
        )

    def batch(self, numbers: Sequence[int], motions: int, seed: int = 0) -> Drives:
        """Worlds of these numbers with as many drives each, the body in them; the same for every
        design.

        seed: of film samples and sensor noise.
        """
        body = self.body()
        drives = [self.drive(number, motions) for number in numbers]
        scenes = tuple(
            render.MovingScene(self.world(number), {"body": (body, poses)})
            for number, (poses, _) in zip(numbers, drives, strict=True)
        )
        poses, twists = (torch.stack(part) for part in zip(*drives, strict=True))
        return Drives(poses, times(), scenes, seed, twist=twists.flatten(0, 1))

    def system(self, design: Design, layer: str = "memory") -> System:
        """Camera, mount, sensor, flow and estimate of a design; objective "error" is the mean
        bounded one.

        layer: "memory" (hard counts, straight-through gradient), "counts" (smooth, without noise)
          or "sensor" (single events, no gradient: the judge).
        """
        mount = self.check(design).mount()

        def error(estimate, batch):
            return self.errors(estimate, batch).bounded().mean()

        return System(
            camera=self.camera(design),
            mount=lambda: mount,
            events=LAYERS[layer],
            flow=closed_form,
            estimate=EgoVelocity(FREE, self.prior, self.depth),
            objectives={"error": error},
            bins=BINS,
        )

    def errors(self, estimate: Motion, batch: Drives) -> VelocityErrors:
        """Errors of the velocities that count."""
        return velocity_errors(estimate.velocity[:, list(self.axes)], batch.twist, self.axes)

    def judged(self, design: Design, batch: Drives, layer: str = "memory") -> VelocityErrors:
        """Errors of a design over a batch, without gradient."""
        with torch.no_grad():
            return self.errors(self.system(design, layer).begin(batch)["estimate"], batch)


LAYERS = {
    "memory": events.Settled(events.layer("memory", SENSOR, learn=()), LEAD_S),
    "counts": events.Settled(
        events.layer("counts", replace(SENSOR, theta_sigma=0.0, shot_rate_hz=0.0), learn=()), LEAD_S
    ),
    "sensor": events.HardSensor(SENSOR, BINS, LEAD_S),
}


def mount_at(ranges: MountRanges, T_body_cam: Tensor) -> Mount:
    """The learnable mount in the middle of a box that stands at a pose [4, 4]; a wall is approached
    to a billionth."""
    low, high = ranges.low[:3], ranges.high[:3]
    half, middle = (high - low) / 2, (low + high) / 2
    inside = torch.where(
        half > 0, (T_body_cam[:3, 3] - middle).clamp(-INSIDE * half, INSIDE * half), 0.0
    )
    yaw, pitch, roll = yaw_pitch_roll_rad(T_body_cam).tolist()
    return Mount(
        middle, half, yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll, position_m=middle + inside
    )


def closed_form(volume):
    """Affine flow of each window, with its covariance."""
    return flow.estimate_lk(volume, model="affine", prior_px=PRIOR_PX)


def training(count: int) -> range:
    """Numbers of the first training variants."""
    return range(_counted(count))


def unseen(count: int) -> range:
    """Numbers of the first unseen variants."""
    return range(UNSEEN_FROM, UNSEEN_FROM + _counted(count))


def _counted(count):
    if not 1 <= count <= UNSEEN_FROM:
        raise DomainError(f"{count} variants are asked for; give 1 to {UNSEEN_FROM}.")
    return count


def times() -> Tensor:
    """[T] seconds of the frames: one before the window, in which the sensor settles, and those of
    the window."""
    window = LEAD_S + torch.linspace(0, DURATION_S, FRAMES - 1, dtype=torch.float64)
    return torch.cat([torch.zeros(1, dtype=torch.float64), window])


def moved(T_world_body: Tensor, twist: Tensor) -> Tensor:
    """Poses [M, T, 4, 4] of bodies that are at [M, 4, 4] in the middle of the window and go with
    twists [M, 6]."""
    return T_world_body[:, None] @ se3_exp((times() - MIDDLE_S)[:, None] * twist[:, None])


def slowed(pair: RobotPair, share: float) -> RobotPair:
    """The same drives through the same places at a share of their speed.

    >>> from scenes.robots.pairs import PAIRS
    >>> pair = PAIRS["outdoors"]()
    >>> (poses, twist), (slow, third) = (each.drive(0, 2) for each in (pair, slowed(pair, 0.3)))
    >>> bool(torch.allclose(third, 0.3 * twist))
    True
    >>> way, less = ((each[:, -1, :3, 3] - each[:, 0, :3, 3]).norm(dim=1) for each in (poses, slow))
    >>> [round(share, 3) for share in (less / way).tolist()]
    [0.3, 0.3]
    """

    def drive(number: int, motions: int) -> tuple[Tensor, Tensor]:
        poses, twist = pair.drive(number, motions)
        return moved(poses[:, 0] @ se3_exp(MIDDLE_S * twist), share * twist), share * twist

    return replace(pair, drive=drive)


def speeds_and_deviates(number: int, motions: int, columns: int) -> tuple[Tensor, Tensor]:
    """Speeds [M] m/s, even in the logarithm over SPEED_M_S, and standard normal numbers
    [M, columns]; each of them spread evenly over its distribution, in an order of its own
    (a Latin hypercube)."""
    random = np.random.default_rng([number, 1])
    order = random.permuted(np.tile(np.arange(motions), (columns + 1, 1)), axis=1)
    share = torch.from_numpy((order + random.random(order.shape)) / motions).T
    slowest, fastest = (math.log(speed) for speed in SPEED_M_S)
    deviates = math.sqrt(2) * torch.erfinv((2 * share[:, 1:] - 1).clamp(-0.9999, 0.9999))
    return (slowest + (fastest - slowest) * share[:, 0]).exp(), deviates


def rolling(speed: Tensor, deviates: Tensor, slip: float, heave_m_s: float) -> Tensor:
    """Twists [M, 6] of bodies that roll at speeds [M]: they slip sideways by a share of it, heave
    and turn, all by standard normal numbers [M, 5]."""
    slide = [slip * speed * deviates[:, 0], heave_m_s * deviates[:, 1]]
    return torch.stack([speed, *slide, *(RATE_RAD_S * deviates[:, 2:]).unbind(1)], 1)


def picture(random: np.random.Generator, unseen: bool, level: float) -> np.ndarray:
    """A photograph or a random pattern of many scales as radiance [H, W] of a mean level, at
    CONTRAST."""
    if random.random() < 0.5:
        found = textures.photo(str(random.choice(PHOTOS[unseen])))
    else:
        found = textures.speckle(int(random.integers(2**31)), finest_px=3.0, coarsest_px=128.0)
    found = found**CONTRAST
    return (found * (level / found.mean())).astype(np.float32)


def variant(number: int) -> tuple[np.random.Generator, float, Callable[[float, float], Paint]]:
    """What every world of a number begins with: its random numbers, the mean radiance of its
    surfaces, even in the logarithm over LIGHT, and what paints a surface of a width and height in
    metres, in texels of 1.5 to 3 mm."""
    random = np.random.default_rng([number, 2])
    level = float(np.exp(random.uniform(*np.log(LIGHT))))

    def paint(width_m: float, height_m: float) -> Paint:
        found = picture(random, number >= UNSEEN_FROM, level)
        texel_m = random.uniform(0.0015, 0.003)
        return Paint(
            found, (width_m / (texel_m * found.shape[1]), height_m / (texel_m * found.shape[0]))
        )

    return random, level, paint


def standing(at: Tensor) -> Tensor:
    """Upright poses [M, 4, 4] from places and headings [M, 3] on the ground, m and rad."""
    turn = torch.zeros(len(at), 6, dtype=torch.float64)
    turn[:, 5] = at[:, 2]
    pose = se3_exp(turn)
    pose[:, :2, 3] = at[:, :2]
    return pose
