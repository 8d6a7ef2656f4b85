"""A ground robot with differential drive: turns, wheel slip and the shake of its suspension, all of
them smooth random functions of time whose integrals and products are known in closed form
(Waves)."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.pose import rigid
from scenes.trajectories.trajectory import Trajectory, positive

STEP_S = 0.02  # between points of the table of positions
NODES = 8  # of Gauss and Legendre on such a step: exact to rounding for the slow waves below


@dataclass(frozen=True)
class Waves:
    """mean + sum of amplitude cos(rate t + phase); amplitude, rate_rad_s, phase_rad: [K]
    float64."""

    mean: float
    amplitude: Tensor
    rate_rad_s: Tensor
    phase_rad: Tensor

    @staticmethod
    def random(generator, mean, bound, lowest_hz, highest_hz, count=3):
        """``count`` waves with frequencies drawn between two, which never lead further than
        ``bound`` from the mean."""
        draw = torch.rand(3, count, generator=generator, dtype=torch.float64)
        share = 0.5 + draw[0]
        frequency = lowest_hz * (highest_hz / lowest_hz) ** draw[1]
        return Waves(
            float(mean), bound * share / share.sum(), 2 * math.pi * frequency, 2 * math.pi * draw[2]
        )

    def __call__(self, t_s):
        """Values at times of any shape."""
        return self.mean + (
            self.amplitude * (self.rate_rad_s * t_s[..., None] + self.phase_rad).cos()
        ).sum(-1)

    def integral(self, t_s):
        """Integral from 0 to each time."""
        half = self.rate_rad_s * t_s[..., None] / 2
        return t_s * (
            self.mean
            + (self.amplitude * (half + self.phase_rad).cos() * torch.sinc(half / math.pi)).sum(-1)
        )

    def scaled(self, factor):
        """factor times this."""
        return Waves(self.mean * factor, self.amplitude * factor, self.rate_rad_s, self.phase_rad)

    def plus(self, other):
        """The sum of two."""
        return Waves(
            self.mean + other.mean,
            *(
                torch.cat([getattr(self, k), getattr(other, k)])
                for k in ("amplitude", "rate_rad_s", "phase_rad")
            ),
        )

    def times(self, other):
        """The product of two: cos a cos b is half of cos(a - b) + cos(a + b)."""
        amplitude = (self.amplitude[:, None] * other.amplitude / 2).reshape(-1)

        def pairs(name, sign):
            return (getattr(self, name)[:, None] + sign * getattr(other, name)).reshape(-1)

        total = self.scaled(other.mean).plus(replace(other.scaled(self.mean), mean=0.0))
        for sign in (-1, 1):
            mixed = pairs("rate_rad_s", sign), pairs("phase_rad", sign)
            total = total.plus(Waves(0.0, amplitude, *mixed))
        return total


class Driving(Trajectory):
    """Pose of the body of a robot that drives on the plane z = 0.

    The wheels turn at speeds v -/+ w track / 2 (left, right), with speed v and turn rate w smooth
    random functions of time. Over the ground a wheel moves slower, by its slip (a share, at most
    ``slip``); in a turn the robot slides outwards at ``side_slip_s`` times its sideways
    acceleration. Without slip the velocity has no sideways part (the nonholonomic constraint) and
    heading and distance are those the wheels count.

    Args:
      generator: torch.Generator. duration_s: poses exist from 0 to there.
      speed_m_s, turn_rad_s: mean speed and turn rate (left positive). speed_share: by how much the
        speed varies, below 1. turn_swing_rad_s: by how much the rate does.
      track_m: distance of the wheels. slip: largest slip, 0 to below 1. side_slip_s: seconds.
      height_m: of the body's origin over the ground. heave_m, pitch_rad, roll_rad: largest shake,
        between 2 and 9 Hz.
      x_m, y_m, yaw_rad: pose at time 0 (without shake).
    """

    def __init__(
        self,
        generator,
        duration_s,
        speed_m_s=0.6,
        turn_rad_s=0.0,
        *,
        speed_share=0.3,
        turn_swing_rad_s=0.6,
        track_m=0.3,
        slip=0.05,
        side_slip_s=0.02,
        height_m=0.3,
        heave_m=0.003,
        pitch_rad=0.008,
        roll_rad=0.008,
        x_m=0.0,
        y_m=0.0,
        yaw_rad=0.0,
    ):
        self.span_s = (0.0, positive("duration_s", duration_s, most=1e4))
        start = speed_m_s + turn_rad_s + x_m + y_m + yaw_rad + height_m
        shake = turn_swing_rad_s + heave_m + pitch_rad + roll_rad
        if not math.isfinite(start + shake):
            raise DomainError("driving: speed, turn rate, shake and start must be finite numbers.")
        positive("speed_share", speed_share, 0, 1, inclusive=True)
        self.track_m = positive("track_m", track_m)
        self.side_slip_s = positive("side_slip_s", side_slip_s, inclusive=True)
        positive("slip", slip, 0, 1, inclusive=True)
        speed = Waves.random(generator, speed_m_s, abs(speed_m_s) * speed_share, 0.1, 0.5)
        turn = Waves.random(generator, turn_rad_s, turn_swing_rad_s, 0.1, 0.5)
        self._wheels = tuple(speed.plus(turn.scaled(side * self.track_m / 2)) for side in (-1, 1))
        self._rolled = tuple(
            wheel.times(Waves.random(generator, 1 - slip / 2, slip / 2, 0.2, 1.5))
            for wheel in self._wheels
        )
        self._turn = self._rolled[1].plus(self._rolled[0].scaled(-1)).scaled(1 / self.track_m)
        self._shake = tuple(
            Waves.random(generator, 0.0, bound, 2.0, 9.0, 4)
            for bound in (heave_m, pitch_rad, roll_rad)
        )
        self.height_m = float(height_m)
        self.start = (float(x_m), float(y_m), float(yaw_rad))
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        self._nodes = torch.from_numpy(nodes / 2 + 0.5)
        self._weights = torch.from_numpy(weights / 2)
        knots = torch.arange(math.ceil(self.span_s[1] / STEP_S) + 1, dtype=torch.float64) * STEP_S
        moved = self._moved(knots[:-1], torch.full_like(knots[:-1], STEP_S))
        self._table = torch.cat([torch.zeros(1, 2, dtype=torch.float64), moved.cumsum(0)])

    def _yaw(self, t_s):
        return self.start[2] + self._turn.integral(t_s)

    def _ground(self, t_s):
        """Forward m/s, sideways m/s (left) and turn rate rad/s without shake, [..., 3]."""
        forward = (self._rolled[0](t_s) + self._rolled[1](t_s)) / 2
        turn = self._turn(t_s)
        return torch.stack([forward, -self.side_slip_s * forward * turn, turn], -1)

    def _moved(self, start_s, length_s):
        """Displacement over the ground [n, 2] from times [n] on, for lengths [n]."""
        t = start_s[:, None] + self._nodes * length_s[:, None]
        forward, left, _ = self._ground(t).unbind(-1)
        yaw = self._yaw(t)
        rate = torch.stack(
            [forward * yaw.cos() - left * yaw.sin(), forward * yaw.sin() + left * yaw.cos()], -1
        )
        return (rate * self._weights[:, None]).sum(1) * length_s[:, None]

    def _pose(self, t_s):
        index = (t_s.detach() / STEP_S).floor().long().clamp(max=len(self._table) - 1)
        knot = index.to(t_s) * STEP_S
        place = self._table[index] + self._moved(knot, t_s - knot)
        heave, pitch, roll = (wave(t_s) for wave in self._shake)
        position = torch.stack(
            [self.start[0] + place[:, 0], self.start[1] + place[:, 1], self.height_m + heave], 1
        )
        return rigid(_turned(2, self._yaw(t_s)) @ _turned(1, pitch) @ _turned(0, roll), position)


def _turned(axis, angle_rad):
    """Rotations [n, 3, 3] about a coordinate axis."""
    one = torch.ones_like(angle_rad)
    nothing = torch.zeros_like(angle_rad)
    c = angle_rad.cos()
    s = angle_rad.sin()
    rows = {
        0: (one, nothing, nothing, nothing, c, -s, nothing, s, c),
        1: (c, nothing, s, nothing, one, nothing, -s, nothing, c),
        2: (c, -s, nothing, s, c, nothing, nothing, nothing, one),
    }
    return torch.stack(rows[axis], 1).reshape(-1, 3, 3)
