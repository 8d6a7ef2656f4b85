"""Zernike polynomials in Noll's order, with their slopes.

Orthonormal over the unit disc: a term's mean square there is 1, so its coefficient is its RMS. Odd terms are
those of the sine. Source: Noll, Zernike polynomials and atmospheric turbulence, JOSA 66 (1976).
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError


def noll(term: int) -> tuple[int, int]:
    """(n, m) of a term counted from 1: radial order, and azimuthal order, negative for sines.

    >>> from codesign.lens.plates import noll
    >>> [noll(j) for j in (1, 4, 7, 8, 11)]
    [(0, 0), (2, 0), (3, -1), (3, 1), (4, 0)]
    """
    if int(term) != term or term < 1:
        raise DomainError(f"Noll's terms are whole numbers from 1 (piston), got {term}.")
    n = math.isqrt(8 * int(term) - 7) // 2 + (math.isqrt(8 * int(term) - 7) % 2) - 1
    place = int(term) - n * (n + 1) // 2  # 1 to n + 1 within the radial order
    m = place // 2 * 2 if n % 2 == 0 else (place - 1) // 2 * 2 + 1
    return n, m if term % 2 == 0 else -m


def zernike(terms: Sequence[int], points: Tensor) -> tuple[Tensor, Tensor]:
    """Values and slopes of Zernike terms.

    Args: terms: K of Noll's indices, from 1. points: [N, 2] (x, y) in units of the disc's radius; beyond 1 the
      polynomials go on.
    Returns: values [N, K]; slopes [N, K, 2] along x and y, per radius. Gradient: both to the points.
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
        slope = [2 * at * bend * around + m * radial * by for at, by in zip((x, y), turn, strict=True)]
        found.append((radial * around, torch.stack(slope, 1)))
    return torch.stack([value for value, _ in found], 1), torch.stack([slope for _, slope in found], 1)


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
        ahead = (s - 1) * (s * (s - 2) * t + a * a - b * b) * now - 2 * (i + a - 1) * (i + b - 1) * s * before
        before, now = now, ahead / (2 * i * (i + a + b) * (s - 2))
    return now
