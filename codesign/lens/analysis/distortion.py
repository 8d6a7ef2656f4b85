"""Distortion: where the chief ray meets the image plane, against an ideal mapping of field angles."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis.rays import chief_ray
from codesign.lens.distance import PARALLEL, Distances, vergence_per_mm
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.paraxial import image_scale_mm

MAPPINGS = {"f-tan": math.tan, "f-theta": float}


def chief_height_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelength_um: float = WAVELENGTH_UM["d"],
    at_m: Distances = PARALLEL,
) -> Tensor:
    """Height y of the real chief ray on the image plane, [F] mm; [D, F] for D distances ``at_m`` of the object, see
    ``trace_field``. Gradient: to every lens tensor (a chief ray is the same at every distance). Raises: DomainError
    when one does not arrive."""
    return chief_ray(lens, fields_rad, wavelength_um, at_m=at_m).position_mm[..., 0, 1]


def distortion_percent(
    lens: GeoLens,
    fields_rad: Sequence[float],
    mapping: str = "f-tan",
    wavelength_um: float = WAVELENGTH_UM["d"],
    at_m: Distances = PARALLEL,
) -> Tensor:
    """100 (y / (f m(field)) - 1) of the real chief ray, [F] percent, [D, F] for D distances; 0 on the axis.

    Args: mapping: "f-tan" (a picture without distortion) or "f-theta" (a scan lens or fisheye). at_m: metres to
      the object plane. f is the height of the paraxial image of that plane per tangent: the focal length for
      parallel light. On a film that is not focused there (``GeoLens.focus_at``) the change of scale by defocus is
      part of the figure.
    Gradient: to every lens tensor and to at_m. Raises: DomainError for another mapping, or when a chief ray does not
      arrive.
    """
    if mapping not in MAPPINGS:
        raise DomainError(f"mapping '{mapping}' is not known; known mappings: {', '.join(MAPPINGS)}.")
    scale = image_scale_mm(lens, vergence_per_mm(lens, at_m), wavelength_um)
    ideal = scale[..., None] * torch.tensor(
        [MAPPINGS[mapping](float(field)) for field in fields_rad],
        dtype=lens.dtype,
        device=lens.curvature_per_mm.device,
    )
    off_axis = torch.tensor([float(field) != 0 for field in fields_rad], device=ideal.device)
    height = chief_height_mm(lens, fields_rad, wavelength_um, at_m)
    return torch.where(off_axis, 100 * (height / torch.where(off_axis, ideal, 1) - 1), 0)
