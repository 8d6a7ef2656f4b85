"""Errors of mounting: an element, or a cemented group, decentred, tilted and wedged as one rigid body.

The lens knows a decentre and a tilt per surface. A rigid motion turns every vertex about the vertex of the first
face, so that those behind it move sideways and along the axis, and turns every axis. Surfaces are symmetric about
their axes, so two angles say where an axis points.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.lens.distance import real_numbers
from codesign.lens.geolens import GeoLens


def moved_element(
    lens: GeoLens,
    faces: tuple[int, int],
    decentre_mm: Tensor | Sequence[float] | None = None,
    tilt_rad: Tensor | Sequence[float] | None = None,
    wedge_rad: Tensor | Sequence[float] | None = None,
) -> GeoLens:
    """The lens with the surfaces of one element moved as a rigid body; exact, however large the angles.

    Args:
      faces: first and last surface (counted from 0), see ``moves.elements`` and ``moves.groups``.
      decentre_mm: [2] of the vertex of the first face, x and y. tilt_rad: [2] about x, then about y, around that
        vertex. wedge_rad: [2] tilt of the last face alone, about x and about y, around its own vertex and before
        the element is tilted. None is no error.
    Returns: a lens as from ``replace``, with other decentres, tilts and thicknesses (the gap in front of a vertex
      that moves along the axis and the one behind it). Errors that the surfaces have already are turned along.
    Gradient: to the errors and to every tensor of the lens.
    Raises: DomainError for faces that are not there or a mirror between them, whose axis is unfolded; ShapeError.
    """
    count = len(lens.surfaces)
    if len(faces) != 2 or not all(isinstance(face, int) for face in faces):
        raise DomainError(
            f"{lens.name}: faces {faces} of an element must be two whole numbers; give a pair out of elements(lens) or "
            "groups(lens)."
        )
    first, last = faces
    if not 0 <= first < last < count or any(lens.mirrors[first : last + 1]):
        raise DomainError(
            f"{lens.name}: surfaces {first} to {last} are no element without mirrors; give a pair out of "
            f"elements(lens) or groups(lens), counted from 0 to {count - 1}."
        )
    like = lens.thickness_mm
    errors = []
    for label, value in (("decentre_mm", decentre_mm), ("tilt_rad", tilt_rad), ("wedge_rad", wedge_rad)):
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
    """Turn about x, then about the y that came of it, [3, 3]: from the axes of a surface to those of the lens."""
    (ca, cb), (sa, sb) = angles.cos(), angles.sin()
    zero = torch.zeros_like(ca)
    return torch.stack([cb, zero, sb, sa * sb, ca, -sa * cb, -ca * sb, sa, ca * cb]).reshape(3, 3)


def _with_rows(table, rows, values):
    return torch.cat([table[: rows.start], values, table[rows.stop :]])
