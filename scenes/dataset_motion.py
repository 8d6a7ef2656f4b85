"""Which path a camera takes through a world: one of five families, drawn at random until it keeps clear of
everything."""

import math

import torch

from codesign.errors import DomainError
from codesign.mount import Mount
from codesign.render.hits import first_hits
from scenes.trajectories import Driving, Flying, Orbital, Swinging, body_at, mounted

FAMILIES = ("orbital", "radial", "vertical", "driving", "flying")
TRIES = 200
CLEAR_M = 0.15  # the least depth a path may come to
SEEN = 0.35  # the least share of the picture that shows something
PROBES = 24  # poses at which a path is looked at
LEAD_S = 0.6  # flights start from rest: recorded from here on


def motion(family, stage, scene, camera, duration_s, generator):
    """A camera trajectory of a family, that lasts ``duration_s`` from ``LEAD_S`` on and keeps its distance.

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

    level = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))().detach()
    tilted = Mount(
        (0.0, 0.0, 0.05), (0.0, 0.0, 0.0), yaw_rad=stage.aside_rad, pitch_rad=stage.pitch_rad
    )().detach()
    if family == "orbital":
        rate = min(between(0, 0.4, 0.8), stage.sweep_rad / until_s / 1.3)
        start = -math.pi / 2 + (
            between(1, -math.pi, math.pi) if math.isinf(stage.sweep_rad) else -rate * until_s / 2
        )
        sign = 1 if u[2] < 0.5 or not math.isinf(stage.sweep_rad) else -1
        body = Orbital(
            stage.centre_m or stage.target_m,
            stage.orbit_m[0],
            stage.orbit_m[1],
            sign * rate,
            start,
            0.12,
            0.3,
            between(3, 1.5, 3.0),
            between(4, 1.5, 3.0),
        )
        return mounted(body, level)
    if family in ("radial", "vertical"):
        place = [
            low + (high - low) * share
            for low, high, share in zip(stage.low_m, stage.high_m, u[:3], strict=True)
        ]
        swing = Swinging.radial if family == "radial" else Swinging.vertical
        return mounted(
            swing(body_at(place, stage.target_m), between(3, 0.15, 0.3), between(4, 0.4, 0.7)), level
        )
    if family == "driving":
        turn = stage.turn_rad_s * between(0, 0.8, 1.2) * (1 if u[1] < 0.5 or not stage.turn_rad_s else -1)
        start = dict(zip(("x_m", "y_m"), stage.start_m, strict=True))
        speed = between(2, 0.3, 0.6)
        body = Driving(
            generator,
            until_s,
            speed,
            turn,
            turn_swing_rad_s=0.4 if turn else 0.15,
            height_m=stage.height_m,
            **start,
            yaw_rad=stage.yaw_rad + (between(3, -math.pi, math.pi) if turn else 0.0),
        )
        return mounted(body, tilted)
    try:
        body = Flying.random(generator, until_s, stage.low_m, stage.high_m, stage.target_m)
    except DomainError:  # too fast for the draw of waypoints
        return None
    return mounted(body, Mount((0.0, 0.0, 0.05), (0.0, 0.0, 0.0), pitch_rad=stage.pitch_rad)().detach())


def _keeps_clear(T_world_cam, scene, camera):
    """Whether a coarse grid of chief rays meets something, but nothing too near, at every pose."""
    pixels = camera.film.pixels()
    rays = camera.chief_rays(pixels[:: max(1, len(pixels) // 97)])
    with torch.no_grad():
        hits = first_hits(rays.origin_m, rays.direction, rays.weight > 0, scene, T_world_cam[None])
    seen = (hits.part >= 0).double().mean(1)
    return bool(((seen >= SEEN) & (hits.distance_m.amin(1) >= CLEAR_M)).all())
