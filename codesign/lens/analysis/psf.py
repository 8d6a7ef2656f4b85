"""Point spread functions: by diffraction from the pupil's wavefront, and geometric by counting rays
on pixels."""

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.checks import check_positive, check_whole
from codesign.errors import DomainError
from codesign.lens.analysis.rays import Light, chief_ray, spectral_lines
from codesign.lens.analysis.spots import lit_points
from codesign.lens.diffraction.pupil import pupil_function, pupil_functions
from codesign.lens.distance import PARALLEL
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM


@dataclass(frozen=True)
class Psf:
    """A point image. Rows along +y, columns along +x of the lens; the reference point lies on
    [K // 2, K // 2] of K rows and columns.

    energy: [K, K] share of the light per pixel. pitch_mm: [2] pixel size (x, y). reference_mm: [2]
      the reference point on the image plane.
    """

    energy: Tensor
    pitch_mm: Tensor
    reference_mm: Tensor


def diffraction_psf(
    lens: GeoLens,
    field_rad: float,
    wavelength_um: float = D_UM,
    grid: int | None = None,
    padding: int = 4,
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Psf:
    """Psf by a Fourier transform of the pupil, zero-padded from n to n * padding cells.

    The pixel is then wavelength / (2 r padding), r the pupil's radius in direction cosines: a
    quarter of the Airy scale wavelength times f-number per unit of padding 4. The picture repeats
    with n wavelength times f-number. Energy sums to 1.

    Args:
      grid, vignetting, at_m: see ``pupil_function``.
      padding: >= 2, so that the energy is not aliased.
    Gradient: energy and pitch to every lens tensor. Raises: DomainError, see ``pupil_function``.
    """
    padding = check_whole(padding, "padding", 2)
    pupil = pupil_function(lens, field_rad, wavelength_um, grid, vignetting, at_m=at_m)
    count = pupil.field.shape[0] * int(padding)
    # signs in a chequer put the reference point into the middle; columns of padding alone need no
    # transform
    sign = 1 - 2 * (torch.arange(pupil.field.shape[0], device=pupil.field.device) % 2)
    light = (pupil.field.real.square() + pupil.field.imag.square()).sum()
    # so that the energy sums to 1 (Parseval)
    field = pupil.field * (sign * sign[:, None]) * (count / light.sqrt())
    amplitude = torch.fft.ifft(torch.fft.ifft(field, n=count, dim=0), n=count, dim=1)
    energy = amplitude.real.square() + amplitude.imag.square()
    pitch = pupil.wavelength_mm / (2 * pupil.cosine_radius * int(padding))
    return Psf(energy, pitch, pupil.reference_mm)


def psf_on_pixels(
    lens: GeoLens,
    field_rad: float,
    pixel_mm: float,
    pixels: int = 64,
    light: Light = D_UM,
    grid: int | None = None,
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Psf:
    """Psf of one or several wavelengths by diffraction, on a pixel grid of one's own, about the
    chief ray of the first wavelength.

    The Fourier integral is summed for each pixel centre (two matrix products), so wavelengths share
    the grid and their lateral colour is in it. The energy of a pixel is the density at its centre
    times its area; the sum tells the share that falls on the grid.

    Args:
      pixel_mm: size of a square pixel.
      pixels: rows and columns.
      light: see ``spectral_lines``.
      at_m: metres to the object plane, see ``wavefront``.
    Gradient: to every lens tensor. Raises: DomainError, see ``pupil_function``, and when the grid
      is wider than the sampled pupil's period.
    """
    pixel_mm, pixels = _pixels(pixel_mm, pixels)
    reference, pupils = pupil_functions(lens, field_rad, light, grid, vignetting, at_m)
    at = (torch.arange(pixels, dtype=lens.dtype, device=reference.device) - pixels // 2) * pixel_mm
    total = torch.zeros(pixels, pixels, dtype=lens.dtype, device=reference.device)
    for share, pupil in pupils:
        n = pupil.field.shape[0]
        period = n * pupil.wavelength_mm / (2 * float(pupil.cosine_radius.detach().max()))
        if pixels * pixel_mm > period:
            raise DomainError(
                f"{lens.name}: {pixels} pixels of {pixel_mm:g} mm are wider than the {period:.3g} mm that "
                f"{n} pupil cells resolve; give fewer pixels or a finer pupil grid."
            )
        amplitude = pupil.amplitude(at)
        total = total + share * pixel_mm**2 * (amplitude.real.square() + amplitude.imag.square())
    return Psf(total, reference.new_full((2,), pixel_mm, dtype=lens.dtype), reference)


def geometric_psf(
    lens: GeoLens,
    field_rad: float,
    pixel_mm: float,
    pixels: int = 64,
    light: Light = D_UM,
    grid: int = 128,
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Psf:
    """Psf by rays: each ray's weight is shared bilinearly among the four pixel centres around it.
    About the chief ray of the first wavelength.

    Args:
      grid: pupil cells across.
      at_m: metres to the object plane, see ``wavefront``. Rays beyond the grid are lost: the sum of
        ``energy`` is the share that falls on it.
    Gradient: energy to every lens tensor, piecewise linear in the ray positions.
    """
    pixel_mm, pixels = _pixels(pixel_mm, pixels)
    points, weight = lit_points(lens, field_rad, light, grid, vignetting, at_m)
    reference = chief_ray(lens, field_rad, spectral_lines(light)[0][0], at_m).position_mm[0]
    place = (points - reference) / pixel_mm + pixels // 2  # x, y in pixels
    low = place.detach().floor()
    share = place - low
    low = low.long()
    energy = torch.zeros(pixels * pixels, dtype=lens.dtype, device=reference.device)
    for corner in itertools.product((0, 1), (0, 1)):
        at = low + low.new_tensor(corner)
        parts = [s if step else 1 - s for s, step in zip(share.unbind(1), corner, strict=True)]
        on = ((at >= 0) & (at < pixels)).all(1)
        pixel = at[:, 1] * pixels + at[:, 0]
        energy = energy.index_add(0, pixel[on], (weight * parts[0] * parts[1])[on])
    pitch_mm = reference.new_full((2,), pixel_mm, dtype=lens.dtype)
    return Psf(energy.reshape(pixels, pixels), pitch_mm, reference)


def _pixels(pixel_mm, pixels):
    """Size and number of the pixels of a grid. Raises: DomainError for what is none."""
    return check_positive(pixel_mm, "pixel_mm"), check_whole(pixels, "pixels")
