"""Five scenes before the same lens, each with an object that can be moved: a smooth plane in
float64, a textured room, occluders, the robot in its own view, and a room near darkness."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from codesign import lens, pose, render
from codesign.render.sequence import Way
from scenes import silhouettes, worlds

SIZE_PX = 32
WIDTH_MM = 8.0  # of the film
FRAMES = 5
DURATION_S = 0.05
# of the camera over the time, metres and radians, in its own axes: about two pixels
MOTION = torch.tensor([0.12, -0.08, 0.1, 0.02, -0.03, 0.04], dtype=torch.float64)
POSE = tuple(f"pose {name}" for name in ("x", "y", "z", "about x", "about y", "about z"))
OBJECT = "object pose"
# unit steps: each moves the rays on the film by about a tenth of a pixel
LENS_UNITS = {
    "curvature_per_mm": 2e-3,
    "thickness_mm": 6e-2,
    "conic": 0.15,
    "asphere": 1.5e-4,
    "index_offset": 4e-3,
    "phase": 12.0,
    "decentre_mm": 1.2e-2,
    "tilt_rad": 2.5e-3,
}
TWIST_UNITS = torch.tensor([4e-3, 4e-3, 8e-3, 2e-3, 2e-3, 4e-3], dtype=torch.float64)
START = ((0.05, -1.2, 1.0), (0.0, 1.0, 0.7))
T_S = torch.linspace(0, DURATION_S, FRAMES, dtype=torch.float64)
Numbers = Mapping[str, Tensor]


@dataclass(frozen=True)
class Scene:
    """A world, an object in it with its pose, the camera's first pose, and the way to the frames'
    gradient.

    on_object: whether the camera stands on the object, which carries it along. step: of
      differences, in unit steps: small where textures have texels, as large as bending allows where
      silhouettes make noise. near: share of a step of translations, before something near.
    """

    world: render.moving.Scene
    thing: render.moving.Scene
    T_world_object: Tensor
    T_world_cam: Tensor
    way: Way = "interior"
    on_object: bool = False
    step: float = 1.0
    near: float = 1.0

    def at(self, numbers: Numbers) -> tuple[render.MovingScene, Tensor]:
        """The moving scene and the camera's path [FRAMES, 4, 4], changed by twists: numbers' "pose
        ..." [1] of the camera and "object pose" [6], each in its own axes."""
        along = torch.linspace(-0.5, 0.5, FRAMES, dtype=torch.float64)[:, None]
        moved = pose.se3_exp(along * MOTION)
        turn = pose.se3_exp(torch.cat([numbers[name] for name in POSE])[None])
        resting = self.T_world_object.expand(FRAMES, 4, 4)
        objects = resting @ moved if self.on_object else resting
        path = objects @ self.T_world_cam if self.on_object else self.T_world_cam @ moved
        objects = objects @ pose.se3_exp(numbers[OBJECT][None])
        return render.MovingScene(self.world, {"object": (self.thing, objects)}), path @ turn


def optics() -> lens.GeoLens:
    """The triplet, with a polynomial and a phase on every surface, both zero."""
    geo = lens.load("cooke-triplet").scaled(0.22)
    given = {"asphere": (0.0,), "phase": lens.Phase((0.0,))}
    surfaces = [dataclasses.replace(s, **given) for s in geo.surfaces]
    return lens.GeoLens(surfaces, geo.entrance_pupil_diameter_mm).freeze()


def point() -> dict[str, Tensor]:
    """Where gradients are asked for: lens tensors by kind, six components of the camera's pose, the
    object's pose."""
    geo = optics()
    zeros = {name: torch.zeros(1, dtype=torch.float64) for name in POSE}
    kinds = {name: getattr(geo, name).detach() for name in LENS_UNITS}
    return {**kinds, **zeros, OBJECT: torch.zeros(6, dtype=torch.float64)}


def steps(name: str) -> dict[str, Tensor]:
    """Steps of ``point``'s numbers in the scene of that name, in the shape of each."""
    before = scene(name)
    twist = TWIST_UNITS * torch.tensor([before.near] * 3 + [1.0] * 3, dtype=torch.float64)
    twists = dict(zip(POSE, twist.split(1), strict=True))
    kinds = {kind: torch.tensor(unit).double() for kind, unit in LENS_UNITS.items()}
    kinds["index_offset"] = kinds["index_offset"] * optics().glass
    units = {**kinds, **twists, OBJECT: twist}
    return {key: before.step * units[key].expand(value.shape) for key, value in point().items()}


def camera(numbers: Numbers, samples: int, seed: int) -> render.Camera:
    geo = optics().replace(**{name: numbers[name] for name in LENS_UNITS})
    return render.Camera(geo, SIZE_PX, SIZE_PX, WIDTH_MM / SIZE_PX, samples, seed)


def _plane():
    wall = worlds.smooth_plane(0, pose.look_at((0, 0, 0), (0, -1, 0)), finest_period_m=0.3)
    return Scene(_behind(), wall, _eye(), pose.look_at((0.1, -2, 0.05), (0, 0, 0)), step=0.02)


def _room():
    start = pose.look_at((0.3, -0.8, 1.2), (0.1, 2.0, 1.0))
    return Scene(_behind(), worlds.room(objects=False), _eye(), start, step=0.05)


def _occluders():
    ball = pose.se3_exp(torch.tensor([0.0, 1.7, 1.3, 0, 0, 0], dtype=torch.float64))
    start = pose.look_at(*START)
    return Scene(silhouettes.build("cubes"), silhouettes.ball(), ball, start, "boundary")


def _robot():
    stand = pose.se3_exp(torch.tensor([0.05, -1.2, 1.0, 0.0, 0.0, 0.1], dtype=torch.float64))
    mounted = pose.look_at((0.0, 0.0, 0.0), (0.0, 1.0, -0.15))
    return Scene(
        silhouettes.room(), silhouettes.robot(), stand, mounted, "boundary", True, near=0.2
    )


def _dark():
    start = pose.look_at(*worlds.VIEWS["dark-room"])
    return Scene(_behind(), worlds.dark_room(), _eye(), start, "boundary")


def _behind():
    """What is seen where the object is not: nothing, since the object is the whole world."""
    return worlds.smooth_plane(1, pose.look_at((0, 50, 0), (0, -1, 0)))


def _eye():
    return torch.eye(4, dtype=torch.float64)


# scenes whose gradient has a boundary term
SILHOUETTES = ("occluders", "robot in view", "dark room")
BUILDERS: dict[str, Callable[[], Scene]] = {
    "smooth plane": _plane,
    "textured room": _room,
    "occluders": _occluders,
    "robot in view": _robot,
    "dark room": _dark,
}


@cache
def scene(name: str) -> Scene:
    """The scene of that name, built once."""
    return BUILDERS[name]()
