"""What a Mitsuba scene is made of, as its outline needs it: triangles with what their radiance is
looked up by, spheres, disks and cylinders; and how near the nearest of it is. World axes, metres,
float64 out of Mitsuba's float32."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from codesign.errors import DomainError
from codesign.render.mitsuba_shapes import front_faces, is_mirrored, matrix_of
from codesign.render.triangles import across

EVEN = 1e-4  # axes of a sphere or cylinder may differ in length and angle by this share


class Surface:
    """What is one surface of one radiance, or of one picture."""

    light: float | None

    def light_of(self, face):
        """The one radiance of the shape, None where it changes over it."""
        return self.light

    def round(self):
        """Centre [3], axis [3] from there to a tube's other end or 0, and radius of a round one;
        None of a flat one."""
        return None

    def rims(self):
        """Rims centre + cos u + sin v, each (centre, u, v, axis as above), [3] each."""
        return []

    def seams(self):
        """Start and end [3] of straight lines on which a picture begins: its last column need not
        go on in the first."""
        return []


@dataclass(frozen=True)
class Mesh(Surface):
    """vertices: [V, 3]; faces: [F, 3], normals on the side that shines; values: [F, 3, k] by which
    radiance is looked up at every corner (texture coordinates, colours, radiance of a face), None
    where it is one for all; light: that one radiance, None where it changes or is not known."""

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    values: np.ndarray | None
    light: float | None = None

    def corners(self):
        """Points [N, 3] whose box holds the shape."""
        return self.vertices

    def light_of(self, face):
        """The one radiance of a face, None where it changes over the face or is not known."""
        if self.values is None or self.light is not None:
            return self.light
        own = self.values[face]
        return float(own[0, 0]) if own.shape[1] == 1 and (own == own[0]).all() else None


@dataclass(frozen=True)
class Ball(Surface):
    """A sphere: centre [3], radius; seam: half axes [2, 3] of the circle on which its picture
    begins."""

    name: str
    centre: np.ndarray
    radius: float
    light: float | None = None
    seam: np.ndarray | None = None

    def round(self):
        """As for Surface."""
        return self.centre, np.zeros(3), self.radius

    def corners(self):
        """Points [N, 3] whose box holds the shape."""
        return self.centre + self.radius * np.array([[-1.0], [1.0]])


@dataclass(frozen=True)
class Disk(Surface):
    """A disk: centre [3] and half axes u, v [3] at right angles."""

    name: str
    centre: np.ndarray
    u: np.ndarray
    v: np.ndarray
    light: float | None = None

    def corners(self):
        """Points [N, 3] whose box holds the shape."""
        reach = np.hypot(self.u, self.v)
        return np.stack([self.centre - reach, self.centre + reach])

    def rims(self):
        """As for Surface."""
        return [(self.centre, self.u, self.v, np.zeros(3))]

    def seams(self):
        """As for Surface."""
        return [(self.centre, self.centre + self.u)]


@dataclass(frozen=True)
class Tube(Surface):
    """A cylinder without caps: ends of its axis [3], half axes u, v [3] of one length at right
    angles."""

    name: str
    start: np.ndarray
    end: np.ndarray
    u: np.ndarray
    v: np.ndarray
    light: float | None = None

    @property
    def radius(self):
        """Radius, metres."""
        return float(np.linalg.norm(self.u))

    def round(self):
        """As for Surface."""
        return self.start, self.end - self.start, self.radius

    def corners(self):
        """Points [N, 3] whose box holds the shape."""
        reach = np.hypot(self.u, self.v)
        return np.stack([p + k * reach for p in (self.start, self.end) for k in (-1, 1)])

    def rims(self):
        """As for Surface."""
        return [
            (a, self.u, self.v, b - a) for a, b in ((self.start, self.end), (self.end, self.start))
        ]

    def seams(self):
        """As for Surface."""
        return [(self.start + self.u, self.end + self.u)]


Shape = Mesh | Ball | Disk | Tube


def read(mi: Any, shape: Any) -> Shape:
    """A Mitsuba shape as Mesh, Ball, Disk or Tube. Raises: DomainError for shapes whose outline is
    not known."""
    kind = shape.shape_type()
    name = shape.id()
    light = _light(shape)
    parameters = mi.traverse(shape)
    if kind == int(mi.ShapeType.Rectangle):
        corners = _place(parameters, [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        turned = shape.has_flipped_normals() != is_mirrored(matrix_of(parameters))
        return Mesh(name, corners, faces[:, ::-1] if turned else faces, None, light)
    if kind == int(mi.ShapeType.Sphere):
        centre, *ends = _place(parameters, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        _check_even(name, "sphere", *(end - centre for end in ends))
        seam = np.stack([ends[0] - centre, ends[2] - centre])
        return Ball(name, centre, float(np.linalg.norm(ends[0] - centre)), light, seam)
    if kind == int(mi.ShapeType.Disk):
        centre, u, v = _place(parameters, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
        return Disk(name, centre, u - centre, v - centre, light)
    if kind == int(mi.ShapeType.Cylinder):
        start, end, u, v = _place(parameters, [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0]])
        _check_even(name, "cylinder", u - start, v - start)
        return Tube(name, start, end, u - start, v - start, light)
    if shape.is_mesh() and "vertex_positions" in parameters:
        vertices = np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3)
        faces = front_faces(shape, parameters)
        return Mesh(name, vertices, faces, _values(shape, parameters, faces, len(vertices)), light)
    raise DomainError(
        f"the outline of shape '{name}' is not known; use meshes, rectangles, cubes, spheres, disks and "
        "cylinders, or ask for gradient 'difference'."
    )


def _light(shape):
    """The one radiance of a shape, None where it has a texture."""
    if not shape.is_emitter():
        return 0.0
    uniform = re.search(r"radiance = UniformSpectrum\[value=\[([^\]]*)\]\]", str(shape.emitter()))
    return float(uniform[1]) if uniform else None


def _values(shape, parameters, faces, count):
    emitter = str(shape.emitter()) if shape.is_emitter() else ""
    attribute = re.search(r'MeshAttribute\[\s*name = "((face|vertex)_[^"]*)"', emitter)
    if attribute:
        value = np.array(parameters[attribute[1]], dtype=np.float64)
        if attribute[2] == "face":
            return np.repeat(value.reshape(len(faces), 1, -1), 3, 1)
        return value.reshape(count, -1)[faces]
    if (
        "vertex_texcoords" in parameters
        and "Uniform" not in emitter
        and shape.has_vertex_texcoords()
    ):
        return np.array(parameters["vertex_texcoords"], dtype=np.float64).reshape(-1, 2)[faces]
    return None


def _place(parameters, points):
    matrix = matrix_of(parameters)
    return np.array(points, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def _check_even(name, kind, *axes):
    lengths = [float(np.linalg.norm(axis)) for axis in axes]
    even = max(lengths) - min(lengths) <= EVEN * max(lengths)
    square = all(
        abs(float(a @ b)) <= EVEN * max(lengths) ** 2
        for i, a in enumerate(axes)
        for b in axes[i + 1 :]
    )
    if not (even and square):
        raise DomainError(
            f"{kind} '{name}' is scaled unequally (half axes {', '.join(f'{v:.3g}' for v in lengths)} m) or "
            "sheared, and the outline of such a shape is not known; scale it equally, or give it as a mesh."
        )


@dataclass(frozen=True)
class Bodies:
    """Triangles corners [N, 3, 3] and distances [N] from them to the surface: 0, or the radius
    about a point or line."""

    corners: np.ndarray
    radius: np.ndarray

    @classmethod
    def of(cls, shapes: list[Shape]) -> "Bodies":
        """The triangles of meshes, squares around disks, middles of balls and axes of cylinders."""
        found = [(np.zeros((0, 3, 3)), 0.0), *(_body(shape) for shape in shapes)]
        return cls(
            np.concatenate([corners for corners, _ in found]).astype(np.float32),
            np.concatenate([np.full(len(corners), radius) for corners, radius in found]),
        )

    def nearest_m(self, eye: np.ndarray) -> float:
        """Distance from a point [3] below which there is no surface; infinite without any."""
        if not len(self.radius):
            return np.inf
        middle = self.corners.mean(1)
        reach = np.linalg.norm(self.corners - middle[:, None], axis=2).max(1)
        away = np.linalg.norm(middle - eye, axis=1)
        flat = self.radius == 0
        most = (away + reach)[flat].min(initial=np.inf)
        rows = ~flat | (away - reach <= most * (1 + 1e-5))
        apart = _distance(self.corners[rows].astype(np.float64) - eye)
        return float(np.abs(apart - self.radius[rows]).min())


def _body(shape):
    if isinstance(shape, Mesh):
        return shape.vertices[shape.faces], 0.0
    if isinstance(shape, Disk):
        square = np.array([[[-1, -1], [1, -1], [1, 1]], [[-1, -1], [1, 1], [-1, 1]]])
        return shape.centre + square @ np.stack([shape.u, shape.v]), 0.0
    ends = (shape.centre,) * 3 if isinstance(shape, Ball) else (shape.start, shape.start, shape.end)
    return np.stack(ends)[None], shape.radius


def _distance(corners):
    """Distance [n] of triangles [n, 3, 3], which may be lines or points, from the origin."""
    normal = across(corners)
    size = np.linalg.norm(normal, axis=1)
    above = np.abs((corners[:, 0] * normal).sum(1)) / np.maximum(size, 1e-300)
    along = np.roll(corners, -1, axis=1) - corners
    within = (size > 0) & ((np.cross(along, -corners) * normal[:, None]).sum(2) >= 0).all(1)
    share = -(corners * along).sum(2) / np.maximum((along * along).sum(2), 1e-300)
    nearest = np.linalg.norm(corners + share.clip(0, 1)[..., None] * along, axis=2).min(1)
    return np.where(within, above, nearest)
