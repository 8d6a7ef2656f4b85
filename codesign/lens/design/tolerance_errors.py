"""Errors of manufacture and assembly: how large they are, what each changes in a lens, and a lens that has them."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.lens.design.constraints import is_glass
from codesign.lens.design.element_errors import moved_element
from codesign.lens.design.moves import groups
from codesign.lens.geolens import GeoLens
from codesign.lens.media import passes_of

OF_ELEMENT = "element "  # before the argument of ``moved_element``


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of independent normal errors, all at least 0; 0 leaves that kind out.

    radius_relative: of every radius, as a share. radius_mm: of every radius, mm. fringes: rings of Newton's
      power fringes over the semi-aperture, at 546 nm (N rings change the curvature by N wavelength /
      semi-aperture^2). The three add in squares.
    thickness_mm: of every thickness but the last, which is the focus. index: of every glass, the same at
      every wavelength.
    decentre_mm: of every surface, in x and in y. tilt_deg: of every surface, about x and about y.
    element_decentre_mm, element_tilt_deg, element_wedge_deg: of every element, a cemented group being one, moved as a
      rigid body; in x and y, and about x and y. See ``element_errors.moved_element``.
    """

    radius_relative: float = 0.0
    radius_mm: float = 0.0
    fringes: float = 0.0
    thickness_mm: float = 0.0
    index: float = 0.0
    decentre_mm: float = 0.0
    tilt_deg: float = 0.0
    element_decentre_mm: float = 0.0
    element_tilt_deg: float = 0.0
    element_wedge_deg: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < math.inf:
                raise DomainError(
                    f"tolerance {name} is {value}; it is a standard deviation, a finite number of at least 0."
                )
        if not any(vars(self).values()):
            raise DomainError("all tolerances are 0, so nothing varies; give at least one.")


@dataclass(frozen=True)
class Error:
    """One independent error: a name with the surfaces counted from 1, the lens tensor (or the argument of
    ``moved_element``) and the entry it changes, and its standard deviation."""

    name: str
    tensor: str
    at: tuple[int, ...]
    deviation: float

    @property
    def drawn(self) -> str:
        """The tolerance of a drawing it falls under: the name without the axis."""
        return re.sub(r" (in|about) [xy]$", "", self.name)


def errors_of(lens: GeoLens, tolerances: Tolerances | Sequence[Error]) -> list[Error]:
    """The independent errors of a lens under ``tolerances``, a list of Error, surface by surface and then element by
    element; errors given as such stay as they are. A plane keeps its radius but not its fringes.

    Surfaces that do not bend light (a stop in air) have no shape or place to get wrong.
    Raises: DomainError for tolerances of elements with a mirror in them, or that the light passes twice.
    """
    if not isinstance(tolerances, Tolerances):
        return list(tolerances)
    found = []
    glass = is_glass(lens)
    t = tolerances
    for i, (c, a) in enumerate(
        zip(lens.curvature_per_mm.tolist(), lens.semi_aperture_mm.tolist(), strict=True)
    ):
        where = f"surface {i + 1}"
        bends = (
            glass[i] or (i > 0 and glass[i - 1]) or lens.mirrors[i]
        )  # even where both have one index today
        curvature = (
            math.hypot(c * t.radius_relative, c * c * t.radius_mm, t.fringes * 0.546074e-3 / a**2)
            if bends
            else 0.0
        )
        found.append(Error(f"curvature of {where}", "curvature_per_mm", (i,), curvature))
        if i + 1 < len(glass):
            found.append(Error(f"thickness behind {where}", "thickness_mm", (i,), t.thickness_mm))
        if glass[i] and not lens.mirrors[i]:
            found.append(Error(f"index behind {where}", "index_offset", (i,), t.index))
        for axis, label in enumerate("xy"):
            found.append(
                Error(f"decentre of {where} in {label}", "decentre_mm", (i, axis), t.decentre_mm * bends)
            )
            found.append(
                Error(
                    f"tilt of {where} about {label}", "tilt_rad", (i, axis), math.radians(t.tilt_deg) * bends
                )
            )
    of_elements = t.element_decentre_mm or t.element_tilt_deg or t.element_wedge_deg
    for g, (first, last) in enumerate(groups(lens) if of_elements else ()):
        _check_body(lens, first, last)
        for kind, deviation in (
            ("decentre_mm", t.element_decentre_mm),
            ("tilt_rad", math.radians(t.element_tilt_deg)),
            ("wedge_rad", math.radians(t.element_wedge_deg)),
        ):
            noun = kind.split("_")[0]
            side = "in" if noun == "decentre" else "about"
            for axis, label in enumerate("xy"):
                name = f"{noun} of element {first + 1}-{last + 1} {side} {label}"
                found.append(Error(name, OF_ELEMENT + kind, (g, axis), deviation))
    return [error for error in found if error.deviation > 0]


def _check_body(lens, first, last):
    surfaces = lens.to_surfaces()
    if any(lens.mirrors[first : last + 1]) or any(passes_of(surfaces, i) for i in range(first, last)):
        raise DomainError(
            f"{lens.name}: element {first + 1}-{last + 1} holds a mirror or is passed twice by the light, and moving it "
            "as a body is not modelled; give tolerances of surfaces instead of elements."
        )


def perturbed(lens: GeoLens, errors: Sequence[Error], amounts: Tensor) -> GeoLens:
    """The lens with errors of ``amounts`` [P] standard deviations. Gradient: to the amounts and to the
    lens."""
    if amounts.shape != (len(errors),):
        raise ShapeError(f"{len(errors)} errors need as many amounts, got shape {tuple(amounts.shape)}.")
    tensors = {}
    bodies = {}
    elements = groups(lens)
    for name in dict.fromkeys(e.tensor for e in errors):
        mine = [k for k, e in enumerate(errors) if e.tensor == name]
        of_element = name.startswith(OF_ELEMENT)
        base = lens.decentre_mm.new_zeros(len(elements), 2) if of_element else getattr(lens, name)
        places = tuple(torch.tensor(axis) for axis in zip(*(errors[k].at for k in mine), strict=True))
        sizes = torch.tensor([errors[k].deviation for k in mine], dtype=base.dtype, device=base.device)
        faulty = base.index_put(places, sizes * amounts[mine], accumulate=True)
        if of_element:
            bodies[name.removeprefix(OF_ELEMENT)] = faulty
        else:
            tensors[name] = faulty
    lens = lens.replace(**tensors)
    for g, faces in enumerate(elements if bodies else ()):
        lens = moved_element(lens, faces, **{name: table[g] for name, table in bodies.items()})
    return lens
