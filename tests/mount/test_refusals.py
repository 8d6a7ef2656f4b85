"""What cannot be is refused by a sentence: each call with one wrong value, and a part of what is
said."""

import math

import numpy as np
import torch

from codesign import lens, mount, render
from codesign.mount import (
    FREE,
    Body,
    Clearance,
    EgoVelocity,
    Housing,
    Mount,
    MountRanges,
    Readings,
    UnknownDepth,
)
from scenes import bodies, robots
from tests import refusals
from tests.numbers import D

NAN, INF = math.nan, math.inf
AT, HALF, STILL = (0.2, -0.1, 0.4), (0.1, 0.05, 0.2), (0.0, 0.0, 0.0)
CAMERA = render.Camera(lens.Pinhole(3.4), 24, 16, 0.2, 1)
SMALL = render.Camera(lens.load("cooke-triplet"), 60, 60, 2.0, 1)
DOWN = Mount((0.0, 0.0, 0.4), STILL, pitch_rad=math.pi / 2)().detach()
FLAT = torch.full((384,), 0.4, dtype=D)
BOX = bodies.box((1.0, 1.0, 1.0), (0.5, 0.5, 0.5))
TURNED = np.concatenate([BOX.faces[:-1], BOX.faces[-1:, ::-1]])
PARTS = robots.from_urdf(robots.ROVER).parts
ROVER = Body.of(PARTS, without=["camera_link"])
NEAR = Clearance(ROVER, Housing(0.03))
LOW, HIGH = [0.1, -0.2, 0.3, -2.0, -1.4, -3.0], [0.3, 0.1, 0.7, 3.0, 1.5, 3.0]
UNKNOWN = EgoVelocity(FREE, (1.0,) * 6, UnknownDepth())


def rover_mount(**more):
    return Mount((0.15, 0.0, 0.45), (0.15, 0.1, 0.15), pitch_rad=0.4, **more)


def ranges(k, low, high):
    return MountRanges([*LOW[:k], low, *LOW[k + 1 :]], [*HIGH[:k], high, *HIGH[k + 1 :]])


def read(parallax=None):
    flow = torch.zeros(1, 4, 2, dtype=D)
    ones = torch.ones(1, 4, dtype=D)
    rows = torch.zeros(1, 4, 2, 6, dtype=D)
    precision = torch.eye(2, dtype=D).expand(1, 4, 2, 2)
    return Readings(flow, flow, precision, ones, ones, rows, ones, 1, parallax)


NAMES = vars(mount) | globals()


@refusals.table(__file__)
def test_what_cannot_be_is_refused(row):
    row.holds(NAMES)
