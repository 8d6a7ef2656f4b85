"""Thin phase plates, in Zernike terms or on a grid, that light and rays see alike.

Zernike terms are in Noll's order, orthonormal over the unit disc: a term's mean square there is 1,
so its coefficient is its RMS. Odd terms are those of the sine. Source: Noll, Zernike polynomials
and atmospheric turbulence, JOSA 66 (1976).
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from codesign.checks import check_finite, check_positive, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.lens.glass import D_UM
from codesign.lens.replaceable import Replaceable


def noll(term: int) -> tuple[int, int]:
    """(n, m) of a term counted from 1: radial order, and azimuthal order, negative for sines.

    >>> from codesign.lens.diffraction import noll
    >>> [noll(j) for j in (1, 4, 7, 8, 11)]
    [(0, 0), (2, 0), (3, -1), (3, 1), (4, 0)]
    """
    check_whole(term, "Noll's term", remedy="1 is piston")
    n = math.isqrt(8 * int(term) - 7) // 2 + (math.isqrt(8 * int(term) - 7) % 2) - 1
    place = int(term) - n * (n + 1) // 2  # 1 to n + 1 within the radial order
    m = place // 2 * 2 if n % 2 == 0 else (place - 1) // 2 * 2 + 1
    return n, m if term % 2 == 0 else -m


def zernike(terms: Sequence[int], points: Tensor) -> tuple[Tensor, Tensor]:
    """Values and slopes of Zernike terms.

    Args:
      terms: K of Noll's indices, from 1.
      points: [N, 2] (x, y) in units of the disc's radius; beyond 1 the polynomials go on.
    Returns: values [N, K]; slopes [N, K, 2] along x and y, per radius. Gradient: both to the
      points.
    """
    x, y = points.unbind(1)
    r2 = x.square() + y.square()
    found = []
    for term in terms:
        n, signed = noll(term)
        m = abs(signed)
        norm = math.sqrt((n + 1) * (2 if m else 1))
        radial = norm * _jacobi((n - m) // 2, 0, m, 2 * r2 - 1)
        # d/dr2 of P_k^(0, m)(2 r2 - 1)
        bend = norm * (n + m + 2) / 2 * _jacobi((n - m) // 2 - 1, 1, m + 1, 2 * r2 - 1)
        around = _turned(x, y, m, signed < 0)
        ahead, aside = _turned(x, y, m - 1, False), _turned(x, y, m - 1, True)
        turn = (aside, ahead) if signed < 0 else (ahead, -aside)
        slope = [
            2 * at * bend * around + m * radial * by for at, by in zip((x, y), turn, strict=True)
        ]
        found.append((radial * around, torch.stack(slope, 1)))
    return torch.stack([value for value, _ in found], 1), torch.stack(
        [slope for _, slope in found], 1
    )


def _turned(x, y, m, sine):
    """Imaginary (``sine``) or real part of (x + i y)^m; 0 for m below 0."""
    real = torch.ones_like(x) if m >= 0 else torch.zeros_like(x)
    imaginary = torch.zeros_like(x)
    for _ in range(m):
        real, imaginary = real * x - imaginary * y, real * y + imaginary * x
    return imaginary if sine else real


def _jacobi(k, a, b, t):
    """Jacobi polynomial P_k^(a, b)(t) by its recurrence; 0 for k below 0."""
    before, now = torch.zeros_like(t), torch.ones_like(t)
    if k < 0:
        return before
    for i in range(1, k + 1):
        s = 2 * i + a + b
        if i == 1:
            before, now = now, (a + 1) + (a + b + 2) * (t - 1) / 2
            continue
        ahead = (s - 1) * (s * (s - 2) * t + a * a - b * b) * now - 2 * (i + a - 1) * (
            i + b - 1
        ) * s * before
        before, now = now, ahead / (2 * i * (i + a + b) * (s - 2))
    return now


class Plate(Replaceable):
    """What all plates are: a phase over (x, y) that adds optical path, positive phase more of it.

    wavelength_um: where the phase holds. diffractive: whether the phase is the same at every
      wavelength (the first order of a blazed grating, all light in it), or, as for a smooth relief,
      the optical path is.
    finest_mm: length below which the phase has no detail.
    """

    wavelength_um: float
    diffractive: bool
    finest_mm: float

    def __init__(self, wavelength_um: float, diffractive: bool) -> None:
        super().__init__()
        check_positive(wavelength_um, "plate: wavelength_um")
        self.wavelength_um = float(wavelength_um)
        self.diffractive = bool(diffractive)

    def _identity(self):
        return {
            "wavelength in um": self.wavelength_um,
            "being diffractive": float(self.diffractive),
            "finest detail in mm": self.finest_mm,
        }

    def look(self, points_mm: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Phase [N] rad, its slope [N, 2] rad/mm, and whether the plate reaches there, [N] bool, at
        points [N, 2] mm from the axis. Gradient: to the points and to what the plate is made of."""
        raise NotImplementedError

    def mm_per_rad(self, wavelength_um: float) -> float:
        """Optical path that a radian of phase adds at a wavelength."""
        return (wavelength_um if self.diffractive else self.wavelength_um) * 1e-3 / (2 * math.pi)


