"""The body of a robot as triangles, and how far the housing of a camera is from it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from codesign.backend import differentiable_once
from codesign.checks import check_finite, check_number, check_positive
from codesign.errors import DomainError, ShapeError
from codesign.mount.triangles import (
    closest_points,
    first_crossings,
    nearest_to_edges,
    winding_numbers,
)

DEPTHS = 17  # points of a capsule's axis at which its depth inside a solid is looked for
ON_SURFACE_M = 1e-9  # nearer than this the face's normal stands for the direction to the surface


class Part(Protocol):
    """A mesh of a robot, as ``scenes.robots`` has them: name, vertices_m [V, 3] and faces
    [F, 3]."""

    @property
    def name(self) -> str: ...

    @property
    def vertices_m(self) -> Any: ...

    @property
    def faces(self) -> Any: ...


@dataclass(frozen=True)
class Housing:
    """What holds a camera, as a ball or a capsule about its axis.

    radius_m: > 0. behind_m: how far the axis of the capsule goes behind the camera's origin; 0 is a
      ball.
    Raises: DomainError for other numbers.
    """

    radius_m: float
    behind_m: float = 0.0

    def __post_init__(self):
        check_positive(self.radius_m, "housing: radius_m")
        check_number(self.behind_m, "housing: behind_m", 0.0)


class Body:
    """Triangles of a robot in its own axes, metres.

    Each closed surface is a solid, whichever way its faces turn; solids may overlap. What is not
    closed has two sides and is a solid where it winds more than half around a point.

    >>> corners = [[x, y, z] for x in (-0.2, 0.2) for y in (-0.1, 0.1) for z in (0.0, 0.1)]
    >>> sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    >>> faces = [(a, b, c) for a, b, c, d in sides] + [(a, c, d) for a, b, c, d in sides]
    >>> box = Body([(corners, faces)])
    >>> box.distance_m(torch.tensor([[0.5, 0.0, 0.05], [0.0, 0.0, 0.05]])).round(decimals=6).tolist()
    [0.3, -0.05]

    Args:
      meshes: pairs of vertices [V, 3] in metres and faces [F, 3] of their indices.
    solids: tuple of triangles [F, 3, 3] float64, those of one solid together.
    Raises: DomainError where there is no triangle, a vertex is not finite, or a face names one that
      is not there; ShapeError.
    """

    solids: tuple[Tensor, ...]

    def __init__(self, meshes: Iterable[tuple[Any, Any]]) -> None:
        self.solids = tuple(
            solid for vertices, faces in meshes for solid in solids_of(vertices, faces)
        )
        if not self.solids:
            raise DomainError("body: there are no triangles; give at least one mesh with a face.")

    @classmethod
    def of(cls, parts: Sequence[Part], without: Sequence[str] = ()) -> "Body":
        """The body of a robot's parts (``scenes.robots.from_urdf(...).parts``), less the links
        named in ``without``: those that carry the camera and move with it.

        Raises: DomainError for a link that has no part.
        """
        names = {part.name for part in parts}
        unknown = [name for name in without if name not in names]
        if unknown:
            raise DomainError(
                f"body: no part belongs to the link '{unknown[0]}'; there are {', '.join(sorted(names))}."
            )
        return cls([(part.vertices_m, part.faces) for part in parts if part.name not in without])

    @property
    def triangles(self) -> Tensor:
        """All triangles, [F, 3, 3] float64."""
        return torch.cat(self.solids)

    def distances_m(self, points_m: Tensor) -> Tensor:
        """Signed distance of points to every solid, negative inside.

        Args:
          points_m: [..., 3], axes of the body.
        Returns: [..., solids] float64.
        Gradient: to the points, the exact one of the distance; at a surface the normal of its face.
          It jumps where two parts of a solid are equally near.
        """
        points = points_m.double().reshape(-1, 3)
        found = [_signed(points, solid) for solid in self.solids]
        return torch.stack(found, -1).reshape(*points_m.shape[:-1], len(found))

    def distance_m(self, points_m: Tensor) -> Tensor:
        """Signed distance [...] of points [..., 3] to the body: exact outside, and inside the depth
        in the solid that is deepest."""
        return self.distances_m(points_m).amin(-1)

    def clearances_m(self, T_body_cam: Tensor, housing: Housing) -> Tensor:
        """Free space between the housing of a camera and every solid, [..., solids] for mounts
        [..., 4, 4]; negative where they overlap.

        Exact where they do not; the depth of a capsule inside is that of the deepest of DEPTHS
        points of its axis.
        Gradient: to the mount.
        """
        pose = T_body_cam.double().reshape(-1, 4, 4)
        start = pose[:, :3, 3]
        if housing.behind_m == 0:
            found = self.distances_m(start)
        else:
            end = start - housing.behind_m * pose[:, :3, 2]
            found = torch.stack([_of_segments(start, end, solid) for solid in self.solids], -1)
        return (found - housing.radius_m).reshape(*T_body_cam.shape[:-2], len(self.solids))


def _signed(points, triangles):
    """Signed distance [N] of points to one solid, with its gradient."""
    with torch.no_grad():
        closest, face = closest_points(points, triangles)
        away = points - closest
        far = torch.linalg.vector_norm(away, dim=-1)
        winding = winding_numbers(points, triangles)
        inside = winding.abs() > 0.5  # what is not closed may be turned either way
        corner = triangles[face]
        normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normal = torch.nn.functional.normalize(normal, dim=-1)
        sign = torch.where(inside, -1.0, 1.0).to(points)
        close = far <= ON_SURFACE_M
        slope = torch.where(close[:, None], normal, (sign / far.clamp_min(1e-300))[:, None] * away)
    return differentiable_once(
        sign * far + ((points - points.detach()) * slope).sum(-1),
        "the gradient of a distance to a body has none of its own; use differences of gradients.",
    )


def _of_segments(start, end, triangles):
    """Smallest signed distance [N] along segments to one solid: outside it lies at an end, at an
    edge or where the segment crosses a triangle."""
    crossing = first_crossings(start, end - start, triangles).clamp_max(1.0)
    edges = nearest_to_edges(start, end, triangles)
    fixed = torch.linspace(0, 1, DEPTHS).to(start).expand(len(start), DEPTHS)
    share = torch.cat([fixed, crossing[:, None], edges[:, None]], 1)
    points = start[:, None] + share[..., None] * (end - start)[:, None]
    with torch.no_grad():
        best = _signed(points.detach().reshape(-1, 3), triangles).reshape(share.shape).argmin(1)
    return _signed(points[torch.arange(len(points)), best], triangles)


def solids_of(vertices_m: Any, faces: Any) -> list[Tensor]:
    """Triangles of each closed surface of a mesh, and those of all that is not closed, together.

    Args:
      vertices_m: [V, 3].
      faces: [F, 3] indices of them. Vertices at one place count as one: seams of a texture are no
        holes.
    Returns: list of [F', 3, 3] float64, turned outward where they are closed.
    Raises: ShapeError; DomainError for vertices that are not finite, faces of vertices that are not
      there, and closed surfaces whose faces turn different ways.
    """
    vertices = check_finite(
        torch.tensor(np.asarray(vertices_m, dtype=np.float64)), "body: vertices"
    )
    faces = np.array(faces, dtype=np.int64) if len(faces) else np.zeros((0, 3), dtype=np.int64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ShapeError(
            f"body: a mesh has vertices [V, 3] and faces [F, 3], got {list(vertices.shape)} and {list(faces.shape)}."
        )
    wrong = faces[(faces < 0) | (faces >= len(vertices))]
    if len(wrong):
        raise DomainError(
            f"body: a face names the vertex {int(wrong[0])}; there are those from 0 to {len(vertices) - 1}."
        )
    if not len(faces):
        return []
    triangles = vertices[torch.from_numpy(faces)]
    component, closed = _components(
        np.unique(vertices.numpy(), axis=0, return_inverse=True)[1][faces]
    )
    found = [_outward(triangles[torch.from_numpy(component == k)]) for k in np.flatnonzero(closed)]
    loose = torch.from_numpy(~closed[component])
    return [*found, triangles[loose]] if bool(loose.any()) else found


def _components(corners):
    """Which connected component each face [F, 3] belongs to, and whether each of them is closed."""
    count = int(corners.max()) + 1
    edges = np.stack([corners, np.roll(corners, -1, 1)], -1)
    # of faces that are not folded to a line
    whole = np.repeat((edges[..., 0] != edges[..., 1]).all(1), 3)
    edges = edges.reshape(-1, 2)
    of_vertex = _least_connected(edges, count)
    names, component = np.unique(of_vertex[corners[:, 0]], return_inverse=True)
    edges = edges[whole]
    forth = np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)
    # closed where each edge is run through as often one way as the other
    name = edges.min(1) * count + edges.max(1)
    used, which, uses = np.unique(name, return_inverse=True, return_counts=True)
    where = np.searchsorted(names, of_vertex[used // count])
    balance = np.bincount(which, forth, len(used))
    unbalanced = np.bincount(where, balance != 0, len(names)) > 0
    paired = np.bincount(where, uses != 2, len(names)) == 0
    if bool((unbalanced & paired).any()):
        raise DomainError(
            "body: a closed surface has neighbouring faces that turn different ways, so it has no inside; turn them "
            "alike, as by trimesh.repair.fix_winding."
        )
    return component, ~unbalanced


def _least_connected(edges, count):
    """The least vertex [count] that edges [E, 2] connect each with."""
    least = np.arange(count)
    while True:
        ends = least[edges]
        if (ends[:, 0] == ends[:, 1]).all():
            return least
        np.minimum.at(least, ends.max(1), ends.min(1))
        while (least != least[least]).any():
            least = least[least]


def _outward(triangles):
    """A closed surface with its faces turned outward."""
    volume = (triangles[:, 0] * torch.linalg.cross(triangles[:, 1], triangles[:, 2])).sum()
    return triangles.flip(1) if float(volume) < 0 else triangles
