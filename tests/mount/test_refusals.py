"""What cannot be is refused by a sentence: each call with one wrong value, and a part of what is
said."""

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
    body_flow,
    check_mount,
    expected_error,
    expected_errors,
    flow_precision,
    judge,
    sight,
    sight_map,
    starts,
    velocity_errors,
)
from scenes import bodies, robots

D = torch.float64
NAN, INF = math.nan, math.inf
NOTHING: Any = None
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
    (lambda: Mount(AT, HALF).variables(CAMERA, 1.0, step_px=0), "step_px must be .* got 0"),
    (lambda: ranges(2, 0.5, 0.4), r"z_m goes from 0\.5 to 0\.4; give the lower bound first"),
    (lambda: ranges(4, 0.0, math.pi / 2), r"pitch_rad goes from 0 to 1\.57.*strictly between"),
    (lambda: ranges(3, -3.2, 3.2), r"yaw_rad .* more than a turn"),
    (lambda: ranges(0, NAN, 1.0), "NaN or infinity"),
    (lambda: MountRanges(LOW[:3], HIGH), r"low needs six numbers \(x_m, .*got shape \(3,\)"),
    (lambda: MountRanges(LOW, HIGH).pose(torch.zeros(5)), r"shares are \[\.\.\., 6\].*got \(5,\)"),
    (
        lambda: MountRanges(LOW, HIGH).pose(torch.full((6,), NAN)),
        "shares must be finite, got .* in 6 of 6 values",
    ),
    (lambda: MountRanges(LOW, HIGH).share_at(DOWN), "outside"),
    # bodies and requirements
    (lambda: Body([]), "no triangles"),
    (lambda: Body([([(0, 0, NAN)] * 3, [(0, 1, 2)])]), "vertices"),
    (lambda: Body([([(0, 0, 0)] * 3, [(0, 1, 3)])]), "vertex 3; there are those from 0 to 2"),
    (lambda: Body([([(0, 0)] * 3, [(0, 1, 2)])]), r"\[V, 3\]"),
    (lambda: Body([(BOX.vertices_m, TURNED)]), "turn different ways"),
    (lambda: Body.of(PARTS, without=["arm"]), "'arm'; there are"),
    (lambda: Housing(0.0), r"radius_m must be .* got 0"),
    (lambda: Housing(0.1, -1.0), r"behind_m must be .* got -1"),
    (lambda: CableSide((0, 0, 0), 0.3), "not all 0"),
    (lambda: CableSide((0, 0, 1), 4.0), "half_angle_rad must be .* got 4"),
    (lambda: LookAhead(-1.0, 0.3), "distance_m must be .* got -1"),
    (lambda: LookAhead(1.0, 1.3), "share must be .* got 1.3"),
    (lambda: LookAhead(1.0, 0.3).slack(DOWN, NOTHING), "looks through the camera"),
    (lambda: Clearance(NOTHING, Housing(0.1), margin_m=-1), "margin_m must be .* got -1"),
    (lambda: Clearance(NOTHING, Housing(0.1), step=0), "step must be .* got 0"),
    (lambda: OwnBody(ROVER, 2.0), "largest_share must be .* got 2"),
    (lambda: judge([], DOWN[None], NOTHING), r"one mount \[4, 4\]"),
    # what makes a search hopeless: inside the chassis; beside a wheel, hypot(1.62, 0.07, 0.1);
    # millimetres; on the mast
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
        lambda: starts(ranges(4, 0.9, 1.5), 3, [LookAhead(3.0, share=0.9), NEAR], CAMERA),
        r"most, \d+%, fail first at 'look-ahead'",
    ),
    # flow and what it tells
    (lambda: body_flow(CAMERA, FLAT[:7], DOWN), "one per pixel"),
    (lambda: body_flow(CAMERA, FLAT, NAN * DOWN), "T_body_cam"),
    (lambda: flow_precision(torch.zeros(4, 2)), "xx, xy, yy"),
    (lambda: flow_precision(torch.tensor([1.0, 2.0, 1.0])), "not positive"),
    (lambda: expected_error(torch.eye(3), (1.0, 1.0), (1.0, 1.0, 1.0)), "unit has 2 numbers"),
    (lambda: expected_error(torch.eye(2), (1.0, 1.0), (1.0, 0.0)), "prior is"),
    (lambda: sight(torch.eye(3).repeat(2, 1, 1), (1.0, 1.0, 1.0), PLANAR), "one information"),
    (lambda: sight_map(CAMERA, Surroundings(STILL), rows=1), "rows must be .* got 1"),
    (lambda: Surroundings(STILL, deviation_px_s=0.0), "deviation_px_s"),
    # as a stage of a system
    (lambda: EgoVelocity(depth="guess"), "depth is 'guess'"),
    (lambda: EgoVelocity(FREE), "each of the 6 velocities"),
    (lambda: EgoVelocity(outlier=NAN), "outlier"),
    (lambda: velocity_errors(torch.zeros(2, 3), torch.zeros(2, 3), PLANAR), "velocities are"),
    (
        lambda: PrecisionTrend().followed(read(), torch.zeros(1, 4, 2, dtype=D)),
        "has seen no readings",
    ),
    (lambda: UnknownDepth(0.0, 1.0), "nearest"),
    (lambda: UnknownDepth(1.0, 1.0), "nearest"),
    (lambda: UNKNOWN.solve(read()), "know their depth"),
    (
        lambda: expected_errors(UNKNOWN, read(torch.zeros(1, 4, 2, 6)), torch.zeros(1, 6)),
        "depth is known",
    ),
    (lambda: VelocityHead(UNKNOWN), "head"),
]


@pytest.mark.parametrize(("make", "sentence"), WRONG, ids=[sentence for _, sentence in WRONG])
def test_what_cannot_be_is_refused(make, sentence):
    with pytest.raises(CodesignError, match=sentence):
        make()
