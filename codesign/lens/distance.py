"""How far away the object is: distances in metres from the camera's origin, as vergences, so that
parallel light is 0 and needs no branch."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.lens.paraxial import ParaxialLens

Distances = float | Sequence[float] | Tensor  # metres; one, or several as [D]
PARALLEL = math.inf


def vergence_per_mm(
    lens: ParaxialLens,
    at_m: Distances,
    origin_z_mm: Tensor | None = None,
) -> Tensor:
    """1 / distance of an object plane, per mm.

    Args:
      at_m: metres before the camera's origin, the entrance pupil of the d line; one number, or [D]
        of them; inf is parallel light.
      origin_z_mm: that pupil's place behind the first vertex, where it is known already.
    Returns: scalar, or [D], in the precision of the lens. Gradient: to at_m where it is a tensor.
    Raises: DomainError for a distance that is not positive, lies in the lens or is NaN; ShapeError
      for more than one axis or none given.
    """
    like = lens.thickness_mm
    at = real_numbers(at_m, "object distances").to(like)
    if at.ndim > 1 or at.numel() == 0:
        raise ShapeError(
            f"object distances must be one number or a list of them, got a tensor of shape {tuple(at.shape)}."
        )
    origin_mm = float(
        (lens.first_order().entrance_pupil_z_mm if origin_z_mm is None else origin_z_mm).detach()
    )
    if not math.isfinite(origin_mm):
        raise DomainError(
            f"{lens.name}: the entrance pupil lies at infinity, so object distances and fields have no "
            "origin; move the stop off the focal plane."
        )
    nearest = max(0.0, origin_mm) * 1e-3
    bad = [d for d in at.detach().reshape(-1).tolist() if not d > nearest]
    if bad:
        raise DomainError(
            f"{lens.name}: an object {', '.join(f'{d:.6g}' for d in bad)} m before the entrance pupil does "
            f"not lie before the lens; give distances above {nearest:.6g} m, inf for parallel light."
        )
    return 1 / (1e3 * at)


def real_numbers(values: Any, name: str) -> Tensor:
    """The values as a tensor: DomainError where they are no real numbers."""
    try:
        found = (
            torch.as_tensor(values)
            if isinstance(values, Tensor)
            else torch.as_tensor(values, dtype=torch.float64)
        )
    except (TypeError, ValueError, RuntimeError, OverflowError):
        found = None
    if found is None or found.is_complex():
        raise DomainError(
            f"{name}: {values!r} is no real number and no list of them; give numbers."
        )
    return found


def one_distance(at_m: Distances) -> Distances:
    """The distance itself, where a result is that of one: ShapeError for several."""
    count = real_numbers(at_m, "object distances").shape
    if count:
        raise ShapeError(
            f"this is a figure of one object distance, got {tuple(count)}; call it for each."
        )
    return at_m
