"""Which numbers of a traced lens can become variables, by name, and how far a unit of each may go at most."""

import torch

from codesign.lens.traced import TracedLens
from codesign.lens.variables import Kind

# largest natural steps, for numbers that hardly move a ray
GAP = 0.1  # thickness, in focal lengths
BEND = 0.1  # slope that a change of shape adds at the rim
INDEX = 0.05
PHASE = 300.0  # radians at the rim, over its radius


def kinds(lens: TracedLens) -> dict[str, Kind]:
    """{name: Kind} of a GeoLens."""
    rows = torch.arange(len(lens.surfaces), device=lens.semi_aperture_mm.device)
    efl = lens.first_order().efl_mm.detach().abs()
    rim = lens.semi_aperture_mm.minimum(efl)
    gap = (GAP * efl).expand(rows.shape)
    turn = (lens.curvature_per_mm.detach() * rim).square().clamp_min(1e-12)
    index = torch.full_like(rim, INDEX)[lens.glass]
    return {
        "curvature": Kind("curvature_per_mm", rows, BEND / rim),
        "thickness": Kind("thickness_mm", rows[:-1], gap[:-1], 0.0),
        "focus": Kind("thickness_mm", rows[-1:], gap[-1:], 0.0),
        "conic": Kind("conic", rows, BEND / turn),
        "asphere": _polynomial("asphere", lens.asphere, BEND, rim),
        "index": Kind("index_offset", rows[lens.glass], index),
        "phase": _polynomial("phase", lens.phase, PHASE, rim),
    }


def _polynomial(name, table, slope, rim):
    """Coefficients [S, A] of r^2, r^4, ...: each may add that much per millimetre at the rim."""
    power = 2 * torch.arange(1, table.shape[1] + 1, dtype=rim.dtype, device=rim.device)
    return Kind(
        name,
        torch.arange(table.numel(), device=rim.device),
        (slope * rim[:, None] ** (1 - power)).reshape(-1),
    )
