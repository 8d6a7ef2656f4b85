"""Whether a size looks like metres: files rarely say which unit their numbers are in."""

import warnings
from collections.abc import Sequence

LARGE_M = 100.0  # rooms and robots are smaller, and so are most outdoor worlds
SMALL_M = 0.01
EPS = 2.0**-23  # scenes are rendered in single precision
FAR = 1e-4  # of the size, that places may be off by
UNITS = (("centimetres", 0.01), ("millimetres", 0.001))


def hint(
    low_m: Sequence[float], high_m: Sequence[float], what: str = "the world", unit_m: float = 1.0
) -> str | None:
    """A sentence when a box of these two corners, sequences of three numbers in metres, is too
    large or too small for a room or a robot, also given as a UserWarning; None when it is not. One
    that lies so far from the origin that rounding spoils it is a UserWarning too.

    Args:
      what: name of what the box holds, with its file.
      unit_m: metres per unit of the file that the corners were reckoned with.

    >>> hint((0, 0, 0), (4, 5, 2.6)) is None
    True
    """
    size_m = max(float(high) - float(low) for low, high in zip(low_m, high_m, strict=True))
    far_m = max(abs(float(end)) for end in (*low_m, *high_m))
    if far_m * EPS > FAR * size_m > 0:
        warnings.warn(
            f"{what} lies {far_m:.3g} m from the origin, where places are known to {far_m * EPS:.2g} m in single precision; "
            "subtract an offset from it and from the poses.",
            UserWarning,
            stacklevel=3,
        )
    if SMALL_M <= size_m <= LARGE_M or not size_m > 0:
        return None
    remedy = "a larger unit_m"
    if size_m > LARGE_M:
        smaller = (
            f"unit_m={metres:g} ({name}: {size_m / unit_m * metres:.3g} m)"
            for name, metres in UNITS
            if metres < unit_m
        )
        remedy = " or ".join(smaller) or "a smaller unit_m"
    sentence = f"{what} is {size_m:.3g} m wide; if its file is not in units of {unit_m:g} m, give {remedy}."
    warnings.warn(sentence, UserWarning, stacklevel=3)
    return sentence