class ZernikePlate(Plate):
    """Phase as a sum of Zernike terms, orthonormal on a disc of the plate; see ``zernike``.

    >>> from codesign.lens import diffraction
    >>> plate = diffraction.ZernikePlate({4: 0.0, 11: 1.5}, radius_mm=5.0)  # defocus, spherical aberration
    >>> plate.coefficients_rad.tolist()
    [0.0, 1.5]

    Args:
      coefficients_rad: {Noll's index: radians RMS}.
      radius_mm: of the disc; the polynomials go on beyond it.
      wavelength_um, diffractive: see ``Plate``.
    coefficients_rad: [K] Parameter, in the order given.
    """

    def __init__(
        self,
        coefficients_rad: Mapping[int, float],
        radius_mm: float,
        wavelength_um: float = D_UM,
        diffractive: bool = False,
    ) -> None:
        super().__init__(wavelength_um, diffractive)
        if not coefficients_rad or not 0 < radius_mm < math.inf:
            raise DomainError(
                f"plate: give at least one Zernike term and a positive radius, got {radius_mm} mm."
            )
        values = torch.tensor(list(coefficients_rad.values()), dtype=torch.float64)
        self.terms = tuple(coefficients_rad)
        self.radius_mm = float(radius_mm)
        self.coefficients_rad = nn.Parameter(
            check_finite(values, "plate coefficients", "give finite radians")
        )
        self.finest_mm = self.radius_mm / max(1, *(noll(term)[0] for term in self.terms))

    def _identity(self):
        terms = {f"term {i}": float(term) for i, term in enumerate(self.terms, 1)}
        return super()._identity() | {"radius in mm": self.radius_mm} | terms

    def look(self, points_mm: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        values, slopes = zernike(self.terms, points_mm / self.radius_mm)
        weights = self.coefficients_rad.to(points_mm)
        reaches = torch.ones_like(values[:, 0], dtype=torch.bool)
        return (
            values @ weights,
            torch.einsum("nkc,k->nc", slopes, weights) / self.radius_mm,
            reaches,
        )


class GridPlate(Plate):
    """Phase given on a square grid about the axis; between the points the natural cubic spline
    through them, so that rays meet a smooth slope.

    >>> import torch
    >>> from codesign.lens import diffraction
    >>> plate = diffraction.GridPlate(torch.zeros(16, 16, dtype=torch.float64), pitch_mm=0.5)  # 7.5 mm x 7.5 mm

    Args:
      phase_rad: [N, N] unwrapped, rows along +y, columns along +x, point (N - 1) / 2 on the axis.
      pitch_mm: distance of the points.
      wavelength_um, diffractive: see ``Plate``. Light beyond the outer points is stopped.
    phase_rad: [N, N] Parameter.
    """

    spline: Tensor

    def __init__(
        self,
        phase_rad: Tensor | Sequence[Sequence[float]],
        pitch_mm: float,
        wavelength_um: float = D_UM,
        diffractive: bool = False,
    ) -> None:
        super().__init__(wavelength_um, diffractive)
        phase = torch.as_tensor(phase_rad, dtype=torch.float64).detach().clone()
        if phase.ndim != 2 or phase.shape[0] != phase.shape[1] or phase.shape[0] < 4:
            raise ShapeError(
                f"plate: phases on a grid must be [N, N] with N of at least 4, got {tuple(phase.shape)}."
            )
        if not (bool(phase.isfinite().all()) and 0 < pitch_mm < math.inf):
            raise DomainError(
                f"plate: phases must be finite and their pitch positive, got {pitch_mm} mm."
            )
        self.phase_rad = nn.Parameter(phase)
        self.pitch_mm = self.finest_mm = float(pitch_mm)
        count = phase.shape[0]
        sampled = torch.diag_embed(torch.full((count,), 4.0)) + sum(
            torch.diag_embed(torch.ones(count - 1), offset) for offset in (-1, 1)
        )
        sampled[[0, -1]] = 6 * torch.eye(count)[[0, -1]]  # no curvature at the rim
        self.register_buffer("spline", torch.linalg.inv(sampled.double() / 6), persistent=False)

    def look(self, points_mm: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        count = self.phase_rad.shape[0]
        weights = self.spline @ self.phase_rad @ self.spline.T
        for _ in range(2):  # straight on by one point, along x and then along y
            weights = torch.cat(
                [
                    2 * weights[:, :1] - weights[:, 1:2],
                    weights,
                    2 * weights[:, -1:] - weights[:, -2:-1],
                ],
                1,
            ).T
        at = points_mm / self.pitch_mm + (count - 1) / 2
        first = at.detach().floor().clamp(0, count - 2)
        (wx, dx), (wy, dy) = (_cubic(u) for u in (at - first).unbind(1))
        column, row = (first.long()[..., None] + torch.arange(4, device=first.device)).unbind(1)
        near = weights.to(points_mm)[row[:, :, None], column[:, None, :]]  # [N, y, x]

        def blend(y, x):
            return torch.einsum("nyx,ny,nx->n", near, y, x)

        reaches = ((at.detach() >= 0) & (at.detach() <= count - 1)).all(1)
        slope = torch.stack([blend(wy, dx), blend(dy, wx)], 1) / self.pitch_mm
        return blend(wy, wx), slope, reaches


def _cubic(u):
    """Weights [N, 4] of the uniform cubic B-spline at a place u in its middle interval, and their
    slopes."""
    v = 1 - u
    weights = (v**3, 3 * u**3 - 6 * u**2 + 4, 3 * v**3 - 6 * v**2 + 4, u**3)
    slopes = (-3 * v**2, 9 * u**2 - 12 * u, 12 * v - 9 * v**2, 3 * u**2)
    return torch.stack(weights, 1) / 6, torch.stack(slopes, 1) / 6
