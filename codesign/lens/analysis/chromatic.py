"""Colour errors of position: lateral colour of the chief ray, and the paraxial focus by wavelength."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.lens.analysis.distortion import chief_height_mm
from codesign.lens.distance import PARALLEL, Distances, vergence_per_mm
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.paraxial import image_place_mm


def lateral_colour_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelengths_um: Sequence[float],
    reference_um: float = WAVELENGTH_UM["d"],
    at_m: Distances = PARALLEL,
) -> Tensor:
    """Chief ray heights minus that at the reference wavelength, [F, W] mm, [D, F, W] for D distances ``at_m`` of the
    object (see ``trace_field``). Gradient: to every lens tensor."""
    reference = chief_height_mm(lens, fields_rad, reference_um, at_m)
    heights = [chief_height_mm(lens, fields_rad, float(w), at_m) for w in wavelengths_um]
    return torch.stack([height - reference for height in heights], -1)


def chromatic_focus_shift_mm(
    lens: GeoLens,
    wavelengths_um: Sequence[float],
    reference_um: float = WAVELENGTH_UM["d"],
    at_m: Distances = PARALLEL,
) -> Tensor:
    """Place of the paraxial image of an axial point minus that at the reference wavelength, [W] mm, [D, W] for D
    distances ``at_m``. Gradient: to every lens tensor and to at_m."""
    vergence = vergence_per_mm(lens, at_m)
    reference, *places = (image_place_mm(lens, vergence, float(w)) for w in (reference_um, *wavelengths_um))
    return torch.stack([place - reference for place in places], -1)
