"""Curves in a scene where radiance may jump: edges of meshes, rims, and the outlines of spheres and cylinders
as seen from a point.

A curve is cut into pieces [s0, s1] of its parameter; a piece becomes a point of the world once a parameter
and a viewpoint are given.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError

SAME_PLACE_M = 1e-4  # edges of different shapes whose ends are nearer than this are one
SAME_POINT = 1e-5  # vertices nearer than this share of the mesh's size are one
# cosine of the angle of two faces: above the first an edge is none, below the second it may part two
# radiances
FLAT = 1 - 1e-6
SHARP = 0.98
ROUND = 96  # pieces of a full circle
INSIDE = (
    1e-3  # share of an edge left out at either end when it is looked along: there it may touch its neighbours
)


@dataclass(frozen=True)
class Segments:
    """Straight edges. start, end: [E, 3]. normals: [E, 2, 3] of the two faces; always: [E] bool, True where
    it counts from every side (rims, seams, sharp creases)."""

    start: Tensor
    end: Tensor
    normals: Tensor
    always: Tensor

    def pieces(self, viewpoint, angle):
        """Indices and parameters [n], [n, 2] of pieces that subtend at most ``angle`` from the viewpoint [3]
        and may be outlines there."""
        towards = viewpoint - self.start
        turned = (self.normals * towards[:, None]).sum(2)
        kept = torch.nonzero(self.always | (turned[:, 0] * turned[:, 1] <= 0))[:, 0]
        a = self.start[kept] - viewpoint
        b = self.end[kept] - viewpoint
        along = b - a
        length = along.norm(dim=1)
        nearest = (-(a * along).sum(1) / length.square()).clamp(0, 1)
        distance = (a + nearest[:, None] * along).norm(dim=1).clamp_min(1e-6)
        return _cut(kept, (length / (distance * angle)).ceil().clamp(1, 4096).long())

    def points(self, index, s, viewpoint):
        return self.start[index] + s[:, None] * (self.end - self.start)[index]


@dataclass(frozen=True)
class Circles:
    """Rims of disks and cylinders: centre + cos u + sin v, with u and v of the rim's radius; [C, 3] each."""

    centre: Tensor
    u: Tensor
    v: Tensor

    def pieces(self, viewpoint, angle):
        return _cut(torch.arange(self.centre.shape[0]), torch.full(self.centre.shape[:1], ROUND))

    def points(self, index, s, viewpoint):
        turn = 2 * torch.pi * s[:, None]
        return self.centre[index] + turn.cos() * self.u[index] + turn.sin() * self.v[index]


@dataclass(frozen=True)
class Spheres:
    """Outlines of spheres: the circle where rays from the viewpoint are tangent. centre: [C, 3]; radius:
    [C]."""

    centre: Tensor
    radius: Tensor

    def pieces(self, viewpoint, angle):
        outside = torch.nonzero((self.centre - viewpoint).norm(dim=1) > self.radius * (1 + 1e-6))[:, 0]
        return _cut(outside, torch.full(outside.shape, ROUND))

    def points(self, index, s, viewpoint):
        centre = self.centre[index]
        radius = self.radius[index]
        towards = viewpoint - centre
        distance = towards.norm(dim=1, keepdim=True)
        axis = towards / distance
        share = radius[:, None] / distance
        u, v = _across(axis)
        turn = 2 * torch.pi * s[:, None]
        return centre + radius[:, None] * (
            share * axis + (1 - share.square()).clamp_min(0).sqrt() * (turn.cos() * u + turn.sin() * v)
        )


