"""The kernels of the spike response model as linear recursions with one decay a, one amplitude m and at most
two states; no sum is cut:

    pair     q <- a (q + p), p <- a p, y = m q, p <- p + z    y_t = m sum_{k>=1} k a^k z_{t-k}
    late     p <- a p, y = m p, p <- p + z                    y_t = m sum_{k>=1} a^k z_{t-k}
    early    y = m p, p <- a p + z                            y_t = m sum_{k>=1} a^{k-1} z_{t-k}
    sum      p <- p + z, y = p                                y_t = sum_{k>=0} z_{t-k}
    none     y = z
"""

import math
from dataclasses import dataclass

from torch import Tensor

STATES = {"pair": 2, "late": 1, "early": 1, "sum": 1, "none": 0}
RESPONSES = {"none": "none", "alpha": "pair", "step": "sum"}
RESETS = {"slayer": "pair", "thesis": "late", "exp": "early", "step": "early"}


@dataclass(frozen=True)
class Coefficients:
    """Decay a and amplitude m per pixel, and their derivatives with respect to h = dt/tau; tensors of one
    shape."""

    a: Tensor
    m: Tensor
    a_h: Tensor
    m_h: Tensor


def response_coefficients(h: Tensor) -> Coefficients:
    """Alpha kernel (k h) exp(1 - k h), k >= 1."""
    a = (-h).exp()
    return Coefficients(a, math.e * h, -a, (0 * h) + math.e)


def reset_coefficients(kernel: str, h: Tensor, amplitude: Tensor) -> Coefficients:
    """Reset kernel of the given name, for k >= 1, with amplitude = -reset_scale * theta: slayer: amplitude k
    h exp(1 - k h); thesis: amplitude exp(1 - k h); exp: amplitude exp(-(k - 1) h); step: amplitude."""
    a = (-h).exp()
    zero = 0 * h
    if kernel == "slayer":
        return Coefficients(a, math.e * h * amplitude, -a, math.e * amplitude)
    if kernel == "thesis":
        return Coefficients(a, math.e * amplitude, -a, zero)
    if kernel == "exp":
        return Coefficients(a, amplitude, -a, zero)
    return Coefficients(zero + 1, amplitude, zero, zero)


def advance(kind, states, a, m, z=None):
    """One step of the recursion up to its output y; returns y and the states, into whose first one the input
    z is still to be added (``sum`` and ``none`` take z in at once)."""
    if kind == "pair":
        p, q = states
        q = a * (q + p)
        return m * q, [a * p, q]
    if kind == "late":
        p = a * states[0]
        return m * p, [p]
    if kind == "early":
        return m * states[0], [a * states[0]]
    if kind == "sum":
        return states[0] + z, [states[0] + z]
    return z, []


def retreat(kind, adjoint, a, m, y):
    """Adjoint of the states before a step, from the adjoint after it and the adjoint y of its output."""
    if kind == "pair":
        p = adjoint[0]
        q = adjoint[1] + m * y
        return [a * (p + q), a * q]
    if kind == "late":
        return [a * (adjoint[0] + m * y)]
    if kind == "early":
        return [a * adjoint[0] + m * y]
    return [adjoint[0] + y] if kind == "sum" else []


def retreat_tangent(kind, tangent, adjoint, a, m, da, dm, y):
    """Derivative of ``retreat`` where a and m move by da and dm, y being held; da None stands for zero
    (``adjoint`` is then not needed)."""
    if kind == "pair":
        p = tangent[0]
        q = tangent[1] + dm * y
        moved = [a * (p + q), a * q]
        if da is None:
            return moved
        later = adjoint[1] + m * y
        return [moved[0] + da * (adjoint[0] + later), moved[1] + da * later]
    if kind == "late":
        moved = a * (tangent[0] + dm * y)
        return [moved if da is None else moved + da * (adjoint[0] + m * y)]
    moved = a * tangent[0] + dm * y
    return [moved if da is None else moved + da * adjoint[0]]
