"""Robot bodies and other triangle meshes from files: STL (binary and text), OBJ, PLY. Metres."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from codesign import backend
from codesign.errors import DomainError, FileFormatError

# share of light from everywhere, and where the rest comes from
SKY = 0.6
SUN = (0.3, -0.5, 0.81)


@dataclass(frozen=True)
class Body:
    """Triangles in the world: vertices_m [V, 3], faces [F, 3]."""

    vertices_m: np.ndarray
    faces: np.ndarray

    def placed(self, x=0.0, y=0.0, bottom_m=0.0, turn_deg=0.0):
        """The body turned about z, its bounding box centred over (x, y) and resting on ``bottom_m``."""
        angle = np.radians(turn_deg)
        turned = self.vertices_m @ np.array(
            [[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        low = turned.min(0)
        high = turned.max(0)
        return Body(
            turned - [(low[0] + high[0]) / 2 - x, (low[1] + high[1]) / 2 - y, low[2] - bottom_m], self.faces
        )


def read(path, scale=1.0):
    """A mesh file as a Body, its coordinates times ``scale`` (0.001 for a file in millimetres).

    Raises: FileFormatError when the file is missing, of another kind, empty or damaged; DomainError for a
      scale that is not positive.
    """
    path = Path(path)
    if not 0 < scale < float("inf"):
        raise DomainError(f"mesh {path}: scale = {scale} must be positive and finite.")
    if not path.is_file():
        raise FileFormatError(f"mesh '{path}' is not a file; give the path of an .stl, .obj or .ply file.")
    kind = path.suffix.lower()
    if kind == ".stl":
        vertices, faces = _stl(path)
    elif kind in (".obj", ".ply"):
        vertices, faces = _by_mitsuba(path, kind[1:])
    else:
        raise FileFormatError(f"mesh '{path}' ends in '{kind}'; .stl, .obj and .ply are read, so convert it.")
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise FileFormatError(f"mesh '{path}' has no faces or vertices that are not finite; export it anew.")
    return Body(scale * vertices, faces)


def skylight(body):
    """Share [F] of full light on each face from a plain sky with a soft sun: what stands for shading where
    nothing is lit."""
    corners = body.vertices_m[body.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    sun = np.array(SUN) / np.linalg.norm(SUN)
    return SKY * (0.6 + 0.4 * normal[:, 2]) + (1 - SKY) * np.maximum(normal @ sun, 0)


def _stl(path):
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    if len(data) == 84 + 50 * count:
        record = np.frombuffer(
            data,
            dtype=np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]),
            offset=84,
            count=count,
        )
        corners = record["corners"].astype(np.float64).reshape(-1, 3)
    elif data[:5] == b"solid":
        try:
            corners = np.array(
                [
                    line.split()[1:4]
                    for line in data.decode("ascii", "strict").splitlines()
                    if line.split()[:1] == ["vertex"]
                ],
                dtype=np.float64,
            ).reshape(-1, 3)
        except ValueError as error:
            raise FileFormatError(
                f"mesh '{path}' is a text STL with a broken vertex line ({str(error)[:80]}); export it anew."
            ) from error
    else:
        raise FileFormatError(
            f"mesh '{path}' is not an STL file: it says {count} triangles but holds {len(data)} bytes; "
            "export it anew."
        )
    if len(corners) % 3:
        raise FileFormatError(
            f"mesh '{path}' holds {len(corners)} vertices, which is no whole number of triangles; export it "
            "anew."
        )
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    whole = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    )  # slivers of no area
    return vertices, faces[whole]


def _by_mitsuba(path, kind):
    mi = backend.mitsuba("cpu")
    try:
        parameters = mi.traverse(mi.load_dict({"type": kind, "filename": str(path)}))
    except Exception as error:  # Mitsuba raises plain RuntimeErrors of many lines
        raise FileFormatError(
            f"mesh '{path}' cannot be read as {kind.upper()} ({str(error).splitlines()[-1][:120]}); export "
            "it anew."
        ) from error
    return np.array(parameters["vertex_positions"], dtype=np.float64).reshape(-1, 3), np.array(
        parameters["faces"]
    ).reshape(-1, 3)
