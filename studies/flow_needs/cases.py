"""What the lens is used on: textured worlds, and motions of stated length before them."""

import math
from collections.abc import Iterator
from functools import cache

import numpy as np
import torch

from codesign import pose, render
from codesign.errors import DomainError
from codesign.lens import Pinhole
from codesign.render.truth import world_points
from codesign.system import Batch
from scenes import textures, trajectories, worlds

SENSOR_PX = (346, 260)  # DAVIS346: 346 x 260 pixels of 18.5 um
PITCH_MM = 18.5e-3
EFL_MM = 11.0
EDGE_MM = math.hypot(*SENSOR_PX) / 2 * PITCH_MM
WINDOW_PX = 64
CENTRE = tuple((n - WINDOW_PX) // 2 for n in SENSOR_PX)
CORNER = tuple(n - WINDOW_PX for n in SENSOR_PX)
WINDOWS = {"centre": CENTRE, "corner": CORNER}
DURATION_S = 0.05
FRAMES = 13
WALL_M = 2.0
ROOM_M = (4.0, 4.0, 2.6)
PHOTOS = ("brick", "astronaut", "hubble_deep_field")
TEXTURES = ("photos", "fine", "coarse", "rooms")
TOGETHER = 10  # cases of one batch, with one set of film samples and of sensor noise
# standard deviations per pixel of motion: approach as a share of the distance, and roll in radians
APPROACH = 0.005
ROLL = 0.003


def film(window: str) -> render.Film:
    """One window of 64 x 64 pixels in the middle of the sensor, or in its corner."""
    return render.Film(*SENSOR_PX, WINDOW_PX, WINDOW_PX, PITCH_MM, (WINDOWS[window],))


@cache
def pool(texture: str) -> tuple[render.MitsubaScene, ...]:
    """The worlds of a kind of texture. A pixel sees 3.4 mm of the walls, which are 2 m away.

    photos: photographs, 3 mm a texel. fine: speckle with periods of 2.2 to 7 pixels. coarse: of 16 to 70 pixels.
    rooms: photographs of 2.6 mm a texel on all sides, with crates and a ball, seen from within.
    """
    if texture not in TEXTURES:
        raise DomainError(f"texture {texture!r} is not known; give one of {', '.join(TEXTURES)}.")
    if texture == "photos":
        return tuple(worlds.wall(textures.shrunk(textures.photo(name), 2), 0.003) for name in PHOTOS)
    if texture == "rooms":
        pictures = [
            np.tile(textures.photo(name), (3, 3)) for name in (*PHOTOS, "coffee", "gravel", "chelsea")
        ]
        return (worlds.room(pictures, ROOM_M),)
    finest, coarsest = {"fine": (5.0, 16.0), "coarse": (36.0, 160.0)}[texture]
    return tuple(
        worlds.wall(textures.speckle(seed, finest_px=finest, coarsest_px=coarsest), 0.0015)
        for seed in (1, 2, 3)
    )


def batches(texture: str, speed_px: float, count: int, seed: int) -> Iterator[Batch]:
    """``count`` cases in batches of at most TOGETHER; the same at every call.

    A case is a place, and a motion along the film by ``speed_px`` at the median distance seen, in any direction,
    with some approach and roll in proportion.
    """
    for first in range(0, count, TOGETHER):
        numbers = range(first, min(first + TOGETHER, count))
        drawn = [_draw(texture, speed_px, 1_000_003 * (seed + 1) + k) for k in numbers]
        scenes, poses, t_s = zip(*drawn, strict=True)
        yield Batch(torch.stack(poses), t_s[0], scenes, 7919 * (seed + 1) + first)


def _draw(texture, speed_px, seed):
    generator = torch.Generator().manual_seed(seed)
    worlds_there = pool(texture)
    scene = worlds_there[int(torch.randint(len(worlds_there), (1,), generator=generator))]
    start = _inside(generator) if texture == "rooms" else _before_wall(generator)
    away_m = median_depth_m(scene, start)
    angle = 2 * math.pi * float(torch.rand(1, generator=generator, dtype=torch.float64))
    approach, roll = torch.randn(2, generator=generator, dtype=torch.float64).tolist()
    along_m = speed_px * PITCH_MM / EFL_MM * away_m
    motion = torch.tensor(
        [
            along_m * math.cos(angle),
            along_m * math.sin(angle),
            speed_px * APPROACH * approach * away_m,
            0.0,
            0.0,
            speed_px * ROLL * roll,
        ],
        dtype=torch.float64,
    )
    t_s = torch.linspace(0, DURATION_S, FRAMES, dtype=torch.float64)
    return scene, trajectories.body_twist(start, motion / DURATION_S, t_s), t_s


def _before_wall(generator):
    x, z = (2 * torch.rand(2, generator=generator, dtype=torch.float64) - 1).tolist()
    return pose.look_at((x, -WALL_M, z), (x, 0.0, z))


def _inside(generator):
    """Anywhere in a room above its furniture and at least 0.2 m from its walls, looking anywhere but steeply."""
    x, y, z, ahead, height = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
    at = ((x - 0.5) * (ROOM_M[0] - 0.4), (y - 0.5) * (ROOM_M[1] - 0.4), 0.8 + z * (ROOM_M[2] - 1.2))
    turn = 2 * math.pi * ahead
    return pose.look_at(at, (at[0] + math.cos(turn), at[1] + math.sin(turn), at[2] + height - 0.7))


def median_depth_m(scene: render.MitsubaScene, T_world_cam: torch.Tensor) -> float:
    """Median depth over a coarse grid of the sensor, from one pose, in metres."""
    camera = render.Camera(Pinhole(EFL_MM), *SENSOR_PX, PITCH_MM)
    rays = camera.chief_rays(render.film.coarse_pixels(camera.film, 40))
    _, depth_m, valid = world_points(rays, scene, T_world_cam)
    return float(depth_m[valid].median())
