"""Figures over field, pupil, colour and focus: distortion, field curvature, axial colour, relative
illumination, ray fans, and spots through focus."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.checks import check_choice
from codesign.errors import DomainError
from codesign.lens.aiming import aimed_rays
from codesign.lens.analysis.mtf import diffraction_mtf, geometric_mtf
from codesign.lens.analysis.rays import (
    Light,
    Values,
    chief_ray,
    pupil_grid,
    spectral_lines,
    trace_field,
    trace_with_chief,
)
from codesign.lens.analysis.spots import spot_radius_mm
from codesign.lens.analysis.wavefront import path_difference_mm
from codesign.lens.distance import PARALLEL, Distances, one_distance, vergence_per_mm
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM
from codesign.lens.paraxial import chief_scale_mm, image_place_mm
from codesign.lens.traced import in_float64


def lateral_colour_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelengths_um: Sequence[float],
    reference_um: float = D_UM,
    at_m: Distances = PARALLEL,
) -> Tensor:
    """Chief ray heights minus that at the reference wavelength, [F, W] mm, [D, F, W] for D
    distances ``at_m`` of the object (see ``trace_field``), computed in float64 and given in the
    lens's precision. Gradient: to every lens tensor."""
    dtype = lens.dtype
    lens = in_float64(lens)
    reference = chief_height_mm(lens, fields_rad, reference_um, at_m)
    heights = [chief_height_mm(lens, fields_rad, float(w), at_m) for w in wavelengths_um]
    return torch.stack([height - reference for height in heights], -1).to(dtype)


def chromatic_focus_shift_mm(
    lens: GeoLens,
    wavelengths_um: Sequence[float],
    reference_um: float = D_UM,
    at_m: Distances = PARALLEL,
) -> Tensor:
    """Place of the paraxial image of an axial point minus that at the reference wavelength, [W] mm,
    [D, W] for D distances ``at_m``, computed in float64 and given in the lens's precision.
    Gradient: to every lens tensor and to at_m."""
    dtype = lens.dtype
    lens = in_float64(lens)
    vergence = vergence_per_mm(lens, at_m)
    reference, *places = (
        image_place_mm(lens, vergence, float(w)) for w in (reference_um, *wavelengths_um)
    )
    return torch.stack([place - reference for place in places], -1).to(dtype)


REACH = 1e-3  # share of the pupil radius, of the rays of a thin bundle
MAPPINGS = {"f-tan": math.tan, "f-theta": float}


def chief_height_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelength_um: float = D_UM,
    at_m: Distances = PARALLEL,
) -> Tensor:
    """Height y of the real chief ray on the image plane, [F] mm; [D, F] for D distances ``at_m`` of
    the object, see ``trace_field``. Gradient: to every lens tensor (a chief ray is the same at
    every distance).
    Raises: DomainError when one does not arrive."""
    return chief_ray(lens, fields_rad, wavelength_um, at_m=at_m).position_mm[..., 0, 1]


def distortion_percent(
    lens: GeoLens,
    fields_rad: Sequence[float],
    mapping: str = "f-tan",
    wavelength_um: float = D_UM,
    at_m: Distances = PARALLEL,
) -> Tensor:
    """100 (y / (s m(field)) - 1) of the real chief ray's height y, [F] percent, [D, F] for D
    distances; 0 on the axis and, as a limit, near it.

    s is the height of the paraxial chief ray per tangent on the same image plane: a plane out of
    focus makes a picture larger or smaller, which is no distortion. Where the plane is in focus, s
    is the focal length (parallel light) or magnification x distance (``paraxial.image_scale_mm``).

    Args:
      mapping: "f-tan" (a picture without distortion) or "f-theta" (a scan lens or fisheye).
      at_m: metres to the object plane; the chief ray and its distortion are the same at every
        distance.
    Gradient: to every lens tensor. Raises: DomainError for another mapping, or when a chief ray
      does not arrive.
    """
    check_choice(mapping, "mapping", MAPPINGS)
    ideal = chief_scale_mm(lens, wavelength_um) * torch.tensor(
        [MAPPINGS[mapping](float(field)) for field in fields_rad],
        dtype=lens.dtype,
        device=lens.curvature_per_mm.device,
    )
    off_axis = torch.tensor([float(field) != 0 for field in fields_rad], device=ideal.device)
    height = chief_height_mm(lens, fields_rad, wavelength_um, at_m)
    return torch.where(off_axis, 100 * (height / torch.where(off_axis, ideal, 1) - 1), 0)


