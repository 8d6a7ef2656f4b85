"""Distortion: where the chief ray meets the image plane, against an ideal mapping of field angles."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis.rays import chief_ray
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM

MAPPINGS = {"f-tan": math.tan, "f-theta": float}


def chief_height_mm(
    lens: GeoLens, fields_rad: Sequence[float], wavelength_um: float = WAVELENGTH_UM["d"]
) -> Tensor:
    """Height y of the real chief ray on the image plane, [F] mm. Gradient: to every lens tensor. Raises:
    DomainError when one does not arrive."""
    return torch.stack(
        [chief_ray(lens, float(field), wavelength_um).position_mm[0, 1] for field in fields_rad]
    )


def distortion_percent(
    lens: GeoLens,
    fields_rad: Sequence[float],
    mapping: str = "f-tan",
    wavelength_um: float = WAVELENGTH_UM["d"],
) -> Tensor:
    """100 (y / (f m(field)) - 1) of the real chief ray, [F] percent; 0 on the axis.

    Args: mapping: "f-tan" (a picture without distortion) or "f-theta" (a scan lens or fisheye). f is the
      paraxial focal length.
    Gradient: to every lens tensor. Raises: DomainError for another mapping, or when a chief ray does not
      arrive.
    """
    if mapping not in MAPPINGS:
        raise DomainError(f"mapping '{mapping}' is not known; known mappings: {', '.join(MAPPINGS)}.")
    ideal = lens.first_order(wavelength_um).efl_mm * torch.tensor(
        [MAPPINGS[mapping](float(field)) for field in fields_rad],
        dtype=lens.dtype,
        device=lens.curvature_per_mm.device,
    )
    off_axis = torch.tensor([float(field) != 0 for field in fields_rad], device=ideal.device)
    height = chief_height_mm(lens, fields_rad, wavelength_um)
    return torch.where(off_axis, 100 * (height / torch.where(off_axis, ideal, 1) - 1), 0)
