"""Curves in a scene where radiance may jump: edges of meshes, rims, and the outlines of spheres and cylinders
as seen from a point."""

from typing import Any

import numpy as np
import torch

from codesign.render.outline.curves import Circles, Cylinders, Segments, Spheres
from codesign.render.outline.edges import mesh_edges
from codesign.render.outline.joints import edges_once, rims_once, tolerance
from codesign.render.outline.shapes import Ball, Disk, Mesh, Tube, read


def outlines(mi: Any, scene: Any) -> list[Any]:
    """All curves of a Mitsuba scene: a list of Segments, Circles, Spheres, Cylinders. Raises: DomainError for
    shapes whose outline is not known."""
    shapes = [read(mi, shape) for shape in scene.shapes()]
    if not shapes:
        return []
    apart_m = tolerance(np.concatenate([shape.corners() for shape in shapes]))
    edges = [mesh_edges(s.vertices, s.faces, s.values) for s in shapes if isinstance(s, Mesh)]
    balls = [(s.centre, s.radius) for s in shapes if isinstance(s, Ball)]
    tubes = [(s.start, s.end, s.radius) for s in shapes if isinstance(s, Tube)]
    rims = [(s.centre, s.u, s.v) for s in shapes if isinstance(s, Disk)]
    rims += [(end, s.u, s.v) for s in shapes if isinstance(s, Tube) for end in (s.start, s.end)]
    found = []
    if any(map(len, edges)):
        once = edges_once(edges, apart_m)
        found.append(Segments(*_tensors(once.start, once.end, once.normals, once.always, once.width_m)))
    if rims:
        found.append(Circles(*_tensors(*rims_once(*_columns(rims), apart_m))))
    if balls:
        found.append(Spheres(*_tensors(*_columns(balls))))
    if tubes:
        found.append(Cylinders.of(*_tensors(*_columns(tubes))))
    return found


def _columns(rows):
    return [np.array(column) for column in zip(*rows, strict=True)]


def _tensors(*columns):
    return [torch.tensor(column) for column in columns]
