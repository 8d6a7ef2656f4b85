"""A row of the certificate: what autograd and differences say of one group of parameters, and the
verdict."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from codesign.grad.differences import Difference

SIGMAS = 3.0  # standard deviations between what may be noise and what may not
EXCLUDED = 10.0  # tolerances: an error that a pass has excluded,
# and never more than this relative error (or the tolerance, where that is larger)
MOST_EXCLUDED = 0.1


@dataclass(frozen=True)
class Row:
    """The certificate of one group of parameters.

    autograd, difference: one number per parameter (or per random direction). relative_error: L2 of
      their difference over L2 of the differences (over that of autograd where the differences are
      zero; 0 for two zeros).
    cosine: of the two vectors. signed_bias: (autograd . difference) / |difference|^2 - 1; negative
      means too small.
    noise_floor: L2 of the differences' standard deviations, relative like the error. step_plateau:
      step that each difference was taken from.
    verdict: at three noise floors, "fail" (the error is above the tolerance), "pass" (it may be
      within the tolerance, and more than ten tolerances, or 0.1, is excluded; 0 against 0 passes)
      or "noise" (the differences cannot tell).
    length_bias: signed error of the gradient's length, by a difference along the gradient itself:
      only where the numbers above are lost in noise. The row fails when this is above the
      tolerance.
    left_out: steps of the ladder not taken somewhere, because the function is not finite there or
      the parameter does not move in its number format.
    """

    name: str
    autograd: tuple[float, ...]
    difference: tuple[float, ...]
    relative_error: float
    cosine: float
    signed_bias: float
    noise_floor: float
    step_plateau: tuple[float, ...]
    verdict: str
    length_bias: float | None = None
    left_out: tuple[float, ...] = ()


def make_row(
    name: str,
    autograd: Sequence[float],
    found: Sequence[Difference],
    tolerance: float,
) -> Row:
    """Row of derivatives by autograd and by differences along the same lines."""
    a = torch.tensor(autograd, dtype=torch.float64)
    d = torch.tensor([f.value for f in found], dtype=torch.float64)
    noise = float(torch.tensor([f.noise for f in found], dtype=torch.float64).norm())
    gap = float((a - d).norm())
    length = float(a.norm())
    size = float(d.norm())
    if length == size == 0:
        cosine, bias, error, floor = 1.0, 0.0, 0.0, 0.0
    elif size == 0:
        cosine, bias, error, floor = 0.0, math.inf, 1.0, noise / length
    else:
        cosine = float((a / length) @ (d / size)) if length else 0.0
        bias = cosine * length / size - 1
        error, floor = gap / size, noise / size
    return Row(
        name,
        tuple(a.tolist()),
        tuple(d.tolist()),
        error,
        cosine,
        bias,
        floor,
        tuple(f.step for f in found),
        verdict(gap, size, noise, tolerance),
        left_out=tuple(sorted({step for f in found for step in f.left_out}, reverse=True)),
    )


def verdict(gap: float, size: float, noise: float, tolerance: float) -> str:
    """Judge a distance ``gap`` from differences of length ``size`` that are known to ``noise``."""
    margin = SIGMAS * noise
    if gap == size == 0:
        return "pass"
    if gap - margin > tolerance * size:
        return "fail"
    excluded = max(tolerance, min(EXCLUDED * tolerance, MOST_EXCLUDED))
    return "pass" if gap + margin <= excluded * size else "noise"
