"""Shapes that random worlds are made of: each with what Mitsuba needs, and its convex hull, by which two of
them are told apart without any ray."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from codesign.render.charts import emissive_mesh
from scenes.silhouettes import smooth

STEPS = 400  # of the search for the gap between two hulls


@dataclass(frozen=True)
class Hull:
    """The convex hull of balls and discs. centres: [K, 3] m; radii: [K] m, 0 for a point; axes: [K, 3], the
    unit normal of a disc, zero for a ball."""

    centres: np.ndarray
    radii: np.ndarray
    axes: np.ndarray

    @classmethod
    def of_points(cls, points):
        points = np.asarray(points, dtype=float)
        return cls(points, np.zeros(len(points)), np.zeros((len(points), 3)))

    def furthest(self, direction):
        """The point [3] of the hull that lies furthest along a direction [3]."""
        across = direction - (self.axes @ direction)[:, None] * self.axes
        length = np.linalg.norm(across, axis=1)
        points = self.centres + (self.radii / np.maximum(length, 1e-300))[:, None] * across
        return points[np.argmax(points @ direction)]


def gap_m(a, b):
    """A distance [m] that the two hulls are certainly apart; 0 where none was found, be they apart or not.

    Every plane across a direction in which one hull ends before the other begins is a proof. Directions come
    from Gilbert's search for the shortest vector between two convex sets (SIAM J. Control 4, 1966)."""
    between = a.centres[0] - b.centres[0]
    best = 0.0
    for _ in range(STEPS):
        size = np.linalg.norm(between)
        if size < 1e-12:
            return best
        nearer = a.furthest(-between) - b.furthest(between)
        best = max(best, float(nearer @ between) / size)
        if best > 0.9 * size:
            return best
        step = between - nearer
        share = float(between @ step) / max(float(step @ step), 1e-300)
        between = between - min(max(share, 0.0), 1.0) * step
    return best


@dataclass(frozen=True)
class Shape:
    """One shape in the axes of its room. kind: a Mitsuba plugin with ``to_room`` [4, 4], or "mesh" with
    vertices [V, 3] and faces [F, 3]. radiance: a number, a texture [H, W, 1], or one per face [F]. uv: [V, 2]
    of a mesh with texture. px: its size on the film of the draw, about."""

    name: str
    kind: str
    hull: Hull
    radiance: Any
    to_room: np.ndarray = field(default_factory=lambda: np.eye(4))
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    uv: np.ndarray | None = None
    px: float = 0.0

    def description(self, mi, T_world_room):
        """The Mitsuba dictionary or mesh of the shape."""
        if self.kind == "mesh":
            vertices = self.vertices @ T_world_room[:3, :3].T + T_world_room[:3, 3]
            by_face = np.ndim(self.radiance) == 1
            light = self.radiance if by_face else _emitter(mi, self.radiance)
            return emissive_mesh(mi, vertices, self.faces, light, self.uv)
        matrix = mi.ScalarTransform4f(T_world_room @ self.to_room)
        return {"type": self.kind, "to_world": matrix, "emitter": _emitter(mi, self.radiance)}


def _emitter(mi, radiance):
    if np.ndim(radiance) == 0:
        return {"type": "area", "radiance": {"type": "rgb", "value": float(radiance)}}
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(radiance), "raw": True, "wrap_mode": "repeat"}
    return {"type": "area", "radiance": texture}


def painted(rng, px, textured=None):
    """A radiance for a shape of about ``px`` pixels: a number, or a texture of waves of eight pixels or more."""
    base = float(rng.uniform(5, 240))
    cycles = min(px / 12, 4.0)
    if cycles < 1 or not (rng.random() < 0.5 if textured is None else textured):
        return base
    low, high = sorted(rng.uniform(5, 240, 2))
    return smooth(int(rng.integers(1 << 30)), cycles=cycles, darkest=low, brightest=max(high, low + 20))


def frame(axis, centre=(0, 0, 0), turn=0.0):
    """A rigid motion [4, 4] that takes z to ``axis`` and the origin to ``centre``, after a turn about z."""
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    u = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    across = np.cos(turn) * u + np.sin(turn) * v
    found = np.eye(4)
    found[:3, :3] = np.stack([across, np.cross(axis, across), axis], 1)
    found[:3, 3] = centre
    return found


def _scaled(placed, *sizes):
    return placed @ np.diag([*sizes, 1.0])


def _moved(placed, points):
    return np.asarray(points, dtype=float) @ placed[:3, :3].T + placed[:3, 3]


def box(name, placed, half_m, radiance, px):
    """A cuboid of half sizes ``half_m`` [3] about the origin of the frame ``placed`` [4, 4]."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half_m
    hull = Hull.of_points(_moved(placed, corners))
    return Shape(name, "cube", hull, radiance, _scaled(placed, *half_m), px=px)


def card(name, placed, half_m, radiance, px):
    """A rectangle of half sizes ``half_m`` [2], lit on the side of the frame's z."""
    corners = np.array([[x, y, 0] for x in (-1, 1) for y in (-1, 1)]) * [*half_m, 1]
    hull = Hull.of_points(_moved(placed, corners))
    return Shape(name, "rectangle", hull, radiance, _scaled(placed, *half_m, 1.0), px=px)


