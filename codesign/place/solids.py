"""A mesh as the closed surfaces that it is made of."""

from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite


def solids_of(vertices_m: Any, faces: Any) -> list[Tensor]:
    """Triangles of each closed surface of a mesh, and those of all that is not closed, together.

    Args: vertices_m: [V, 3]. faces: [F, 3] indices of them. Vertices at one place count as one: seams of a texture
      are no holes.
    Returns: list of [F', 3, 3] float64, turned outward where they are closed.
    Raises: ShapeError; DomainError for vertices that are not finite, faces of vertices that are not there, and
      closed surfaces whose faces turn different ways.
    """
    vertices = check_finite(torch.tensor(np.asarray(vertices_m, dtype=np.float64)), "body: vertices")
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
    component, closed = _components(np.unique(vertices.numpy(), axis=0, return_inverse=True)[1][faces])
    found = [_outward(triangles[torch.from_numpy(component == k)]) for k in np.flatnonzero(closed)]
    loose = torch.from_numpy(~closed[component])
    return [*found, triangles[loose]] if bool(loose.any()) else found


def _components(corners):
    """Which connected component each face [F, 3] belongs to, and whether each of them is closed."""
    count = int(corners.max()) + 1
    edges = np.stack([corners, np.roll(corners, -1, 1)], -1)
    whole = np.repeat((edges[..., 0] != edges[..., 1]).all(1), 3)  # of faces that are not folded to a line
    edges = edges.reshape(-1, 2)
    ones = np.ones(len(edges))
    of_vertex = connected_components(coo_matrix((ones, edges.T), (count, count)), directed=False)[1]
    edges = edges[whole]
    forth = np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)
    place = np.sort(edges, 1).T
    # closed where each edge is run through as often one way as the other
    runs = coo_matrix((forth, place), (count, count)).tocsr()
    used = coo_matrix((np.ones(len(edges)), place), (count, count)).tocsr()
    names, component = np.unique(of_vertex[corners[:, 0]], return_inverse=True)
    where = np.searchsorted(names, of_vertex[used.nonzero()[0]])
    uses = np.asarray(used[used.nonzero()]).reshape(-1)
    balance = np.asarray(runs[used.nonzero()]).reshape(-1)
    unbalanced = np.bincount(where, balance != 0, len(names)) > 0
    paired = np.bincount(where, uses != 2, len(names)) == 0
    if bool((unbalanced & paired).any()):
        raise DomainError(
            "body: a closed surface has neighbouring faces that turn different ways, so it has no inside; turn them "
            "alike, as by trimesh.repair.fix_winding."
        )
    return component, ~unbalanced


def _outward(triangles):
    """A closed surface with its faces turned outward."""
    volume = (triangles[:, 0] * torch.linalg.cross(triangles[:, 1], triangles[:, 2])).sum()
    return triangles.flip(1) if float(volume) < 0 else triangles
