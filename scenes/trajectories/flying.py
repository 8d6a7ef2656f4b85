"""A quadrotor's flight of least snap (fourth derivative) through waypoints; the attitude follows
from acceleration and yaw.

The path of least integral of squared snap with given points, and with velocity, acceleration and
jerk of 0 at both ends, has degree 7 between points and six continuous derivatives at them (the
Euler-Lagrange equation x^(8) = 0 with its natural conditions).
Source: Mellinger and Kumar, Minimum snap trajectory generation and control for quadrotors, ICRA
  2011.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from codesign.checks import check_finite
from codesign.errors import DomainError, ShapeError
from codesign.pose import rigid
from scenes.trajectories.trajectory import Trajectory

TERMS = 8
MOST_POINTS = 200
LARGEST_RATIO = 100.0  # of segment durations: beyond, the spline loses too many digits
GRAVITY_M_S2 = 9.81
LEAST_THRUST = 0.1  # of gravity: below, the thrust hardly says where up is
# sine of the angle between thrust and heading below which the heading says little
LEVEL_ENOUGH = 0.05
SAMPLES = 64  # per segment, at which flights are checked


@dataclass(frozen=True)
class Polynomials:
    """Piecewise polynomials: coefficient [M, 8, D] of powers of (t - start) / length per segment,
    knots_s [M + 1]."""

    coefficient: Tensor
    knots_s: Tensor

    def __call__(self, t_s, order=0):
        """The ``order``-th derivative at times [n] (seconds): [n, D]. At a knot the segment behind
        it counts; gradient to the time."""
        segment = (
            torch.searchsorted(self.knots_s, t_s.detach().contiguous(), right=True) - 1
        ).clamp(0, len(self.knots_s) - 2)
        length = self.knots_s.diff()[segment]
        u = ((t_s - self.knots_s[segment]) / length)[:, None]
        value = torch.zeros_like(u)
        for power in range(TERMS - 1, order - 1, -1):
            value = value * u + self.coefficient[segment, power] * math.perm(power, order)
        return value / length[:, None] ** order


def minimum_snap(points, t_s):
    """The path of least snap that is at rest at both ends.

    Args:
      points: [K >= 2, D] to pass, t_s: [K] when, strictly increasing seconds.
    Returns: Polynomials, float64.
    Raises: ShapeError; DomainError for values that are not finite, times that do not increase,
      durations that differ more than 100 times, more than 200 points.
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
    if (length <= 0).any():
        raise DomainError(f"waypoint times must increase strictly, got {t_s.tolist()}.")
    if (length.max() / length.min()) > LARGEST_RATIO:
        raise DomainError(
            f"the segments last from {length.min():g} to {length.max():g} s; let the longest "
            f"be at most {LARGEST_RATIO:g} times the shortest."
        )
    from scipy.interpolate import make_interp_spline

    at_rest = [(order, np.zeros(points.shape[1])) for order in (1, 2, 3)]
    spline = make_interp_spline(t_s.numpy(), points.numpy(), TERMS - 1, bc_type=(at_rest, at_rest))
    # of powers of the time since a segment's start, in lengths of the segment
    powers = [spline(t_s[:-1].numpy(), k) / math.factorial(k) for k in range(TERMS)]
    scale = length[:, None] ** torch.arange(TERMS)
    return Polynomials(torch.from_numpy(np.stack(powers, 1)) * scale[:, :, None], t_s)


