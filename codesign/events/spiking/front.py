"""The learnable front end of Spike-ESIM: noise prefilter, tone curve, bandwidth. Each is exactly the identity
before it is trained."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from codesign.events.intensity import light_share
from codesign.events.low_pass import coefficients, passed

KNOTS = 6
# log levels between which the tone curve bends
DARKEST = 0.0
BRIGHTEST = math.log(256.0)


class Prefilter(nn.Module):
    """Spatial 3x3 filter of the log level with unit gain for an even picture; ``weight`` is what it adds to
    the identity, less its mean."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(3, 3))

    def forward(self, level: Tensor) -> Tensor:
        """level: [B, 1, H, W]; edges repeated."""
        delta = torch.zeros(3, 3, dtype=level.dtype, device=level.device)
        delta[1, 1] = 1
        kernel = delta + (self.weight - self.weight.mean()).to(level)
        return F.conv2d(F.pad(level, (1, 1, 1, 1), mode="replicate"), kernel[None, None])


class ToneCurve(nn.Module):
    """Monotone change of the level: slope exp(w_k) in each of six stretches of log level, so gain per
    intensity. Stands also for a dark offset."""

    def __init__(self):
        super().__init__()
        self.log_slope = nn.Parameter(torch.zeros(KNOTS))

    def forward(self, level: Tensor) -> Tensor:
        """level: [B, 1, H, W] log level; same shape."""
        width = (BRIGHTEST - DARKEST) / KNOTS
        edges = torch.arange(KNOTS, dtype=level.dtype, device=level.device) * width + DARKEST
        inside = (level[..., None] - edges).clamp(0, width)
        return level + (inside * (self.log_slope.exp() - 1).to(level)).sum(-1)


class Bandwidth(nn.Module):
    """One-pole low-pass of the level, mixed in by ``gate``: 0 leaves the level as it is, 1 is a
    photoreceptor.

    The corner frequency is f light^p with light = (I + 20)/275; f and p are learnt, p starts at 1
    (photocurrent sets the bandwidth).
    """

    def __init__(self, cutoff_hz: float = 100.0):
        super().__init__()
        self.gate = nn.Parameter(torch.zeros(()))
        self.log_cutoff = nn.Parameter(torch.tensor(math.log(cutoff_hz)))
        self.power = nn.Parameter(torch.ones(()))

    def advance(
        self, filtered: Tensor, before: Tensor, now: Tensor, intensity: Tensor, interval_s: float
    ) -> Tensor:
        """The filter after an interval over which the level runs linearly from ``before`` to ``now``;
        intensity: mean over the interval."""
        light = light_share(intensity)
        pace = (2 * math.pi * interval_s) * torch.exp(self.log_cutoff + self.power * light.log())
        return passed(filtered, before, now, *coefficients(pace, torch.exp, torch.where))

    def mixed(self, level: Tensor, filtered: Tensor) -> Tensor:
        return level + self.gate * (filtered - level)
