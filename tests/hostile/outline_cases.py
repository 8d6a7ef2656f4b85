"""Worlds in which gradients at silhouettes once were wrong without a word, one by one: each a scene
and where the camera stands. Radiances are constant or smooth, so that the silhouettes are what is
tested."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign import backend, pose
from codesign.render import MitsubaScene, MovingScene
from codesign.render.charts import emissive_mesh
from scenes import silhouettes
from tests.hostile.random_worlds import convex
from tests.scenes.solids import across

AHEAD = pose.look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
RADIUS_M = 0.01  # of the cylinders that are seen from afar


@dataclass(frozen=True)
class World:
    """scene: what is seen. T_world_cam: [4, 4]. nearest_m: how far away its things are. focus_m,
    lens_scale: of a lens with an aperture; over one of 11 mm at f/5. narrow: how much less than the
    usual field the film takes in."""

    scene: MitsubaScene | MovingScene
    T_world_cam: Tensor
    nearest_m: float
    focus_m: float = 2.0
    lens_scale: float = 1.0
    narrow: float = 1.0
    kinds: tuple[str, ...] = ("pinhole", "traced")


def frame(axis, centre=(0, 0, 0), turn=0.0):
    """A rigid motion [4, 4] that takes z to ``axis`` and the origin to ``centre``, after a turn
    about z."""
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    u = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    across = np.cos(turn) * u + np.sin(turn) * v
    found = np.eye(4)
    found[:3, :3] = np.stack([across, np.cross(axis, across), axis], 1)
    found[:3, 3] = centre
    return found


def icosphere(level):
    """20 x 4^level faces on the unit sphere."""
    g = (1 + 5**0.5) / 2
    corners = np.array([[0, s, t * g] for s in (-1, 1) for t in (-1, 1)])
    vertices = np.concatenate([np.roll(corners, k, 1) for k in range(3)])
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    _, faces = convex(vertices)
    for _ in range(level):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
        ends, which = np.unique(edges, axis=0, return_inverse=True)
        middle = vertices[ends].mean(1)
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        ab, bc, ca = len(vertices) + which.reshape(3, -1)
        vertices = np.concatenate([vertices, middle])
        a, b, c = faces.T
        parts = ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))
        faces = np.concatenate([np.stack(part, 1) for part in parts])
    return vertices, faces


def _shape(kind, value, **entries):
    """A shape of one radiance."""
    light = {"type": "area", "radiance": {"type": "rgb", "value": float(value)}}
    return {"type": kind, **entries, "emitter": light}


def _placed(matrix):
    return backend.mitsuba("cpu").ScalarTransform4f(matrix)


def _ahead(roll=0.3):
    """A camera at the origin that looks along +y, rolled by some radians."""
    turn = torch.tensor([0, 0, 0, 0, 0, roll], dtype=torch.float64)
    return AHEAD @ pose.se3_exp(turn)


def _wall(distance_m, value):
    leaning = frame([0.15, -1.0, 0.1], (0, distance_m, 0), 0.4)
    matrix = _placed(leaning @ np.diag([2 * distance_m, 2 * distance_m, 1, 1]))
    return _shape("rectangle", value, to_world=matrix)


def poles() -> World:
    """Five poles 5 to 8 mm thick, 1 m away, with their ends in view."""
    shapes: dict[str, Any] = {"wall": _wall(2.5, 120)}
    for k in range(5):
        x = -0.22 + 0.11 * k
        low, high = [x - 0.03, 1.0 + 0.02 * k, -0.16 + 0.02 * k], [x + 0.05, 1.05, 0.15 + 0.01 * k]
        radius = 0.0025 + 0.0004 * k
        shapes[f"pole{k}"] = _shape("cylinder", 20 + 45 * k, p0=low, p1=high, radius=radius)
    return World(MitsubaScene(shapes), _ahead(), 1.0)


def far_pole(ratio: float) -> World:
    """A cylinder seen from ``ratio`` times its radius, its ends out of view, through a film that is
    narrower where it is further."""
    distance = ratio * RADIUS_M
    half = 0.5 * distance
    low, high = [-0.17 * half, distance, -half], [0.17 * half, distance, half]
    pole = _shape("cylinder", 200, p0=low, p1=high, radius=RADIUS_M)
    shapes = {"wall": _wall(1.5 * distance, 40), "pole": pole}
    seen = {"narrow": min(1.0, 20.0 / ratio), "kinds": ("pinhole",)}
    return World(MitsubaScene(shapes), _ahead(), distance, focus_m=distance, **seen)


def facets() -> World:
    """A ball of 5,120 faces with one radiance per face, as bodies and baked meshes have."""
    vertices, faces = icosphere(4)
    normal = across(vertices[faces])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    light = 30 + 180 * np.maximum(normal @ np.array([0.5, -0.6, 0.6]), 0)
    ball = emissive_mesh(backend.mitsuba("cpu"), 0.3 * vertices + [0.05, 1.2, 0.02], faces, light)
    return World(MitsubaScene({"wall": _wall(2.5, 120), "ball": ball}), _ahead(), 0.9)


def t_junction() -> World:
    """One edge of a floor against the lower edges of two walls."""
    T = backend.mitsuba("cpu").ScalarTransform4f
    floor = T().translate([0, 1.0, -0.3]).scale([2, 1, 1])
    shapes = {"floor": _shape("rectangle", 60, to_world=floor)}
    for name, left, right, value in (("left", -2.0, 0.15, 150), ("right", 0.15, 2.0, 220)):
        half = (right - left) / 2
        place = T().translate([left + half, 2.0, 0.7]).rotate([1, 0, 0], 90).scale([half, 1, 1])
        shapes[name] = _shape("rectangle", value, to_world=place)
    return World(MitsubaScene(shapes), _ahead(), 0.6)


def _in_floor(thing):
    T = backend.mitsuba("cpu").ScalarTransform4f
    floor = _shape("rectangle", 60, to_world=T().translate([0, 1.5, -0.3]).scale([3, 3, 1]))
    return World(MitsubaScene({"floor": floor, "thing": thing}), _ahead(), 0.8)


def sphere_in_floor() -> World:
    """A ball that sticks in a floor by half its radius."""
    return _in_floor(_shape("sphere", 200, center=[0.03, 1.2, -0.2], radius=0.2))


def cylinder_in_floor() -> World:
    """A leaning cylinder that passes through a floor."""
    ends = {"p0": [-0.05, 1.2, -0.5], "p1": [0.15, 1.3, 0.15]}
    return _in_floor(_shape("cylinder", 200, **ends, radius=0.08))


def crossing_mesh() -> World:
    """Two balls of one mesh that pass through each other, each of one radiance."""
    vertices, faces = icosphere(3)
    both = np.concatenate([0.2 * vertices + [-0.1, 1.2, 0], 0.16 * vertices + [0.12, 1.15, 0.05]])
    joined = np.concatenate([faces, faces + len(vertices)])
    light = np.repeat([60.0, 210.0], len(faces))
    mesh = emissive_mesh(backend.mitsuba("cpu"), both, joined, light)
    return World(MitsubaScene({"wall": _wall(2.5, 120), "mesh": mesh}), _ahead(), 1.0)


def defocus() -> World:
    """A card just beside the film's border, whose blur reaches far into it."""
    place = _placed(frame([0.0, -1.0, 0.0], (0.155, 0.4, 0.02), 0.1) @ np.diag([0.1, 0.1, 1, 1]))
    world = MitsubaScene({"wall": _wall(8.0, 60), "card": _shape("rectangle", 220, to_world=place)})
    return World(
        world, _ahead(), 0.4, focus_m=8.0, lens_scale=15.0, narrow=0.3, kinds=("thin", "traced")
    )


