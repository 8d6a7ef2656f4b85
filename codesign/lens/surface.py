"""One refracting surface of a sequential lens: shape, the gap behind it, and the medium in that gap."""

import math
from dataclasses import dataclass

from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.glass import Glass


@dataclass(frozen=True)
class Surface:
    """A rotationally symmetric surface.

    radius_mm: vertex radius of curvature, positive when the centre lies towards the image; inf is a plane.
    thickness_mm: axial distance to the next surface (or to the image plane), >= 0.
    medium: glass that follows the surface; None is air (n = 1).
    semi_aperture_mm: half of the clear diameter.
    conic: conic constant k (0 sphere, -1 paraboloid).
    asphere: coefficients of r^2, r^4, r^6, ... in mm^-1, mm^-3, mm^-5, ...
    is_stop: whether this surface is the aperture stop.
    """

    radius_mm: float
    thickness_mm: float
    medium: Glass | None
    semi_aperture_mm: float
    conic: float = 0.0
    asphere: tuple[float, ...] = ()
    is_stop: bool = False

    @property
    def curvature_per_mm(self):
        return 0.0 if math.isinf(self.radius_mm) else 1.0 / self.radius_mm

    def check(self, label):
        """Raise DomainError naming the value and the remedy when the surface cannot exist."""
        numbers = (self.thickness_mm, self.semi_aperture_mm, self.conic, *self.asphere)
        if math.isnan(self.radius_mm) or self.radius_mm == 0 or not all(math.isfinite(v) for v in numbers):
            raise DomainError(f"{label}: radius {self.radius_mm} mm, thickness {self.thickness_mm} mm, conic {self.conic} and asphere {self.asphere} must be finite numbers, the radius not 0 (inf is a plane).")
        if self.thickness_mm < 0:
            raise DomainError(f"{label}: thickness {self.thickness_mm} mm is negative; light travels towards +z, so give the distance to the next surface as 0 or more.")
        if self.semi_aperture_mm <= 0:
            raise DomainError(f"{label}: semi-aperture {self.semi_aperture_mm} mm must be positive.")
        reach = (1 + self.conic) * (self.curvature_per_mm * self.semi_aperture_mm) ** 2
        if reach > 1:
            limit = abs(self.radius_mm) / math.sqrt(1 + self.conic)
            raise DomainError(f"{label}: semi-aperture {self.semi_aperture_mm} mm exceeds what radius {self.radius_mm} mm and conic {self.conic} reach ({limit:.6g} mm); make the aperture smaller or the radius longer.")
        return self


def scaled(surface, factor):
    """The same surface with all lengths multiplied by ``factor``."""
    asphere = tuple(a * factor ** (1 - 2 * (i + 1)) for i, a in enumerate(surface.asphere))
    return Surface(surface.radius_mm * factor, surface.thickness_mm * factor, surface.medium, surface.semi_aperture_mm * factor, surface.conic, asphere, surface.is_stop)


def sag_mm(height_mm: Tensor, curvature_per_mm, conic, asphere):
    """Depth of a surface at heights [...] from the axis, mm.

    Args: curvature_per_mm, conic, and each coefficient of r^2, r^4, ... in ``asphere``: numbers, or tensors that broadcast with the heights.
    Gradient: everything given as a tensor. Beyond the reach of the conic its root is held at 1e-3, so that the gradient stays finite.
    """
    r2 = height_mm.square()
    sag = curvature_per_mm * r2 / (1 + (1 - (1 + conic) * curvature_per_mm**2 * r2).clamp_min(1e-6).sqrt())
    for i, coefficient in enumerate(asphere):
        sag = sag + coefficient * r2 ** (i + 1)
    return sag
