"""Diffraction: the complex pupil of a lens, and phase plates as elements of a ray-traced lens."""

from codesign.lens.diffraction.place import with_plate
from codesign.lens.diffraction.plates import GridPlate, Plate, ZernikePlate, noll, zernike
from codesign.lens.diffraction.pupil import PupilFunction, pupil_function

__all__ = [
    "GridPlate",
    "Plate",
    "PupilFunction",
    "ZernikePlate",
    "noll",
    "pupil_function",
    "with_plate",
    "zernike",
]