@dataclass(frozen=True)
class Cylinders:
    """Outlines of cylinders without caps: the two lines where rays from the viewpoint are tangent. start,
    end: [C, 3] of the axis; radius: [C]. Parameter 0..1 and 1..2."""

    start: Tensor
    end: Tensor
    radius: Tensor

    def pieces(self, viewpoint, angle):
        count = self.start.shape[0]
        index, s = _cut(torch.arange(count).repeat_interleave(2), torch.full((2 * count,), ROUND // 2))
        return index, s + (torch.arange(s.shape[0]) // (ROUND // 2) % 2)[:, None]

    def points(self, index, s, viewpoint):
        start = self.start[index]
        along = (self.end - self.start)[index]
        axis = torch.nn.functional.normalize(along, dim=1)
        towards = viewpoint - start
        towards = towards - (towards * axis).sum(1, keepdim=True) * axis
        distance = towards.norm(dim=1, keepdim=True)
        share = (self.radius[index][:, None] / distance).clamp_max(1)
        out = towards / distance
        aside = torch.linalg.cross(axis, out) * torch.where(s < 1, 1.0, -1.0).to(s)[:, None]
        return (
            start
            + (s % 1)[:, None] * along
            + self.radius[index][:, None] * (share * out + (1 - share.square()).sqrt() * aside)
        )


def outlines(mi, scene):
    """All curves of a Mitsuba scene: a list of Segments, Circles, Spheres, Cylinders. Raises: DomainError for
    shapes whose outline is not known."""
    edges = []
    rims = []
    spheres = []
    tubes = []
    for shape in scene.shapes():
        before = len(edges)
        kind = shape.shape_type()
        parameters = mi.traverse(shape)
        if kind == int(mi.ShapeType.Rectangle):
            corners = _transform(parameters, [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
            edges += mesh_edges(corners, np.array([[0, 1, 2], [0, 2, 3]]))
        elif kind == int(mi.ShapeType.Sphere):
            points = _transform(parameters, [[0, 0, 0], [1, 0, 0]])
            spheres.append((points[0], np.linalg.norm(points[1] - points[0])))
        elif kind == int(mi.ShapeType.Disk):
            rims.append(_rim(*_transform(parameters, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])))
        elif kind == int(mi.ShapeType.Cylinder):
            low, high, *across = _transform(
                parameters, [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [1, 0, 1], [0, 1, 1]]
            )
            rims += [_rim(low, *across[:2]), _rim(high, *across[2:])]
            tubes.append((low, high, np.linalg.norm(across[0] - low)))
        elif shape.is_mesh() and "vertex_positions" in parameters:
            edges += mesh_edges(
                np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3),
                np.array(parameters["faces"]).reshape(-1, 3),
            )
        else:
            raise DomainError(
                f"the outline of shape '{shape.id()}' is not known; use meshes, rectangles, cubes, spheres, "
                "disks and cylinders, or ask for gradient 'difference'."
            )
        _check_apart(mi, scene, shape, edges[before:])
    edges = _without_twins(edges)

    def tensor(rows):
        return torch.tensor(np.array(rows), dtype=torch.float64)

    kinds = ((Segments, edges), (Circles, rims), (Spheres, spheres), (Cylinders, tubes))
    return [
        kind(
            *[
                tensor(column).bool() if i == 3 else tensor(column)
                for i, column in enumerate(zip(*rows, strict=True))
            ]
        )
        for kind, rows in kinds
        if rows
    ]


def _without_twins(edges):
    """Edges once each: walls that meet list their seam twice, and its jump would count twice."""

    def place(point):
        return tuple(np.round(point / SAME_PLACE_M).astype(np.int64))

    found = {}
    for row in edges:
        found.setdefault(frozenset((place(row[0]), place(row[1]))), row)
    return list(found.values())


def _check_apart(mi, scene, shape, rows):
    """Raise DomainError when an edge of a shape passes through another: where objects interpenetrate there
    are edges that no mesh lists."""
    if not rows:
        return
    start, end = (np.array([row[i] for row in rows]) for i in (0, 1))
    along = end - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    start = start + INSIDE * along
    along = along / length

    def column(v):
        return [mi.Float(np.ascontiguousarray(c, dtype=np.float32)) for c in v.T]

    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(*column(start)), mi.Vector3f(*column(along))))
    other = (
        si.is_valid()
        & (si.shape != mi.ShapePtr(shape))
        & (si.t < mi.Float((length[:, 0] * (1 - 2 * INSIDE)).astype(np.float32)))
    )
    where = np.nonzero(np.array(other))[0]
    if where.size:
        first = where[0]
        at = ", ".join(f"{v:.3g}" for v in start[first] + along[first] * np.array(si.t)[first])
        raise DomainError(
            f"an edge of shape '{shape.id()}' passes through another shape near ({at}) m, which makes edges "
            "that no mesh lists; move them apart, or ask for gradient 'difference'."
        )


def mesh_edges(vertices, faces):
    """Edges of a triangle mesh that may part two radiances: rows (start, end, normals of the two faces,
    whether it counts from every side).

    Vertices at one place are one vertex; an edge between faces that do not share their vertices' indices is a
    seam. Diagonals of flat faces are left out.
    """
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-12)
    _, place = np.unique(
        np.round(vertices / (SAME_POINT * size)).astype(np.int64), axis=0, return_inverse=True
    )
    place = place.reshape(-1)
    normals = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(lengths, 1e-300)
    found = {}
    for face, corners in enumerate(faces):
        if lengths[face] > 0:
            for i, j in ((0, 1), (1, 2), (2, 0)):
                a = int(corners[i])
                b = int(corners[j])
                found.setdefault((min(place[a], place[b]), max(place[a], place[b])), []).append(
                    (face, {a, b}, a, b)
                )
    rows = []
    for sides in found.values():
        (face, ends, a, b), other = sides[0], sides[1:]
        if len(other) != 1:  # a rim, or more than two faces that meet
            rows.append((vertices[a], vertices[b], np.stack([normals[face], normals[face]]), True))
            continue
        cosine = float(normals[face] @ normals[other[0][0]])
        seam = ends != other[0][1]
        if cosine < FLAT:
            rows.append(
                (
                    vertices[a],
                    vertices[b],
                    np.stack([normals[face], normals[other[0][0]]]),
                    cosine < SHARP or seam,
                )
            )
    return rows


def _cut(index, count):
    """Cut the parameter 0..1 of each curve into ``count`` pieces: indices [n], bounds [n, 2]."""
    which = torch.repeat_interleave(torch.arange(index.shape[0]), count)
    first = torch.cumsum(count, 0) - count
    k = torch.arange(which.shape[0]) - first[which]
    return index[which], torch.stack([k / count[which], (k + 1) / count[which]], 1).double()


def _across(axis):
    """Two unit vectors [n, 3] across unit vectors [n, 3]."""
    helper = torch.eye(3, dtype=axis.dtype)[axis.abs().argmin(1)]
    u = torch.nn.functional.normalize(torch.linalg.cross(axis, helper), dim=1)
    return u, torch.linalg.cross(axis, u)


def _transform(parameters, points):
    matrix = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    return np.array(points, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def _rim(centre, at_u, at_v):
    return centre, at_u - centre, at_v - centre
