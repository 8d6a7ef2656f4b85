"""A quadrotor's flight of least snap through waypoints; the attitude follows from acceleration and yaw."""

import math

import torch

from codesign.errors import DomainError, ShapeError
from scenes.trajectories.minimum_snap import minimum_snap
from scenes.trajectories.trajectory import Trajectory, rigid

GRAVITY_M_S2 = 9.81
LEAST_THRUST = 0.1  # of gravity: below, the thrust hardly says where up is
LEVEL_ENOUGH = 0.05  # sine of the angle between thrust and heading below which the heading says little
SAMPLES = 64  # per segment, at which flights are checked


class Flying(Trajectory):
    """Pose of a quadrotor that flies through waypoints, at rest at both ends.

    The thrust axis (body z) is along acceleration plus gravity; the heading is the yaw, whose path has least
    snap too (differential flatness).

    Args:
      waypoints_m: [K >= 2, 3]. yaw_rad: [K] heading at each, not wrapped (350 to 10 degrees is a turn of
        -340). t_s: [K] seconds, increasing.
    Raises: ShapeError; DomainError as minimum_snap, and when the flight comes close to free fall or to thrust
      along its heading (fly slower).
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
        if float(size.min()) < LEAST_THRUST * GRAVITY_M_S2:
            at = float(t[size.argmin()])
            raise DomainError(
                f"the flight comes within {LEAST_THRUST:g} g of free fall at {at:.3g} s, where its attitude "
                "is undefined; allow more time between waypoints."
            )
        if float(torch.linalg.cross(thrust / size[:, None], heading).norm(dim=1).min()) < LEVEL_ENOUGH:
            raise DomainError(
                "the flight tilts until its thrust points along its heading, where its attitude is "
                "undefined; allow more time between waypoints."
            )

    @staticmethod
    def random(generator, duration_s, low_m, high_m, target_m=None, seconds_per_leg=1.2):
        """A flight through points drawn in a box, looking at ``target_m`` at each (along the path when None);
        lasts at least ``duration_s``.

        Raises: DomainError when the box is so large that no such flight is possible in the time per leg.
        """
        legs = max(2, math.ceil(duration_s / seconds_per_leg))
        low = torch.tensor(low_m, dtype=torch.float64)
        high = torch.tensor(high_m, dtype=torch.float64)
        points = low + (high - low) * torch.rand(legs + 1, 3, generator=generator, dtype=torch.float64)
        towards = (
            points.diff(dim=0)[:, :2]
            if target_m is None
            else torch.tensor(target_m, dtype=torch.float64)[:2] - points[:, :2]
        )
        yaw = torch.atan2(towards[:, 1], towards[:, 0])
        yaw = torch.cat([yaw, yaw[-1:]]) if target_m is None else yaw
        turns = torch.remainder(yaw.diff() + math.pi, 2 * math.pi) - math.pi  # the short way round
        yaw = yaw[0] + torch.cat([torch.zeros(1, dtype=torch.float64), turns.cumsum(0)])
        return Flying(points, yaw, torch.arange(legs + 1, dtype=torch.float64) * seconds_per_leg)

    def thrust_m_s2(self, t_s):
        """Thrust per mass, [n]."""
        return self._thrust(self._times(t_s)).norm(dim=1)

    def _thrust(self, t_s):
        return self.path(t_s, 2)[:, :3] + torch.tensor([0.0, 0.0, GRAVITY_M_S2], dtype=torch.float64)

    def _heading(self, t_s):
        yaw = self.path(t_s)[:, 3]
        return torch.stack([yaw.cos(), yaw.sin(), torch.zeros_like(yaw)], 1)

    def _pose(self, t_s):
        def unit(v):
            return v / v.square().sum(1, keepdim=True).sqrt()

        up = unit(self._thrust(t_s))
        left = unit(torch.linalg.cross(up, self._heading(t_s)))
        return rigid(torch.stack([torch.linalg.cross(left, up), left, up], 2), self.path(t_s)[:, :3])
