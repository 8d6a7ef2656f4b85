"""Curves in a scene where radiance may jump: edges of meshes, rims, and the outlines of spheres and cylinders
as seen from a point."""

import numpy as np
import torch

from codesign.errors import DomainError
from codesign.render.outline.curves import Circles, Cylinders, Segments, Spheres

SAME_PLACE_M = 1e-4  # edges of different shapes whose ends are nearer than this are one
SAME_POINT = 1e-5  # vertices nearer than this share of the mesh's size are one
# cosine of the angle of two faces: above the first an edge is none, below the second it may part two
# radiances
FLAT = 1 - 1e-6
SHARP = 0.98
INSIDE = (
    1e-3  # share of an edge left out at either end when it is looked along: there it may touch its neighbours
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

    kinds = ((Segments, edges), (Circles, rims), (Spheres, spheres), (Cylinders.of, tubes))
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


def _transform(parameters, points):
    matrix = np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)
    return np.array(points, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def _rim(centre, at_u, at_v):
    return centre, at_u - centre, at_v - centre
