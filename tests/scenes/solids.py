"""Volume and area of meshes."""

import numpy as np


def volume(vertices, faces):
    """By the divergence theorem: positive when faces turn outwards."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum()) / 6


def volume_m3(mesh):
    return volume(mesh.vertices_m, mesh.faces)


def across(corners):
    """Of every face, by its corners [F, 3, 3], a vector along its normal, as long as twice its
    area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def area_m2(mesh):
    return np.linalg.norm(across(mesh.vertices_m[mesh.faces]), axis=1).sum() / 2
