"""Smooth random functions of time: a mean and a few cosines, whose integrals and products are known in closed
form."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Waves:
    """mean + sum of amplitude cos(rate t + phase); amplitude, rate_rad_s, phase_rad: [K] float64."""

    mean: float
    amplitude: Tensor
    rate_rad_s: Tensor
    phase_rad: Tensor

    @staticmethod
    def random(generator, mean, bound, lowest_hz, highest_hz, count=3):
        """``count`` waves with frequencies drawn between two, which never lead further than ``bound`` from
        the mean."""
        draw = torch.rand(3, count, generator=generator, dtype=torch.float64)
        share = 0.5 + draw[0]
        frequency = lowest_hz * (highest_hz / lowest_hz) ** draw[1]
        return Waves(float(mean), bound * share / share.sum(), 2 * math.pi * frequency, 2 * math.pi * draw[2])

    def __call__(self, t_s):
        """Values at times of any shape."""
        return self.mean + (self.amplitude * (self.rate_rad_s * t_s[..., None] + self.phase_rad).cos()).sum(
            -1
        )

    def integral(self, t_s):
        """Integral from 0 to each time."""
        half = self.rate_rad_s * t_s[..., None] / 2
        return t_s * (
            self.mean + (self.amplitude * (half + self.phase_rad).cos() * torch.sinc(half / math.pi)).sum(-1)
        )

    def scaled(self, factor, shift=0.0):
        """factor times this, plus shift."""
        return Waves(self.mean * factor + shift, self.amplitude * factor, self.rate_rad_s, self.phase_rad)

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

        mixed = (
            Waves(0.0, amplitude, pairs("rate_rad_s", sign), pairs("phase_rad", sign)) for sign in (-1, 1)
        )
        total = self.scaled(other.mean).plus(
            Waves(0.0, other.amplitude * self.mean, other.rate_rad_s, other.phase_rad)
        )
        for part in mixed:
            total = total.plus(part)
        return total
