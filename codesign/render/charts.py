"""Where the texels of a shape lie: charts from texture coordinates to points and normals, for shapes whose
light is baked."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from codesign.errors import DomainError, ShapeError
from codesign.render.soundness import checked_mesh

# texels around each face of a cube's texture that repeat its border, so that interpolation sees no neighbour
CUBE_GAP = 2
OVERLAP = 1.02  # area of all triangles in texture space over the area they cover


@dataclass(frozen=True)
class Chart:
    """A map from the unit square to a surface: ``at`` takes u, v [N] (v up) and gives points [N, 3], normals
    [N, 3], on the surface [N]. size_m: its extent along u and v."""

    size_m: tuple[float, float]
    at: Callable[[Any, Any], tuple[Any, Any, Any]]


@dataclass(frozen=True)
class Faces:
    """A triangle mesh without texture coordinates: corners [F, 3, 3]; flip: -1 where normals point to the
    other side."""

    corners: np.ndarray
    flip: float

    def points(self, random, samples):
        """Uniform points [F, samples, 3] on every face, and the faces' normals [F, 3]."""
        s = np.sqrt(random.random((len(self.corners), samples)))
        t = random.random((len(self.corners), samples))
        weights = np.stack([1 - s, s * (1 - t), s * t], -1)
        across = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        return weights @ self.corners, self.flip * across / np.maximum(
            np.linalg.norm(across, axis=1, keepdims=True), 1e-30
        )


def charts_of(mi, name, entry, shape) -> Any:
    """Charts of a Mitsuba shape, or Faces. Raises: DomainError for a shape that has neither."""
    kind = shape.shape_type()
    flip = -1.0 if shape.has_flipped_normals() else 1.0
    parameters = mi.traverse(shape)
    if kind == int(mi.ShapeType.Rectangle):
        return [_rectangle(_matrix(parameters), flip)]
    if kind == int(mi.ShapeType.Disk):
        return [_disk(_matrix(parameters), flip)]
    if kind == int(mi.ShapeType.Sphere):
        return [_sphere(_matrix(parameters), flip)]
    if kind == int(mi.ShapeType.Cylinder):
        return [_cylinder(_matrix(parameters), flip)]
    if not shape.is_mesh():
        raise DomainError(
            f"bake: shape '{name}' has no texture chart here; use meshes, rectangles, cubes, spheres, disks "
            "and cylinders, or PathScene."
        )
    vertices, faces = mesh_arrays(parameters)
    if isinstance(entry, dict) and entry.get("type") == "cube":
        return [_rectangle(frame, 1.0) for frame in cube_frames(_cube_matrix(entry))]
    if not shape.has_vertex_texcoords():
        return Faces(vertices[faces], flip)
    return [
        _unwrapped(
            mi,
            name,
            shape,
            vertices,
            faces,
            np.array(parameters["vertex_texcoords"], dtype=float).reshape(-1, 2),
            flip,
        )
    ]


def placed(mi, entry, shape, charts, textures):
    """The shape as dictionary or mesh with its textures as emission."""
    if isinstance(charts, Faces):
        vertices, faces = mesh_arrays(mi.traverse(shape))
        return emissive_mesh(mi, vertices, faces, textures, flip=charts.flip < 0)
    if len(charts) == 6:
        atlas, vertices, faces, uv = cube_atlas(cube_frames(_cube_matrix(entry)), textures)
        return emissive_mesh(mi, vertices, faces, emitter(mi, atlas), uv)
    if isinstance(entry, dict):
        return {
            **{
                key: value
                for key, value in entry.items()
                if key not in ("bsdf", "emitter") and not _is_surface(value)
            },
            "emitter": emitter(mi, textures[0]),
        }
    parameters = mi.traverse(shape)
    return emissive_mesh(
        mi,
        *mesh_arrays(parameters),
        emitter(mi, textures[0]),
        np.array(parameters["vertex_texcoords"]).reshape(-1, 2),
        flip=shape.has_flipped_normals(),
    )


def _is_surface(value):
    return isinstance(value, dict) and value.get("type") in ("diffuse", "twosided", "area")


