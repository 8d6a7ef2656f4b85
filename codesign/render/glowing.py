"""Triangles that glow before nothing: a picture of them is the share of each pixel that they cover."""

import numpy as np
from torch import Tensor

from codesign import backend
from codesign.render.charts import emissive_mesh
from codesign.render.world import MitsubaScene


def glowing(triangles_m: Tensor) -> MitsubaScene:
    """Scene of triangles [F, 3, 3] with radiance 1 on both sides, and 0 elsewhere. Raises: DomainError for a mesh that
    cannot be."""
    corners = triangles_m.detach().cpu().reshape(-1, 3).numpy()
    faces = np.arange(len(corners)).reshape(-1, 3)
    mesh = emissive_mesh(backend.mitsuba("cpu"), corners, faces, np.ones(len(faces)))
    return MitsubaScene({"body": mesh}).two_sided()
