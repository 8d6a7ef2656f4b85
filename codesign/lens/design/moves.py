"""Elements taken out, exchanged for another glass, or moved as rigid bodies.

Moves between lens forms leave all other surfaces where they are, keep the focal length and the
f-number, and the image plane as far from the paraxial focus as it was. Elements are single pieces
of glass: a cemented doublet is two. Re-optimisation around these moves is in
``codesign.optimise.lens_moves``.

Errors of mounting: the lens knows a decentre and a tilt per surface. A rigid motion turns every
vertex about the vertex of the first face, so that those behind it move sideways and along the axis,
and turns every axis. Surfaces are symmetric about their axes, so two angles say where an axis
points.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from codesign.checks import check_finite, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.lens.distance import real_numbers
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM, Glass, names
from codesign.lens.solves import focus_paraxial, hold_efl
from codesign.lens.surface import Surface, passes_of

VD_PER_ND = 100.0  # an Abbe number of 1 counts like an index of 0.01


def elements(lens: GeoLens) -> tuple[tuple[int, int], ...]:
    """Front and back surface (counted from 0) of every element, from the object: one pair per piece
    of glass, so that neighbours in a cemented group share a surface.

    >>> from codesign import lens
    >>> lens.design.elements(lens.load("cooke-triplet"))
    ((0, 1), (2, 3), (4, 5))
    """
    return tuple((i, i + 1) for i, filled in enumerate(lens.glass.tolist()[:-1]) if filled)


def groups(lens: GeoLens) -> tuple[tuple[int, int], ...]:
    """First and last surface (counted from 0) of every group: elements that share no surface with
    another, and cemented ones as a whole."""
    found: list[tuple[int, int]] = []
    for front, back in elements(lens):
        if found and found[-1][1] == front:
            front = found.pop()[0]
        found.append((front, back))
    return tuple(found)


def without_element(lens: GeoLens, element: int) -> GeoLens:
    """The lens without one element; air takes its place.

    An element that is cemented to another leaves the cemented face to that one. Where the stop was
    on a face that goes, a plane stop stays in its place. Args:
      element: its number in ``elements(lens)``, counted from 0; from the last when negative.
    Returns: a lens of its own, built from today's values. Its focal length is the old one, held by
      ``hold_efl``. A semi-aperture beyond the reach of its surface becomes that reach.
    Raises: DomainError for an element that is not there, is the only one, or touches a mirror; and
      when the rest cannot have the focal length with the image behind it.

    >>> from codesign import lens
    >>> dialyte = lens.design.without_element(lens.load("cooke-triplet"), 1)
    >>> len(lens.design.elements(dialyte)), round(dialyte.first_order().fno.item(), 3)
    (2, 5.002)
    """
    pairs = elements(lens)
    front, back = _element_faces(lens, pairs, element)
    if len(pairs) == 1 and not any(lens.mirrors):
        raise DomainError(
            f"{lens.name}: element 1 is its only one, and without it nothing bends light; add an element "
            "first."
        )
    filled = lens.glass.tolist()
    surfaces = _surfaces(lens)
    if filled[back]:
        gone = [front]
    else:
        surfaces[front] = replace(surfaces[front], medium=surfaces[back].medium)
        gone = [back] if front > 0 and filled[front - 1] else [back, front]
    for at in gone:
        surfaces = _without(surfaces, at)
    return _held(lens, surfaces, f"without element {range(len(pairs))[element] + 1}")


def flattened(lens: GeoLens, element: int, share: float) -> GeoLens:
    """The lens on its way to ``without_element``: at ``share`` 1 the element is a plane-parallel
    plate, or a shell of equal curvatures where it is cemented to another; at 0 it is as now.

    Gradient: to the lens tensors. Focal length and focus are left alone.
    """
    front, back = _element_faces(lens, elements(lens), element)
    filled = lens.glass.tolist()
    c = lens.curvature_per_mm
    cemented = [front > 0 and filled[front - 1], filled[back]]
    target = c.clone()
    if not any(cemented):
        target = target.index_fill(0, torch.tensor([front, back], device=c.device), 0.0)
    elif cemented[1]:
        target[front] = c[back]
    else:
        target[back] = c[front]
    return lens.replace(curvature_per_mm=c + share * (target - c))


def with_glass(lens: GeoLens, surface: int, medium: Glass | str) -> GeoLens:
    """The lens with another glass behind a surface (counted from 0), focal length, f-number and
    defocus as before; ``GeoLens.replace_glass`` leaves them as they come.

    Args:
      medium: a Glass, or a name of the catalogue.
    Returns, Raises: as ``without_element``; DomainError for a gap that holds no glass, and for air
      in its place.
    """
    if surface not in [front for front, _ in elements(lens)]:
        fronts = ", ".join(str(front) for front, _ in elements(lens))
        raise DomainError(
            f"{lens.name}: there is no glass behind surface {surface} to exchange; there is behind "
            f"{fronts or 'none'}."
        )
    other = lens.replace_glass(surface, medium)
    found = other.surfaces[surface].medium
    if found is None:
        raise DomainError(
            f"{lens.name}: {medium} is no glass; give one, or take the element out with without_element."
        )
    return _held(lens, _surfaces(other), f"with {found.name} behind surface {surface + 1}")


def neighbour_glasses(
    medium: Glass | str, count: int = 4, apart: float = 2e-3, among: Sequence[str] | None = None
) -> list[Glass]:
    """The catalogue's glasses nearest to one on the (nd, Vd) map, the nearest first.

    The distance is hypot(nd difference, Vd difference / 100), see VD_PER_ND.
    Args:
      medium: a Glass, or a name of the catalogue.
      apart: least distance; other makers' versions of the same glass lie closer and are left out.
      among: names of the catalogue to choose from, None for all.
    Returns: at most ``count`` glasses. Raises: DomainError for a name the catalogue does not know,
      or a medium without dispersion.

    >>> from codesign import lens
    >>> [glass.name for glass in lens.design.neighbour_glasses("F2", 3)]
    ['F4', 'F1', 'S-TIM1']
    """
    given = Glass.named(medium) if isinstance(medium, str) else medium
    count = check_whole(count, "number of neighbours")
    if math.isinf(given.abbe_number):
        raise DomainError(
            f"medium {given.name} has no dispersion, so it has no place on the glass map and no neighbours."
        )
    chosen = map(Glass.named, names() if among is None else among)
    found = [
        (math.hypot(g.index_d - given.index_d, (g.abbe_number - given.abbe_number) / VD_PER_ND), g)
        for g in chosen
        if g.range_um[0] <= WAVELENGTH_UM["F"] and g.range_um[1] >= WAVELENGTH_UM["C"]
    ]
    found = [entry for entry in found if entry[0] >= apart and not math.isinf(entry[0])]
    return [g for _, g in sorted(found, key=lambda entry: entry[0])[:count]]


def _element_faces(lens, pairs, element):
    if not pairs:
        raise DomainError(
            f"{lens.name}: it has no element, as no gap between its surfaces is of glass."
        )
    if not isinstance(element, int) or not -len(pairs) <= element < len(pairs):
        raise DomainError(
            f"{lens.name}: there is no element {element}; it has 0 to {len(pairs) - 1}."
        )
    front, back = pairs[element]
    if lens.mirrors[front] or lens.mirrors[back]:
        raise DomainError(
            f"{lens.name}: element {range(len(pairs))[element] + 1} touches a mirror, and without that the "
            "light turns no more; choose another."
        )
    passes = passes_of(lens.to_surfaces(), front)
    if passes:
        raise DomainError(
            f"{lens.name}: the light passes element {range(len(pairs))[element] + 1} again behind surface "
            f"{passes[0] + 1}, as a mirror sends it back, and only one pass would change; choose another."
        )
    return front, back


def _surfaces(lens):
    """Today's surfaces as a list, the stop marked."""
    return [replace(s, is_stop=i == lens.stop_index) for i, s in enumerate(lens.to_surfaces())]