def emitter(mi, texture):
    """Area emitter of a texture [H, W] whose first row is v = 0."""
    return {
        "type": "area",
        "radiance": {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(texture, dtype=np.float32)[..., None]),
            "raw": True,
            "wrap_mode": "clamp",
        },
    }


def emissive_mesh(mi, vertices, faces, light, uv=None, flip=False, bsdf=None):
    """A Mitsuba mesh of flat faces: ``light`` is an emitter dictionary, an array [F] of radiance per face, or
    None; ``bsdf`` a dictionary or None. Raises: DomainError and ShapeError for a mesh that cannot be."""
    vertices, faces = checked_mesh("mesh", vertices, faces)
    for label, values, count in (
        ("radiance per face", None if isinstance(light, dict) else light, len(faces)),
        ("texture coordinates", uv, len(vertices)),
    ):
        if values is not None and len(values) != count:  # Mitsuba would read beyond their end
            raise ShapeError(f"mesh: {len(values)} values of {label} for {count}; give one for each.")
    properties = mi.Properties()
    if light is not None:
        source = (
            light
            if isinstance(light, dict)
            else {"type": "area", "radiance": {"type": "mesh_attribute", "name": "face_radiance"}}
        )
        properties["mesh_emitter"] = mi.load_dict(source)
    if bsdf is not None:
        properties["mesh_bsdf"] = mi.load_dict(bsdf)
    if flip:
        properties["flip_normals"] = True
    mesh = mi.Mesh("mesh", len(vertices), len(faces), props=properties, has_vertex_texcoords=uv is not None)
    if light is not None and not isinstance(light, dict):
        mesh.add_attribute("face_radiance", 1, np.asarray(light, dtype=np.float32).reshape(-1))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(vertices, dtype=np.float32).reshape(-1))
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, dtype=np.uint32).reshape(-1))
    if uv is not None:
        parameters["vertex_texcoords"] = mi.Float(np.ascontiguousarray(uv, dtype=np.float32).reshape(-1))
    parameters.update()
    return mesh


def mesh_arrays(parameters):
    """Vertices [V, 3] float64 and faces [F, 3] of a mesh."""
    return np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3), np.array(
        parameters["faces"]
    ).reshape(-1, 3)


# ---- the map of each shape; texture coordinates as Mitsuba has them


def _matrix(parameters):
    return np.array(parameters["to_world"].matrix, dtype=np.float64).reshape(4, 4)


def _to_world(matrix, local):
    return local @ matrix[:3, :3].T + matrix[:3, 3]


def _rectangle(matrix, flip):
    axes = matrix[:3, :3]
    normal = np.cross(axes[:, 0], axes[:, 1])
    normal *= flip / np.linalg.norm(normal)

    def at(u, v):
        points = _to_world(matrix, np.stack([2 * u - 1, 2 * v - 1, 0 * u], -1))
        return points, np.broadcast_to(normal, points.shape), np.ones(len(points), dtype=bool)

    return Chart((2 * float(np.linalg.norm(axes[:, 0])), 2 * float(np.linalg.norm(axes[:, 1]))), at)


def _disk(matrix, flip):
    flat = _rectangle(matrix, flip)
    radius = float(np.linalg.norm(matrix[:3, 0]))

    def at(u, v):
        x = u * np.cos(2 * np.pi * v)
        y = u * np.sin(2 * np.pi * v)
        return flat.at((x + 1) / 2, (y + 1) / 2)

    return Chart((radius, 2 * np.pi * radius), at)


def _sphere(matrix, flip):
    radius = float(np.linalg.norm(matrix[:3, 0]))

    def at(u, v):
        phi = 2 * np.pi * u
        theta = np.pi * v
        local = np.stack([np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta)], -1)
        return (
            _to_world(matrix, local),
            flip * local @ matrix[:3, :3].T / radius,
            np.ones(len(local), dtype=bool),
        )

    return Chart((2 * np.pi * radius, np.pi * radius), at)


