"""What a body reads off event flow, as a stage of a system: its velocity, and the errors by which a design is
judged."""

from codesign.task.depth import ground_depth, scene_depth
from codesign.task.ego_velocity import EgoVelocity, Motion
from codesign.task.own_body import OwnBody
from codesign.task.score import VelocityErrors, velocity_errors

__all__ = [
    "EgoVelocity",
    "Motion",
    "OwnBody",
    "VelocityErrors",
    "ground_depth",
    "scene_depth",
    "velocity_errors",
]