def focus_shift_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    wavelength_um: float = D_UM,
    at_m: Distances = PARALLEL,
) -> Tensor:
    """Tangential and sagittal focus of each field, along z from the image plane; the difference is
    the astigmatism.

    Rays at +-REACH and +-2 REACH of the pupil radius stand for the infinitely thin bundle of
    Coddington's equations; four points cancel the terms of third order in the reach, so what is
    left is rounding (below 1e-8 of the focal length).

    Args:
      fields_rad: F angles.
      at_m: metres to the object plane, or D of them.
    Returns: [F, 2] or [D, F, 2] mm, tangential (rays displaced in y) then sagittal (in x); positive
      behind the image plane. Computed in float64, as the rays lie so close together, and given in
      the lens's precision.
    Gradient: to every lens tensor and to at_m. Raises: DomainError when a field does not arrive.
    """
    dtype = lens.dtype
    lens = in_float64(lens)
    line = (
        torch.tensor([-2.0, -1.0, 1.0, 2.0], dtype=lens.dtype, device=lens.curvature_per_mm.device)
        * REACH
    )
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
    """Derivative at the middle of values [..., 4] at -2, -1, 1, 2 steps, per step, exact for
    cubics."""
    return (8 * (values[..., 2] - values[..., 1]) - (values[..., 3] - values[..., 0])) / 12


@dataclass(frozen=True)
class RayFan:
    """Aberrations along a pupil diameter, relative to the reference point (the chief ray's, unless
    another was given).

    pupil: [M] in [-1, 1]. tangential_mm: [M] transverse aberration in y of rays (0, pupil);
      sagittal_mm: [M] that in x of rays (pupil, 0). tangential_waves, sagittal_waves: [M] optical
      path differences.
      tangential_weight, sagittal_weight: [M], 0 where no ray arrives.
    """

    pupil: Tensor
    tangential_mm: Tensor
    sagittal_mm: Tensor
    tangential_waves: Tensor
    sagittal_waves: Tensor
    tangential_weight: Tensor
    sagittal_weight: Tensor


def ray_fan(
    lens: GeoLens,
    field_rad: float,
    wavelength_um: float = D_UM,
    count: int = 33,
    vignetting: bool = False,
    reference_mm: Tensor | None = None,
    at_m: float | Tensor = PARALLEL,
) -> RayFan:
    """RayFan of one object point and wavelength.

    Args:
      count: rays per diameter, odd to hold the chief ray. reference_mm: [2] image point to which
        both aberrations refer; None is the chief ray of this wavelength. Give that of a middle
        wavelength to see lateral colour. vignetting, at_m (one distance): see ``trace_field``.
    Returns: RayFan, in the lens's precision; paths of many wavelengths are computed in float64.
    Gradient: aberrations to every lens tensor and to at_m. Raises: DomainError when no ray, or not
      the chief ray, arrives.
    """
    like = lens.curvature_per_mm
    lens = in_float64(lens)
    line = torch.linspace(-1, 1, count, dtype=torch.float64, device=like.device)
    zero = torch.zeros_like(line)
    pupil = torch.cat([torch.stack([zero, line], 1), torch.stack([line, zero], 1)])
    reference_mm = None if reference_mm is None else reference_mm.double()
    rays, chief = trace_with_chief(lens, field_rad, pupil, wavelength_um, vignetting, at_m)
    centre = chief.position_mm[0] if reference_mm is None else reference_mm
    away = rays.position_mm - centre
    waves = path_difference_mm(lens, rays, chief, wavelength_um, reference_mm) / (
        wavelength_um * 1e-3
    )
    fans = (
        line,
        away[:count, 1],
        away[count:, 0],
        waves[:count],
        waves[count:],
        rays.weight[:count],
        rays.weight[count:],
    )
    return RayFan(*(fan.to(like.dtype) for fan in fans))


