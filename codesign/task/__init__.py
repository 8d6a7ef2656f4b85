"""What a body reads off event flow, as a stage of a system: its velocity, and the errors by which a design is
judged."""

from codesign.doors import explain
from codesign.task.depth import ground_depth, scene_depth
from codesign.task.ego_velocity import EgoVelocity, Motion, Readings
from codesign.task.evidence import Evidence
from codesign.task.expected import Expected, FlowErrors, expected_errors
from codesign.task.head import VelocityHead
from codesign.task.own_body import OwnBody
from codesign.task.score import VelocityErrors, velocity_errors
from codesign.task.sight import ATTITUDES, VELOCITIES, Surroundings, sight_map, sight_table, sight_units
from codesign.task.trend import PrecisionTrend
from codesign.task.unknown_depth import UnknownDepth

__all__ = [
    "ATTITUDES",
    "VELOCITIES",
    "EgoVelocity",
    "Evidence",
    "Expected",
    "FlowErrors",
    "Motion",
    "OwnBody",
    "PrecisionTrend",
    "Readings",
    "Surroundings",
    "UnknownDepth",
    "VelocityErrors",
    "VelocityHead",
    "expected_errors",
    "ground_depth",
    "scene_depth",
    "sight_map",
    "sight_table",
    "sight_units",
    "velocity_errors",
]

explain(globals())
