"""Refractive index of optical glass as a function of wavelength."""

from dataclasses import dataclass

from codesign.errors import DomainError

WAVELENGTH_UM = {"F": 0.4861327, "d": 0.5875618, "C": 0.6562725}


@dataclass(frozen=True)
class Glass:
    """A medium known by its indices at the F, d and C lines (486.1, 587.6, 656.3 nm), relative to air."""

    name: str
    index_F: float
    index_d: float
    index_C: float

    @staticmethod
    def from_indices(F, d, C, name="custom"):
        """Glass from its indices at the F, d and C lines; each must be at least 1."""
        if not all(1.0 <= n < 5.0 for n in (F, d, C)):
            raise DomainError(f"glass {name}: indices F={F}, d={d}, C={C} must lie in [1, 5); check the catalogue page.")
        return Glass(name, float(F), float(d), float(C))

    @staticmethod
    def named(name):
        """Glass by its catalogue name; DomainError lists the known names when there is none."""
        if name not in CATALOGUE:
            raise DomainError(f"glass '{name}' is not in the catalogue; known names: {', '.join(sorted(CATALOGUE))}. Give its indices with Glass.from_indices.")
        return CATALOGUE[name]

    def shifted(self, offset):
        """A medium with all indices larger by ``offset``, under the same name with the offset written behind it."""
        return Glass.from_indices(self.index_F + offset, self.index_d + offset, self.index_C + offset, f"{self.name}{offset:+.6g}")

    def index(self, wavelength_um):
        """Index at a vacuum wavelength in micrometres: A + B/w + C/w^3.5 through the three lines, exact at each.

        Within 3e-6 of the catalogue formula between the lines, 5e-5 from 0.43 to 0.71 um. Source: Conrady, Applied Optics and Optical Design.
        Raises: DomainError outside 0.36 to 1.1 um, where three visible lines say little.
        """
        if not 0.36 <= wavelength_um <= 1.1:
            raise DomainError(f"glass {self.name}: wavelength {wavelength_um} um lies outside 0.36 to 1.1 um; give a wavelength in micrometres.")
        F, d, C, w = (_conrady(x) for x in (*WAVELENGTH_UM.values(), wavelength_um))
        whole = _area(F, d, C)
        return self.index_F * (_area(w, d, C) / whole) + self.index_d * (_area(F, w, C) / whole) + self.index_C * (_area(F, d, w) / whole)


def _conrady(wavelength_um):
    return 1 / wavelength_um, wavelength_um**-3.5


def _area(a, b, c):
    """Twice the area of a triangle; the shares of three such areas interpolate linearly."""
    return (a[0] - c[0]) * (b[1] - c[1]) - (b[0] - c[0]) * (a[1] - c[1])


AIR = Glass("air", 1.0, 1.0, 1.0)

# Schott catalogue values (2017 edition), rounded to 1e-9, relative to air.
CATALOGUE = {
    glass.name: glass
    for glass in (
        Glass("N-BK7", 1.52237629, 1.516800035, 1.514322347),
        Glass("N-SK16", 1.627556349, 1.620409965, 1.61727166),
        Glass("N-SK2", 1.614857066, 1.60738097, 1.604135445),
        Glass("N-SSK2", 1.630451679, 1.622293796, 1.618770607),
        Glass("F2", 1.632081457, 1.620040137, 1.615031692),
        Glass("F5", 1.614612261, 1.603420257, 1.598745273),
    )
}