METHODS = {"diffraction": diffraction_mtf, "geometric": geometric_mtf}


def through_focus_spot_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    defocus_mm: Values,
    light: Light = D_UM,
    grid: int = 32,
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Tensor:
    """RMS spot about its mean for each field and plane, [F, Z] mm. Args: defocus_mm: [Z], positive
    further from the lens; at_m: metres to the object plane. Gradient: to every lens tensor."""
    pupil = pupil_grid(grid, lens.dtype, lens.curvature_per_mm.device)
    wavelengths, shares = spectral_lines(light)
    one_distance(at_m)
    rays = [trace_field(lens, fields_rad, pupil, w, vignetting, at_m=at_m) for w in wavelengths]
    weight = torch.stack([r.weight * share for r, share in zip(rays, shares, strict=True)], 1)
    place = torch.stack([r.position_mm for r in rays], 1)
    slope = torch.stack([r.direction[..., :2] / r.direction[..., 2:] for r in rays], 1)
    return torch.stack(
        [
            torch.stack(
                [
                    spot_radius_mm(p + float(z) * s, w)
                    for p, s, w in zip(place, slope, weight, strict=True)
                ]
            )
            for z in defocus_mm
        ],
        1,
    )


def through_focus_mtf(
    lens: GeoLens,
    field_rad: float,
    frequency_per_mm: float,
    defocus_mm: Values,
    light: Light = D_UM,
    method: str = "diffraction",
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Tensor:
    """MTF at one frequency on several planes, [2, Z] tangential, sagittal. Args: method:
    "diffraction" or "geometric"; at_m: metres to the object plane. Gradient: to every lens
    tensor."""
    check_choice(method, "method", METHODS)
    behind = torch.zeros_like(lens.thickness_mm)
    behind[-1] = 1.0
    lenses = [lens.replace(thickness_mm=lens.thickness_mm + float(z) * behind) for z in defocus_mm]
    options = {"light": light, "vignetting": vignetting, "at_m": at_m}
    return torch.cat(
        [METHODS[method](geo, field_rad, [frequency_per_mm], **options) for geo in lenses], 1
    )


def relative_illumination(lens: GeoLens, fields_rad: Sequence[float], grid: int = 24) -> Tensor:
    """Irradiance of the image of a uniform world at each field, relative to the axis, vignetting
    included.

    Args:
      fields_rad: angles from the axis.
      grid: pupil points across the stop.
    Returns: [fields], computed in float64 and given in the lens's precision. For an ideal lens of
      small aperture without distortion it is cos^4 of the field angle.
    Gradient: to every lens tensor.
    Raises: DomainError for a field that no ray passes.
    Source: E = integral of radiance over image-space direction cosines (Slyusarev; Rimmer, Relative
      illumination calculations, Proc. SPIE 655, 1986).
    """
    dtype = lens.dtype
    lens = in_float64(lens)
    pupil = pupil_grid(grid, device=lens.curvature_per_mm.device)
    fields = [0.0, *map(float, fields_rad)]
    heights = torch.stack([_image_height(lens, field) for field in fields])
    film = torch.stack([torch.zeros_like(heights), heights], 1).repeat_interleave(pupil.shape[0], 0)
    # camera rays take points as seen upright
    rays = lens.camera_rays(-film, pupil.repeat(len(fields), 1), aim=True)
    assert rays.irradiance is not None  # GeoLens gives it
    light = (rays.weight * rays.irradiance).reshape(len(fields), -1).mean(1)
    return (light[1:] / light[0]).to(dtype)


def _image_height(lens, field_rad):
    """Where the chief ray of a field meets the image plane, mm (negative for a positive field)."""
    origin, direction = aimed_rays(lens, field_rad, torch.zeros(1, 2, dtype=lens.dtype))
    out = lens.trace(origin, direction)
    if out.status[0] != 0:
        raise DomainError(
            f"{lens.name}: the chief ray of field {field_rad * 57.29578:.4g} degrees does not pass the "
            "lens; use a smaller field."
        )
    return out.position_mm[0, 1]
