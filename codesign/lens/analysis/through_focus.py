"""How spot and MTF change when the image plane moves."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis.mtf import diffraction_mtf, geometric_mtf
from codesign.lens.analysis.rays import Light, Values, pupil_grid, spectral_lines, trace_field
from codesign.lens.analysis.spots import spot_radius_mm
from codesign.lens.distance import PARALLEL, one_distance
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM

METHODS = {"diffraction": diffraction_mtf, "geometric": geometric_mtf}


def through_focus_spot_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    defocus_mm: Values,
    light: Light = WAVELENGTH_UM["d"],
    grid: int = 32,
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Tensor:
    """RMS spot about its mean for each field and plane, [F, Z] mm. Args: defocus_mm: [Z], positive further
    from the lens; at_m: metres to the object plane. Gradient: to every lens tensor."""
    pupil = pupil_grid(grid, lens.dtype, lens.curvature_per_mm.device)
    wavelengths, shares = spectral_lines(light)
    one_distance(at_m)
    rays = [trace_field(lens, fields_rad, pupil, w, vignetting, at_m=at_m) for w in wavelengths]
    weight = torch.stack([r.weight * share for r, share in zip(rays, shares, strict=True)], 1)
    columns = []
    for z in defocus_mm:
        positions = torch.stack([r.shifted(float(z)).position_mm for r in rays], 1)
        columns.append(torch.stack([spot_radius_mm(p, w) for p, w in zip(positions, weight, strict=True)]))
    return torch.stack(columns, 1)


def through_focus_mtf(
    lens: GeoLens,
    field_rad: float,
    frequency_per_mm: float,
    defocus_mm: Values,
    light: Light = WAVELENGTH_UM["d"],
    method: str = "diffraction",
    grid: int | None = None,
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Tensor:
    """MTF at one frequency on several planes, [2, Z] tangential, sagittal. Args: method: "diffraction" or
    "geometric"; at_m: metres to the object plane. Gradient: to every lens tensor."""
    if method not in METHODS:
        raise DomainError(f"method '{method}' is not known; known methods: {', '.join(METHODS)}.")
    options = {} if grid is None else {"grid": grid}
    return torch.cat(
        [
            METHODS[method](
                lens,
                field_rad,
                [frequency_per_mm],
                light,
                vignetting=vignetting,
                defocus_mm=float(z),
                at_m=at_m,
                **options,
            )
            for z in defocus_mm
        ],
        1,
    )
