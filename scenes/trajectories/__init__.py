"""Paths of cameras and bodies: simple ones as poses at given times, and five families as smooth functions of
time.

Functions (``orbit``, ``radial``, ...) give poses T_world_cam at times. Trajectories (``Orbital``,
``Swinging.radial``, ``Swinging.vertical``, ``Driving``, ``Flying``) are called with any times and give
T_world_body; ``mounted`` puts a camera on one.
"""

from scenes.trajectories.driving import Driving
from scenes.trajectories.flying import Flying
from scenes.trajectories.minimum_snap import Polynomials, minimum_snap
from scenes.trajectories.sampled import body_twist, orbit, oscillation, radial, times, translation, vertical
from scenes.trajectories.swinging import Orbital, Swinging
from scenes.trajectories.trajectory import Trajectory, body_at, mounted
from scenes.trajectories.waves import Waves

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
    "orbit",
    "oscillation",
    "radial",
    "times",
    "translation",
    "vertical",
]
