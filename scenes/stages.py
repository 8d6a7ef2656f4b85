"""Where a camera may move in each world."""

import inspect
import math
from dataclasses import dataclass
from typing import Any

from codesign.errors import DomainError
from codesign.render import MitsubaScene
from scenes import worlds
from scenes.build import LEVELS


@dataclass(frozen=True)
class Stage:
    """Where a camera may move in a world, metres.

    target_m: what it looks at. low_m, high_m: box of the camera. orbit_m: radius and height of orbits, about
      centre_m (the target when None); sweep_rad: how far round they may go. start_m, yaw_rad, turn_rad_s,
      height_m: how the robot starts, its mean turn rate, and the height of its body. aside_rad: to which side
      of the robot's way its camera looks. pitch_rad: how far down cameras on the robot and the quadrotor
      look.
    """

    target_m: tuple[float, float, float] = (0.0, 0.6, 0.7)
    low_m: tuple[float, float, float] = (-0.8, -1.4, 0.7)
    high_m: tuple[float, float, float] = (0.8, -0.4, 1.6)
    orbit_m: tuple[float, float] = (1.2, 0.6)
    sweep_rad: float = math.inf
    start_m: tuple[float, float] = (0.0, -1.2)
    yaw_rad: float = 0.0
    turn_rad_s: float = 0.9
    aside_rad: float = 0.0
    pitch_rad: float = 0.1
    height_m: float = 0.35
    centre_m: tuple[float, float, float] | None = None


# past what is seen, with the camera to the left
ALONG_WALL: dict[str, Any] = {
    "yaw_rad": 0.0,
    "turn_rad_s": 0.0,
    "aside_rad": math.pi / 2,
}
AHEAD: dict[str, Any] = {"yaw_rad": math.pi / 2, "turn_rad_s": 0.0}
STAGES = {
    "room": Stage(),
    "blank-room": Stage(),
    "dark-room": Stage(),
    "checkerboard": Stage(
        (0.0, 0.0, 1.0),
        (-0.9, -2.2, 0.6),
        (0.9, -1.2, 1.5),
        (1.7, 0.2),
        1.2,
        start_m=(-1.0, -1.5),
        pitch_rad=0.0,
        **ALONG_WALL,
    ),
    "corridor": Stage(
        (0.0, 8.0, 1.2),
        (-0.4, 0.6, 0.9),
        (0.4, 2.6, 1.7),
        (0.5, 0.3),
        centre_m=(0.0, 3.0, 1.0),
        start_m=(0.0, 1.0),
        **AHEAD,
    ),
    "outdoor": Stage(
        (0.0, 0.0, 0.9),
        (-0.5, -7.5, 1.0),
        (0.5, -5.0, 2.0),
        (0.5, 0.5),
        centre_m=(0.0, -6.0, 0.6),
        start_m=(0.0, -7.5),
        **AHEAD,
    ),
    "tabletop": Stage(
        (0.0, 0.05, 0.78),
        (-0.4, -1.2, 1.0),
        (0.4, -0.7, 1.4),
        (0.9, 0.5),
        start_m=(-0.6, -1.0),
        height_m=1.1,
        pitch_rad=0.3,
        **ALONG_WALL,
    ),
}


def make_world(name: str, light: str = "emissive") -> tuple[MitsubaScene, Stage]:
    """Scene and Stage of a world.

    Args: name: one of scenes.worlds.WORLDS. light: one of scenes.build.LEVELS.
    Raises: DomainError when there is no such world, or none with lamps.
    """
    if name not in worlds.WORLDS:
        raise DomainError(f"world '{name}' is unknown; there are {', '.join(worlds.WORLDS)}.")
    build = worlds.WORLDS[name]
    if light != "emissive" and "light" not in inspect.signature(build).parameters:
        raise DomainError(f"the world '{name}' has no lamps; only the light 'emissive' suits it.")
    options = {} if light == "emissive" else {"light": LEVELS[light]}
    if name in STAGES:
        return build(**options), STAGES[name]
    origin, target = worlds.VIEWS[name]
    distance = math.dist(origin, target)
    x, y, z = origin
    yaw = math.atan2(target[1] - y, target[0] - x)
    low, high = ((x + side, y + side, z + side) for side in (-0.2, 0.2))
    return build(**options), Stage(
        target, low, high, (0.7 * distance, 0.3 * distance), 0.5, (x, y), yaw, 0.0, height_m=z
    )
