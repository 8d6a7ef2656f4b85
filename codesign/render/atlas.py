"""Triangle meshes cut into cells, parallelograms where two triangles make one, laid side by side in
one
texture: a texture for any mesh, whatever texture coordinates it has. Meshes finer than the texels
  get radiance at vertices.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from codesign.render.triangles import edge_pairs, normals_of

SAME_POINT = 1e-5  # vertices nearer than this share of the mesh's size are one
STRAIGHT = 1e-3  # of an edge: how far a parallelogram may be from one
SMOOTH = 0.8  # cosine of the angle of two faces up to which they share the light of their vertices
GAP = 1  # texels around a cell, so that interpolation sees no neighbour
MAX_TEXELS = 1 << 21  # of a light map; a mesh that would need more has larger texels
NEAR = 0.4  # of a face, from a vertex: where light counts as that of the vertex


@dataclass(frozen=True)
class Cells:
    """Flat pieces of a mesh. origin, along_u, along_v, normal: [C, 3]; triangle: [C] bool, whether
    a cell is only the half of its parallelogram next to its origin."""

    origin: np.ndarray
    along_u: np.ndarray
    along_v: np.ndarray
    normal: np.ndarray
    triangle: np.ndarray

    def area(self):
        """[C]."""
        whole = np.linalg.norm(np.cross(self.along_u, self.along_v), axis=1)
        return np.where(self.triangle, whole / 2, whole)


def cells_of(vertices: np.ndarray, faces: np.ndarray) -> Cells:
    """Cells of a mesh of vertices [V, 3] and faces [F, 3] that have an area."""
    corners = vertices[faces]
    normal = normals_of(corners)
    pairs = _parallelograms(places(vertices)[faces], corners, normal)
    alone = np.setdiff1d(np.arange(len(faces)), pairs[:, :2].reshape(-1))
    sides = corners[alone] - np.roll(corners[alone], -1, axis=1)
    first = (np.linalg.norm(sides, axis=2).argmax(1) + 2) % 3  # opposite to the longest side
    o, a, b = (corners[alone, (first + k) % 3] for k in range(3))
    face, _, k, far = pairs.T
    start, end, apex = (corners[face, (k + j) % 3] for j in range(3))
    other = corners[pairs[:, 1], far]
    # the diagonal runs from start to end, so seen from where the normal points to: start, other,
    # end, apex
    return Cells(
        np.concatenate([start, o]),
        np.concatenate([other - start, a - o]),
        np.concatenate([apex - start, b - o]),
        np.concatenate([normal[face], normal[alone]]),
        np.arange(len(pairs) + len(alone)) >= len(pairs),
    )


def places(vertices: np.ndarray) -> np.ndarray:
    """Number of the place of each vertex [V]; those at one place share it."""
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-12)
    rounded = np.round((vertices - vertices.min(0)) / (SAME_POINT * size)).astype(np.int64)
    return np.unique(rounded, axis=0, return_inverse=True)[1].reshape(-1)


def shared_edges(place: np.ndarray) -> np.ndarray:
    """Edges between two faces of places [F, 3]: [E, 4] of face, other face, and the corner where
    the edge starts in each, running one way in the first and the other way in the second."""
    one, other, count, rises = edge_pairs(place)
    apart = (one // 3 != other // 3) & (count == 2) & (rises[one] != rises[other])
    one, other = one[apart], other[apart]
    one, other = np.where(rises[one], (one, other), (other, one))
    return np.stack([one // 3, other // 3, one % 3, other % 3], 1)


def _parallelograms(place, corners, normal):
    """Pairs of faces that make one: [P, 4] of face, other face, corner where their common edge
    starts in the first, corner opposite to it in the second. No face twice, longest edges first."""
    edges = shared_edges(place)
    face, other, k, j = edges.T
    start, end, apex = (corners[face, (k + i) % 3] for i in range(3))
    far = corners[other, (j + 2) % 3]
    length = np.linalg.norm(end - start, axis=1)
    closes = np.linalg.norm(apex + far - start - end, axis=1) < STRAIGHT * length
    fits = closes & ((normal[face] * normal[other]).sum(1) > 0.999)
    taken = np.zeros(len(corners), dtype=bool)
    found = []
    for row in np.flatnonzero(fits)[np.argsort(-length[fits], kind="stable")]:
        if not (taken[face[row]] or taken[other[row]]):
            taken[[face[row], other[row]]] = True
            found.append((face[row], other[row], k[row], (j[row] + 2) % 3))
    return np.array(found, dtype=np.int64).reshape(-1, 4)


@dataclass(frozen=True)
class Atlas:
    """Cells in one texture. left, bottom: [C] first texel of each cell behind its gap; wide, high:
    [C] its texels;
    texels: (rows, columns) of the whole; cell: [rows, columns] number of the cell of each texel, -1
      for none."""

    cells: Cells
    left: np.ndarray
    bottom: np.ndarray
    wide: np.ndarray
    high: np.ndarray
    texels: tuple[int, int]
    cell: np.ndarray

    def at(self, u, v):
        """Points [N, 3], normals [N, 3] and whether they are on the surface [N], of texture
        coordinates [N]."""
        rows, columns = self.texels
        x = u * columns
        y = v * rows
        k = self.cell[np.clip(y.astype(int), 0, rows - 1), np.clip(x.astype(int), 0, columns - 1)]
        s = (x - self.left[k]) / self.wide[k]
        t = (y - self.bottom[k]) / self.high[k]
        inside = (k >= 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        inside &= ~self.cells.triangle[k] | (s + t <= 1)
        points = (
            self.cells.origin[k]
            + s[:, None] * self.cells.along_u[k]
            + t[:, None] * self.cells.along_v[k]
        )
        return points, self.cells.normal[k], inside

    def mesh(self):
        """Vertices [V, 3], faces [F, 3] and texture coordinates [V, 2] of the mesh that shows the
        texture."""
        c = self.cells
        corners = np.stack(
            [
                c.origin,
                c.origin + c.along_u,
                c.origin + c.along_u + c.along_v,
                c.origin + c.along_v,
            ],
            1,
        )
        at = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        size = np.stack([self.wide, self.high], 1)[:, None]
        uv = (np.stack([self.left, self.bottom], 1)[:, None] + at * size) / self.texels[::-1]
        number = 4 * np.arange(len(c.origin))
        both = np.stack(
            [number, number + 1, number + 2, number, number + 2, number + 3], 1
        ).reshape(-1, 2, 3)
        half = np.stack([number, number + 1, number + 3], 1)
        faces = np.concatenate([both[~c.triangle].reshape(-1, 3), half[c.triangle]])
        used, faces = np.unique(faces, return_inverse=True)
        return corners.reshape(-1, 3)[used], faces.reshape(-1, 3), uv.reshape(-1, 2)[used]


def atlas_of(cells: Cells, texel: float) -> Atlas:
    """Cells laid out with texels of this size, or larger ones where they would be too many."""
    lengths = np.stack(
        [np.linalg.norm(cells.along_u, axis=1), np.linalg.norm(cells.along_v, axis=1)], 1
    )
    while True:
        size = np.maximum(np.ceil(lengths / texel), 1).astype(np.int64)
        total = int((size + 2 * GAP).prod(1).sum())
        if total <= MAX_TEXELS or size.max() == 1:
            break
        texel *= 1.1 * np.sqrt(total / MAX_TEXELS)
    width = max(int(np.ceil(np.sqrt(1.05 * total))), int(size[:, 0].max()) + 2 * GAP)
    corner = np.zeros((len(size), 2), dtype=np.int64)
    x = y = shelf = 0
    for k in np.argsort(-size[:, 1], kind="stable"):
        if x + size[k, 0] + 2 * GAP > width:
            x = 0
            y += shelf
            shelf = 0
        corner[k] = x + GAP, y + GAP
        x += size[k, 0] + 2 * GAP
        shelf = max(shelf, size[k, 1] + 2 * GAP)
    texels = (int(y + shelf), width)
    cell = np.full(texels, -1, dtype=np.int64)
    for k, ((left, bottom), (wide, high)) in enumerate(zip(corner, size, strict=True)):
        cell[bottom : bottom + high, left : left + wide] = k
    return Atlas(cells, *corner.T, *size.T, texels, cell)


@dataclass(frozen=True)
class Nodes:
    """Vertices of a fine mesh, one per place and smooth surface. vertices: [N, 3]; faces: [F, 3] of
    them;
    normal: [F, 3]; corner: [3 F] corners 3 face + k in order of their nodes; first: [N + 1] where
      each node starts there."""

    vertices: np.ndarray
    faces: np.ndarray
    normal: np.ndarray
    corner: np.ndarray
    first: np.ndarray

    def points(self, random, node):
        """Random points near nodes [n], on the faces around them: [n, 3], with their normals."""
        first = self.first[node]
        pick = first + (random.random(len(node)) * (self.first[node + 1] - first)).astype(np.int64)
        face, k = np.divmod(self.corner[pick], 3)
        o, a, b = (self.vertices[self.faces[face, (k + j) % 3]] for j in range(3))
        s = NEAR * np.sqrt(random.random((len(node), 1)))
        t = random.random((len(node), 1))
        return o + s * ((1 - t) * (a - o) + t * (b - o)), self.normal[face]


def nodes_of(vertices: np.ndarray, faces: np.ndarray) -> Nodes:
    """Nodes of a mesh of vertices [V, 3] and faces [F, 3]: where faces meet at a crease each has
    its own."""
    corners = vertices[faces]
    normal = normals_of(corners)
    face, other, k, j = shared_edges(places(vertices)[faces]).T
    smooth = (normal[face] * normal[other]).sum(1) > SMOOTH
    face, other, k, j = (part[smooth] for part in (face, other, k, j))
    ends = [(3 * face + k, 3 * other + (j + 1) % 3), (3 * face + (k + 1) % 3, 3 * other + j)]
    a, b = (np.concatenate(part) for part in zip(*ends, strict=True))
    count, label = scipy.sparse.csgraph.connected_components(
        scipy.sparse.coo_matrix((np.ones(len(a)), (a, b)), shape=(faces.size,) * 2), directed=False
    )
    corner = np.argsort(label, kind="stable")
    first = np.searchsorted(label[corner], np.arange(count + 1))
    return Nodes(
        corners.reshape(-1, 3)[corner[first[:-1]]], label.reshape(-1, 3), normal, corner, first
    )
