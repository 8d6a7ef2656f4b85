"""A quadrotor in a room, from low over the floor to under the ceiling: all six velocities count, in
every direction of flight, with a map of the room."""

import math
from itertools import product

import numpy as np
import torch

from codesign import backend
from codesign.mount import FREE
from codesign.pose import se3_exp
from codesign.render import MitsubaScene
from scenes.bodies import box, cylinder
from scenes.build import World, ball, block, emissive, sides
from scenes.robots import pair as robot_pair
from scenes.robots.pair import RATE_RAD_S, Design, RobotPair, speeds_and_deviates

SIDE_M = 5.0
HEIGHT_M = 3.2
THINGS = 10
CLEAR_M = 1.6  # of the middle of the room, where it flies
ABOUT_M = 1.0  # how far from the middle
FLOWN_M = (0.32, 1.9)  # height of the body, even in the logarithm
TILT_RAD = 0.1
CLIMB_RAD = 0.4  # standard deviation of the elevation of the way
ARM_M = 0.2
BODIES = {
    "hub": box((0.16, 0.1, 0.05), (0.0, 0.0, 0.0)),
    "battery": box((0.12, 0.05, 0.03), (-0.01, 0.0, 0.045)),
    "arm left": box((2 * ARM_M * math.sqrt(2), 0.02, 0.016), (0.0, 0.0, 0.004), 45.0),
    "arm right": box((2 * ARM_M * math.sqrt(2), 0.02, 0.016), (0.0, 0.0, 0.004), -45.0),
    "skid left": box((0.24, 0.012, 0.012), (0.0, 0.09, -0.13)),
    "skid right": box((0.24, 0.012, 0.012), (0.0, -0.09, -0.13)),
}
for _x, _y in product((-1, 1), (-1, 1)):
    _at, _tip = f"{_x:+d} {_y:+d}", (ARM_M * _x, ARM_M * _y)
    BODIES[f"leg {_at}"] = box((0.01, 0.01, 0.1), (0.05 * _x, 0.09 * _y, -0.074))
    BODIES[f"motor {_at}"] = cylinder(0.016, 0.03, (*_tip, 0.028))
    BODIES[f"rotor {_at}"] = cylinder(0.12, 0.004, (*_tip, 0.046))
LOW = Design(2.5, 1.2, 0.0, 0.12, -0.06, -0.16, -0.8, -0.4, -0.6)
HIGH = Design(12.0, 1.2, 8.0, 0.25, 0.06, 0.02, 0.8, 1.5, 0.6)
START = Design(6.5, 1.2, 0.55, 0.16, 0.0, -0.08, 0.0, 0.6, 0.0)


def flight() -> RobotPair:
    """The pair. Depth of the room is known at every height.

    >>> flight().axes
    (0, 1, 2, 3, 4, 5)
    """
    prior = (0.8, 0.8, 0.4, 0.8, 0.8, 0.8)
    bounds = LOW, HIGH, START
    how = FREE, prior, "scene", None
    return RobotPair("flight", BODIES, *bounds, *how, world, drive, frame="base_link")


def world(number: int) -> MitsubaScene:
    """A room whose six sides have pictures, with crates and balls along its walls."""
    mi = backend.mitsuba("cpu")
    random, _, covered = robot_pair.variant(number)
    shapes: dict = {}
    for name, side in sides(mi, (SIDE_M, SIDE_M, HEIGHT_M)).items():
        shapes[name] = (side, covered(SIDE_M, SIDE_M if name in ("floor", "ceiling") else HEIGHT_M))
    for k in range(THINGS):
        around = 2 * math.pi * (k + random.uniform(-0.2, 0.2)) / THINGS
        x, y = (CLEAR_M + 0.45) * math.cos(around), (CLEAR_M + 0.45) * math.sin(around)
        size = random.uniform(0.15, 0.28)
        if k % 2:
            shapes[f"ball-{k}"] = (ball(mi, x, y, 0.0, size), covered(1.0, 1.0))
        else:
            half = (size, size, random.uniform(0.2, 0.6))
            crate = block(mi, x, y, 0.0, half, random.uniform(0, 90))
            shapes[f"crate-{k}"] = (crate, covered(0.6, 0.6))
    return emissive(World(shapes))


def drive(number: int, motions: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Flights about the middle of the room: T_world_body [M, T, 4, 4], twist [M, 6]."""
    speed, deviates = speeds_and_deviates(number, motions, 4)
    random = np.random.default_rng([number, 4])
    way = torch.from_numpy(random.uniform(-math.pi, math.pi, motions))
    climb = CLIMB_RAD * deviates[:, 0]
    onward = torch.stack([climb.cos() * way.cos(), climb.cos() * way.sin(), climb.sin()], 1)
    twist = torch.cat([speed[:, None] * onward, RATE_RAD_S * deviates[:, 1:]], 1)
    starts = random.uniform(
        (-ABOUT_M, -ABOUT_M, -math.pi), (ABOUT_M, ABOUT_M, math.pi), (motions, 3)
    )
    lowest, highest = np.log(FLOWN_M)
    share = (random.permutation(motions) + random.random(motions)) / motions
    height = np.exp(lowest + (highest - lowest) * share)
    tilt = torch.zeros(motions, 6, dtype=torch.float64)
    tilt[:, 3:5] = TILT_RAD * torch.from_numpy(random.standard_normal((motions, 2)))
    pose = robot_pair.standing(torch.from_numpy(starts))
    pose[:, 2, 3] = torch.from_numpy(height)
    return robot_pair.moved(pose @ se3_exp(tilt), twist), twist
