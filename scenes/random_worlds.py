"""Random worlds by number, for gradients at silhouettes: boxes, poles, balls, discs, meshes, floors and walls,
0.3 to 20 m away and from a fifth of a pixel to half the film in size; some that pass through each other.

Nothing stands along rows of pixels: an edge there is a kink for differences. Textures are smooth at the scale of
a pixel, so that the silhouettes are what is tested.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign import backend, pose
from codesign.render import MitsubaScene
from scenes import random_shapes as shapes
from scenes.random_shapes import Hull, Shape, gap_m, painted

WIDTH_PX = 28  # of the square film that sizes are meant for
HALF_SLOPE = 4 / 11  # from the middle of the film to its border
SLOPE_PER_PX = 2 * HALF_SLOPE / WIDTH_PX
NEAR_M, FAR_M = 0.3, 20.0
CLEAR_M = 0.15  # around the camera
TRIES = 25
# kinds of things and how often they come; the first of a world is one of the solid ones, in view
THINGS = {"box": 4, "pole": 3, "capped pole": 3, "ball": 3, "disc": 2, "card": 2, "mesh": 7}
SOLID = ("box", "pole", "ball", "mesh")
MESHES = ("ball", "hull", "torus", "sheet", "bowl")
BACKGROUNDS = ("wall", "room", "sky", "nothing")


@dataclass(frozen=True)
class Draw:
    """One random world before a camera. shapes: in room axes; T_world_room, T_world_cam [4, 4]; sky: radiance
    all around, or None. lens_scale: size of the lens over one of 11 mm; focus_m: distance in focus.

    crosses: whether two shapes pass through each other, or may. facts: what was drawn, in plain values."""

    seed: int
    shapes: list[Shape]
    T_world_room: np.ndarray
    T_world_cam: Tensor
    sky: float | None
    lens_scale: float
    focus_m: float
    crosses: bool
    facts: dict[str, Any] = field(default_factory=dict)

    def scene(self, device: str = "cpu") -> MitsubaScene:
        """The world as a scene of its own."""
        mi = backend.mitsuba(device)
        found = {shape.name: shape.description(mi, self.T_world_room) for shape in self.shapes}
        if self.sky is not None:
            found["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": self.sky}}
        return MitsubaScene(found, device)


def draw(seed: int) -> Draw:
    """The world of this number: the same one every time."""
    rng = np.random.default_rng([seed, 15])
    plan = {
        "background": str(rng.choice(BACKGROUNDS, p=(0.35, 0.35, 0.2, 0.1))),
        "crosses": bool(rng.random() < 0.15),
        "border": bool(rng.random() < 0.25),
        "behind": bool(rng.random() < 0.15),
        "far_m": float(np.exp(rng.uniform(np.log(10), np.log(100)))) if rng.random() < 0.15 else 0.0,
    }
    T_room_cam, background, deepest_m = _stage(rng, plan["background"])
    sky = float(rng.uniform(10, 200)) if plan["background"] == "sky" or rng.random() < 0.15 else None
    world = _Builder(rng, T_room_cam, background, deepest_m, plan["border"])
    for k in range(int(rng.integers(1, 7))):
        weights = np.array(list(THINGS.values())) / sum(THINGS.values())
        kind = str(rng.choice(SOLID) if k == 0 else rng.choice(list(THINGS), p=weights))
        world.add_thing(f"thing{k}", kind, smallest_px=2.0 if k == 0 else 0.2)
    if plan["background"] == "room":
        for k in range(int(rng.integers(0, 3))):
            world.add_standing(f"standing{k}")
    if plan["behind"]:
        world.add_from_behind()
    if plan["crosses"]:
        world.add_crossing()
    T_world_room = shapes.frame(rng.standard_normal(3), turn=rng.uniform(0, 2 * np.pi))
    away = rng.standard_normal(3)
    T_world_room[:3, 3] = away / np.linalg.norm(away) * (plan["far_m"] or rng.uniform(0, 3))
    in_focus = rng.random() < 0.5 and world.depths
    focus_m = rng.choice(world.depths) if in_focus else float(np.exp(rng.uniform(np.log(0.25), np.log(30))))
    facts = {
        **plan,
        "crosses": world.crosses,
        "sky": sky is not None,
        "touches": world.touches,
        "things": [[shape.name, shape.kind, round(shape.px, 2)] for shape in world.found],
    }
    return Draw(
        seed,
        world.found,
        T_world_room,
        torch.as_tensor(T_world_room @ T_room_cam),
        sky,
        float(np.exp(rng.uniform(0, np.log(10)))),
        float(max(focus_m, 0.25)),
        world.crosses,
        facts,
    )


def _stage(rng, background):
    """T_room_cam [4, 4], the shapes of the background, and how deep things may stand."""
    if background == "wall":
        distance = float(np.exp(rng.uniform(np.log(1.0), np.log(FAR_M))))
        lean = np.array([*rng.uniform(-0.4, 0.4, 2), -1.0])
        placed = shapes.frame(lean, (0, 0, distance), rng.uniform(0.1, 1.4))
        return np.eye(4), [shapes.card("wall", placed, [2 * distance] * 2, painted(rng, 60), 99)], distance
    if background != "room":
        return np.eye(4), [], FAR_M
    size = float(np.exp(rng.uniform(np.log(1.5), np.log(15))))
    eye = (0.0, 0.0, size * rng.uniform(0.2, 0.5))
    target = (rng.uniform(-0.3, 0.3) * size, size, rng.uniform(0, 0.4) * size)
    roll = torch.tensor([0, 0, 0, 0, 0, float(rng.choice([-1, 1]) * rng.uniform(0.1, 0.6))]).double()
    T_room_cam = (pose.look_at(eye, target) @ pose.se3_exp(roll)).numpy()
    return T_room_cam, _room(rng, size), size


def _room(rng, size):
    """A floor whose far edge meets the lower edges of two walls, and whose right edge meets a part of a third."""
    width = size * rng.uniform(0.4, 1.0)
    seam = width * rng.uniform(-0.5, 0.5)
    floor = np.eye(4)
    floor[:3, 3] = [0, size / 2 - 0.5, 0]
    found = [shapes.card("floor", floor, [width, size / 2 + 0.5], painted(rng, 30), 99)]
    for name, left, right in (("left", -width, seam), ("right", seam, width)):
        height = size * rng.uniform(0.2, 0.8)
        placed = np.eye(4)
        placed[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        placed[:3, 3] = [(left + right) / 2, size, height / 2]
        half = [(right - left) / 2, height / 2]
        found.append(shapes.card(f"wall {name}", placed, half, painted(rng, 20), 99))
    if rng.random() < 0.6:
        length = size * rng.uniform(0.3, 0.9)
        height = size * rng.uniform(0.1, 0.6)
        placed = np.eye(4)
        placed[:3, :3] = [[0, 0, -1], [-1, 0, 0], [0, 1, 0]]
        placed[:3, 3] = [width, size - length / 2, height / 2]
        found.append(shapes.card("wall aside", placed, [length / 2, height / 2], painted(rng, 20), 99))
    return found


class _Builder:
    """Adds things to a world so that none passes through another, unless it is asked to."""

    def __init__(self, rng, T_room_cam, background, deepest_m, border):
        self.rng = rng
        self.T_room_cam = T_room_cam
        self.found = list(background)
        self.deepest_m = deepest_m
        self.border = border
        self.crosses = self.touches = False
        self.depths = []
        eye = T_room_cam[None, :3, 3]
        self.camera = Hull(eye, np.array([CLEAR_M]), np.zeros((1, 3)))

    def fits(self, candidates, exempt=()):
        return all(
            gap_m(shape.hull, other) > 1e-4
            for shape in candidates
            for other in (self.camera, *(s.hull for s in self.found if s.name not in exempt))
        )

    def place(self, border):
        """A point in camera axes, beside the film's border or in view, and its distance."""
        rng = self.rng
        depth = float(np.exp(rng.uniform(np.log(NEAR_M), np.log(self.deepest_m))))
        slope = rng.uniform(-0.9, 0.9, 2) * HALF_SLOPE
        if border and rng.random() < 0.6:
            slope[rng.integers(2)] = rng.choice([-1, 1]) * rng.uniform(0.9, 1.3) * HALF_SLOPE
        return np.array([*slope, 1.0]) * depth, depth

    def add_thing(self, name, kind, smallest_px=0.2):
        """A thing somewhere in the view where it fits; after some tries none."""
        for _ in range(TRIES):
            at, depth = self.place(self.border and smallest_px < 1)
            made = self.make(name, kind, at, depth, smallest_px)
            if self.fits(made):
                self.found += made
                self.depths.append(depth)
                return

    def make(self, name, kind, at, depth, smallest_px=0.2):
        """The shapes of a thing at a point [3] in camera axes."""
        rng = self.rng
        px = float(np.exp(rng.uniform(np.log(smallest_px), np.log(WIDTH_PX / 2))))
        size = px * SLOPE_PER_PX * depth / 2
        placed = self.T_room_cam @ shapes.frame(rng.standard_normal(3), at, rng.uniform(0, 2 * np.pi))
        paint = painted(rng, px)
        if kind == "box":
            return [shapes.box(name, placed, size * rng.uniform(0.3, 1, 3), paint, px)]
        if kind in ("pole", "capped pole"):
            return self.make_pole(name, placed, depth, kind == "capped pole")
        if kind == "ball":
            return [shapes.ball(name, placed, size, paint, px)]
        if kind == "disc":
            return [shapes.disc(name, placed, size, paint, px)]
        if kind == "card":
            return [shapes.card(name, placed, size * rng.uniform(0.3, 1, 2), paint, px)]
        which = str(rng.choice(MESHES))
        vertices, faces = {
            "ball": lambda: shapes.icosphere(int(rng.integers(1, 4))),
            "hull": lambda: shapes.random_hull(rng),
            "torus": lambda: shapes.torus(24, 12, rng.uniform(0.2, 0.6)),
            "sheet": lambda: shapes.sheet(rng, 6),
            "bowl": lambda: shapes.bowl(2),
        }[which]()
        colouring = str(rng.choice(["faces", "uv", "plain"]))
        return [shapes.mesh(f"{name} {which} {colouring}", placed, size, vertices, faces, colouring, rng, px)]

    def make_pole(self, name, placed, depth, capped):
        """A cylinder whose middle is at the frame's origin, a fifth of a pixel to eight pixels thick."""
        rng = self.rng
        px = float(np.exp(rng.uniform(np.log(0.2), np.log(8))))
        radius = px * SLOPE_PER_PX * depth / 2
        length = max(float(np.exp(rng.uniform(np.log(3), np.log(40)))) * SLOPE_PER_PX * depth, radius)
        start = placed.copy()
        start[:3, 3] -= length / 2 * placed[:3, 2]
        shown = painted(rng, px, textured=False)
        found = [shapes.tube(name, start, length, radius, shown, px)]
        if capped:
            for end, sign in (("low", -1), ("high", 1)):
                middle = placed[:3, 3] + sign * length / 2 * placed[:3, 2]
                lid = shapes.frame(sign * placed[:3, 2], middle)
                found.append(shapes.disc(f"{name} {end}", lid, radius, float(rng.uniform(5, 240)), px))
        return found

    def add_standing(self, name):
        """A box on the floor, with a gap or none, or a ball that just touches it."""
        rng = self.rng
        for _ in range(TRIES):
            slope = rng.uniform(-0.8, 0.8, 2) * HALF_SLOPE
            towards = self.T_room_cam[:3, :3] @ [*slope, 1.0]
            eye = self.T_room_cam[:3, 3]
            if towards[2] > -1e-3:
                continue
            depth = -eye[2] / towards[2]
            at = eye + depth * towards
            px = float(np.exp(rng.uniform(np.log(0.5), np.log(WIDTH_PX / 2))))
            half = px * SLOPE_PER_PX * depth / 2 * rng.uniform(0.3, 1, 3)
            gap = float(rng.choice([0.0, 1e-3, 0.02]))
            if rng.random() < 0.3:
                at[2] = half[0] + gap
                made = shapes.ball(name, shapes.frame([0, 0, 1], at), half[0], painted(rng, px), px)
            else:
                at[2] = half[2] + gap
                placed = shapes.frame([0, 0, 1], at, rng.uniform(0, np.pi))
                made = shapes.box(name, placed, half, painted(rng, px), px)
            if self.fits([made], exempt=("floor",)):
                self.found.append(made)
                self.depths.append(float(depth))
                self.touches |= gap == 0
                return

    def add_from_behind(self):
        """A pole that begins behind the camera and ends in the view."""
        rng = self.rng
        for _ in range(TRIES):
            depth = float(np.exp(rng.uniform(np.log(NEAR_M), np.log(3.0))))
            end = np.array([*rng.uniform(-0.8, 0.8, 2) * HALF_SLOPE, 1.0]) * depth
            start = np.array([*rng.choice([-1, 1], 2) * rng.uniform(0.3, 0.8, 2), -rng.uniform(0.05, 1)])
            length = float(np.linalg.norm(end - start))
            placed = self.T_room_cam @ shapes.frame(end - start, start)
            radius = rng.uniform(0.3, 4) * SLOPE_PER_PX * depth / 2
            px = 2 * radius / SLOPE_PER_PX / depth
            made = shapes.tube("beside", placed, length, radius, painted(rng, px, textured=False), px)
            if self.fits([made]):
                self.found.append(made)
                return

    def add_crossing(self):
        """A thing whose middle lies on the surface of another, so that the two pass through each other."""
        rng = self.rng
        if not self.found:
            return
        other = self.found[int(rng.integers(len(self.found)))]
        towards = rng.standard_normal(3)
        at = other.hull.furthest(towards)
        eye = self.T_room_cam
        at_cam = eye[:3, :3].T @ (at - eye[:3, 3])
        kind = str(rng.choice(["box", "pole", "ball", "mesh"]))
        made = self.make("crossing", kind, at_cam, float(np.linalg.norm(at_cam)))
        if all(gap_m(shape.hull, self.camera) > 0 for shape in made):
            self.crosses = not self.fits(made)
            self.found += made
