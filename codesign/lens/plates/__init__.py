"""Phase plates in Zernike terms or on a grid, as elements of a ray-traced lens."""

from codesign.lens.plates.place import with_plate
from codesign.lens.plates.plate import GridPlate, Plate, ZernikePlate
from codesign.lens.plates.zernike import noll, zernike

__all__ = ["GridPlate", "Plate", "ZernikePlate", "noll", "with_plate", "zernike"]
