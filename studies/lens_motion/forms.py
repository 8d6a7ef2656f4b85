"""Cheap fast lenses with few free numbers: the film's place, a bending, and up to two thicknesses.

The stop is the first lens's own cell, as it is where a lens is cheap: no stop can be shifted to
take astigmatism away. A bending adds the same curvature to all surfaces, which leaves the power of
every thin element as it was.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign import lens
from codesign.errors import DomainError
from codesign.lens.design import edge_thickness_mm
from codesign.lens.solves import hold_efl
from studies.lens_opt.spots import film_moved
from studies.lens_opt.task import DISTANCE_M

CROWN, FLINT = "N-BK7", "N-SF5"
MARGIN_MM = 0.6  # of glass around the beam on the axis
THICKNESS_RANGE = 0.2  # by which thicknesses may change, relative
STEPS = (0.05, 0.02, 0.5)  # what a unit of film (mm), bending (1/mm) and thickness (mm) is
BENDING = 2.5  # the most, in its steps: a stock lens, not a meniscus
FILM = (-40.0, 20.0)  # about the paraxial image of the wall, in its steps
EDGE_MM = 0.1  # the least thickness of a glass edge
PENALTY = 100.0  # of edges thinner than that, per mm^2
# rows of radius (mm at a focal length of 11), thickness (mm), glass; then which thicknesses are
# free
ROWS = {
    "singlet": (((5.7, 2.6, CROWN), (math.inf, 9.5, None)), (0,)),
    "achromat": (((6.75, 3.0, CROWN), (-4.9, 1.2, FLINT), (-14.3, 9.5, None)), (0, 1)),
    "pair": (((11.0, 2.4, CROWN), (40.0, 0.5, None), (9.0, 2.4, CROWN), (30.0, 7.5, None)), (1, 2)),
}
# focal length in mm, f-number
FORMS = {"singlet": (9.0, 3.2), "achromat": (11.0, 1.8), "pair": (9.0, 2.0), "triplet": (11.0, 2.8)}


@dataclass(frozen=True)
class Form:
    """A lens and what of it is free. start: the lens at all variables 0. free: indices of its free
    thicknesses."""

    start: lens.GeoLens
    free: tuple[int, ...]
    efl_mm: float

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Least and most of film, bending and thicknesses, in their steps."""
        reach = [THICKNESS_RANGE * float(self.start.thickness_mm[k]) / STEPS[2] for k in self.free]
        return [FILM, (-BENDING, BENDING), *((-r, r) for r in reach)]

    def optics(self, variables: Tensor) -> lens.GeoLens:
        """The lens at variables [2 + thicknesses], its focal length held by the last curvature.
        Gradient: all."""
        film, bending, *thicker = variables.unbind()
        thickness = list(self.start.thickness_mm.unbind())
        for k, more in zip(self.free, thicker, strict=True):
            thickness[k] = thickness[k] + STEPS[2] * more
        bent = self.start.replace(
            curvature_per_mm=self.start.curvature_per_mm + STEPS[1] * bending,
            thickness_mm=torch.stack(thickness),
        )
        focused = hold_efl(bent, self.efl_mm).focus_at(DISTANCE_M)
        return film_moved(focused, STEPS[0] * film)

    def penalty(self, optics: lens.GeoLens) -> Tensor:
        """Of glass edges that are too thin, scalar."""
        return PENALTY * (EDGE_MM - edge_thickness_mm(optics)).clamp_min(0).square().sum()


def make_form(name: str, fno: float | None = None) -> Form:
    """A form by name, at its own f-number or another.

    Raises: DomainError for a name that is no form, and an f-number that is not above 1.
    """
    if name not in FORMS:
        raise DomainError(f"--lens {name} is none of {', '.join(FORMS)}; give one of them.")
    efl_mm, usual = FORMS[name]
    fno = usual if fno is None else fno
    if not 1 < fno < math.inf:
        raise DomainError(f"--fno is {fno}; give a number above 1, or leave it out for {usual:g}.")
    half_mm = efl_mm / fno / 2
    if name == "triplet":
        optics = _opened(lens.load("cooke-triplet"), efl_mm, half_mm)
        return Form(hold_efl(optics, efl_mm).freeze(), (1, 3), efl_mm)
    rows, free = ROWS[name]
    surfaces = []
    for i, (r, t, g) in enumerate(rows):
        glass = lens.Glass.named(g) if g else None
        wide = half_mm + MARGIN_MM
        surfaces.append(lens.Surface(r * efl_mm / 11, t, glass, wide, is_stop=i == 0))
    optics = lens.GeoLens(surfaces, 2 * half_mm, name=name)
    return Form(hold_efl(optics, efl_mm).freeze(), free, efl_mm)


def _opened(published, efl_mm, half_mm):
    """A published lens at another focal length and a wider aperture, its elements as much wider as
    they need be."""
    scaled = published.scaled(efl_mm / float(published.first_order().efl_mm))
    wide = scaled.semi_aperture_mm.clamp_min(half_mm)
    opened = lens.GeoLens(scaled.to_surfaces(), 2 * half_mm, name=published.name)
    return opened.replace(semi_aperture_mm=wide)
