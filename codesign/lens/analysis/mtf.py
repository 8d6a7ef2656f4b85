"""Modulation transfer: by diffraction, geometric, and that of a perfect lens.

Tangential means a pattern that varies along y, the direction of the field
(its lines lie across it); sagittal one that varies along x.
"""

import math

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis.rays import Light, Values, pupil_grid
from codesign.lens.analysis.spots import polychromatic_spot
from codesign.lens.diffraction.pupil import pupil_functions
from codesign.lens.distance import PARALLEL
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM

PADDING = 2  # the line spread is then free of aliasing up to the cut-off
PERIOD_SHARE = 0.25  # of a period of the pattern, that neighbouring rays may lie apart
CELLS = (64, 128, 256, 512, 1024)  # across the pupil, tried in turn
PHASES = 2**24  # of frequencies times rays, held at a time


def ideal_mtf(
    frequency_per_mm: float | Values,
    fno: float | Tensor,
    wavelength_um: float = D_UM,
) -> Tensor:
    """MTF of a perfect lens with a round pupil, (2 / pi) (acos v - v sqrt(1 - v^2)), v = frequency
    x wavelength x f-number. Shape of the frequency; 0 beyond v = 1."""
    v = (torch.as_tensor(frequency_per_mm) * (wavelength_um * 1e-3 * fno)).abs().clamp_max(1.0)
    return 2 / math.pi * (v.acos() - v * (1 - v * v).sqrt())


def diffraction_mtf(
    lens: GeoLens,
    field_rad: float,
    frequency_per_mm: Values,
    light: Light = D_UM,
    grid: int | None = None,
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Tensor:
    """MTF with diffraction of one field, from the Fourier transform of the point spread.

    Several wavelengths add as complex transfer functions about one image point, so that lateral
    colour counts.

    Args:
      frequency_per_mm: [K] line pairs per mm in the image.
      light, grid, vignetting, at_m: see ``psf_on_pixels``.
    Returns: [2, K] tangential, sagittal, in [0, 1]; exactly 0 beyond the cut-off.
    Gradient: to every lens tensor. Raises: DomainError for a negative frequency, and see
      ``pupil_function``.
    """
    frequency = _frequencies(lens, frequency_per_mm)
    _, pupils = pupil_functions(lens, field_rad, light, grid, vignetting, at_m)
    transfers = (
        share * torch.stack([_transfer(pupil, axis, frequency) for axis in (1, 0)])
        for share, pupil in pupils
    )
    return sum(transfers, torch.zeros_like(frequency)).abs()


def geometric_mtf(
    lens: GeoLens,
    field_rad: float,
    frequency_per_mm: Values,
    light: Light = D_UM,
    grid: int | None = None,
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Tensor:
    """MTF of the rays alone, |mean of exp(-2 pi i frequency x)|, [2, K] tangential, sagittal.
    Arguments and gradient as for ``diffraction_mtf``.

    Multiply by ``ideal_mtf`` for the usual estimate between the two limits.

    Args:
      grid: pupil cells across; None takes the first of 64, 128, ... 1024 at which neighbouring rays
        lie at most a quarter of a period of the highest frequency apart: coarser sums alias.
    Raises: DomainError where the grid, or the finest one, is too coarse for the frequencies.
    """
    frequency = _frequencies(lens, frequency_per_mm)
    highest = max(frequency.tolist(), default=0.0)
    for cells in CELLS if grid is None else (grid,):
        points, weight = polychromatic_spot(lens, field_rad, light, cells, vignetting, at_m)
        lit = weight.detach() > 0
        step_mm = _largest_step_mm(points.detach(), lit, cells)
        if not highest or step_mm * highest <= PERIOD_SHARE:
            return _transform(points[lit], weight[lit], frequency)
    remedy = "use fewer line pairs per mm or a sharper image" if grid is None else "use grid=None"
    raise DomainError(
        f"{lens.name}: {cells} rays across the pupil lie up to {step_mm:.3g} mm apart in the image, too far "
        f"for {highest:.4g} line pairs per mm (at most {PERIOD_SHARE / step_mm:.3g}); {remedy}."
    )


def _largest_step_mm(points_mm, lit, cells):
    """Largest distance in x or y between neighbours of a ``pupil_grid`` that both arrive, of points
    [W, M, 2] and lit [W, M]; infinite where none has a neighbour."""
    pupil = pupil_grid(cells, torch.float64, points_mm.device)
    column, row = ((pupil + 1) / 2 * cells).long().unbind(1)
    places = points_mm.new_full((len(points_mm), cells, cells, 2), math.nan)
    places[:, row, column] = torch.where(lit[..., None], points_mm, math.nan)
    steps = torch.cat([places.diff(dim=axis).abs().flatten() for axis in (1, 2)])
    known = steps[steps.isfinite()]
    return float(known.max()) if len(known) else math.inf


def _transform(points_mm, weight, frequency):
    """|Mean of exp(-2 pi i frequency x)| of points [N, 2] of weights [N], [2, K]."""
    away = points_mm - (points_mm * weight[:, None]).sum(0)
    found = []
    for axis in (1, 0):
        parts = []
        for some in frequency.split(max(1, PHASES // len(weight))):
            phase = 2 * math.pi * some[:, None] * away[:, axis]
            cosine, sine = (phase.cos() * weight).sum(1), (phase.sin() * weight).sum(1)
            parts.append(torch.complex(cosine, -sine).abs())
        found.append(torch.cat(parts))
    return torch.stack(found)


def _transfer(pupil, axis, frequency):
    """Complex transfer along an axis (0: x, 1: y) at frequencies [K], from the line spread of the
    zero-padded pupil."""
    n = pupil.field.shape[0]
    field = pupil.field if axis else pupil.field.T
    # line spread along y: by Parseval, |.|^2 may be summed over x in the pupil instead of the image
    spread = torch.fft.ifft(field, n=n * PADDING, dim=0)
    line_spread = torch.fft.fftshift((spread.real.square() + spread.imag.square()).sum(1))
    radius = pupil.cosine_radius[axis]
    number = torch.arange(n * PADDING, dtype=frequency.dtype, device=frequency.device)
    place = (number - n * PADDING // 2) * (pupil.wavelength_mm / (2 * radius * PADDING))
    phase = 2 * math.pi * frequency[:, None] * place
    found = (
        torch.complex(phase.cos() @ line_spread, -(phase.sin() @ line_spread)) / line_spread.sum()
    )
    return torch.where(frequency < 2 * radius / pupil.wavelength_mm, found, 0)


def _frequencies(lens, values):
    frequency = torch.as_tensor(
        values, dtype=lens.dtype, device=lens.curvature_per_mm.device
    ).reshape(-1)
    if not bool((frequency >= 0).all()):
        raise DomainError(f"frequencies {frequency.tolist()} must be at least 0 line pairs per mm.")
    return frequency
