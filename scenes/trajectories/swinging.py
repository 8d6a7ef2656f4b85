"""Motions about a place: orbits of varying radius and speed, and swings towards the scene or up and
down."""

import math

import torch

from codesign.checks import check, check_number, check_positive
from codesign.pose import check_pose, rigid
from scenes.trajectories.trajectory import Trajectory, positive


class Orbital(Trajectory):
    """A circle about a vertical axis, looking at a point on it, with radius and speed that swing.

    Args:
      centre_m: the point looked at. radius_m, height_m: mean distance from the axis; height above
        the centre.
      rate_rad_s: mean angular rate, of either sign, not 0. phase_rad: bearing at time 0.
      radius_swing, rate_swing: shares (below 1) by which radius and rate go up and down;
        radius_period_s, rate_period_s: in which time. Angular rate: rate (1 + rate_swing
        cos(2 pi t / period)). Radius: radius (1 + radius_swing sin(2 pi t / period)).
    """

    def __init__(
        self,
        centre_m,
        radius_m,
        height_m,
        rate_rad_s,
        phase_rad=0.0,
        radius_swing=0.0,
        rate_swing=0.0,
        radius_period_s=2.0,
        rate_period_s=3.0,
    ):
        self.centre_m = check(
            torch.tensor(centre_m, dtype=torch.float64), (3,), "centre_m", finite=True
        )
        self.radius_m = positive("radius_m", radius_m)
        self.height_m = check_number(height_m, "height_m")
        self.phase_rad = check_number(phase_rad, "phase_rad")
        self.rate_rad_s = math.copysign(
            positive("the size of rate_rad_s", abs(rate_rad_s)), rate_rad_s
        )
        self.radius_swing = positive("radius_swing", radius_swing, 0, 1, inclusive=True)
        self.rate_swing = positive("rate_swing", rate_swing, 0, 1, inclusive=True)
        self._radius_turn = 2 * math.pi / positive("radius_period_s", radius_period_s)
        self._rate_turn = 2 * math.pi / positive("rate_period_s", rate_period_s)

    def _pose(self, t_s):
        angle = self.phase_rad + self.rate_rad_s * (
            t_s + self.rate_swing / self._rate_turn * (self._rate_turn * t_s).sin()
        )
        radius = self.radius_m * (1 + self.radius_swing * (self._radius_turn * t_s).sin())
        height = self.height_m + 0 * t_s
        nothing = 0 * t_s
        away = torch.stack([radius * angle.cos(), radius * angle.sin(), height], 1)
        forward = -away / away.square().sum(1, keepdim=True).sqrt()
        left = torch.stack([angle.sin(), -angle.cos(), nothing], 1)  # up x forward, for any height
        return rigid(
            torch.stack([forward, left, torch.linalg.cross(forward, left)], 2), self.centre_m + away
        )


class Swinging(Trajectory):
    """start + direction * amplitude * sin(2 pi frequency t), with the attitude of the start; the
    speed is at most 2 pi frequency amplitude.

    Args:
      T_world_start: [4, 4] body pose.
      direction: [3] in the world, of any length above 0.
      amplitude_m, frequency_hz: above 0.
    """

    def __init__(self, T_world_start, direction, amplitude_m, frequency_hz):
        self.start = check_pose(T_world_start.detach().double())
        direction = check(
            torch.as_tensor(direction, dtype=torch.float64), (3,), "the direction", finite=True
        )
        self.direction = direction / check_positive(
            float(direction.norm()), "the direction's length"
        )
        self.amplitude_m = positive("amplitude_m", amplitude_m)
        self.frequency_hz = positive("frequency_hz", frequency_hz)

    @staticmethod
    def radial(T_world_start, amplitude_m, frequency_hz):
        """Swings towards and away from the scene, along the body's forward axis."""
        return Swinging(T_world_start, T_world_start.detach()[:3, 0], amplitude_m, frequency_hz)

    @staticmethod
    def vertical(T_world_start, amplitude_m, frequency_hz):
        """Swings up and down along the world's z axis."""
        return Swinging(T_world_start, (0.0, 0.0, 1.0), amplitude_m, frequency_hz)

    def _pose(self, t_s):
        shift = self.amplitude_m * (2 * math.pi * self.frequency_hz * t_s).sin()
        return rigid(
            self.start[:3, :3].expand(len(t_s), 3, 3),
            self.start[:3, 3] + shift[:, None] * self.direction,
        )
