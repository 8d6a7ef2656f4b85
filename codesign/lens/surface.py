"""One surface of a sequential lens: shape, what it does to light, the gap behind it, and the medium in that
gap."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.glass import Glass


@dataclass(frozen=True)
class Phase:
    """A diffractive phase on a surface: phi(r) = sum of coefficients[i] r^(2i + 2), in radians and mm, used
    in one order.

    The ray gains the path m w phi / (2 pi), so a negative first coefficient converges light. blaze_um:
    wavelength at which the grating is blazed for its order; it sets ``efficiency``, None leaves that at 1.
    Source: Buralli, Morris and Rogers, Optical performance of holographic kinoforms, Applied Optics 28
      (1989).
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
        if self.blaze_um is not None and not 0 < self.blaze_um < math.inf:
            raise DomainError(f"{label}: blaze wavelength {self.blaze_um} um must be positive.")

    def efficiency(self, wavelength_um: float) -> float:
        """Scalar efficiency of the order at a wavelength: sinc^2(m (blaze / w) - m) for a surface blazed for
        order m, without the dispersion of its material."""
        if self.blaze_um is None:
            return 1.0
        x = math.pi * self.order * (self.blaze_um / wavelength_um - 1)
        return 1.0 if x == 0 else (math.sin(x) / x) ** 2


@dataclass(frozen=True)
class Surface:
    """A rotationally symmetric surface, centred on the axis unless it is decentred or tilted.

    radius_mm: vertex radius of curvature, positive when the centre lies towards the image; inf is a plane.
    thickness_mm: axial distance to the next surface (or to the image plane), >= 0.
    medium: glass that follows the surface; None is air (n = 1).
    semi_aperture_mm: half of the clear diameter.
    conic: conic constant k (0 sphere, -1 paraboloid).
    asphere: coefficients of r^2, r^4, r^6, ... in mm^-1, mm^-3, mm^-5, ...
    is_stop: whether this surface is the aperture stop.
    mirror: whether it reflects. The axis is unfolded at a mirror: light travels along +z behind it too, so
      lengths and curvatures
      that follow count along the light (a file's signs are turned by its reader); its medium is the one in
      front of it.
    phase: a diffractive phase, or None.
    decentre_mm: (x, y) of the vertex; tilt_deg: about x, then about y, around that vertex. Later surfaces
      stay where they were.
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
                f"{label}: medium {self.medium!r} is no glass; give Glass.named({str(self.medium)!r}), or None for air."
            )
        if math.isnan(self.radius_mm) or self.radius_mm == 0 or not all(math.isfinite(v) for v in numbers):
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
            raise DomainError(f"{label}: semi-aperture {self.semi_aperture_mm} mm must be positive.")
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


def scaled(surface: Surface, factor: float) -> Surface:
    """The same surface with all lengths multiplied by ``factor``."""
    asphere = tuple(a * factor ** (1 - 2 * (i + 1)) for i, a in enumerate(surface.asphere))
    phase = surface.phase and replace(
        surface.phase,
        coefficients=tuple(a * factor ** (-2 * (i + 1)) for i, a in enumerate(surface.phase.coefficients)),
    )
    lengths = {
        name: getattr(surface, name) * factor
        for name in ("radius_mm", "thickness_mm", "semi_aperture_mm", "inner_semi_aperture_mm")
    }
    return replace(
        surface,
        **lengths,
        asphere=asphere,
        phase=phase,
        decentre_mm=(surface.decentre_mm[0] * factor, surface.decentre_mm[1] * factor),
    )


def sag_mm(
    height_mm: Tensor,
    curvature_per_mm: float | Tensor,
    conic: float | Tensor,
    asphere: Sequence[float | Tensor],
) -> Tensor:
    """Depth of a surface at heights [...] from the axis, mm.

    Args: curvature_per_mm, conic, and each coefficient of r^2, r^4, ... in ``asphere``: numbers, or tensors
      that broadcast with the heights.
    Gradient: everything given as a tensor. Beyond the reach of the conic its root is held at 1e-3, so that
      the gradient stays finite.
    """
    r2 = height_mm.square()
    sag = curvature_per_mm * r2 / (1 + (1 - (1 + conic) * curvature_per_mm**2 * r2).clamp_min(1e-6).sqrt())
    for i, coefficient in enumerate(asphere):
        sag = sag + coefficient * r2 ** (i + 1)
    return sag