def ball_ahead() -> World:
    """A ball cut by the film's border, straight along a diagonal of the axes: where its outline
    begins must not depend on the point of the pupil it is seen from."""
    ball = _shape("sphere", 200, center=[0.2, 1.5, 0.2], radius=0.3)
    world = MitsubaScene({"wall": _wall(3.0, 60), "ball": ball})
    return World(world, AHEAD, 1.2, kinds=("pinhole", "thin", "traced"))


def robot_body() -> World:
    """A robot in the room with two boxes, with its own deck and mast before the camera that stands
    on it: motions of the camera are those of its mount, under which both the room and the robot
    move in the picture."""
    twist = torch.tensor([[0.05, -1.2, 1.0, 0.0, 0.0, 0.1]], dtype=torch.float64)
    T_world_robot = pose.se3_exp(twist)
    T_robot_cam = pose.look_at((0.0, 0.0, 0.0), (0.0, 1.0, -0.15))
    world = MovingScene(silhouettes.room(), {"robot": (silhouettes.robot(), T_world_robot)})
    return World(world, T_world_robot[0] @ T_robot_cam, 0.4)


CASES: dict[str, Callable[[], World]] = {
    "poles": poles,
    **{f"far_pole_{ratio}": partial(far_pole, ratio) for ratio in (20, 100, 250, 500, 600)},
    "facets": facets,
    "t_junction": t_junction,
    "sphere_in_floor": sphere_in_floor,
    "cylinder_in_floor": cylinder_in_floor,
    "crossing_mesh": crossing_mesh,
    "defocus": defocus,
    "ball_ahead": ball_ahead,
    "robot_body": robot_body,
}
# where a refusal is an answer too
CROSSING = ("sphere_in_floor", "cylinder_in_floor", "crossing_mesh")