class Flying(Trajectory):
    """Pose of a quadrotor that flies through waypoints, at rest at both ends.

    The thrust axis (body z) is along acceleration plus gravity; the heading is the yaw, whose path
    has least snap too (differential flatness).

    Args:
      waypoints_m: [K >= 2, 3]. yaw_rad: [K] heading at each, not wrapped (350 to 10 degrees is a
        turn of -340). t_s: [K] seconds, increasing.
    Raises: ShapeError; DomainError as minimum_snap, and when the flight comes close to free fall or
      to thrust along its heading (fly slower).
    Source: Mellinger and Kumar, ICRA 2011, sections III and IV.
    """

    def __init__(self, waypoints_m, yaw_rad, t_s):
        waypoints = torch.as_tensor(waypoints_m, dtype=torch.float64)
        yaw = torch.as_tensor(yaw_rad, dtype=torch.float64)
        if waypoints.ndim != 2 or waypoints.shape[1] != 3 or yaw.shape != waypoints.shape[:1]:
            raise ShapeError(
                f"a flight needs waypoints [K >= 2, 3] and one yaw each, got {tuple(waypoints.shape)} and "
                f"{tuple(yaw.shape)}."
            )
        self.path = minimum_snap(torch.cat([waypoints, yaw[:, None]], 1), t_s)
        self.span_s = (float(self.path.knots_s[0]), float(self.path.knots_s[-1]))
        knots = self.path.knots_s
        share = torch.arange(SAMPLES, dtype=torch.float64) / SAMPLES
        t = (knots[:-1, None] + knots.diff()[:, None] * share).reshape(-1)
        thrust = self._thrust(t)
        heading = self._heading(t)
        size = thrust.norm(dim=1)
        if size.min() < LEAST_THRUST * GRAVITY_M_S2:
            at = float(t[size.argmin()])
            raise DomainError(
                f"the flight comes within {LEAST_THRUST:g} g of free fall at {at:.3g} s, where its attitude "
                "is undefined; allow more time between waypoints."
            )
        if torch.linalg.cross(thrust / size[:, None], heading).norm(dim=1).min() < LEVEL_ENOUGH:
            raise DomainError(
                "the flight tilts until its thrust points along its heading, where its attitude is "
                "undefined; allow more time between waypoints."
            )

    @staticmethod
    def random(generator, duration_s, low_m, high_m, target_m=None, seconds_per_leg=1.2):
        """A flight through points drawn in a box, looking at ``target_m`` at each
        (along the path when None); lasts at least ``duration_s``.

        Raises: DomainError when the box is so large that no such flight is possible in the time per
          leg.
        """
        legs = max(2, math.ceil(duration_s / seconds_per_leg))
        low = torch.tensor(low_m, dtype=torch.float64)
        high = torch.tensor(high_m, dtype=torch.float64)
        points = low + (high - low) * torch.rand(
            legs + 1, 3, generator=generator, dtype=torch.float64
        )
        if target_m is None:
            ways = points.diff(dim=0)
            towards = torch.cat([ways, ways[-1:]])
        else:
            towards = torch.tensor(target_m, dtype=torch.float64) - points
        yaw = torch.atan2(towards[:, 1], towards[:, 0])
        turns = torch.remainder(yaw.diff() + math.pi, 2 * math.pi) - math.pi  # the short way round
        yaw = yaw[0] + torch.cat([torch.zeros(1, dtype=torch.float64), turns.cumsum(0)])
        return Flying(points, yaw, torch.arange(legs + 1, dtype=torch.float64) * seconds_per_leg)

    def _thrust(self, t_s):
        """Thrust per mass [n, 3], m/s^2."""
        return self.path(t_s, 2)[:, :3] + torch.tensor(
            [0.0, 0.0, GRAVITY_M_S2], dtype=torch.float64
        )

    def _heading(self, t_s):
        yaw = self.path(t_s)[:, 3]
        return torch.stack([yaw.cos(), yaw.sin(), torch.zeros_like(yaw)], 1)

    def _pose(self, t_s):
        def unit(v):
            return v / v.square().sum(1, keepdim=True).sqrt()

        up = unit(self._thrust(t_s))
        left = unit(torch.linalg.cross(up, self._heading(t_s)))
        return rigid(
            torch.stack([torch.linalg.cross(left, up), left, up], 2), self.path(t_s)[:, :3]
        )
