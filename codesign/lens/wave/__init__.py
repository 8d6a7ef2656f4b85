"""Scalar waves in free space: sampled fields and their propagation."""

from codesign.lens.wave.field import Field, disc, rectangle
from codesign.lens.wave.propagate import angular_spectrum, fresnel

__all__ = ["Field", "angular_spectrum", "disc", "fresnel", "rectangle"]