def _without(surfaces, at):
    """The list without a surface, the gap in front of it longer; a plane stop in the place of a
    stop."""
    found = list(surfaces)
    gone = found.pop(at)
    if gone.is_stop:
        medium = found[at - 1].medium if at else None
        found.insert(
            at, Surface(math.inf, gone.thickness_mm, medium, gone.semi_aperture_mm, is_stop=True)
        )
        return found
    if at:
        before = found[at - 1]
        found[at - 1] = replace(before, thickness_mm=before.thickness_mm + gone.thickness_mm)
    return found


def _held(lens, surfaces, label):
    """A lens of these surfaces with the focal length and the defocus of ``lens``."""
    f = lens.first_order()
    defocus = float((lens.thickness_mm[-1] - f.bfl_mm).detach())
    made = GeoLens(
        map(_within_reach, surfaces),
        lens.entrance_pupil_diameter_mm,
        lens.dtype,
        lens.soft_edge_mm,
        lens.name,
        lens.half_field_deg,
    )
    with torch.no_grad():
        held = focus_paraxial(hold_efl(made, float(f.efl_mm)), defocus_mm=defocus)
        image = float(held.thickness_mm[-1])
        if not image > 0:
            raise DomainError(
                f"{lens.name} {label}: at its focal length of {float(f.efl_mm):.6g} mm the image lies "
                f"{-image:.4g} mm before the last surface; flatten the element in steps and re-optimise in "
                "between, or take out another."
            )
        made.curvature_per_mm.copy_(held.curvature_per_mm)
        made.thickness_mm.copy_(held.thickness_mm)
    return made


