"""Scalar waves in free space: sampled fields, their propagation, and the field a lens makes before its film."""

from codesign.lens.wave.before_image import before_image
from codesign.lens.wave.field import Field, disc, rectangle
from codesign.lens.wave.propagate import angular_spectrum, fresnel

__all__ = ["Field", "angular_spectrum", "before_image", "disc", "fresnel", "rectangle"]
