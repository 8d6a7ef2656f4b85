"""The medium behind a surface exchanged for another, and media that light passes more than once."""

import dataclasses
import itertools
from collections.abc import Sequence

from codesign.errors import DomainError
from codesign.lens.glass import AIR, WAVELENGTH_UM, Glass
from codesign.lens.surface import Surface

SHARED = 1e-3  # of the thickness of a piece of glass; less in common is rounding


def with_medium(
    name: str, surfaces: Sequence[Surface], surface: int, glass: Glass | str | None
) -> tuple[Surface, ...]:
    """The surfaces with another medium behind one of them; see ``GeoLens.replace_glass``.

    Args: name: the lens's, for errors. surface: counted from 0, from the last when negative. glass: a Glass, a
      name or code as ``Glass.named`` takes, None for air.
    Raises: DomainError for a surface that is not there or a mirror, glass passed twice, and a name the catalogue does
      not know.
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
    passes = passes_of(surfaces, at)
    if passes:
        raise DomainError(
            f"{label}: the light passes the glass behind it again behind surface {passes[0] + 1}, as a mirror sends it "
            "back, and only one pass would change; build the lens with the other glass in both."
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


def passes_of(surfaces: Sequence[Surface], gap: int) -> list[int]:
    """Other gaps of the same glass that take the same room on the axis, folded at the mirrors: further passes through
    one piece. A gap behind a mirror is left out, as it takes its medium from the one in front."""
    places = [0.0]
    along = 1.0
    for surface in surfaces:
        along = -along if surface.mirror else along
        places.append(places[-1] + along * surface.thickness_mm)
    spans = [sorted(ends) for ends in itertools.pairwise(places)]
    low, high = spans[gap]
    medium = surfaces[gap].medium
    return [
        i
        for i, (surface, (start, stop)) in enumerate(zip(surfaces, spans, strict=True))
        if i != gap
        and medium is not None
        and surface.medium == medium
        and not surface.mirror
        and min(high, stop) - max(low, start) > SHARED * (high - low)
    ]
