"""Where the image of a point lies: by the paraxial rays of a finite distance, and by the least RMS spot."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from codesign.errors import DomainError
from codesign.lens import paraxial
from codesign.lens.analysis.rays import pupil_grid
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.traced import TracedLens


def image_distance_mm(
    lens: TracedLens,
    distance_m: float | Tensor,
    wavelength_um: float = WAVELENGTH_UM["d"],
    spot_grid: int | None = None,
) -> Tensor:
    """Distance from the last vertex of a GeoLens to the image of an axial point, scalar mm; see
    ``GeoLens.focus_at``."""
    origin_z = lens.first_order().entrance_pupil_z_mm
    distance_mm = 1e3 * torch.as_tensor(distance_m, dtype=lens.dtype, device=origin_z.device)
    before = distance_mm - origin_z  # the first vertex
    if not (float(distance_mm.detach()) > 0 and float(before.detach()) > 0):
        raise DomainError(
            f"{lens.name}: a point {_metres(distance_mm)} before the entrance pupil does not lie before the lens; "
            "give a larger distance, inf for parallel light."
        )
    index = lens.index(wavelength_um)
    heights, angles = paraxial.yu_trace(
        lens.surface_power(wavelength_um),
        lens.thickness_mm,
        index,
        torch.ones_like(before),
        index[0] / before,
    )
    if not float(angles[-1].detach()) < -1e-12:
        raise DomainError(
            f"{lens.name}: the light of a point {_metres(distance_mm)} before the entrance pupil does not converge "
            f"behind the lens; {_remedy(lens, origin_z)}."
        )
    image = -heights[-1] * index[-1] / angles[-1]
    return (
        image
        if spot_grid is None
        else image + _least_spot(lens, distance_mm, image, wavelength_um, spot_grid)
    )


def least_spot_shift(position: Tensor, slope: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """How far behind their plane rays of several spots have the least mean square distance from their spot's
    mean, scalar mm; and the mean square slope that says how sharp that place is.

    Straight rays make the squared spot a parabola in z: with d the distance of a ray from its spot's mean and s
    the same of its slope, the least of sum |d + z s|^2 lies at z = -sum(d.s) / sum(s.s).
    Args: position, slope: [spots, M, 2]; weight: [spots, M, 1] >= 0, with a positive sum for every spot.
    """
    total = weight.sum(1, keepdim=True)
    position, slope = (
        (v - (v * weight).sum(1, keepdim=True) / total) * (weight / total.sqrt()) for v in (position, slope)
    )
    sharpness = slope.square().sum()
    return -(position * slope).sum() / sharpness, sharpness


def _least_spot(lens, distance_mm, image_mm, wavelength_um, grid):
    """Shift of the film from the paraxial image to the least RMS spot of the axial point."""
    f = lens.first_order()
    pupil = pupil_grid(grid, lens.dtype, lens.semi_aperture_mm.device) * (f.entrance_pupil_diameter_mm / 2)
    # towards the pupil from a point 1 / distance off parallel, which covers an infinite distance too
    direction = normalize(torch.cat([pupil / distance_mm, torch.ones_like(pupil[:, :1])], 1), dim=1)
    at = torch.cat([pupil, f.entrance_pupil_z_mm.expand(pupil.shape[0], 1)], 1)
    start = at - direction * ((at[:, 2:] + 5.0) / direction[:, 2:])
    placed = lens.replace(thickness_mm=torch.cat([lens.thickness_mm[:-1], image_mm.reshape(1)]))
    out = placed.trace(start, direction, wavelength_um)
    arrived = (out.status == 0).to(lens.dtype)[None, :, None]
    if not bool(arrived.any()):
        raise DomainError(f"{lens.name}: no ray of the axial point arrives; leave spot_grid out.")
    slope = out.direction[:, :2] / out.direction[:, 2:]
    return least_spot_shift(out.position_mm[None, :, :2], slope[None], arrived)[0]


def _metres(length_mm):
    return f"{float(length_mm.detach()) * 1e-3:.6g} m"


def _remedy(lens, origin_z):
    power = -float(paraxial.system_matrix(lens)[1][0].detach())
    if power <= 0:
        return "no distance helps, as the lens diverges; change a curvature"
    return f"it needs more than {_metres(origin_z - paraxial.cardinal_points(lens).front_focal_z_mm)}"
