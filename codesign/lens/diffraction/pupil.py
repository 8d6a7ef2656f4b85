"""The complex pupil of a field, sampled on a square grid for Fourier transforms."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis.rays import Light, chief_ray, spectral_lines
from codesign.lens.analysis.wavefront import wavefront
from codesign.lens.diffraction.place import cells_for_plate, plate_waves, with_plate
from codesign.lens.distance import PARALLEL
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM

# cells across the pupil when the number is found from the aberration
COARSEST = 128
FINEST = 1024
LARGEST_STEP_WAVES = 0.5  # between neighbouring cells; beyond it the sampled phase is ambiguous


@dataclass(frozen=True)
class PupilFunction:
    """Field on the reference sphere of one field and wavelength.

    field: [n, n] complex, rows along y, columns along x, on the cell centres of [-1, 1]^2 in units
      of ``cosine_radius``, in the order of rising direction cosines of the light that goes to the
      image point (so a point high in the pupil stands at a low y); 0 outside the pupil.
    cosine_radius: [2] (x, y) half width of the pupil in direction cosines times index, as seen from
      the image point: 1 / (2 f-number). reference_mm: [2] the image point, centre of the reference
      sphere.
    """

    field: Tensor
    cosine_radius: Tensor
    wavelength_um: float
    reference_mm: Tensor

    @property
    def wavelength_mm(self) -> float:
        return self.wavelength_um * 1e-3

    def cosines(self) -> tuple[Tensor, Tensor]:
        """Direction cosines [n] times index of the columns (x) and the rows (y)."""
        n, like = self.field.shape[0], self.cosine_radius
        line = (torch.arange(n, dtype=like.dtype, device=like.device) + 0.5) / n * 2 - 1
        return like[0] * line, like[1] * line

    def amplitude(self, places_mm: Tensor) -> Tensor:
        """Field [K, K] about the image point at places [K] along y and x; the energy of all of it
        is 1.

        The Fourier integral is summed for each place, as two matrix products.
        """
        k = 2 * math.pi / self.wavelength_mm
        to_x, to_y = (
            torch.polar(torch.ones_like(a), a)
            for a in (k * places_mm[:, None] * c for c in self.cosines())
        )
        # solid angle of a cell in direction cosines
        cell = (2 / self.field.shape[0]) ** 2 * self.cosine_radius.prod()
        power = (self.field.real.square() + self.field.imag.square()).sum()
        return (to_y @ self.field @ to_x.T) * ((cell / power).sqrt() / self.wavelength_mm)


def pupil_function(
    lens: GeoLens,
    field_rad: float,
    wavelength_um: float = D_UM,
    grid: int | None = None,
    vignetting: bool = False,
    reference_mm: Tensor | None = None,
    at_m: float | Tensor = PARALLEL,
) -> PupilFunction:
    """PupilFunction of one object point: amplitude times exp(-2 pi i OPD / wavelength).

    Points that are even over the entrance pupil are taken as even in the direction cosines towards
    the image point (Abbe's sine condition); their scale in x and y, which holds the foreshortening
    off the axis, is fitted to the traced rays. A cell counts when its centre lies in the disc; the
    staircase at the rim costs about 1e-3 of MTF at 64 cells and 3e-4 at 128. A phase plate adds its
    phase where the rays of the bare lens meet it, as a thin element does to a field.

    Args:
      grid: cells across; None picks a power of two from the aberration.
      reference_mm, at_m: see ``wavefront``.
    Gradient: to every lens tensor and to at_m. Raises: DomainError when neighbouring cells differ
      by more than half a wave, a phase plate is finer than the cells, or no ray arrives.
    """
    if lens.plate is not None and reference_mm is None:
        reference_mm = chief_ray(lens, field_rad, wavelength_um, at_m).position_mm[0]
    if grid is None:
        grid = _enough_cells(lens, field_rad, wavelength_um, vignetting, reference_mm, at_m)
    finest = cells_for_plate(lens, wavelength_um)
    if grid < finest:
        raise DomainError(
            f"{lens.name}: the phase plate is finer than {grid} cells across the pupil resolve (its phase "
            f"may step by half a wave from cell to cell, and has detail of {lens.plate.finest_mm:.3g} mm); "
            f"give a grid of at least {finest}, or a smoother plate."
        )
    like = lens.curvature_per_mm
    line = (torch.arange(grid, dtype=like.dtype, device=like.device) + 0.5) / grid * 2 - 1
    seen, front = _bare_front(lens, field_rad, wavelength_um, vignetting, reference_mm, at_m, line)
    scale = _cosine_radius(front)
    if lens.plate is not None:
        waves, reaches = plate_waves(lens, field_rad, front.pupil, wavelength_um, at_m)
        front = replace(
            front,
            opd_mm=front.opd_mm - waves * (wavelength_um * 1e-3),
            weight=front.weight * reaches,
        )
    worst = _largest_step(front, seen)
    if worst > LARGEST_STEP_WAVES:
        raise DomainError(
            f"{lens.name}: neighbouring pupil cells differ by {worst:.2g} waves at field "
            f"{math.degrees(field_rad):.4g} degrees with a grid of {grid}; "
            f"below {LARGEST_STEP_WAVES} is needed: give a finer grid, or use the geometric spread, which "
            "fits such large aberrations."
        )
    phase = 2 * math.pi * front.waves
    amplitude = torch.where(front.weight > 0, front.weight, 1).sqrt() * (front.weight > 0)
    values = torch.complex(amplitude * phase.cos(), -amplitude * phase.sin())
    field = torch.zeros(grid, grid, dtype=values.dtype, device=like.device).masked_scatter(
        seen, values
    )
    # light from above goes down
    mirrored = [axis for axis, value in ((1, scale[0]), (0, scale[1])) if float(value.detach()) < 0]
    return PupilFunction(field.flip(mirrored), scale.abs(), wavelength_um, front.reference_mm)


def pupil_functions(
    lens: GeoLens,
    field_rad: float,
    light: Light,
    grid: int | None,
    vignetting: bool,
    at_m: float | Tensor,
) -> tuple[Tensor, Iterator[tuple[float, PupilFunction]]]:
    """The chief ray's image point [2] of the first wavelength, and share and PupilFunction of each
    about it."""
    wavelengths, shares = spectral_lines(light)
    reference = chief_ray(lens, field_rad, wavelengths[0], at_m).position_mm[0]
    return reference, (
        (share, pupil_function(lens, field_rad, w, grid, vignetting, reference, at_m))
        for w, share in zip(wavelengths, shares, strict=True)
    )


def _bare_front(lens, field_rad, wavelength_um, vignetting, reference_mm, at_m, line):
    """Which points of a square grid lie in the pupil, and the Wavefront there of the lens without
    its plate."""
    y, x = torch.meshgrid(line, line, indexing="ij")
    seen = x * x + y * y <= 1
    points = torch.stack([x, y], -1)[seen]
    bare = with_plate(lens, None)
    return seen, wavefront(
        bare, field_rad, wavelength_um, 0, vignetting, reference_mm, points, at_m
    )


def _cosine_radius(front):
    """Least-squares slope of direction cosines over pupil coordinates, [2]; negative where light
    from above goes down."""
    w = front.weight[:, None] / front.weight.sum()
    pupil = front.pupil - (front.pupil * w).sum(0)
    cosines = front.slope - (front.slope * w).sum(0)
    return (pupil * cosines * w).sum(0) / (pupil * pupil * w).sum(0)


def _largest_step(front, seen):
    """Largest difference in waves of neighbouring points of the grid where both are lit."""
    opd = torch.zeros_like(seen, dtype=front.opd_mm.dtype).masked_scatter(
        seen, front.waves.detach()
    )
    lit = torch.zeros_like(seen).masked_scatter(seen, front.weight > 0)
    count = len(lit) - 1
    both = [lit.narrow(d, 1, count) & lit.narrow(d, 0, count) for d in (0, 1)]
    return max(float((opd.diff(dim=d).abs() * both[d]).max()) for d in (0, 1))


def _enough_cells(lens, field_rad, wavelength_um, vignetting, reference_mm, at_m) -> int:
    """Power of two for which neighbours differ by at most a third of a wave, from a coarse look at
    the wavefront."""
    line = torch.linspace(-1, 1, 65, dtype=lens.dtype, device=lens.curvature_per_mm.device)
    with torch.no_grad():
        seen, front = _bare_front(
            lens, field_rad, wavelength_um, vignetting, reference_mm, at_m, line
        )
    step = _largest_step(front, seen)
    needed = 64 * step / (LARGEST_STEP_WAVES / 1.5) + cells_for_plate(lens, wavelength_um)
    return min(max(2 ** math.ceil(math.log2(max(needed, 1.0))), COARSEST), FINEST)