def _within_reach(surface):
    """The surface, not wider than its own sphere or ellipsoid."""
    square = (1 + surface.conic) * surface.curvature_per_mm**2
    most = 1 / math.sqrt(square) if square > 0 else math.inf
    return (
        surface
        if surface.semi_aperture_mm <= most
        else replace(surface, semi_aperture_mm=most * (1 - 1e-9))
    )


def moved_element(
    lens: GeoLens,
    faces: tuple[int, int],
    decentre_mm: Tensor | Sequence[float] | None = None,
    tilt_rad: Tensor | Sequence[float] | None = None,
    wedge_rad: Tensor | Sequence[float] | None = None,
) -> GeoLens:
    """The lens with the surfaces of one element moved as a rigid body; exact, however large the
    angles.

    Args:
      faces: first and last surface (counted from 0), see ``moves.elements`` and ``moves.groups``.
      decentre_mm: [2] of the vertex of the first face, x and y. tilt_rad: [2] about x, then about
        y, around that vertex. wedge_rad: [2] tilt of the last face alone, about x and about y,
        around its own vertex and before the element is tilted. None is no error.
    Returns: a lens as from ``replace``, with other decentres, tilts and thicknesses (the gap in
      front of a vertex that moves along the axis and the one behind it). Errors that the surfaces
      have already are turned along.
    Gradient: to the errors and to every tensor of the lens.
    Raises: DomainError for faces that are not there or a mirror between them, whose axis is
      unfolded; ShapeError.
    """
    count = len(lens.surfaces)
    if len(faces) != 2 or not all(isinstance(face, int) for face in faces):
        raise DomainError(
            f"{lens.name}: faces {faces} of an element must be two whole numbers; give a pair out of "
            "elements(lens) or groups(lens)."
        )
    first, last = faces
    if not 0 <= first < last < count or any(lens.mirrors[first : last + 1]):
        raise DomainError(
            f"{lens.name}: surfaces {first} to {last} are no element without mirrors; give a pair out of "
            f"elements(lens) or groups(lens), counted from 0 to {count - 1}."
        )
    like = lens.thickness_mm
    errors = []
    for label, value in (
        ("decentre_mm", decentre_mm),
        ("tilt_rad", tilt_rad),
        ("wedge_rad", wedge_rad),
    ):
        value = like.new_zeros(2) if value is None else real_numbers(value, label).to(like)
        if value.shape != (2,):
            raise ShapeError(f"{label} is [2], x and y, got shape {tuple(value.shape)}.")
        errors.append(check_finite(value, label))
    decentre, tilt, wedge = errors
    rows = slice(first, last + 1)
    turn = _rotation(tilt)
    # places of the vertices from the first: where they are now, and turned
    depth = torch.cat([like.new_zeros(1), like[first:last].cumsum(0)])
    sideways = lens.decentre_mm[rows]
    place = torch.cat([sideways - sideways[:1], depth[:, None]], 1) @ turn.T
    axes = torch.stack([_rotation(angles)[:, 2] for angles in lens.tilt_rad[rows]])
    axes = torch.cat([axes[:-1], (_rotation(wedge) @ axes[-1])[None]]) @ turn.T
    shift = torch.cat([like.new_zeros(first), place[:, 2] - depth, like.new_zeros(count - last)])
    return lens.replace(
        thickness_mm=like + shift.diff(),
        decentre_mm=_with_rows(lens.decentre_mm, rows, sideways[:1] + decentre + place[:, :2]),
        tilt_rad=_with_rows(
            lens.tilt_rad,
            rows,
            torch.stack([torch.atan2(-axes[:, 1], axes[:, 2]), torch.asin(axes[:, 0])], 1),
        ),
    )


def _rotation(angles):
    """Turn about x, then about the y that came of it, [3, 3]: from the axes of a surface to those
    of the lens."""
    (ca, cb), (sa, sb) = angles.cos(), angles.sin()
    zero = torch.zeros_like(ca)
    return torch.stack([cb, zero, sb, sa * sb, ca, -sa * cb, -ca * sb, sa, ca * cb]).reshape(3, 3)


def _with_rows(table, rows, values):
    return torch.cat([table[: rows.start], values, table[rows.stop :]])
