"""The medium behind a surface exchanged for another."""

import dataclasses
from collections.abc import Sequence

from codesign.errors import DomainError
from codesign.lens.glass import AIR, WAVELENGTH_UM, Glass
from codesign.lens.surface import Surface


def with_medium(
    name: str, surfaces: Sequence[Surface], surface: int, glass: Glass | str | None
) -> tuple[Surface, ...]:
    """The surfaces with another medium behind one of them; see ``GeoLens.replace_glass``.

    Args: name: the lens's, for errors. surface: counted from 0, from the last when negative. glass: a Glass, a
      name or code as ``Glass.named`` takes, None for air.
    Raises: DomainError.
    """
    count = len(surfaces)
    if isinstance(surface, bool) or not isinstance(surface, int) or not -count <= surface < count:
        raise DomainError(f"{name}: there is no surface {surface}; it has 0 to {count - 1}.")
    at = range(count)[surface]
    label = f"{name}, surface {at + 1}"
    if surfaces[at].mirror:
        raise DomainError(
            f"{label}: it is a mirror, behind which the light stays in the medium in front of it; replace that one."
        )
    if isinstance(glass, str):
        try:
            glass = Glass.named(glass)
        except DomainError as error:
            raise DomainError(f"{label}: {error}") from None
    if not isinstance(glass, (Glass, type(None))):
        raise DomainError(
            f"{label}: {type(glass).__name__} is no medium; give a Glass, the name of one, or None for air."
        )
    if glass is not None:
        glass.index(WAVELENGTH_UM["d"])  # every figure of a lens starts from the d line
    medium = None if glass == AIR else glass
    return (*surfaces[:at], dataclasses.replace(surfaces[at], medium=medium), *surfaces[at + 1 :])
