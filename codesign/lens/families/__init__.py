"""Lens families: one topology whose prescription is a smooth function of the focal length, made for
one image circle, so that wide angle and light cost what they cost.

    retrofocus = lens.family("retrofocus-4")
    optics = retrofocus.lens(efl_mm=4.0, fno=2.0, focus_per_m=0.5)
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.resources import files

import torch
from torch import Tensor

from codesign.checks import check_positive
from codesign.errors import DomainError
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import Glass
from codesign.lens.paraxial import bending as index_steps
from codesign.lens.paraxial import first_order, yu_trace
from codesign.lens.surface import Surface

TABLES = files("codesign.lens.families")
QUANTITIES = ("curvature_per_mm", "thickness_mm", "conic", "semi_aperture_mm")
# powers of a length
LENGTHS = {"curvature_per_mm": -1, "thickness_mm": 1, "conic": 0, "semi_aperture_mm": 1}
FOCUS_PER_M = (0.0, 10.0)
BENDING = (-1.0, 1.0)
SOFT_EDGE_MM = 0.1  # for an image circle as in the table
ROUNDING = 1e-12  # of a bound


@dataclass(frozen=True)
class Family:
    """Lenses of one topology, for an image circle of ``image_radius_mm``. See ``family``.

    fno: (fastest, slowest) f-number. efl_mm: [N] focal lengths at the nodes, the ends of the range
      first and last.
    numbers: for each of QUANTITIES, [N, S] at the nodes. film_mm: [N, 2] how far the film lies
      behind the paraxial focus, and how much farther wide open; in between that falls as the square
      of the aperture.
    bent: [S] change of curvature per unit of bending, per mm.
    template: glasses and stop, at numbers that mean nothing.
    """

    name: str
    image_radius_mm: float
    fno: tuple[float, float]
    efl_mm: Tensor
    numbers: dict[str, Tensor]
    film_mm: Tensor
    bent: Tensor
    template: GeoLens

    def lens(
        self,
        efl_mm: float | Tensor,
        fno: float | Tensor,
        focus_per_m: float | Tensor = 0.0,
        bending: float | Tensor = 0.0,
    ) -> GeoLens:
        """The lens of a focal length (d line, exact), stopped to an f-number
        (that of parallel light), its film where its design has the focus of a point 1 / focus_per_m
        before the entrance pupil.

        >>> from codesign import lens
        >>> figures = lens.family("retrofocus-4").lens(4.0, 2.0).first_order()
        >>> round(figures.efl_mm.item(), 9), round(figures.fno.item(), 9)
        (4.0, 2.0)

        Args:
          efl_mm: within ``self.efl_mm``, number or scalar tensor as all others.
          fno: within ``self.fno``. Other apertures than the stop stay those of the fastest lens, so
            that the corner of the image is vignetted there and not when stopped down.
          focus_per_m: 1 / distance in focus, 0 to 10 per metre; 0 is parallel light.
          bending: -1 to 1, of the last element at equal focal length; 0 is the design. It moves
            aberration between the zone (0.7 of the field) and the corner near 0, and harms both
            towards the ends.
        Returns: a lens as from ``GeoLens.replace``, float64.
        Gradient: to all four.
        Raises: DomainError outside these ranges.
        """
        short, long = self.efl_mm[0].item(), self.efl_mm[-1].item()
        efl = self._within(efl_mm, "a focal length", " mm", short, long)
        number = self._within(fno, "an f-number", "", *self.fno)
        focus = self._within(focus_per_m, "a focus", " per metre", *FOCUS_PER_M)
        bent = self.bent * self._within(bending, "a bending", "", *BENDING)
        weights = self._weights(efl)
        c, t, k, a = (weights @ self.numbers[quantity] for quantity in QUANTITIES)
        # interpolated numbers have the focal length but nearly: the lens is scaled to it
        index, at = self._index, self.template.stop_index
        one, zero = torch.ones_like(efl), torch.zeros_like(efl)
        power = (c + bent) * index_steps(index, self.template.mirrors)
        size = -efl * yu_trace(power, t, index, one, zero)[1][-1]
        power, t, a = power / size, t * size, a * size
        first = first_order(power, t, index, at, efl / number)
        # seen from the first vertex
        vergence = 1e-3 * focus / (1 - 1e-3 * focus * first.entrance_pupil_z_mm)
        heights, angles = yu_trace(power, t, index, one, vergence)
        stopped, wide_open = (weights @ self.film_mm) * size
        film = stopped + wide_open * (self.fno[0] / number).square() - heights[-1] / angles[-1]
        made = self.template.replace(
            curvature_per_mm=(c + bent) / size,
            thickness_mm=torch.cat([t[:-1], film[None]]),
            conic=k,
            semi_aperture_mm=torch.cat([a[:at], first.stop_semi_aperture_mm[None], a[at + 1 :]]),
        )
        return made.with_pupil(efl / number)

    @cached_property
    def _index(self):
        return self.template.index()

    def _within(self, value, what, unit, low, high):
        found = torch.as_tensor(value, dtype=torch.float64)
        spare = ROUNDING * max(abs(low), abs(high))
        if found.ndim or not low - spare <= found.item() <= high + spare:
            given = f"{found.item():g}" if found.ndim == 0 else f"tensor {list(found.shape)}"
            raise DomainError(
                f"lens family '{self.name}' cannot reach {what} of {given}{unit}: it has {low:g} to {high:g}{unit} for an "
                f"image circle of {2 * self.image_radius_mm:g} mm; stay inside, or take another of "
                f"{', '.join(family_names())}."
            )
        return found

    def _weights(self, efl):
        """[N] of the nodes: the polynomial in the logarithm of the focal length through them
        (Lagrange)."""
        at, x = self.efl_mm.log(), efl.log()
        same = torch.eye(len(at), dtype=torch.bool)
        return torch.where(same, 1, (x - at) / torch.where(same, 1, at[:, None] - at)).prod(1)


def family(name: str, image_radius_mm: float | None = None) -> Family:
    """A family of lenses by its name: own designs, optimised at all focal lengths at once for spots
    in F, d and C, distortion and edges. Their tables are kept as they were found; no command here
    makes them again.

    >>> from codesign import lens
    >>> [f"{efl:.1f}" for efl in lens.family("retrofocus-4").efl_mm[[0, -1]].tolist()]
    ['2.5', '12.0']
    >>> larger = lens.family("retrofocus-4", image_radius_mm=8.0).lens(8.0, 2.0)
    >>> round(larger.first_order().efl_mm.item(), 9)
    8.0

    Args:
      name: one of ``family_names()``.
      image_radius_mm: of the image circle, to which all lengths are scaled; None is that of the
        table (4.01 mm, the half diagonal of a DAVIS346).
    Raises: DomainError for a name that is not known, or a radius that is not positive.
    """
    if name not in family_names():
        raise DomainError(
            f"no lens family is called {name!r}; choose one of {', '.join(family_names())}."
        )
    found = _published(name)
    if image_radius_mm is None:
        return found
    check_positive(image_radius_mm, "family: image_radius_mm")
    return _scaled(found, image_radius_mm / found.image_radius_mm)


@cache
def _published(name):
    return read_family(name, TABLES.joinpath(f"{name}.txt").read_text("utf-8"))


@cache
def family_names() -> tuple[str, ...]:
    """The names of the families, those of most elements first."""
    names = [
        path.name.removesuffix(".txt") for path in TABLES.iterdir() if path.name.endswith(".txt")
    ]
    return tuple(sorted(names, key=lambda name: (-int(name.rpartition("-")[2]), name)))


def read_family(name: str, text: str) -> Family:
    """The family of a table: lines of a word and what belongs to it, and of surface, quantity and
    its numbers at the nodes; what is not there is 0."""
    rows = [line.split() for line in text.splitlines() if line and not line.startswith("#")]
    heads = {row[0]: row[1:] for row in rows if not row[0].isdigit()}
    glasses = [None if glass == "air" else Glass.named(glass) for glass in heads["media"]]
    stop = int(heads["stop"][0]) - 1
    surfaces = [
        Surface(float("inf"), 1.0, glass, 1.0, is_stop=i == stop) for i, glass in enumerate(glasses)
    ]
    efl = torch.tensor([*map(float, heads["efl_mm"])], dtype=torch.float64)
    film = [[*map(float, heads[which])] for which in ("film_mm", "film_wide_open_mm")]
    numbers = {quantity: efl.new_zeros(len(efl), len(glasses)) for quantity in QUANTITIES}
    for surface, quantity, *values in (row for row in rows if row[0].isdigit()):
        numbers[quantity][:, int(surface) - 1] = torch.tensor(
            [*map(float, values)], dtype=torch.float64
        )
    bent = efl.new_zeros(len(glasses))
    first, last, step = heads["bends"]
    bent[int(first) - 1 : int(last)] = float(step)
    fastest, slowest = map(float, heads["fno"])
    return Family(
        name,
        float(heads["image_radius_mm"][0]),
        (fastest, slowest),
        efl,
        numbers,
        efl.new_tensor(film).T,
        bent,
        GeoLens(surfaces, 1.0, soft_edge_mm=SOFT_EDGE_MM, name=name).freeze(),
    )


def _scaled(family, factor):
    return replace(
        family,
        image_radius_mm=family.image_radius_mm * factor,
        efl_mm=family.efl_mm * factor,
        numbers={name: value * factor ** LENGTHS[name] for name, value in family.numbers.items()},
        film_mm=family.film_mm * factor,
        bent=family.bent / factor,
        template=family.template.scaled(factor).freeze(),
    )
