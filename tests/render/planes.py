"""Planes that several tests look at, and a pose of the camera over them."""

from codesign.pose import look_at
from codesign.render import TexturedPlane
from scenes import textures
from tests.numbers import f64

START = look_at((0.2, 0.1, 2.0), (0.0, 0.0, 0.0), down=(0, 1, 0))


def at(x_m, z_m):
    """A pose there, turned by nothing."""
    return f64([[1, 0, 0, x_m], [0, 1, 0, 0], [0, 0, 1, z_m], [0, 0, 0, 1]])


def plane(seed=1, height_m=0.0):
    return TexturedPlane(
        *textures.waves(seed, finest_period_m=0.2), T_world_plane=at(0.0, height_m)
    )


def even(radiance, height_m=0.0):
    return TexturedPlane([[1.0, 0.0]], [0.0], [0.0], mean=radiance, T_world_plane=at(0.0, height_m))
