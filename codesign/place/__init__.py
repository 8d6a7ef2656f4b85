"""Placement: a camera mount on a robot body, and what the camera can tell from there about the body's
motion."""

from codesign.place.mount import Mount, yaw_pitch_roll_rad
from codesign.place.observability import FREE, PLANAR, body_flow, information, planar_flow, velocity_from_flow

__all__ = [
    "FREE",
    "PLANAR",
    "Mount",
    "body_flow",
    "information",
    "planar_flow",
    "velocity_from_flow",
    "yaw_pitch_roll_rad",
]
