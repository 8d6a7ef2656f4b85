"""Solves: the focal length held by a curvature, focus held by the last thickness. Closed forms,
differentiable."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis import field_rays, pupil_grid
from codesign.lens.focus import least_spot_shift
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.hold_efl import hold_efl, holding_surface

__all__ = ["focus_paraxial", "focus_rays", "hold_efl", "holding_surface"]


def focus_paraxial(
    lens: GeoLens, wavelength_um: float = WAVELENGTH_UM["d"], defocus_mm: float | Tensor = 0.0
) -> GeoLens:
    """The lens with its image plane at the paraxial focus, or ``defocus_mm`` (number or scalar tensor) behind
    it. Differentiable.

    Raises: DomainError for an afocal lens. A focus inside the lens gives a negative last thickness, which
      constraints must push back.
    """
    return _last_thickness(lens, lens.first_order(wavelength_um).bfl_mm + defocus_mm)


def focus_rays(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelengths_um: Sequence[float] = (WAVELENGTH_UM["d"],),
    grid: int = 16,
) -> GeoLens:
    """The lens with its image plane where the mean square spot over fields and wavelengths is least.

    Spots of one field share their mean over the wavelengths; see ``focus.least_spot_shift``.

    Args: fields_rad: angles; wavelengths_um; grid: pupil samples across, without clipping by apertures.
      Failed rays are left out.
    Gradient: through the rays to every lens tensor. Raises: DomainError when no ray of a field arrives or
      none converges.

    Example:
    >>> from codesign import lens
    >>> geo = lens.load("cooke-triplet")
    >>> sharp = lens.design.focus_rays(geo, (0.0, 0.2))
    >>> before, after = (lens.rms_spot_mm(g, (0.0, 0.2)).square().mean() for g in (geo, sharp))
    >>> bool(after < before)
    True
    """
    pupil = pupil_grid(grid, lens.dtype, lens.curvature_per_mm.device)
    found = []
    for wavelength in wavelengths_um:
        rays = [field_rays(lens, float(f), pupil) for f in fields_rad]
        out = lens.trace(torch.cat([o for o, _ in rays]), torch.cat([d for _, d in rays]), wavelength)
        found.append(
            [
                v.reshape(len(rays), pupil.shape[0], -1)
                for v in (
                    out.position_mm[:, :2],
                    out.direction[:, :2] / out.direction[:, 2:],
                    (out.status == 0).to(lens.dtype),
                )
            ]
        )
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