def disc(name, placed, radius_m, radiance, px):
    """A disc lit on the side of the frame's z."""
    hull = Hull(placed[None, :3, 3], np.array([radius_m]), placed[None, :3, 2])
    return Shape(name, "disk", hull, radiance, _scaled(placed, radius_m, radius_m, 1.0), px=px)


def ball(name, placed, radius_m, radiance, px):
    """A sphere."""
    hull = Hull(placed[None, :3, 3], np.array([radius_m]), np.zeros((1, 3)))
    return Shape(name, "sphere", hull, radiance, _scaled(placed, radius_m, radius_m, radius_m), px=px)


def tube(name, placed, length_m, radius_m, radiance, px):
    """A cylinder without caps, from the frame's origin along its z; lit outside, black inside."""
    ends = _moved(placed, [[0, 0, 0], [0, 0, length_m]])
    hull = Hull(ends, np.full(2, radius_m), np.repeat(placed[None, :3, 2], 2, 0))
    return Shape(name, "cylinder", hull, radiance, _scaled(placed, radius_m, radius_m, length_m), px=px)


def mesh(name, placed, size_m, vertices, faces, paint, rng, px):
    """Triangles of about unit size, times ``size_m``. paint: "faces" for one radiance per face, "uv" for a
    texture laid on along z, "plain" for one radiance."""
    local = size_m * vertices
    points = _moved(placed, local)
    uv = None
    radiance = painted(rng, px, textured=False)
    if paint == "uv":
        uv = vertices[:, :2] / 2.5 + 0.5
        radiance = painted(rng, max(px, 12.0), textured=True)
    if paint == "faces":
        across = np.cross(
            vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
        )
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        sun = rng.standard_normal(3)
        lit = 0.3 + 0.7 * np.maximum(across @ sun / np.linalg.norm(sun), 0)
        radiance = radiance * lit * rng.uniform(1 - 0.5 * rng.random(), 1, len(faces))
    hull = Hull.of_points(points)
    return Shape(name, "mesh", hull, radiance, vertices=points, faces=faces, uv=uv, px=px)


# ---- triangle meshes of about unit size: vertices [V, 3], faces [F, 3] wound outwards


def icosphere(level):
    """20 x 4^level faces on the unit sphere."""
    g = (1 + 5**0.5) / 2
    corners = np.array([[0, s, t * g] for s in (-1, 1) for t in (-1, 1)])
    vertices = np.concatenate([np.roll(corners, k, 1) for k in range(3)])
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    faces = outward(vertices)
    for _ in range(level):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
        ends, which = np.unique(edges, axis=0, return_inverse=True)
        middle = vertices[ends].mean(1)
        ab, bc, ca = len(vertices) + which.reshape(3, -1)
        vertices = np.concatenate([vertices, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        a, b, c = faces.T
        faces = np.concatenate(
            [np.stack(t, 1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
        )
    return vertices, faces


def outward(vertices):
    """Faces [F, 3] of the convex hull of points [V, 3] that all lie on it."""
    hull = ConvexHull(vertices)
    a, b, c = (vertices[hull.simplices[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(1) < 0
    return np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)


def random_hull(rng):
    """A polyhedron of 8 to 16 corners on an ellipsoid."""
    corners = rng.standard_normal((int(rng.integers(8, 17)), 3))
    corners *= rng.uniform(0.5, 1, 3) / np.linalg.norm(corners, axis=1, keepdims=True)
    return corners, outward(corners)


def torus(around, across, thickness):
    """A ring of 2 x around x across faces; thickness: radius of the tube over that of the ring."""
    i, j = (k.reshape(-1) for k in np.meshgrid(np.arange(around), np.arange(across), indexing="ij"))
    big, small = 2 * np.pi * i / around, 2 * np.pi * j / across
    reach = 1 + thickness * np.cos(small)
    vertices = np.stack([reach * np.cos(big), reach * np.sin(big), thickness * np.sin(small)], 1)
    vertices /= 1 + thickness
    a, b = i * across + j, (i + 1) % around * across + j
    c, d = (i + 1) % around * across + (j + 1) % across, i * across + (j + 1) % across
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def sheet(rng, side):
    """A wavy square of 2 x side^2 faces, lit on one side."""
    i, j = (k.reshape(-1) for k in np.meshgrid(np.arange(side + 1), np.arange(side + 1), indexing="ij"))
    x, y = 2 * i / side - 1, 2 * j / side - 1
    waves = rng.uniform(-2, 2, 2)
    vertices = 0.9 * np.stack([x, y, 0.3 * np.sin(waves[0] * x + 1) * np.cos(waves[1] * y)], 1)
    whole = (i < side) & (j < side)
    a = (i * (side + 1) + j)[whole]
    b, c, d = a + side + 1, a + side + 2, a + 1
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def bowl(level):
    """The upper part of a ball: an open mesh, black inside."""
    vertices, faces = icosphere(level)
    faces = faces[vertices[faces].mean(1)[:, 2] > -0.2]
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(-1, 3)
