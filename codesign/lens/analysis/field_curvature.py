"""Field curvature and astigmatism: where thin bundles about the chief ray come to focus."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.lens.analysis.rays import trace_field
from codesign.lens.distance import PARALLEL, Distances
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.traced import in_float64


def focus_shift_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelength_um: float = WAVELENGTH_UM["d"],
    reach: float = 1e-3,
    at_m: Distances = PARALLEL,
) -> Tensor:
    """Tangential and sagittal focus of each field, along z from the image plane; the difference is the
    astigmatism.

    Rays at +-reach and +-2 reach of the pupil radius stand for the infinitely thin bundle of Coddington's
    equations; four points cancel the terms of third order in the reach, so what is left is rounding (below
    1e-8 of the focal length).

    Args: fields_rad: F angles. reach: share of the pupil radius. at_m: metres to the object plane, or D of them.
    Returns: [F, 2] or [D, F, 2] mm, tangential (rays displaced in y) then sagittal (in x); positive behind the image
      plane. Computed in float64, as the rays lie so close together, and given in the lens's precision.
    Gradient: to every lens tensor and to at_m. Raises: DomainError when a field does not arrive.
    """
    dtype = lens.dtype
    lens = in_float64(lens)
    line = torch.tensor([-2.0, -1.0, 1.0, 2.0], dtype=lens.dtype, device=lens.curvature_per_mm.device) * reach
    zero = torch.zeros_like(line)
    pupil = torch.cat([torch.stack([zero, line], 1), torch.stack([line, zero], 1)])
    rays = trace_field(lens, fields_rad, pupil, wavelength_um, at_m=at_m)
    slope = rays.direction[..., :2] / rays.direction[..., 2:]
    tangential, sagittal = (
        -_slope_at_zero(rays.position_mm[..., half, axis]) / _slope_at_zero(slope[..., half, axis])
        for half, axis in ((slice(4), 1), (slice(4, 8), 0))
    )
    return torch.stack([tangential, sagittal], -1).to(dtype)


def _slope_at_zero(values):
    """Derivative at the middle of values [..., 4] at -2, -1, 1, 2 steps, per step, exact for cubics."""
    return (8 * (values[..., 2] - values[..., 1]) - (values[..., 3] - values[..., 0])) / 12
