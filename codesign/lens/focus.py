"""Where the image of a point lies: by the paraxial rays of a finite distance, and by the least RMS spot."""

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens import paraxial
from codesign.lens.analysis.rays import pupil_grid, source_rays, trace_source
from codesign.lens.distance import one_distance, vergence_per_mm
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
    vergence = vergence_per_mm(lens, one_distance(distance_m))
    height, angle = paraxial.focused_image(lens, vergence, wavelength_um)
    if not float(angle.detach()) < -1e-12:
        raise DomainError(
            f"{lens.name}: the light of a point {float(1e-3 / vergence.detach()):.6g} m before the entrance pupil "
            f"does not converge behind the lens; {_remedy(lens)}."
        )
    image = -height * lens.index(wavelength_um)[-1] / angle
    return (
        image if spot_grid is None else image + _least_spot(lens, distance_m, image, wavelength_um, spot_grid)
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


def _least_spot(lens, distance_m, image_mm, wavelength_um, grid):
    """Shift of the film from the paraxial image to the least RMS spot of the axial point."""
    pupil = pupil_grid(grid, lens.dtype, lens.semi_aperture_mm.device)
    placed = lens.replace(thickness_mm=torch.cat([lens.thickness_mm[:-1], image_mm.reshape(1)]))
    rays = trace_source(placed, source_rays(lens, [0.0], pupil, distance_m), wavelength_um)
    if not bool(rays.weight.any()):
        raise DomainError(f"{lens.name}: no ray of the axial point arrives; leave spot_grid out.")
    shift, sharpness = least_spot_shift(
        rays.position_mm, rays.direction[..., :2] / rays.direction[..., 2:], rays.weight[..., None]
    )
    if not float(sharpness.detach()) >= 1e-16:
        raise DomainError(
            f"{lens.name}: {len(pupil)} rays of a pupil of {grid} samples across do not converge, so no spot is the "
            "least; give a spot_grid of at least 2, or leave it out."
        )
    return shift


def _remedy(lens):
    power = -float(paraxial.system_matrix(lens)[1][0].detach())
    if power <= 0:
        return "no distance helps, as the lens diverges; change a curvature"
    nearest = lens.first_order().entrance_pupil_z_mm - paraxial.cardinal_points(lens).front_focal_z_mm
    return f"it needs more than {float(nearest.detach()) * 1e-3:.6g} m"
