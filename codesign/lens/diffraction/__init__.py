"""Diffraction: scalar fields in free space, the field a lens makes before its film, and phase plates as
elements of a ray-traced lens."""

from codesign.lens.diffraction.field import Field, disc, rectangle
from codesign.lens.diffraction.place import with_plate
from codesign.lens.diffraction.plates import GridPlate, Plate, ZernikePlate, noll, zernike
from codesign.lens.diffraction.propagate import angular_spectrum, fresnel
from codesign.lens.diffraction.pupil import PupilFunction, before_image, pupil_function

__all__ = [
    "Field",
    "GridPlate",
    "Plate",
    "PupilFunction",
    "ZernikePlate",
    "angular_spectrum",
    "before_image",
    "disc",
    "fresnel",
    "noll",
    "pupil_function",
    "rectangle",
    "with_plate",
    "zernike",
]
