"""Placement: a camera mount on a robot body, what it has to keep, and what the camera can tell from there about
the body's motion."""

from codesign.doors import explain
from codesign.place.body import Body, Housing
from codesign.place.criterion import Sight, expected_error, flow_precision, sight
from codesign.place.mount import Mount, yaw_pitch_roll_rad
from codesign.place.observability import FREE, PLANAR, body_flow, information, planar_flow, velocity_from_flow
from codesign.place.ranges import MountRanges
from codesign.place.requirements import CableSide, Clearance, LookAhead, Requirement, Verdict, judge, penalty
from codesign.place.starts import check_mount, starts

__all__ = [
    "FREE",
    "PLANAR",
    "Body",
    "CableSide",
    "Clearance",
    "Housing",
    "LookAhead",
    "Mount",
    "MountRanges",
    "Requirement",
    "Sight",
    "Verdict",
    "body_flow",
    "check_mount",
    "expected_error",
    "flow_precision",
    "information",
    "judge",
    "penalty",
    "planar_flow",
    "sight",
    "starts",
    "velocity_from_flow",
    "yaw_pitch_roll_rad",
]

explain(globals())
