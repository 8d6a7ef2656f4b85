"""Ray fans: transverse aberration and optical path difference along the two diameters of the pupil."""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.lens.analysis.rays import trace_with_chief
from codesign.lens.analysis.wavefront import path_difference_mm
from codesign.lens.distance import PARALLEL
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM


@dataclass(frozen=True)
class RayFan:
    """Aberrations along a pupil diameter, relative to the reference point (the chief ray's, unless another
    was given).

    pupil: [M] in [-1, 1]. tangential_mm: [M] transverse aberration in y of rays (0, pupil); sagittal_mm: [M]
      that in x of rays (pupil, 0). tangential_waves, sagittal_waves: [M] optical path differences.
      tangential_weight, sagittal_weight: [M], 0 where no ray arrives.
    """

    pupil: Tensor
    tangential_mm: Tensor
    sagittal_mm: Tensor
    tangential_waves: Tensor
    sagittal_waves: Tensor
    tangential_weight: Tensor
    sagittal_weight: Tensor


def ray_fan(
    lens: GeoLens,
    field_rad: float,
    wavelength_um: float = WAVELENGTH_UM["d"],
    count: int = 33,
    vignetting: bool = False,
    reference_mm: Tensor | None = None,
    defocus_mm: float | Tensor = 0.0,
    at_m: float | Tensor = PARALLEL,
) -> RayFan:
    """RayFan of one object point and wavelength.

    Args:
      count: rays per diameter, odd to hold the chief ray. reference_mm: [2] image point to which both
        aberrations refer; None is the chief ray of this wavelength. Give that of a middle wavelength to see
        lateral colour. vignetting, defocus_mm, at_m (one distance): see ``trace_field``.
    Gradient: aberrations to every lens tensor and to at_m. Raises: DomainError when no ray, or not the chief ray,
      arrives.
    """
    like = lens.curvature_per_mm
    line = torch.linspace(-1, 1, count, dtype=like.dtype, device=like.device)
    zero = torch.zeros(count, dtype=like.dtype, device=like.device)
    pupil = torch.cat([torch.stack([zero, line], 1), torch.stack([line, zero], 1)])
    rays, chief = trace_with_chief(lens, field_rad, pupil, wavelength_um, vignetting, defocus_mm, at_m)
    centre = chief.position_mm[0] if reference_mm is None else reference_mm
    away = rays.position_mm - centre
    waves = path_difference_mm(lens, rays, chief, wavelength_um, reference_mm, defocus_mm) / (
        wavelength_um * 1e-3
    )
    return RayFan(
        line,
        away[:count, 1],
        away[count:, 0],
        waves[:count],
        waves[count:],
        rays.weight[:count],
        rays.weight[count:],
    )
