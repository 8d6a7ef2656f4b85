"""A fork truck in a corridor, its own forks in view: near walls with pillars on both sides, far
ends. It reads its velocity in the plane with a map of the corridor; where it sees itself there is
nothing to read."""

import math

import numpy as np
import torch

from codesign import backend
from codesign.mount import PLANAR
from codesign.render import MitsubaScene
from scenes.bodies import box, cylinder
from scenes.build import GAP_M, World, block, emissive, sides
from scenes.robots import pair as robot_pair
from scenes.robots.pair import Design, RobotPair, speeds_and_deviates

LENGTH_M = 14.0
HEIGHT_M = 2.5
HALF_WIDTH_M = (0.95, 1.3)
PILLAR_M = (0.08, 0.12)  # half sizes, across and along the corridor
EVERY_M = 1.8  # from pillar to pillar
CRATES = 8
CRATE_M = 0.11  # half size across the corridor, between the pillars
ASIDE_M = 0.15  # of the drives from the middle
HEADING_RAD = 0.2
LIFT_M = 0.008  # of what rolls: roll and pitch take it away over half a window
SLIP = 0.05
HEAVE_M_S = 0.02
BODIES = {
    "base": cylinder(0.2, 0.1, (0.0, 0.0, 0.09)),
    "head": box((0.16, 0.24, 0.1), (-0.08, 0.0, 0.195)),
    "carriage": box((0.04, 0.3, 0.08), (0.23, 0.0, 0.09)),
    "fork left": box((0.34, 0.05, 0.016), (0.43, 0.1, 0.06)),
    "fork right": box((0.34, 0.05, 0.016), (0.43, -0.1, 0.06)),
    "wheel left": cylinder(0.05, 0.03, (-0.02, 0.22, 0.05 + LIFT_M), "y"),
    "wheel right": cylinder(0.05, 0.03, (-0.02, -0.22, 0.05 + LIFT_M), "y"),
}
LOW = Design(2.5, 1.2, 0.0, 0.1, -0.12, 0.2, -0.6, 0.0, -0.4)
HIGH = Design(12.0, 1.2, 8.0, 0.3, 0.12, 0.7, 0.6, math.radians(80), 0.4)
START = Design(6.5, 1.2, 0.55, 0.2, 0.0, 0.24, 0.0, math.radians(23), 0.0)


def corridor() -> RobotPair:
    """The pair. The estimator has the true depth of walls, floor and things, and knows where it
    sees the robot itself.

    >>> sorted(corridor().bodies)[2:4]
    ['fork left', 'fork right']
    """
    prior = (1.5, 0.08, 0.04, 0.8, 0.8, 0.8)
    return RobotPair(
        "corridor", BODIES, LOW, HIGH, START, PLANAR, prior, "scene", None, world, drive
    )


def world(number: int) -> MitsubaScene:
    """Walls, floor, ceiling and ends, pillars along both walls and crates between them, along
    +y."""
    mi = backend.mitsuba("cpu")
    random, _, covered = robot_pair.variant(number)
    half = half_width_m(number)
    walls = sides(mi, (2 * half, LENGTH_M, HEIGHT_M), LENGTH_M / 2)
    along, across, level = (LENGTH_M, HEIGHT_M), (2 * half, HEIGHT_M), (2 * half, LENGTH_M)
    sizes = {"west": along, "east": along, "floor": level, "ceiling": level}
    sizes |= {"south": across, "north": across}
    shapes = {name: (walls[name], covered(*size)) for name, size in sizes.items()}
    column = covered(2 * PILLAR_M[1], HEIGHT_M)
    stations = np.arange(EVERY_M, LENGTH_M - 0.5, EVERY_M)
    for k, y in enumerate(stations):
        for sign in (-1, 1):
            size = (*PILLAR_M, HEIGHT_M / 2 - GAP_M)
            shape = block(mi, sign * (half - PILLAR_M[0] - GAP_M), y, 0.0, size)
            shapes[f"pillar-{k}{'we'[sign > 0]}"] = (shape, column)
    taken = random.permutation([(sign, y) for sign in (-1, 1) for y in stations[:-1]])[:CRATES]
    for k, (sign, y) in enumerate(taken):
        size = (CRATE_M, random.uniform(0.1, 0.35), random.uniform(0.1, 0.4))
        shape = block(mi, sign * (half - CRATE_M - GAP_M), y + EVERY_M / 2, 0.0, size)
        shapes[f"crate-{k}"] = (shape, covered(0.5, 0.5))
    return emissive(World(shapes))


def half_width_m(number: int) -> float:
    """From the middle of the corridor to its walls."""
    return np.random.default_rng([number, 3]).uniform(*HALF_WIDTH_M)


def drive(number: int, motions: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Drives along the corridor, either way: T_world_body [M, T, 4, 4], twist [M, 6]."""
    speed, deviates = speeds_and_deviates(number, motions, 5)
    twist = robot_pair.rolling(speed, deviates, SLIP, HEAVE_M_S)
    random = np.random.default_rng([number, 4])
    aside = random.uniform(-ASIDE_M, ASIDE_M, motions)
    along = random.uniform(1.0, LENGTH_M - 1.0, motions)
    way = random.choice([-1.0, 1.0], motions) * math.pi / 2
    heading = way + random.uniform(-HEADING_RAD, HEADING_RAD, motions)
    starts = torch.from_numpy(np.stack([aside, along, heading], 1))
    return robot_pair.moved(robot_pair.standing(starts), twist), twist