def _cylinder(matrix, flip):
    radius = float(np.linalg.norm(matrix[:3, 0]))
    length = float(np.linalg.norm(matrix[:3, 2]))

    def at(u, v):
        phi = 2 * np.pi * u
        around = np.stack([np.cos(phi), np.sin(phi), 0 * phi], -1)
        return (
            _to_world(matrix, around + np.stack([0 * v, 0 * v, v], -1)),
            flip * around @ matrix[:3, :3].T / radius,
            np.ones(len(around), dtype=bool),
        )

    return Chart((2 * np.pi * radius, length), at)


def _unwrapped(mi, name, shape, vertices, faces, uv, flip):
    """A mesh with texture coordinates that cover each place at most once."""
    if uv.min() < -1e-6 or uv.max() > 1 + 1e-6:
        raise DomainError(
            f"bake: texture coordinates of mesh '{name}' leave the unit square, where one texel would hold "
            "several places; unwrap it anew."
        )
    a, b, c = (uv[faces[:, k]] for k in range(3))
    area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()
    side = 512
    v, u = np.divmod(np.arange(side * side), side)

    def look(u, v):
        return shape.eval_parameterization(mi.Point2f(mi.Float(np.float32(u)), mi.Float(np.float32(v))))

    covered = float(np.array(look((u + 0.5) / side, (v + 0.5) / side).is_valid()).mean())
    if area > OVERLAP * covered + 4 / side:
        raise DomainError(
            f"bake: texture coordinates of mesh '{name}' overlap (triangles of area {area:.3g} cover "
            f"{covered:.3g}); unwrap it so that no two places share a texel."
        )
    world = (
        0.5
        * np.linalg.norm(
            np.cross(
                vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
            ),
            axis=1,
        ).sum()
    )
    size = float(np.sqrt(world / max(area, 1e-9)))

    def at(u, v):
        si = look(u, v)
        inside = np.array(si.is_valid()).astype(bool)
        points, normals = (
            np.where(inside[:, None], np.array(part, dtype=np.float64).T, fallback)
            for part, fallback in ((si.p, 0.0), (si.n, 1.0))
        )
        return points, normals, inside

    return Chart((size, size), at)


# ---- cubes: six rectangles in one texture, since Mitsuba's cube has the same texture coordinates on every
# face


def _cube_matrix(entry):
    frame = entry.get("to_world")
    return np.eye(4) if frame is None else np.array(frame.matrix, dtype=np.float64).reshape(4, 4)


def cube_frames(matrix):
    """Rectangle frames [4, 4] of a cube's faces, normals outwards."""
    frames = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            local = np.zeros((4, 4))
            first, second = ((axis + 1) % 3, (axis + 2) % 3) if sign > 0 else ((axis + 2) % 3, (axis + 1) % 3)
            local[first, 0] = local[second, 1] = 1
            local[axis, 2] = local[axis, 3] = sign
            local[3, 3] = 1
            frames.append(matrix @ local)
    return frames


def cube_atlas(frames, textures):
    """One texture of six, three beside each other in two rows, with the mesh that uses it.

    Returns: atlas [H, W], vertices [24, 3], faces [12, 3], uv [24, 2]; each face of the cube has four
      vertices of its own.
    """
    rows, columns = (max(t.shape[k] for t in textures) + 2 * CUBE_GAP for k in (0, 1))
    atlas = np.zeros((2 * rows, 3 * columns), dtype=np.float32)
    vertices = []
    faces = []
    uv = []
    for k, (frame, texture) in enumerate(zip(frames, textures, strict=True)):
        top, left, (h, w) = k // 3 * rows, k % 3 * columns, texture.shape
        padded = np.pad(
            texture, ((CUBE_GAP, rows - h - CUBE_GAP), (CUBE_GAP, columns - w - CUBE_GAP)), mode="edge"
        )
        atlas[top : top + rows, left : left + columns] = padded
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
        vertices.append(_to_world(frame, np.column_stack([2 * corners - 1, np.zeros(4)])))
        uv.append((corners * [w, h] + [left + CUBE_GAP, top + CUBE_GAP]) / [3 * columns, 2 * rows])
        faces += [[4 * k, 4 * k + 1, 4 * k + 2], [4 * k, 4 * k + 2, 4 * k + 3]]
    return atlas, np.concatenate(vertices), np.array(faces), np.concatenate(uv)
