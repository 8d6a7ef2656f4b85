"""How much light a lens brings to each field point."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.aiming import aimed_rays
from codesign.lens.analysis import pupil_grid
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.traced import in_float64


def relative_illumination(
    lens: GeoLens, fields_rad: Sequence[float], wavelength_um: float = WAVELENGTH_UM["d"], grid: int = 24
) -> Tensor:
    """Irradiance of the image of a uniform world at each field, relative to the axis, vignetting included.

    Args: fields_rad: angles from the axis; grid: pupil points across the stop.
    Returns: [fields], computed in float64 and given in the lens's precision. For an ideal lens of small aperture without distortion it is cos^4 of the field angle.
    Gradient: to every lens tensor.
    Raises: DomainError for a field that no ray passes.
    Source: E = integral of radiance over image-space direction cosines (Slyusarev; Rimmer, Relative
      illumination calculations, Proc. SPIE 655, 1986).
    """
    dtype = lens.dtype
    lens = in_float64(lens)
    pupil = pupil_grid(grid)
    fields = [0.0, *map(float, fields_rad)]
    heights = [_image_height(lens, field, wavelength_um) for field in fields]
    film = torch.stack([torch.zeros_like(torch.stack(heights)), torch.stack(heights)], 1).repeat_interleave(
        pupil.shape[0], 0
    )
    rays = lens.camera_rays(
        -film, pupil.repeat(len(fields), 1), wavelength_um, aim=True
    )  # camera rays take points as seen upright
    assert rays.irradiance is not None  # GeoLens gives it
    light = (rays.weight * rays.irradiance).reshape(len(fields), -1).mean(1)
    return (light[1:] / light[0]).to(dtype)


def _image_height(lens, field_rad, wavelength_um):
    """Where the chief ray of a field meets the image plane, mm (negative for a positive field)."""
    origin, direction = aimed_rays(lens, field_rad, torch.zeros(1, 2, dtype=lens.dtype), wavelength_um)
    out = lens.trace(origin, direction, wavelength_um)
    if out.status[0] != 0:
        raise DomainError(
            f"{lens.name}: the chief ray of field {field_rad * 57.29578:.4g} degrees does not pass the "
            "lens; use a smaller field."
        )
    return out.position_mm[0, 1]
