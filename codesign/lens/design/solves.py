"""Solves: the focal length held by a curvature, focus held by the last thickness. Closed forms,
differentiable."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis.rays import pupil_grid, source_rays, trace_source
from codesign.lens.distance import PARALLEL, Distances, one_distance, vergence_per_mm
from codesign.lens.focus import least_spot_shift
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.hold_efl import hold_efl, holding_surface
from codesign.lens.paraxial import focused_image

__all__ = ["focus_paraxial", "focus_rays", "hold_efl", "holding_surface"]


def focus_paraxial(
    lens: GeoLens,
    wavelength_um: float = WAVELENGTH_UM["d"],
    defocus_mm: float | Tensor = 0.0,
    at_m: float | Tensor = PARALLEL,
) -> GeoLens:
    """The lens with its image plane at the paraxial image of an axial point, or ``defocus_mm`` (number or scalar
    tensor) behind it. Differentiable.

    Args: at_m: metres from the entrance pupil to the point, inf for parallel light. ``GeoLens.focus_at`` does the
      same and refuses images that are not real.
    Raises: DomainError for light that leaves the lens parallel, or a distance inside the lens. A focus inside the
      lens gives a negative last thickness, which constraints must push back.
    """
    height, angle = focused_image(lens, vergence_per_mm(lens, one_distance(at_m)), wavelength_um)
    if abs(float(angle.detach())) < 1e-12:
        raise DomainError(
            f"{lens.name}: the light of a point {float(torch.as_tensor(at_m).detach()):.6g} m away leaves the lens parallel, "
            "so it has no focus; the lens is afocal for it: change a curvature or the distance."
        )
    return _last_thickness(lens, -height * lens.index(wavelength_um)[-1] / angle + defocus_mm)


def focus_rays(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelengths_um: Sequence[float] = (WAVELENGTH_UM["d"],),
    grid: int = 16,
    at_m: Distances = PARALLEL,
) -> GeoLens:
    """The lens with its image plane where the mean square spot over fields, distances and wavelengths is least.

    Spots of one object point share their mean over the wavelengths; see ``focus.least_spot_shift``.

    Args: fields_rad: angles; wavelengths_um; grid: pupil samples across, without clipping by apertures.
      Failed rays are left out. at_m: metres from the entrance pupil to the object plane, or several that share the
      image plane; inf for parallel light.
    Gradient: through the rays to every lens tensor and to at_m. Raises: DomainError when no ray of a field arrives,
      none converges, or a distance lies inside the lens.

    Example:
    >>> from codesign import lens
    >>> geo = lens.load("cooke-triplet")
    >>> sharp = lens.design.focus_rays(geo, (0.0, 0.2), at_m=(0.5, 2.0))
    >>> before, after = (lens.rms_spot_mm(g, (0.0, 0.2), at_m=(0.5, 2.0)).square().mean() for g in (geo, sharp))
    >>> bool(after < before)
    True
    """
    if len(wavelengths_um) == 0:
        raise DomainError(f"{lens.name}: no wavelength was given; give at least one, in um.")
    pupil = pupil_grid(grid, lens.dtype, lens.curvature_per_mm.device)
    source = source_rays(lens, fields_rad, pupil, at_m)
    found = []
    for wavelength in wavelengths_um:
        rays = trace_source(lens, source, wavelength)
        slope = rays.direction[..., :2] / rays.direction[..., 2:]
        columns = (rays.position_mm, slope, rays.weight[..., None])
        found.append([v.reshape(-1, pupil.shape[0], v.shape[-1]) for v in columns])
    position, slope, weight = (torch.cat(columns, 1) for columns in zip(*found, strict=True))
    total = weight.sum(1, keepdim=True)
    if bool((total == 0).any()):
        raise DomainError(
            f"{lens.name}: no ray of some field arrives, so it has no best focus; use smaller fields or "
            "weaker curvatures."
        )
    shift, sharpness = least_spot_shift(position, slope, weight)
    if float(sharpness.detach()) < 1e-16:
        raise DomainError(f"{lens.name}: its rays leave parallel, so no image plane is better than another.")
    return _last_thickness(lens, lens.thickness_mm[-1] + shift)


def _last_thickness(lens: GeoLens, value):
    return lens.replace(thickness_mm=torch.cat([lens.thickness_mm[:-1], value.reshape(1)]))
