"""Volume and area of meshes."""

import numpy as np


def volume(vertices, faces):
    """By the divergence theorem: positive when faces turn outwards."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum()) / 6


def volume_m3(mesh):
    return volume(mesh.vertices_m, mesh.faces)


def across(vertices, faces):
    """Of every face a vector along its normal, as long as twice its area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def area_m2(mesh):
    return np.linalg.norm(across(mesh.vertices_m, mesh.faces), axis=1).sum() / 2
