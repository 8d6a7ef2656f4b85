"""Spot diagrams of a lens for objects at infinity."""

import math

import torch

from codesign.errors import DomainError
from codesign.lens.glass import WAVELENGTH_UM


def pupil_grid(count, dtype=torch.float64, device="cpu"):
    """Cell centres of a count x count grid over [-1, 1]^2 that lie in the unit disc, [M, 2]."""
    line = (torch.arange(count, dtype=dtype, device=device) + 0.5) / count * 2 - 1
    y, x = torch.meshgrid(line, line, indexing="ij")
    points = torch.stack([x.reshape(-1), y.reshape(-1)], 1)
    return points[points.square().sum(1) <= 1]


def field_rays(lens, field_rad, pupil, wavelength_um=WAVELENGTH_UM["d"], start_z_mm=-5.0):
    """Parallel rays of one field angle (in +y) through points of the paraxial entrance pupil.

    Args: field_rad scalar; pupil [M, 2] on the unit disc (placed at the pupil of the d line). Returns: origins and directions [M, 3].
    Gradient: origins to the lens, since the pupil moves with it.
    """
    f = lens.first_order()
    at = torch.cat([pupil * (f.entrance_pupil_diameter_mm / 2), f.entrance_pupil_z_mm.expand(pupil.shape[0], 1)], 1)
    direction = torch.tensor([0.0, math.sin(field_rad), math.cos(field_rad)], dtype=pupil.dtype, device=pupil.device).expand(pupil.shape[0], 3)
    return at + direction * ((start_z_mm - at[:, 2:]) / direction[:, 2:]), direction.contiguous()


def spots(lens, fields_rad, wavelength_um=WAVELENGTH_UM["d"], grid=32):
    """Spot diagrams: ray positions on the image plane, [fields, M, 2] mm, and weights [fields, M] (1, or 0 for failed rays).

    Equal weights over a square pupil grid, no clipping by apertures. Gradient: positions to every lens tensor.
    """
    pupil = pupil_grid(grid, lens.curvature_per_mm.dtype, lens.curvature_per_mm.device)
    rays = [field_rays(lens, float(f), pupil, wavelength_um) for f in fields_rad]
    out = lens.trace(torch.cat([o for o, _ in rays]), torch.cat([d for _, d in rays]), wavelength_um)
    shape = (len(rays), pupil.shape[0])
    return out.position_mm[:, :2].reshape(*shape, 2), (out.status == 0).to(pupil.dtype).reshape(shape)


def rms_spot_mm(lens, fields_rad, wavelength_um=WAVELENGTH_UM["d"], grid=32):
    """RMS distance of rays from their mean point, [fields] mm. Raises DomainError where no ray of a field arrives."""
    positions, weight = spots(lens, fields_rad, wavelength_um, grid)
    total = weight.sum(1)
    if bool((total == 0).any()):
        dead = [round(math.degrees(float(f)), 2) for f, n in zip(fields_rad, total.tolist(), strict=True) if n == 0]
        raise DomainError(f"{lens.name}: no ray arrives at field {dead} degrees; use a smaller field or weaker curvatures.")
    w = weight[..., None]
    centre = (positions * w).sum(1, keepdim=True) / total[:, None, None]
    return torch.linalg.vector_norm((positions - centre) * w, dim=(1, 2)) / total.sqrt()  # weights are 0 or 1; the gradient at a point image is 0
