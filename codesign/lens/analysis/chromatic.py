"""Colour errors of position: lateral colour of the chief ray, and the paraxial focus by wavelength."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.lens.analysis.distortion import chief_height_mm
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM


def lateral_colour_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelengths_um: Sequence[float],
    reference_um: float = WAVELENGTH_UM["d"],
) -> Tensor:
    """Chief ray heights minus that at the reference wavelength, [F, W] mm. Gradient: to every lens tensor."""
    reference = chief_height_mm(lens, fields_rad, reference_um)
    return torch.stack([chief_height_mm(lens, fields_rad, float(w)) - reference for w in wavelengths_um], 1)


def chromatic_focus_shift_mm(
    lens: GeoLens, wavelengths_um: Sequence[float], reference_um: float = WAVELENGTH_UM["d"]
) -> Tensor:
    """Paraxial back focal length minus that at the reference wavelength, [W] mm. Gradient: to every lens
    tensor."""
    reference = lens.first_order(reference_um).bfl_mm
    return torch.stack([lens.first_order(float(w)).bfl_mm - reference for w in wavelengths_um])
