"""Curves in a scene where radiance may jump: edges of meshes, rims, the outlines of spheres and cylinders as
seen from a point, and where shapes pass through each other."""

from typing import Any

import numpy as np
import torch

from codesign.render.silhouettes.crossings import find_crossings
from codesign.render.silhouettes.curves import Circles, Cylinders, Meridians, Segments, Spheres
from codesign.render.silhouettes.edges import edges_once, mesh_edges, rims_once, segments, tolerance
from codesign.render.silhouettes.intersections import on_surfaces
from codesign.render.silhouettes.shapes import Ball, Disk, Mesh, Shape, Tube


def outlines(shapes: list[Shape]) -> list[Any]:
    """All curves of the shapes of a scene: a list of Segments, Circles, Spheres, Cylinders, Meridians,
    Intersections, and of Overlaps that refuse to be seen."""
    if not shapes:
        return []
    apart_m = tolerance(np.concatenate([shape.corners() for shape in shapes]))
    crossed, over = find_crossings(shapes, apart_m)
    flat = np.array([isinstance(s, Mesh | Disk) for s in shapes])[crossed.shapes].all(1)
    curved, width_m = on_surfaces(crossed[~flat], shapes, apart_m)
    edges = [mesh_edges(s.vertices, s.faces, s.values) for s in shapes if isinstance(s, Mesh)]
    edges.append(segments(crossed.start[flat], crossed.end[flat]))
    edges.append(_seams(shapes))
    balls = [(s.centre, s.radius) for s in shapes if isinstance(s, Ball)]
    tubes = [(s.start, s.end, s.radius) for s in shapes if isinstance(s, Tube)]
    rims = []
    for s, both in zip(shapes, width_m, strict=True):
        if isinstance(s, Disk):
            rims.append((s.centre, s.u, s.v, np.zeros(3), both[0]))
        if isinstance(s, Tube):
            rims.append((s.start, s.u, s.v, s.end - s.start, both[0]))
            rims.append((s.end, s.u, s.v, s.start - s.end, both[1]))
    meridians = [
        (s.centre, *s.seam) for s in shapes if isinstance(s, Ball) and s.light is None and s.seam is not None
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


def _seams(shapes):
    """Straight lines on which pictures of cylinders and disks begin: their last column need not go on in the
    first."""
    lines = [(s.start + s.u, s.end + s.u) for s in shapes if isinstance(s, Tube) and s.light is None]
    lines += [(s.centre, s.centre + s.u) for s in shapes if isinstance(s, Disk) and s.light is None]
    return segments(*(_columns(lines) if lines else (np.zeros((0, 3)), np.zeros((0, 3)))))


def _columns(rows):
    return [np.array(column) for column in zip(*rows, strict=True)]


def _tensors(*columns):
    return [torch.tensor(column) for column in columns]
