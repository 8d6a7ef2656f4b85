"""Which path a camera takes through a world: one of five families, drawn at random until it keeps
clear of everything."""

import inspect
import math
from dataclasses import dataclass
from typing import Any

import torch

from codesign.errors import DomainError
from codesign.mount import Mount
from codesign.render import MitsubaScene
from codesign.render.hits import first_hits
from scenes import worlds
from scenes.build import LEVELS
from scenes.trajectories import Driving, Flying, Orbital, Swinging, body_at, mounted

FAMILIES = ("orbital", "radial", "vertical", "driving", "flying")
TRIES = 200
CLEAR_M = 0.15  # the least depth a path may come to
SEEN = 0.35  # the least share of the picture that shows something
PROBES = 24  # poses at which a path is looked at
LEAD_S = 0.6  # flights start from rest: recorded from here on


@dataclass(frozen=True)
class Stage:
    """Where a camera may move in a world, metres.

    target_m: what it looks at. low_m, high_m: box of the camera. orbit_m: radius and height of
      orbits, about centre_m (the target when None); sweep_rad: how far round they may go. start_m,
      yaw_rad, turn_rad_s, height_m: how the robot starts, its mean turn rate, and the height of its
      body. aside_rad: to which side of the robot's way its camera looks. pitch_rad: how far down
      cameras on the robot and the quadrotor look.
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
ALONG_WALL: dict[str, Any] = {"turn_rad_s": 0.0, "aside_rad": math.pi / 2}
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


def make_world(
    name: str, light: str = "emissive", device: str = "cpu"
) -> tuple[MitsubaScene, Stage]:
    """Scene and Stage of a world.

    Args:
      name: one of scenes.worlds.WORLDS.
      light: one of scenes.build.LEVELS.
    Raises: DomainError when there is no such world, or none with lamps.
    """
    if name not in worlds.WORLDS:
        raise DomainError(f"world '{name}' is unknown; there are {', '.join(worlds.WORLDS)}.")
    build = worlds.WORLDS[name]
    if light != "emissive" and "light" not in inspect.signature(build).parameters:
        raise DomainError(f"the world '{name}' has no lamps; only the light 'emissive' suits it.")
    options = {} if light == "emissive" else {"light": LEVELS[light]}
    return build(device=device, **options), STAGES[name]


def motion(family, stage, scene, camera, duration_s, generator):
    """A camera trajectory of a family, that lasts ``duration_s`` from ``LEAD_S`` on and keeps its
    distance.

    Raises: DomainError when no path of ``TRIES`` does.
    """
    t_s = LEAD_S + torch.linspace(0, duration_s, PROBES, dtype=torch.float64)
    for _ in range(TRIES):
        path = _drawn(family, stage, LEAD_S + duration_s, generator)
        if path is not None and _keeps_clear(path(t_s).detach(), scene, camera):
            return path
    raise DomainError(
        f"none of {TRIES} {family} paths of {duration_s:g} s keeps {CLEAR_M} m from all surfaces with "
        f"{SEEN:.0%} of the picture filled; ask for fewer frames, a higher rate, or another world."
    )


def _drawn(family, stage, until_s, generator):
    u = torch.rand(6, generator=generator, dtype=torch.float64).tolist()

    def between(k, low, high):
        return low + (high - low) * u[k]

    def camera(height_m, **attitude):
        return Mount((0.0, 0.0, height_m), (0.0, 0.0, 0.0), **attitude)().detach()

    if family == "orbital":
        rate = min(between(0, 0.4, 0.8), stage.sweep_rad / until_s / 1.3)
        start = -math.pi / 2 + (
            between(1, -math.pi, math.pi) if math.isinf(stage.sweep_rad) else -rate * until_s / 2
        )
        sign = 1 if u[2] < 0.5 or not math.isinf(stage.sweep_rad) else -1
        periods_s = between(3, 1.5, 3.0), between(4, 1.5, 3.0)
        centre_m = stage.centre_m or stage.target_m
        body = Orbital(centre_m, *stage.orbit_m, sign * rate, start, 0.12, 0.3, *periods_s)
        return mounted(body, camera(0.0))
    if family in ("radial", "vertical"):
        place = [between(k, stage.low_m[k], stage.high_m[k]) for k in range(3)]
        swing = Swinging.radial if family == "radial" else Swinging.vertical
        start = body_at(place, stage.target_m)
        return mounted(swing(start, between(3, 0.15, 0.3), between(4, 0.4, 0.7)), camera(0.0))
    if family == "driving":
        turn = stage.turn_rad_s * between(0, 0.8, 1.2) * (1 if u[1] < 0.5 else -1)
        x_m, y_m = stage.start_m
        body = Driving(
            generator,
            until_s,
            between(2, 0.3, 0.6),
            turn,
            turn_swing_rad_s=0.4 if turn else 0.15,
            height_m=stage.height_m,
            x_m=x_m,
            y_m=y_m,
            yaw_rad=stage.yaw_rad + (between(3, -math.pi, math.pi) if turn else 0.0),
        )
        return mounted(body, camera(0.05, yaw_rad=stage.aside_rad, pitch_rad=stage.pitch_rad))
    try:
        body = Flying.random(generator, until_s, stage.low_m, stage.high_m, stage.target_m)
    except DomainError:  # too fast for the draw of waypoints
        return None
    return mounted(body, camera(0.05, pitch_rad=stage.pitch_rad))


def _keeps_clear(T_world_cam, scene, camera):
    """Whether a coarse grid of chief rays meets something, but nothing too near, at every pose."""
    pixels = camera.film.pixels()
    rays = camera.chief_rays(pixels[:: max(1, len(pixels) // 97)])
    T_world_cam = T_world_cam.to(rays.origin_m.device)
    with torch.no_grad():
        hits = first_hits(rays.origin_m, rays.direction, rays.weight > 0, scene, T_world_cam[None])
    seen = (hits.part >= 0).double().mean(1)
    return bool(((seen >= SEEN) & (hits.distance_m.amin(1) >= CLEAR_M)).all())
