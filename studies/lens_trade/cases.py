"""Scenes, motions and judgement of the trade study: textured walls 0.3 to 5 m away, seen at a slant, in polychromatic light."""

import math
from dataclasses import dataclass
from functools import cache

import torch

from codesign import events, flow, lens, pose, render
from codesign.events import HardSensor
from codesign.lens import WAVELENGTH_UM, GeoLens
from codesign.system import Batch, System
from scenes import textures, trajectories, worlds
from studies.lens_opt.task import BINS, DURATION_S, PITCH_MM, SENSOR, WINDOW_PX, film, log_error
from studies.lens_trade.problem import FAR_M, LINES, NEAR_M

FRAMES = 9
MOST_SLANT_RAD = math.radians(45)
# standard deviations over the interval: sideways, up and along, in distances to the wall; pitch, yaw and roll, radians
MOTION = torch.tensor([0.006, 0.006, 0.01, 0.001, 0.001, 0.006], dtype=torch.float64)
# textures on which designs are chosen
DEVELOPMENT = ("camera", "coffee", "speckle-2:0.7")
OCTAVES = 4  # walls per texture: texels grow with distance, so that they keep their size in pixels


@dataclass(frozen=True)
class Light:
    """What the sensor makes of the light: its model, and the radiance at f/2.8 over that of daylight."""

    sensor: events.SensorModel = SENSOR
    share: float = 1.0
    at_fno: float = 2.8

    def gain(self, fno: float) -> float:
        """Factor of the frames at an f-number."""
        return self.share * (self.at_fno / fno) ** 2


@cache
def spectrum() -> lens.Spectrum:
    """The three lines of the spots, of equal signal."""
    return lens.Spectrum(tuple(WAVELENGTH_UM[line] for line in LINES), (1 / 3,) * 3)


@cache
def walls(name: str, octave: int):
    """A wall of one texture for distances about NEAR (FAR / NEAR)^((octave + 1/2) / OCTAVES)."""
    name, _, zoom = name.partition(":")
    pattern = (
        textures.speckle(int(name.split("-")[1])) if name.startswith("speckle-") else textures.photo(name)
    )
    distance = NEAR_M * (FAR_M / NEAR_M) ** ((octave + 0.5) / OCTAVES)
    return worlds.wall(
        textures.shrunk(pattern, 2),
        texel_m=0.0015 * distance * float(zoom or 1),
        half_width_m=6 * distance,
    )


def judged_cases(names: tuple[str, ...], first: int, count: int, efl_mm: float) -> list[Batch]:
    """Cases whose distances are spread evenly over the range, one in each of ``count`` strata, and whose textures take
    turns: fewer of them tell two lenses apart."""
    strata = torch.randperm(count, generator=torch.Generator().manual_seed(first)).tolist()
    return [
        draw_case((names[i % len(names)],), first + i, efl_mm, (strata[i] + 0.5) / count)
        for i in range(count)
    ]


def draw_case(
    names: tuple[str, ...], seed: int, efl_mm: float = 11.0, distance_share: float | None = None
) -> Batch:
    """A texture out of ``names``, a distance even in its logarithm, a slant and a motion, all from one seed.

    The motion covers the same pixels at every distance and focal length. distance_share: where on the way from near to
    far, in the logarithm, instead of a random place.
    """
    generator = torch.Generator().manual_seed(seed)
    name = names[int(torch.randint(len(names), (1,), generator=generator))]
    share, slant, turn, x, z = torch.rand(5, generator=generator, dtype=torch.float64).tolist()
    share = share if distance_share is None else distance_share
    motion = MOTION * torch.randn(6, generator=generator, dtype=torch.float64)
    distance = NEAR_M * (FAR_M / NEAR_M) ** share
    world = walls(name, min(int(share * OCTAVES), OCTAVES - 1))
    tangent = math.tan(MOST_SLANT_RAD * (2 * slant - 1))
    at = ((2 * x - 1) * distance, 0.0, (2 * z - 1) * distance)
    away = 1 / math.hypot(1, tangent)
    eye = (
        at[0] + distance * away * tangent * math.cos(2 * math.pi * turn),
        -distance * away,
        at[2] + distance * away * tangent * math.sin(2 * math.pi * turn),
    )
    t_s = torch.linspace(0, DURATION_S, FRAMES, dtype=torch.float64)
    size = torch.tensor([distance] * 3 + [1.0] * 3, dtype=torch.float64) * (11.0 / efl_mm)
    return Batch(
        trajectories.body_twist(pose.look_at(eye, at), motion * size / DURATION_S, t_s), t_s, world, seed
    )


def camera(geo: GeoLens, samples: int, seed: int = 0) -> render.Camera:
    return render.Camera(geo, WINDOW_PX, WINDOW_PX, PITCH_MM, samples, seed, film(), spectrum=spectrum())


def system(seen_by, layer, light: Light, fno: float) -> System:
    """System of a camera (or what makes one) whose objective is the log of the angular error over the windows."""
    gain = light.gain(fno)

    def shown(camera, scene, T_world_cam, rays):
        return gain * render.frames(camera, scene, T_world_cam, rays=rays)

    return System(
        camera=seen_by,
        render=shown,
        events=layer,
        flow=flow.estimate_lk,
        objectives={"flow": log_error()},
        bins=BINS,
    )


def hard_log_error(geo: GeoLens, case: Batch, light: Light, fno: float, samples: int = 30) -> float:
    """Mean log angular error (mrad) of a lens on a case with the hard sensor."""
    with torch.no_grad():
        return float(system(camera(geo, samples), HardSensor(light.sensor, BINS), light, fno)(case).loss)


def smooth_layer(light: Light):
    return events.layer("memory", light.sensor, learn=())
