"""One surface of a sequential lens: shape, what it does to light, the gap behind it, and the medium
in that gap, which can be exchanged."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from codesign.checks import check_positive
from codesign.errors import DomainError
from codesign.lens.glass import AIR, D_UM, WAVELENGTH_UM, Glass


@dataclass(frozen=True)
class Phase:
    """A diffractive phase on a surface: phi(r) = sum of coefficients[i] r^(2i + 2), in radians and
    mm, used in one order.

    The ray gains the path m w phi / (2 pi), so a negative first coefficient converges light.
    blaze_um:
    wavelength at which the grating is blazed for its order; it sets ``efficiency``, None leaves
    that at 1.
    Source: Buralli, Morris and Rogers, Optical performance of holographic kinoforms, Applied Optics
      28 (1989).
    """

    coefficients: tuple[float, ...]
    order: int = 1
    blaze_um: float | None = None

    def check(self, label: str) -> None:
        """Raise DomainError when the phase cannot exist."""
        if (
            not self.coefficients
            or not all(math.isfinite(a) for a in self.coefficients)
            or not isinstance(self.order, int)
        ):
            raise DomainError(
                f"{label}: a phase needs finite coefficients and a whole order, got {self.coefficients} and "
                f"{self.order!r}."
            )
        if self.blaze_um is not None:
            check_positive(self.blaze_um, f"{label}: blaze_um")

    def efficiency(self, wavelength_um: float) -> float:
        """Scalar efficiency of the order at a wavelength: sinc^2(m (blaze / w) - m) for a surface
        blazed for order m, without the dispersion of its material."""
        if self.blaze_um is None:
            return 1.0
        x = math.pi * self.order * (self.blaze_um / wavelength_um - 1)
        return 1.0 if x == 0 else (math.sin(x) / x) ** 2


@dataclass(frozen=True)
class Surface:
    """A rotationally symmetric surface, centred on the axis unless it is decentred or tilted.

    radius_mm: vertex radius of curvature, positive when the centre lies towards the image; inf is a
      plane.
    thickness_mm: axial distance to the next surface (or to the image plane), >= 0.
    medium: glass that follows the surface; None is air (n = 1).
    semi_aperture_mm: half of the clear diameter.
    conic: conic constant k (0 sphere, -1 paraboloid).
    asphere: coefficients of r^2, r^4, r^6, ... in mm^-1, mm^-3, mm^-5, ...
    is_stop: whether this surface is the aperture stop.
    mirror: whether it reflects. The axis is unfolded at a mirror: light travels along +z behind it
      too, so lengths and curvatures that follow count along the light (a file's signs are turned by
      its reader); its medium is the one in front of it.
    phase: a diffractive phase, or None.
    decentre_mm: (x, y) of the vertex; tilt_deg: about x, then about y, around that vertex. Later
      surfaces stay where they were.
    inner_semi_aperture_mm: half the diameter of a central obstruction, 0 for none.

    Example:
    >>> from codesign import lens
    >>> front = lens.Surface(51.68, 4.0, lens.Glass.named("N-BK7"), semi_aperture_mm=10.0)
    >>> back = lens.Surface(float("inf"), 97.4, None, semi_aperture_mm=10.0)
    >>> singlet = lens.GeoLens([front, back], entrance_pupil_diameter_mm=15.0)
    >>> round(singlet.first_order().efl_mm.item(), 3)  # 51.68 / (n - 1)
    100.0
    """

    radius_mm: float
    thickness_mm: float
    medium: Glass | None
    semi_aperture_mm: float
    conic: float = 0.0
    asphere: tuple[float, ...] = ()
    is_stop: bool = False
    mirror: bool = False
    phase: Phase | None = None
    decentre_mm: tuple[float, float] = (0.0, 0.0)
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    inner_semi_aperture_mm: float = 0.0

    @property
    def curvature_per_mm(self) -> float:
        return 0.0 if math.isinf(self.radius_mm) else 1.0 / self.radius_mm

    def check(self, label: str) -> "Surface":
        """Raise DomainError naming the value and the remedy when the surface cannot exist."""
        numbers = (
            self.thickness_mm,
            self.semi_aperture_mm,
            self.conic,
            *self.asphere,
            *self.decentre_mm,
            *self.tilt_deg,
        )
        if self.medium is not None and not isinstance(self.medium, Glass):
            raise DomainError(
                f"{label}: medium {self.medium!r} is no glass; give Glass.named({str(self.medium)!r}), or "
                "None for air."
            )
        no_radius = math.isnan(self.radius_mm) or self.radius_mm == 0
        if no_radius or not all(map(math.isfinite, numbers)):
            raise DomainError(
                f"{label}: radius {self.radius_mm} mm, thickness {self.thickness_mm} mm, conic {self.conic} "
                f"and asphere {self.asphere} must be finite numbers, the radius not 0 (inf is a plane)."
            )
        if self.thickness_mm < 0:
            raise DomainError(
                f"{label}: thickness {self.thickness_mm} mm is negative; light travels towards +z, so give "
                "the distance to the next surface as 0 or more."
            )
        if self.semi_aperture_mm <= 0:
            raise DomainError(
                f"{label}: semi-aperture {self.semi_aperture_mm} mm must be positive."
            )
        if not 0 <= self.inner_semi_aperture_mm < self.semi_aperture_mm:
            raise DomainError(
                f"{label}: central obstruction of {self.inner_semi_aperture_mm} mm must be at least 0 and "
                f"smaller than the semi-aperture {self.semi_aperture_mm} mm."
            )
        if max(map(abs, self.tilt_deg)) >= 90:
            raise DomainError(f"{label}: tilt {self.tilt_deg} degrees must stay below 90.")
        if self.phase is not None:
            self.phase.check(label)
            if self.mirror:
                raise DomainError(
                    f"{label}: a diffractive phase on a mirror is not traced; put it on a refracting "
                    "surface or on a plane of its own."
                )
        reach = (1 + self.conic) * (self.curvature_per_mm * self.semi_aperture_mm) ** 2
        if reach > 1:
            limit = abs(self.radius_mm) / math.sqrt(1 + self.conic)
            raise DomainError(
                f"{label}: semi-aperture {self.semi_aperture_mm} mm exceeds what radius {self.radius_mm} mm "
                f"and conic {self.conic} reach ({limit:.6g} mm); make the aperture smaller or the radius "
                "longer."
            )
        return self


def checked(name: str, surfaces: Iterable[Surface]) -> tuple[tuple[Surface, ...], int]:
    """Surfaces that can be a lens of that name, and which of them is the stop; the first where none
    is marked.

    Raises: DomainError for none, for what is no Surface or cannot exist, and for two stops.
    """
    surfaces = tuple(surfaces)
    if not surfaces or not all(isinstance(surface, Surface) for surface in surfaces):
        kinds = ", ".join(sorted({type(surface).__name__ for surface in surfaces})) or "none"
        raise DomainError(
            f"{name}: a lens needs at least one surface, each a Surface; given: {kinds}."
        )
    for i, surface in enumerate(surfaces):
        surface.check(f"{name}, surface {i + 1}")
    stops = [i for i, s in enumerate(surfaces) if s.is_stop]
    if len(stops) > 1:
        raise DomainError(
            f"{name}: surfaces {[i + 1 for i in stops]} are all marked as the stop; mark one."
        )
    return surfaces, stops[0] if stops else 0


def described(surfaces: Iterable[Surface]) -> dict[str, float]:
    """What surfaces are beside the tensors of a lens, {what: number}: media, mirrors, obstructions
    and gratings."""
    found = {}
    for i, s in enumerate(surfaces, 1):
        medium = s.medium or AIR
        low, high = medium.range_um
        for line, w in WAVELENGTH_UM.items():
            what = f"index behind surface {i} at {line} ({medium.name} here)"
            found[what] = medium.index(min(max(w, low), high))
        found[f"mirror at surface {i}"] = float(s.mirror)
        found[f"obstruction of surface {i} in mm"] = s.inner_semi_aperture_mm
        found[f"diffraction order of surface {i}"] = float(s.phase.order if s.phase else 0)
        found[f"blaze of surface {i} in um"] = (s.phase and s.phase.blaze_um) or 0.0
    return found


def scaled_asphere(coefficients: Sequence[float], factor: float) -> tuple[float, ...]:
    """Coefficients of r^2, r^4, ... of a sag when all lengths are multiplied by ``factor``."""
    return tuple(a * factor ** (-1 - 2 * i) for i, a in enumerate(coefficients))


def scaled_phase(phase: Phase | None, factor: float) -> Phase | None:
    """The same phase in another unit of length, of which ``factor`` are one of the old."""
    if phase is None:
        return None
    return replace(
        phase,
        coefficients=tuple(a * factor ** (-2 - 2 * i) for i, a in enumerate(phase.coefficients)),
    )


def scaled(surface: Surface, factor: float) -> Surface:
    """The same surface with all lengths multiplied by ``factor``, and its phase so that light of the
    same wavelength is turned as far."""
    lengths = {
        name: getattr(surface, name) * factor
        for name in ("radius_mm", "thickness_mm", "semi_aperture_mm", "inner_semi_aperture_mm")
    }
    return replace(
        surface,
        **lengths,
        asphere=scaled_asphere(surface.asphere, factor),
        phase=surface.phase
        and replace(surface.phase, coefficients=scaled_asphere(surface.phase.coefficients, factor)),
        decentre_mm=(surface.decentre_mm[0] * factor, surface.decentre_mm[1] * factor),
    )


def sag_mm(
    height_mm: Tensor,
    curvature_per_mm: float | Tensor,
    conic: float | Tensor,
    asphere: Sequence[float | Tensor],
) -> Tensor:
    """Depth of a surface at heights [...] from the axis, mm.

    Args: curvature_per_mm, conic, and each coefficient of r^2, r^4, ... in ``asphere``: numbers, or
      tensors that broadcast with the heights.
    Gradient: everything given as a tensor. Beyond the reach of the conic its root is held at 1e-3,
      so that the gradient stays finite.
    """
    r2 = height_mm.square()
    root = (1 - (1 + conic) * curvature_per_mm**2 * r2).clamp_min(1e-6).sqrt()
    sag = curvature_per_mm * r2 / (1 + root)
    for i, coefficient in enumerate(asphere):
        sag = sag + coefficient * r2 ** (i + 1)
    return sag


SHARED = 1e-3  # of the thickness of a piece of glass; less in common is rounding


def with_medium(
    name: str, surfaces: Sequence[Surface], surface: int, glass: Glass | str | None
) -> tuple[Surface, ...]:
    """The surfaces with another medium behind one of them; see ``GeoLens.replace_glass``.

    Args:
      name: the lens's, for errors.
      surface: counted from 0, from the last when negative.
      glass: a Glass, a name or code as ``Glass.named`` takes, None for air.
    Raises: DomainError for a surface that is not there or a mirror, glass passed twice, and a name
      the catalogue does not know.
    """
    count = len(surfaces)
    if isinstance(surface, bool) or not isinstance(surface, int) or not -count <= surface < count:
        raise DomainError(f"{name}: there is no surface {surface}; it has 0 to {count - 1}.")
    at = range(count)[surface]
    label = f"{name}, surface {at + 1}"
    if surfaces[at].mirror:
        raise DomainError(
            f"{label}: it is a mirror, behind which the light stays in the medium in front of it; replace "
            "that one."
        )
    passes = passes_of(surfaces, at)
    if passes:
        raise DomainError(
            f"{label}: the light passes the glass behind it again behind surface {passes[0] + 1}, as a "
            "mirror sends it back, and only one pass would change; build the lens with the other glass in "
            "both."
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
        glass.index(D_UM)  # every figure of a lens starts from the d line
    medium = None if glass == AIR else glass
    return (*surfaces[:at], dataclasses.replace(surfaces[at], medium=medium), *surfaces[at + 1 :])


def passes_of(surfaces: Sequence[Surface], gap: int) -> list[int]:
    """Other gaps of the same glass that take the same room on the axis, folded at the mirrors:
    further passes through one piece. A gap behind a mirror is left out, as it takes its medium from
    the one in front."""
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


def passed_twice(surfaces: Sequence[Surface]) -> tuple[set[int], set[int], set[int]]:
    """Rows of faces, gaps and media of glass that the light passes again behind a mirror, where
    another row says the same. A mirrored back is one face, with the medium in front on both ways."""
    media = {i for i in range(len(surfaces)) if passes_of(surfaces, i)}
    gaps = set(media)
    filled = False
    for i, surface in enumerate(surfaces):
        if not surface.mirror:
            filled = surface.medium not in (None, AIR)
        elif filled:
            gaps |= {i - 1, i}
    faces = {i for i, s in enumerate(surfaces) if not s.mirror and not gaps.isdisjoint((i - 1, i))}
    return faces, gaps, media
