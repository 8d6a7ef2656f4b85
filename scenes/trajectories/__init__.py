"""Paths of cameras and bodies: simple ones as poses at given times, and five families as smooth
functions of time.

Functions (``translation``, ``body_twist``) give poses T_world_cam at times. Trajectories
(``Orbital``, ``Swinging``, ``Driving``, ``Flying``) are called with any times and give
T_world_body; ``mounted`` puts a camera on one.
"""

from codesign.doors import explain
from scenes.trajectories.driving import Driving, Waves
from scenes.trajectories.flying import Flying, Polynomials, minimum_snap
from scenes.trajectories.swinging import Orbital, Swinging
from scenes.trajectories.trajectory import (
    Trajectory,
    body_at,
    body_twist,
    mounted,
    times,
    translation,
)

__all__ = [
    "Driving",
    "Flying",
    "Orbital",
    "Polynomials",
    "Swinging",
    "Trajectory",
    "Waves",
    "body_at",
    "body_twist",
    "minimum_snap",
    "mounted",
    "times",
    "translation",
]

explain(globals())
