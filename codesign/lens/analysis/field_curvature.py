"""Field curvature and astigmatism: where thin bundles about the chief ray come to focus."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.lens.analysis.rays import trace_field
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM


def focus_shift_mm(
    lens: GeoLens, fields_rad: Sequence[float], wavelength_um: float = WAVELENGTH_UM["d"], reach: float = 1e-3
) -> Tensor:
    """Tangential and sagittal focus of each field, along z from the image plane; the difference is the
    astigmatism.

    Rays at +-reach and +-2 reach of the pupil radius stand for the infinitely thin bundle of Coddington's
    equations; four points cancel the terms of third order in the reach, so what is left is rounding (below
    1e-8 of the focal length).

    Args: fields_rad: F angles. reach: share of the pupil radius.
    Returns: [F, 2] mm, tangential (rays displaced in y) then sagittal (in x); positive behind the image
      plane.
    Gradient: to every lens tensor. Raises: DomainError when a field does not arrive.
    """
    line = torch.tensor([-2.0, -1.0, 1.0, 2.0], dtype=lens.dtype, device=lens.curvature_per_mm.device) * reach
    zero = torch.zeros_like(line)
    pupil = torch.cat([torch.stack([zero, line], 1), torch.stack([line, zero], 1)])
    found = []
    for field in fields_rad:
        rays = trace_field(lens, float(field), pupil, wavelength_um)
        slope = rays.direction[:, :2] / rays.direction[:, 2:]
        moves = [
            _slope_at_zero(values)
            for values in (rays.position_mm[:4, 1], slope[:4, 1], rays.position_mm[4:, 0], slope[4:, 0])
        ]
        found.append(torch.stack([-moves[0] / moves[1], -moves[2] / moves[3]]))
    return torch.stack(found)


def _slope_at_zero(values):
    """Derivative at the middle of values at -2, -1, 1, 2 steps, per step, exact for cubics."""
    return (8 * (values[2] - values[1]) - (values[3] - values[0])) / 12
