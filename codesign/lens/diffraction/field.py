"""Monochromatic scalar fields on a square grid, and the openings that shape them."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite

STRIPS = 64  # per cell, in which the rim of a disc is summed


@dataclass(frozen=True)
class Field:
    """A scalar field on a plane across the axis; light travels along +z as exp(+i k z).

    amplitude: [..., N, N] complex, rows along +y, columns along +x; the axis passes through the sample
      [N // 2, N // 2]. pitch_mm: distance of the samples. wavelength_um: in vacuum, and the field lies in it.

    >>> import torch
    >>> from codesign.lens import diffraction
    >>> slit = diffraction.Field(torch.ones(64, 64, dtype=torch.complex128), 0.002, 0.55)
    >>> float(slit.energy)  # (64 x 2 um)^2
    0.016384
    """

    amplitude: Tensor
    pitch_mm: float
    wavelength_um: float

    def __post_init__(self) -> None:
        shape = tuple(self.amplitude.shape)
        if len(shape) < 2 or shape[-1] != shape[-2] or shape[-1] < 2 or not self.amplitude.is_complex():
            raise ShapeError(
                f"a field must be complex and [..., N, N] with N of at least 2, got {self.amplitude.dtype} "
                f"{shape}."
            )
        if not (0 < self.pitch_mm < math.inf and 0 < self.wavelength_um < math.inf):
            raise DomainError(
                f"pitch {self.pitch_mm} mm and wavelength {self.wavelength_um} um of a field must be "
                "positive."
            )

        check_finite(self.amplitude, "field")

    @property
    def count(self) -> int:
        """Samples across."""
        return self.amplitude.shape[-1]

    @property
    def wavelength_mm(self) -> float:
        return self.wavelength_um * 1e-3

    @property
    def intensity(self) -> Tensor:
        """[..., N, N] squared modulus, per mm^2."""
        return self.amplitude.real.square() + self.amplitude.imag.square()

    @property
    def energy(self) -> Tensor:
        """[...] integral of the intensity over the grid."""
        return self.intensity.sum((-2, -1)) * self.pitch_mm**2

    def places_mm(self) -> Tensor:
        """[N] places of the samples along x, or y."""
        real = self.amplitude.real
        return (
            torch.arange(self.count, dtype=real.dtype, device=real.device) - self.count // 2
        ) * self.pitch_mm

    def times(self, factor: Tensor) -> "Field":
        """The field behind a thin element of this transmission, [..., N, N], complex or real."""
        return replace(self, amplitude=self.amplitude * factor)


def rectangle(count: int, pitch_mm: float, half_mm: tuple[float, float]) -> Tensor:
    """Transmission of an opening |x| < half_mm[0], |y| < half_mm[1], [N, N] float64; see ``disc``."""
    _check_opening(count, pitch_mm, *half_mm)
    at = torch.arange(count, dtype=torch.float64) - count // 2
    x, y = (_passed(half / pitch_mm - at) - _passed(-half / pitch_mm - at) for half in half_mm)
    return x * y[:, None]


def disc(count: int, pitch_mm: float, radius_mm: float) -> Tensor:
    """Transmission of a round opening about the axis, [N, N] float64. No gradient.

    Samples that are open or not make a staircase, which errs by 1e-3 of the peak of an Airy pattern at 128
    across. Here a sample is the integral of the opening over a cubic interpolation kernel, so that sums over
    samples are integrals over the opening itself, to third order of the pitch; at the rim they lie a little
    outside of [0, 1].
    Source: Keys, Cubic convolution interpolation, IEEE Trans. ASSP 29 (1981).
    """
    _check_opening(count, pitch_mm, radius_mm)
    at = torch.arange(count, dtype=torch.float64) - count // 2
    strips = (torch.arange((count + 3) * STRIPS, dtype=torch.float64) + 0.5) / STRIPS - count // 2 - 2
    half = ((radius_mm / pitch_mm) ** 2 - strips.square()).clamp_min(0).sqrt()[:, None]  # of the chord
    chords = _passed(half - at) - _passed(-half - at)
    weights = _passed(torch.arange(4 * STRIPS + 1, dtype=torch.float64) / STRIPS - 2).diff()
    return torch.nn.functional.conv1d(chords.T[:, None], weights[None, None], stride=STRIPS)[:, 0].T


def check_grid(count: int, pitch_mm: float) -> None:
    """Raise DomainError unless there can be a grid of ``count`` samples ``pitch_mm`` apart."""
    if not isinstance(count, int) or count < 2 or not 0 < pitch_mm < math.inf:
        raise DomainError(
            f"a grid of {count} samples, {pitch_mm} mm apart, cannot be; give a whole number of at least 2 "
            "and a "
            "positive, finite pitch."
        )


def _check_opening(count, pitch_mm, *halves_mm):
    check_grid(count, pitch_mm)
    if not all(0 <= half < math.inf for half in halves_mm):
        raise DomainError(
            f"half widths of an opening must be finite and at least 0, got {', '.join(map(str, halves_mm))} "
            "mm."
        )


def _passed(s):
    """Integral of the cubic kernel up to s, in samples: 0 below -2, 1 above 2."""
    a = s.abs().clamp_max(2)
    near = 0.375 * a**4 - 5 / 6 * a**3 + a
    far = -0.125 * a**4 + 5 / 6 * a**3 - 2 * a**2 + 2 * a - 1 / 6
    return 0.5 + s.sign() * torch.where(a < 1, near, far)
