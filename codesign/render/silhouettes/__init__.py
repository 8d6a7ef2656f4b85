"""Curves in a scene where radiance may jump: edges of meshes, rims, the outlines of spheres and
cylinders as seen from a point, and where shapes pass through each other."""

from typing import Any

import numpy as np
import torch

from codesign.render.silhouettes.crossings import find_crossings
from codesign.render.silhouettes.curves import Circles, Cylinders, Meridians, Segments, Spheres
from codesign.render.silhouettes.edges import edges_once, mesh_edges, rims_once, segments, tolerance
from codesign.render.silhouettes.intersections import on_surfaces
from codesign.render.silhouettes.shapes import Ball, Disk, Mesh, Shape, Tube


def outlines(shapes: list[Shape]) -> list[Any]:
    """All curves of the shapes of a scene: a list of Segments, Circles, Spheres, Cylinders,
    Meridians, Intersections, and of Overlaps that refuse to be seen."""
    if not shapes:
        return []
    apart_m = tolerance(np.concatenate([shape.corners() for shape in shapes]))
    crossed, over = find_crossings(shapes, apart_m)
    flat = np.array([isinstance(s, Mesh | Disk) for s in shapes])[crossed.shapes].all(1)
    curved, width_m = on_surfaces(crossed[~flat], shapes, apart_m)
    edges = [mesh_edges(s.vertices, s.faces, s.values) for s in shapes if isinstance(s, Mesh)]
    edges.append(segments(crossed.start[flat], crossed.end[flat]))
    seams = [seam for s in shapes if s.light is None for seam in s.seams()]
    edges.append(segments(*np.array(seams).reshape(-1, 2, 3).swapaxes(0, 1)))
    balls = [(s.centre, s.radius) for s in shapes if isinstance(s, Ball)]
    tubes = [(s.start, s.end, s.radius) for s in shapes if isinstance(s, Tube)]
    rims = [
        (*rim, far)
        for s, both in zip(shapes, width_m, strict=True)
        for rim, far in zip(s.rims(), both, strict=False)
    ]
    meridians = [
        (s.centre, *s.seam)
        for s in shapes
        if isinstance(s, Ball) and s.light is None and s.seam is not None
    ]
    found = []
    if any(map(len, edges)):
        once = edges_once(edges, apart_m)
        found.append(Segments.of(once))
    if rims:
        found.append(Circles(*_tensors(*rims_once(*_columns(rims), apart_m))))
    if balls:
        found.append(Spheres(*_tensors(*_columns(balls))))
    if tubes:
        found.append(Cylinders.of(*_tensors(*_columns(tubes))))
    if meridians:
        found.append(Meridians(*_tensors(*_columns(meridians))))
    if curved is not None:
        found.append(curved)
    if over is not None:
        found.append(over)
    return found


def _columns(rows):
    return [np.array(column) for column in zip(*rows, strict=True)]


def _tensors(*columns):
    return [torch.tensor(column) for column in columns]
