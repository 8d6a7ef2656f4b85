"""A rover outdoors: rough ground with crates, balls and posts under a sky. It reads its velocity in
the plane off ground it knows to be flat, from ahead of its bumper, and must also see what lies
before it."""

import math

import numpy as np
import torch

from codesign import backend
from codesign.errors import DomainError
from codesign.mount import PLANAR
from codesign.render import MitsubaScene
from scenes import textures
from scenes.bodies import box, cylinder
from scenes.build import GAP_M, Paint, World, ball, block, emissive, pole, rectangle, sky
from scenes.robots import pair as robot_pair
from scenes.robots.pair import Design, RobotPair, speeds_and_deviates

HALF_M = 12.0  # of the ground
THINGS = 28
REACH_M = 5.0  # from the middle, where things stand and the rover drives
CLEAR_M = 0.75  # around the rover's middle
WHEEL_M = 0.11
LIFT_M = 0.008  # of the wheels: what roll and pitch take away over half a window
SLIP = 0.15  # sideways over forward speed
HEAVE_M_S = 0.03
BODIES = {
    "chassis": box((0.5, 0.3, 0.13), (0.0, 0.0, 0.2)),
    "bumper": box((0.03, 0.34, 0.06), (0.27, 0.0, 0.17)),
    "deck": box((0.22, 0.22, 0.1), (-0.1, 0.0, 0.316)),
    "mast": cylinder(0.02, 0.5, (-0.18, 0.0, 0.617)),
} | {
    f"wheel {x:+g} {y:+g}": cylinder(WHEEL_M, 0.07, (0.17 * x, 0.19 * y, WHEEL_M + LIFT_M), "y")
    for x in (-1, 1)
    for y in (-1, 1)
}
LOW = Design(2.5, 1.2, 0.0, 0.33, -0.15, 0.1, -0.6, 0.0, -0.4)
HIGH = Design(12.0, 1.2, 8.0, 0.5, 0.15, 0.7, 0.6, math.radians(80), 0.4)
START = Design(6.5, 1.2, 0.55, 0.4, 0.0, 0.22, 0.0, math.radians(19), 0.0)


def outdoors() -> RobotPair:
    """The pair. The estimator knows the height and attitude of the rover over flat ground; what
    stands on it, and the sky, it takes for what they are not.

    >>> pair = outdoors()
    >>> pair.check(pair.design).mount()[:3, 3].tolist()
    [0.4, 0.0, 0.22]
    """
    prior = (1.5, 0.2, 0.05, 0.8, 0.8, 0.8)
    return RobotPair(
        "outdoors", BODIES, LOW, HIGH, START, PLANAR, prior, "ground", (3.0, 0.1), world, drive
    )


def world(number: int) -> MitsubaScene:
    """Ground, things on it, and a sky as bright as they are."""
    mi = backend.mitsuba("cpu")
    random, level, paint = robot_pair.variant(number)
    ground = paint(2 * HALF_M, 2 * HALF_M)
    shapes: dict = {
        "ground": (rectangle(mi, (0, 0, 0), (0, 0, 1), 2 * HALF_M, 2 * HALF_M, (0, 1, 0)), ground)
    }
    for k, (x, y, size) in enumerate(places(number)):
        covered = paint(2 * size, 2 * size)
        if k % 3 == 0:
            half = (size, size * random.uniform(0.5, 1), size * random.uniform(0.6, 1.6))
            shapes[f"crate-{k}"] = (block(mi, x, y, 0.0, half, random.uniform(0, 90)), covered)
        elif k % 3 == 1:
            shapes[f"ball-{k}"] = (ball(mi, x, y, 0.0, size), covered)
        else:
            tube, cap = pole(mi, (x, y, GAP_M), (x, y, random.uniform(0.8, 2.5)), 0.2 * size)
            shapes[f"post-{k}"] = (tube, covered)
            shapes[f"cap-{k}"] = (cap, Paint(np.full((4, 4), level)))
    above = textures.sky(number, sun_azimuth_deg=random.uniform(0, 360))
    return emissive(World(shapes, {"sky": sky(mi, above * (level / above.mean()))}))


def places(number: int) -> list[tuple[float, float, float]]:
    """Where things stand, x and y, and their half size, metres; none touches another."""
    random = np.random.default_rng([number, 3])
    found: list[tuple[float, float, float]] = []
    while len(found) < THINGS:
        x, y = random.uniform(-REACH_M, REACH_M, 2)
        size = random.uniform(0.08, 0.3)
        if all(math.hypot(x - u, y - v) > 1.5 * (size + other) for u, v, other in found):
            found.append((x, y, size))
    return found


def drive(number: int, motions: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Drives over the ground, clear of all things: T_world_body [M, T, 4, 4], twist [M, 6]."""
    speed, deviates = speeds_and_deviates(number, motions, 5)
    twist = robot_pair.rolling(speed, deviates, SLIP, HEAVE_M_S)
    random = np.random.default_rng([number, 4])
    things = np.array(places(number))
    starts = []
    for _ in range(200 * motions):
        x, y = random.uniform(-REACH_M / 2, REACH_M / 2, 2)
        heading = random.uniform(-math.pi, math.pi)
        if (np.hypot(things[:, 0] - x, things[:, 1] - y) > CLEAR_M + 1.5 * things[:, 2]).all():
            starts.append((x, y, heading))
        if len(starts) == motions:
            break
    else:
        raise DomainError(
            f"world {number} has room for {len(starts)} of {motions} drives; ask for fewer."
        )
    at = robot_pair.standing(torch.tensor(starts, dtype=torch.float64))
    return robot_pair.moved(at, twist), twist
