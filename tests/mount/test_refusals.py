"""What cannot be is refused by a sentence: each call with one wrong value, and a part of what is said."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.errors import CodesignError
from codesign.mount import (
    FREE,
    PLANAR,
    Body,
    CableSide,
    Clearance,
    EgoVelocity,
    Housing,
    LookAhead,
    Mount,
    MountRanges,
    OwnBody,
    PrecisionTrend,
    Readings,
    Surroundings,
    UnknownDepth,
    VelocityHead,
    check_mount,
    expected_error,
    expected_errors,
    flow_precision,
    information,
    judge,
    sight,
    sight_map,
    starts,
    velocity_errors,
    velocity_from_flow,
)
from scenes import robots

D = torch.float64
NAN, INF = math.nan, math.inf
NOTHING: Any = None
AT, HALF, STILL = (0.2, -0.1, 0.4), (0.1, 0.05, 0.2), (0.0, 0.0, 0.0)
CAMERA = render.Camera(lens.Pinhole(3.4), 24, 16, 0.2, 1)
SMALL = render.Camera(lens.load("cooke-triplet"), 60, 60, 2.0, 1)
DOWN = Mount((0.0, 0.0, 0.4), STILL, pitch_rad=math.pi / 2)().detach()
UP = Mount((0.0, 0.0, 0.4), STILL, pitch_rad=-1.0)().detach()
FLAT = torch.full((384,), 0.4, dtype=D)
SKY = torch.full((384,), NAN, dtype=D)
ONE = torch.where(torch.arange(384) == 5, FLAT, SKY)  # one pixel: two equations for three unknowns
SADDLE = torch.tensor([[1.0, 2.0], [2.0, 1.0]], dtype=D).repeat(384, 1, 1)
BOX = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([(a, b, c) for a, b, c, _ in SIDES] + [(a, c, d) for a, _, c, d in SIDES])
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


WRONG = [
    # mounts and their bounds
    (lambda: Mount((0, 0, NAN), HALF), "nominal_m"),
    (lambda: Mount(AT, (0.1, -0.1, 0.1)), "at least 0"),
    (lambda: Mount(AT, HALF, yaw_rad=INF), "yaw_rad"),
    (lambda: Mount(AT, HALF, position_m=(0.31, -0.1, 0.4)), "not strictly inside the allowed box"),
    (lambda: Mount((0, 0), HALF), "three numbers"),
    (lambda: Mount(AT, HALF)(torch.zeros(5, dtype=D)), r"\[..., 6\]"),
    (lambda: Mount(AT, HALF)(torch.full((6,), NAN, dtype=D)), "last finite"),
    (lambda: Mount(AT, HALF).variables(CAMERA, 0.0), "no pixel sees a surface"),
    (lambda: Mount(AT, HALF).variables(CAMERA, FLAT[:5]), r"one number or \[384\]"),
    (lambda: Mount(AT, HALF).variables(CAMERA, 1.0, step_px=0), "step_px is 0"),
    (lambda: ranges(2, 0.5, 0.4), r"z_m goes from 0\.5 to 0\.4; give the lower bound first"),
    (lambda: ranges(4, 0.0, math.pi / 2), r"pitch_rad goes from 0 to 1\.57.*strictly between"),
    (lambda: ranges(4, -2.0, 0.0), r"pitch_rad .*strictly between"),
    (lambda: ranges(3, -3.2, 3.2), r"yaw_rad .* more than a turn"),
    (lambda: ranges(5, 0.0, 7.0), r"roll_rad .* more than a turn"),
    (lambda: ranges(0, NAN, 1.0), "NaN or infinite"),
    (lambda: ranges(1, 0.0, INF), "NaN or infinite"),
    (lambda: MountRanges(LOW[:3], HIGH), r"low needs six numbers \(x_m, .*got shape \(3,\)"),
    (lambda: MountRanges(LOW, HIGH).pose(torch.zeros(5)), r"shares are \[\.\.\., 6\].*got \(5,\)"),
    (lambda: MountRanges(LOW, HIGH).pose(torch.full((6,), NAN)), "shares: 6 of 6 values"),
    (lambda: MountRanges(LOW, HIGH).share_at(DOWN), "outside"),
    # bodies and requirements
    (lambda: Body([]), "no triangles"),
    (lambda: Body([([(0, 0, NAN)] * 3, [(0, 1, 2)])]), "vertices"),
    (lambda: Body([([(0, 0, 0)] * 3, [(0, 1, 3)])]), "vertex 3; there are those from 0 to 2"),
    (lambda: Body([([(0, 0)] * 3, [(0, 1, 2)])]), r"\[V, 3\]"),
    (lambda: Body([(BOX, np.concatenate([FACES[:-1], FACES[-1:, ::-1]]))]), "turn different ways"),
    (lambda: Body.of(PARTS, without=["arm"]), "'arm'; there are"),
    (lambda: Housing(0.0), "radius_m is 0"),
    (lambda: Housing(0.1, -1.0), "behind_m is -1"),
    (lambda: CableSide((0, 0, 0), 0.3), "not all 0"),
    (lambda: CableSide((0, 0, 1), 4.0), "between 0 and pi"),
    (lambda: LookAhead(-1.0, 0.3), "distance_m is -1"),
    (lambda: LookAhead(1.0, 1.3), "share is 1.3"),
    (lambda: LookAhead(1.0, 0.3, ahead=(1, 0, 1)), "level"),
    (lambda: LookAhead(1.0, 0.3).slack(DOWN, NOTHING), "looks through the camera"),
    (lambda: Clearance(NOTHING, Housing(0.1), margin_m=-1), "margin_m is -1"),
    (lambda: Clearance(NOTHING, Housing(0.1), step=0), "step is 0"),
    (lambda: OwnBody(ROVER, 2.0), "largest_share is 2"),
    (lambda: OwnBody(ROVER, 0.2, step=0.0), "step is 0"),
    (lambda: judge([], DOWN[None], NOTHING), r"one mount \[4, 4\]"),
    # what makes a search hopeless: inside the chassis; beside a wheel, hypot(1.62, 0.07, 0.1); millimetres;
    # on the mast
    (
        lambda: check_mount(Mount((0.0, 0.0, 0.17), (0.05, 0.05, 0.02)), [NEAR], CAMERA),
        "no room for the camera",
    ),
    (
        lambda: check_mount(Mount((2.0, 0.0, 0.3), (0.1, 0.1, 0.1)), [NEAR], CAMERA),
        "1.62 m away from the robot",
    ),
    (lambda: check_mount(Mount((200.0, 0.0, 450.0), (100.0,) * 3), [NEAR], CAMERA), "in metres"),
    (
        lambda: check_mount(
            rover_mount(position_m=(0.09, 0.0, 0.5)), [NEAR, LookAhead(9.0, share=0.9)], CAMERA
        ),
        r"clearance: missed by 0.0\d+ m; look-ahead: missed by",
    ),
    (lambda: check_mount(rover_mount(), [NEAR], SMALL), "image circle"),
    (
        lambda: starts(rover_mount(), 3, [NEAR, CableSide((-1, 0, 0.4), 1.5)], CAMERA, reach_rad=0.2),
        r"most, \d+%, fail first at 'cable side'",
    ),
    (lambda: starts(rover_mount(), 3, reach_rad=4.0), "reach_rad is 4"),
    # velocity from flow
    (lambda: information(CAMERA, SKY, UP), "no pixel sees the ground"),
    (lambda: information(CAMERA, ONE, DOWN), "not observable"),
    (lambda: information(CAMERA, FLAT, DOWN, -torch.ones(384, dtype=D)), "negative"),
    (lambda: information(CAMERA, FLAT, DOWN, SADDLE), "not symmetric and positive"),
    (lambda: information(CAMERA, FLAT, DOWN, 0 * SADDLE), "positive weight"),
    (lambda: information(CAMERA, FLAT, DOWN, prior=(1.0, 0.0, 1.0)), "prior"),
    (lambda: information(CAMERA, FLAT, DOWN, prior=(1.0,) * 3, axes=FREE), "6 finite standard deviations"),
    (lambda: information(CAMERA, FLAT, DOWN, axes=(0, 6)), "axes = "),
    (lambda: information(CAMERA, FLAT[:7], DOWN), "one per pixel"),
    (lambda: velocity_from_flow(torch.full((1, 2, 16, 24), NAN), CAMERA, FLAT, DOWN), "flow"),
    (lambda: velocity_from_flow(torch.zeros(2, 16, 24), CAMERA, FLAT, DOWN), r"\[B, 2, H, W\]"),
    (lambda: flow_precision(torch.zeros(4, 2)), "xx, xy, yy"),
    (lambda: flow_precision(torch.tensor([1.0, 2.0, 1.0])), "not positive"),
    (lambda: expected_error(torch.eye(3), (1.0, 1.0), (1.0, 1.0, 1.0)), "unit has 2 numbers"),
    (lambda: expected_error(torch.eye(2), (1.0, 1.0), (1.0, 0.0)), "prior is"),
    (lambda: sight(torch.eye(3).repeat(2, 1, 1), (1.0, 1.0, 1.0), PLANAR), "one information"),
    (lambda: sight_map(CAMERA, Surroundings(STILL), rows=1), "1 rows"),
    (lambda: sight_map(CAMERA, Surroundings(STILL), unit=(1.0,)), "unit and prior need 6 numbers"),
    (lambda: Surroundings(STILL, deviation_px_s=0.0), "deviation_px_s"),
    # as a stage of a system
    (lambda: EgoVelocity(depth="guess"), "depth is 'guess'"),
    (lambda: EgoVelocity(FREE), "each of the 6 velocities"),
    (lambda: EgoVelocity(outlier=NAN), "outlier"),
    (lambda: velocity_errors(torch.zeros(2, 3), torch.zeros(2, 3), PLANAR), "velocities are"),
    (lambda: PrecisionTrend().followed(read(), torch.zeros(1, 4, 2, dtype=D)), "has seen no readings"),
    (lambda: PrecisionTrend(1.5), "from 0 to 1"),
    (lambda: UnknownDepth(0.0, 1.0), "nearest"),
    (lambda: UnknownDepth(1.0, 1.0), "nearest"),
    (lambda: UnknownDepth(NAN, 1.0), "nearest"),
    (lambda: UNKNOWN.solve(read()), "know their depth"),
    (lambda: expected_errors(UNKNOWN, read(torch.zeros(1, 4, 2, 6)), torch.zeros(1, 6)), "depth is known"),
    (lambda: VelocityHead(UNKNOWN), "head"),
]


@pytest.mark.parametrize(("make", "sentence"), WRONG, ids=[sentence for _, sentence in WRONG])
def test_what_cannot_be_is_refused(make, sentence):
    with pytest.raises(CodesignError, match=sentence):
        make()
