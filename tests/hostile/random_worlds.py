"""Random worlds by number, for gradients at silhouettes: things that stick in each other, lie in
each other, are small and far, mirrored, or move, before sequences of views.

Everything is drawn in the axes of the first camera, where the film says how large things are, and
nothing is asked of the renderer. Only things that move keep clear of the others: those that stick
in each other are refused, as the docs say.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from torch import Tensor

from codesign import backend
from codesign.render import MitsubaScene, MovingScene
from codesign.render.charts import emissive_mesh

WIDTH_PX = 28  # of the square film that sizes are meant for
WIDEST = 4 / 11  # slope at the border of the film, at most
FRAMES = 3
# radii from which round shapes are seen at most: half of where float32 rays lose their edges
ROUNDEST = 1000
BACKGROUNDS = ("wall", "room", "sky", "nothing")
EDGED = ("cube", "card", "hull", "ring", "sheet", "fine", "bowl")
KINDS = ("ball", "tube", "can", "disc", *EDGED)
NEIGHBOURS = ("apart", "stuck", "nested")


@dataclass(frozen=True)
class Draw:
    """A random world before a camera on its way. T_world_cam: [FRAMES, 4, 4]; half_slope: of the
    film's border. lens_scale:
    size of the lens over one of 11 mm; focus_m: distance in focus. facts: what was drawn, in plain
    values."""

    seed: int
    scene: MitsubaScene | MovingScene
    T_world_cam: Tensor
    half_slope: float
    lens_scale: float
    focus_m: float
    facts: dict[str, Any] = field(default_factory=dict)


def draw(seed: int) -> Draw:
    """The world of this number: the same one every time."""
    rng = np.random.default_rng([seed, 2026])
    half = _between(rng, 0.02, WIDEST)
    depth = _between(rng, 0.5, 100)
    background = str(rng.choice(BACKGROUNDS, p=(0.4, 0.25, 0.25, 0.1)))
    turn = Rotation.random(random_state=rng)
    T_world_first = _rigid(turn, rng.standard_normal(3) * _between(rng, 0.1, 30))
    world = _World(rng, T_world_first, half, depth)
    world.add_background(background)
    for _ in range(int(rng.integers(1, 4))):
        world.add_cluster()
    moving = {}
    for k in range(int(rng.choice([0, 1, 2], p=(0.65, 0.25, 0.1)))):
        world.add_moving(f"moving{k}", moving)
    scene: Any = MitsubaScene(world.shapes, merge=False)
    if moving:
        scene = MovingScene(scene, moving)
    # a walk of some pixels a frame
    pixel = 2 * half / WIDTH_PX
    turns = pixel * _between(rng, 0.3, 6) * np.cumsum(rng.standard_normal((FRAMES, 3)), 0)
    ways = pixel * depth * _between(rng, 0.3, 3) * np.cumsum(rng.standard_normal((FRAMES, 3)), 0)
    path = [
        T_world_first @ _rigid(Rotation.from_rotvec(t - turns[0]), w - ways[0])
        for t, w in zip(turns, ways, strict=True)
    ]
    # the pupil, 2.2 mm times the scale, blurs what lies twice as far away as the focus by two
    # pixels at most
    scale = min(_between(rng, 1, 10), 8 * half / WIDTH_PX * depth / 2.2e-3)
    focus_m = max(depth * _between(rng, 0.5, 3), 0.03 * scale)
    facts = {"background": background, "depth_m": depth, "half_slope": half}
    facts |= {"moving": len(moving), "things": world.told}
    poses = torch.as_tensor(np.stack(path))
    return Draw(seed, scene, poses, half, max(scale, 0.05), focus_m, facts)


def _between(rng, low, high):
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _rigid(rotation, place):
    found = np.eye(4)
    found[:3, :3] = rotation.as_matrix()
    found[:3, 3] = place
    return found


class _World:
    """Things so far: shapes by name, and balls around them (middle, radius) in the axes of the
    first camera."""

    def __init__(self, rng, T_world_first, half, depth):
        self.rng, self.T_world_first, self.half, self.depth = rng, T_world_first, half, depth
        self.mi = backend.mitsuba("cpu")
        self.shapes: dict[str, Any] = {}
        self.balls: list[tuple[np.ndarray, float]] = []
        self.told: list[Any] = []
        self.furthest = np.inf

    def add_background(self, kind):
        rng = self.rng
        if kind in ("sky", "wall"):
            level = float(rng.uniform(10, 200))
            self.shapes["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": level}}
        if kind == "wall":
            self.furthest = self.depth * _between(rng, 1.3, 5)
            aside = Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3))
            lean = Rotation.from_rotvec([np.pi, 0, 0]) * aside
            placed = _rigid(lean, [0, 0, self.furthest]) @ np.diag([3 * self.furthest] * 2 + [1, 1])
            self.add("wall", "card", placed, 20)
        if kind == "room":
            self.furthest = self.depth * _between(rng, 2, 4)
            size = np.array([1.1, 1.2, 1.3]) * self.furthest
            inside = _rigid(Rotation.from_rotvec(rng.uniform(-0.5, 0.5, 3)), [0, 0, 0])
            self.add("room", "cube", inside @ np.diag([*size, 1]), 20, flip_normals=True)

    def add_cluster(self):
        """One to four things, each apart from, stuck in or within the first."""
        rng = self.rng
        first = None
        for _ in range(int(rng.integers(1, 5))):
            px = _between(rng, 0.7, 14)
            how = "apart" if first is None else str(rng.choice(NEIGHBOURS))
            centre, size = self.somewhere(px)
            if first is not None and how != "apart":
                away = rng.standard_normal(3)
                reach = rng.uniform(0.5, 1.1) if how == "stuck" else 0.3
                away *= first[1] * reach / np.linalg.norm(away)
                centre = first[0] + away
                size = first[1] * rng.uniform(0.1, 0.6) if how == "nested" else size
            if np.linalg.norm(centre) < 1.5 * size or centre[2] < 0.1 * self.depth:
                continue
            self.add_thing(f"thing{len(self.told)}", centre, size, how)
            first = first or (centre, size)

    def somewhere(self, px):
        """A place in or beside the view, and the radius there of a thing so many pixels wide."""
        rng = self.rng
        away = self.depth * _between(rng, 0.6, 1.6)
        slope = rng.uniform(-1.1, 1.1, 2) * self.half
        return np.array([*slope, 1.0]) * away, px * self.half / WIDTH_PX * away

    def add_thing(self, name, centre, size, how):
        rng = self.rng
        small = np.linalg.norm(centre) > ROUNDEST / 4 * size
        kind = str(rng.choice(EDGED if small else KINDS))
        mirrored = bool(rng.random() < 0.2)
        px = 2 * size / np.linalg.norm(centre) * WIDTH_PX / (2 * self.half)
        sides = [-size if mirrored else size, size, size, 1]
        placed = _rigid(Rotation.random(random_state=rng), centre) @ np.diag(sides)
        self.balls.append((centre, size))
        self.told.append([kind, how, round(float(px), 2), *(["mirrored"] if mirrored else [])])
        self.add(name, kind, placed, px)

    def add_moving(self, name, moving):
        """A thing in a scene of its own, on a way through the world on which it touches nothing."""
        rng = self.rng
        for _ in range(20):
            centre, size = self.somewhere(_between(rng, 1, 10))
            way = np.cumsum(rng.standard_normal((FRAMES, 3)), 0) * size * 0.5
            reach = size + np.linalg.norm(way - way[0], axis=1).max()
            balls = [*self.balls, (np.zeros(3), 0.1 * size)]
            clear = all(np.linalg.norm(centre - c) > reach + r for c, r in balls)
            if clear and centre[2] + reach < 0.6 * self.furthest:
                break
        else:
            return
        others, self.shapes = self.shapes, {}
        T_world_first, self.T_world_first = self.T_world_first, np.eye(4)
        self.add_thing(name, np.array([0.0, 0.0, np.linalg.norm(centre)]), size, "moving")
        self.balls[-1] = (centre, reach)
        own, self.shapes, self.T_world_first = self.shapes, others, T_world_first
        # the thing stands ahead of its own origin: poses carry it to its place
        ahead = _rigid(Rotation.identity(), [0, 0, -np.linalg.norm(centre)])
        turn = [Rotation.from_rotvec(0.2 * k * rng.standard_normal(3)) for k in range(FRAMES)]
        poses = [
            T_world_first @ _rigid(t, centre + w - way[0]) @ ahead
            for t, w in zip(turn, way, strict=True)
        ]
        moving[name] = (MitsubaScene(own, merge=False), torch.as_tensor(np.stack(poses)))

    def add(self, name, kind, placed, px, **options):
        """A shape of about unit radius, ``placed`` [4, 4] in the axes of the first camera."""
        rng, mi = self.rng, self.mi
        size = float(np.linalg.norm(placed[:3, 0]))
        # of a pole: radius over length
        slim = max(0.03, float(np.linalg.norm(placed[:3, 3])) / ROUNDEST / size)
        placed = self.T_world_first @ placed
        unit = np.eye(4)
        plugins = {"ball": "sphere", "cube": "cube", "disc": "disk", "card": "rectangle"}
        plugin = plugins.get(kind, "cylinder")
        if kind == "cube" and name != "room":
            sides = rng.uniform(0.2, 1, 3)
            unit[:3, :3] = np.diag(sides / np.linalg.norm(sides))
        if kind == "card" and name != "wall":
            angle = rng.uniform(0.2, 1.3)
            unit[:3, :3] = np.diag([np.cos(angle), np.sin(angle), 1])
        if kind in ("tube", "can"):
            angle = np.arctan(rng.uniform(slim, 1))
            unit = np.diag([np.sin(angle), np.sin(angle), 2 * np.cos(angle), 1.0])
            unit[2, 3] = -np.cos(angle)
            if kind == "can":
                for end, sign in (("low", -1), ("high", 1)):
                    turn = Rotation.from_rotvec([np.pi if sign < 0 else 0, 0, 0])
                    lid = _rigid(turn, [0, 0, sign * np.cos(angle)])
                    lid = placed @ lid @ np.diag([np.sin(angle), np.sin(angle), 1, 1])
                    self.shapes[f"{name} {end}"] = self._plain("disk", lid, px)
        if kind in ("hull", "ring", "sheet", "fine", "bowl"):
            vertices, faces = MESHES[kind](rng)
            vertices = vertices @ placed[:3, :3].T + placed[:3, 3]
            if np.linalg.det(placed[:3, :3]) < 0:
                faces = faces[:, ::-1]
            if rng.random() < 0.5:
                light = rng.uniform(20, 240) * rng.uniform(0.4, 1, len(faces))
            else:
                light = self._light(px, False)
            self.shapes[name] = emissive_mesh(mi, vertices, faces, light)
            return
        self.shapes[name] = {**self._plain(plugin, placed @ unit, px), **options}

    def _plain(self, plugin, to_world, px):
        return {
            "type": plugin,
            "to_world": self.mi.ScalarTransform4f(to_world),
            "emitter": self._light(px, True),
        }

    def _light(self, px, textured):
        """One radiance, or a picture without detail below some pixels."""
        rng = self.rng
        level = 0.0 if rng.random() < 0.1 else float(rng.uniform(5, 240))
        radiance: Any = {"type": "rgb", "value": level}
        if textured and px > 6 and rng.random() < 0.4:
            coarse = torch.as_tensor(rng.uniform(20, 220, (1, 1, 4, 4)))
            fine = torch.nn.functional.interpolate(
                coarse, size=(64, 64), mode="bicubic", align_corners=True
            )[0, 0]
            picture = self.mi.Bitmap(fine.clamp(5, 250).float().numpy()[..., None])
            radiance = {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "mirror"}
        return {"type": "area", "radiance": radiance}


def _hull(rng):
    corners = rng.standard_normal((int(rng.integers(6, 14)), 3))
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    return convex(corners * rng.uniform(0.5, 1, 3))


def _fine(rng):
    """A ball of some hundred faces, its corners along a spiral."""
    k = np.arange(int(rng.integers(40, 400))) + 0.5
    z = 1 - 2 * k / len(k)
    turn = np.pi * (1 + 5**0.5) * k
    wide = np.sqrt(1 - z**2)
    return convex(np.stack([wide * np.cos(turn), wide * np.sin(turn), z], 1))


def _bowl(rng):
    vertices, faces = _fine(rng)
    return vertices, faces[vertices[faces].mean(1)[:, 2] > rng.uniform(-0.5, 0.3)]


def convex(corners):
    """Points [V, 3] that lie on their convex hull, and its faces [F, 3], wound outwards."""
    found = ConvexHull(corners)
    a, b, c = corners[found.simplices].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * found.equations[:, :3]).sum(1) < 0
    return corners, np.where(inward[:, None], found.simplices[:, ::-1], found.simplices)


def _grid(rows, columns, around_rows, around_columns):
    """Faces of a grid of vertices, closed where it says so."""
    i, j = np.mgrid[: rows - (not around_rows), : columns - (not around_columns)]
    a, b, c, d = (
        ((i + p) % rows * columns + (j + q) % columns).reshape(-1)
        for p, q in ((0, 0), (1, 0), (1, 1), (0, 1))
    )
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _ring(rng):
    u, v = np.meshgrid(2 * np.pi * np.arange(18) / 18, 2 * np.pi * np.arange(9) / 9, indexing="ij")
    thick = rng.uniform(0.15, 0.45)
    reach = 1 - thick + thick * np.cos(v)
    vertices = np.stack([reach * np.cos(u), reach * np.sin(u), thick * np.sin(v)], -1)
    return vertices.reshape(-1, 3), _grid(18, 9, True, True)


def _sheet(rng):
    x, y = np.meshgrid(np.linspace(-0.65, 0.65, 7), np.linspace(-0.65, 0.65, 7), indexing="ij")
    z = 0.2 * np.sin(rng.uniform(-4, 4) * x + rng.uniform(-4, 4) * y + 1)
    return np.stack([x, y, z], -1).reshape(-1, 3), _grid(7, 7, False, False)


MESHES = {"hull": _hull, "ring": _ring, "sheet": _sheet, "fine": _fine, "bowl": _bowl}
