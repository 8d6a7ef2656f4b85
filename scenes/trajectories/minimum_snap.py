"""Polynomial paths of least snap (fourth derivative) through points at given times: splines of degree 7.

The path of least integral of squared snap with given points, and with velocity, acceleration and jerk of 0 at
both ends, has degree 7 between points and six continuous derivatives at them (the Euler-Lagrange equation
x^(8) = 0 with its natural conditions).
Source: Mellinger and Kumar, Minimum snap trajectory generation and control for quadrotors, ICRA 2011.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite

TERMS = 8
MOST_POINTS = 200
LARGEST_RATIO = 100.0  # of segment durations: beyond, the spline loses too many digits


@dataclass(frozen=True)
class Polynomials:
    """Piecewise polynomials: coefficient [M, 8, D] of powers of (t - start) / length per segment, knots_s [M
    + 1]."""

    coefficient: Tensor
    knots_s: Tensor

    def __call__(self, t_s, order=0):
        """The ``order``-th derivative at times [n] (seconds): [n, D]. At a knot the segment behind it counts;
        gradient to the time."""
        segment = (torch.searchsorted(self.knots_s, t_s.detach().contiguous(), right=True) - 1).clamp(
            0, len(self.knots_s) - 2
        )
        length = self.knots_s.diff()[segment]
        u = ((t_s - self.knots_s[segment]) / length)[:, None]
        value = torch.zeros_like(u)
        for power in range(TERMS - 1, order - 1, -1):
            value = value * u + self.coefficient[segment, power] * math.perm(power, order)
        return value / length[:, None] ** order

    def cost(self):
        """Integral of the squared snap over all segments and axes."""
        powers = torch.arange(4, TERMS, dtype=torch.float64)
        factor = torch.tensor([math.perm(k, 4) for k in range(4, TERMS)], dtype=torch.float64)
        inner = factor[:, None] * factor / (powers[:, None] + powers - 7)
        each = torch.einsum("mid,ij,mjd->m", self.coefficient[:, 4:], inner, self.coefficient[:, 4:])
        return (each / self.knots_s.diff() ** 7).sum()


def minimum_snap(points, t_s):
    """The path of least snap that is at rest at both ends.

    Args: points: [K >= 2, D] to pass, t_s: [K] when, strictly increasing seconds.
    Returns: Polynomials, float64.
    Raises: ShapeError; DomainError for values that are not finite, times that do not increase, durations that
      differ more than 100 times, more than 200 points.
    """
    points = torch.as_tensor(points, dtype=torch.float64)
    t_s = torch.as_tensor(t_s, dtype=torch.float64)
    if points.ndim != 2 or len(points) < 2 or t_s.shape != points.shape[:1]:
        raise ShapeError(
            f"minimum snap needs points [K >= 2, D] and one time each, got {tuple(points.shape)} and "
            f"{tuple(t_s.shape)}."
        )
    if len(points) > MOST_POINTS:
        raise DomainError(
            f"minimum snap takes at most {MOST_POINTS} points, got {len(points)}; split the path."
        )
    check_finite(points, "waypoints")
    check_finite(t_s, "waypoint times")
    length = t_s.diff()
    if bool((length <= 0).any()):
        raise DomainError(f"waypoint times must increase strictly, got {t_s.tolist()}.")
    if float(length.max() / length.min()) > LARGEST_RATIO:
        raise DomainError(
            f"the segments last from {float(length.min()):g} to {float(length.max()):g} s; let the longest "
            f"be at most {LARGEST_RATIO:g} times the shortest."
        )
    at_rest = [(order, np.zeros(points.shape[1])) for order in (1, 2, 3)]
    spline = make_interp_spline(t_s.numpy(), points.numpy(), TERMS - 1, bc_type=(at_rest, at_rest))
    # of powers of the time since a segment's start, in lengths of the segment
    powers = [spline(t_s[:-1].numpy(), k) / math.factorial(k) for k in range(TERMS)]
    scale = length[:, None] ** torch.arange(TERMS)
    return Polynomials(torch.from_numpy(np.stack(powers, 1)) * scale[:, :, None], t_s)
