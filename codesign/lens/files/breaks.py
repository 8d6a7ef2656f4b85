"""The rigid frames that coordinate breaks carry from surface to surface, and the surfaces seen from
the image."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from codesign.errors import FileFormatError
from codesign.lens.files.system import FileSurface

# rounding of a frame that was left and entered again: rad, and per length of the lens
NO_TILT = 1e-14
NO_SHIFT = 1e-14


def along(distance: float) -> np.ndarray:
    """The frame [4, 4] further along z. Raises: FileFormatError where that is infinitely far."""
    if math.isinf(distance):
        raise FileFormatError(
            "its thickness is infinite, which only that of the object may be; give a finite one (DISZ)."
        )
    frame = np.eye(4)
    frame[2, 3] = distance
    return frame


def coordinate_break(parameters: Mapping[int, float]) -> np.ndarray:
    """The frame [4, 4] behind a break, in the one before it.

    PARM 1, 2: decentre x, y. PARM 3, 4, 5: right-handed tilts about the x, y, z in force, degrees.
      PARM 6 is 0: decentre, then x, y, z; 1, which undoes it: z, y, x, then decentre.
    Raises: FileFormatError for other parameters.
    """
    for i, value in parameters.items():
        if (value and i not in range(1, 7)) or (i == 6 and value not in (0, 1)):
            raise FileFormatError(
                f"its PARM {i} is {value:g}, which is not understood; a coordinate break has PARM 1 to 5 and "
                "the order PARM 6, 0 or 1."
            )
    shift = np.eye(4)
    shift[:2, 3] = [parameters.get(i, 0.0) for i in (1, 2)]
    steps = [shift, *(_turn(axis, parameters.get(3 + axis, 0.0)) for axis in range(3))]
    return np.linalg.multi_dot(steps[::-1] if parameters.get(6) else steps)


def _turn(axis, angle_deg):
    """Right-handed turn about x, y or z (0, 1, 2)."""
    sine, cosine = math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(4)
    turn[j, j] = turn[k, k] = cosine
    turn[k, j], turn[j, k] = sine, -sine
    return turn


def place(
    surfaces: Sequence[FileSurface],
    frames: Sequence[np.ndarray],
    image: np.ndarray,
) -> float:
    """Write decentres, tilts and depths into the surfaces, seen from the image plane, whose normal
    through its centre is the axis of the model.

    Args:
      frames: of the surfaces, and ``image``, in that of the object.
    Returns: angle between the object's axis and the image's, degrees.
    Raises: FileFormatError where a surface turns by 90 degrees or more.
    """
    back = np.linalg.inv(image)
    length = max(float(np.abs(frame[:3, 3]).max()) for frame in (*frames, image))
    for surface, frame in zip(surfaces, frames, strict=True):
        seen = back @ frame
        x, y, z = seen[:3, 2]
        if z <= NO_TILT:
            raise FileFormatError(
                f"surface {surface.label}: its axis stands at {math.degrees(math.acos(max(z, -1.0))):.4g} "
                "degrees to that of the image plane, less than 90 are traced; use a design that is not "
                "folded by coordinate breaks."
            )
        surface.tilt_deg = _rounded(math.atan2(-y, z)), _rounded(math.atan2(x, math.hypot(y, z)))
        across = np.where(np.abs(seen[:2, 3]) > NO_SHIFT * length, seen[:2, 3], 0.0)
        surface.decentre = float(across[0]), float(across[1])
        surface.depth = float(seen[2, 3])
    return _rounded(math.atan2(math.hypot(*back[:2, 2]), back[2, 2]))


def _rounded(angle):
    return math.degrees(angle) if abs(angle) > NO_TILT else 0.0
