"""A camera on a robot's body, and what the body reads off event flow from there.

Where it sits and what it has to keep: ``Mount``, ``MountRanges``, the requirements. What flow tells
of the body's velocity: ``body_flow``, ``Surroundings``, ``sight_table``. Reading it, as a stage of
a system:
  ``EgoVelocity``.
Read first: pose.py, then ego_velocity.py.
"""

from codesign.doors import explain
from codesign.mount.body import Body, Housing
from codesign.mount.depth import ground_depth, scene_depth
from codesign.mount.ego_velocity import EgoVelocity, Motion, Readings
from codesign.mount.errors import (
    Expected,
    FlowErrors,
    VelocityErrors,
    expected_errors,
    velocity_errors,
)
from codesign.mount.head import Evidence, VelocityHead, window_optics
from codesign.mount.observability import FREE, PLANAR, body_flow, flow_precision
from codesign.mount.pose import Mount, MountRanges, yaw_pitch_roll_rad
from codesign.mount.requirements import (
    CableSide,
    Clearance,
    LookAhead,
    OwnBody,
    Requirement,
    Verdict,
    judge,
    penalty,
)
from codesign.mount.sight import (
    ATTITUDES,
    VELOCITIES,
    Sight,
    Surroundings,
    expected_error,
    sight,
    sight_map,
    sight_table,
    sight_units,
)
from codesign.mount.starts import check_mount, starts
from codesign.mount.trend import PrecisionTrend
from codesign.mount.unknown_depth import UnknownDepth

__all__ = [
    "ATTITUDES",
    "FREE",
    "PLANAR",
    "VELOCITIES",
    "Body",
    "CableSide",
    "Clearance",
    "EgoVelocity",
    "Evidence",
    "Expected",
    "FlowErrors",
    "Housing",
    "LookAhead",
    "Motion",
    "Mount",
    "MountRanges",
    "OwnBody",
    "PrecisionTrend",
    "Readings",
    "Requirement",
    "Sight",
    "Surroundings",
    "UnknownDepth",
    "VelocityErrors",
    "VelocityHead",
    "Verdict",
    "body_flow",
    "check_mount",
    "expected_error",
    "expected_errors",
    "flow_precision",
    "ground_depth",
    "judge",
    "penalty",
    "scene_depth",
    "sight",
    "sight_map",
    "sight_table",
    "sight_units",
    "starts",
    "velocity_errors",
    "window_optics",
    "yaw_pitch_roll_rad",
]

explain(globals())
