"""The learnt parts of Spike-ESIM: noise prefilter, tone curve, bandwidth, a residual branch, noise.
Each is without effect before it is trained: the identity, or zero."""

import math
from collections.abc import Callable

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
    """Spatial 3x3 filter of the log level with unit gain for an even picture; ``weight`` is what it
    adds to the identity, less its mean."""

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
    """Monotone change of the level: slope exp(w_k) in each of six stretches of log level, so gain
    per intensity. Stands also for a dark offset."""

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
        """The filter after an interval over which the level runs linearly from ``before`` to
        ``now``;
        intensity: mean over the interval."""
        light = light_share(intensity)
        pace = (2 * math.pi * interval_s) * torch.exp(self.log_cutoff + self.power * light.log())
        return passed(filtered, before, now, *coefficients(pace, torch.exp, torch.where))

    def mixed(self, level: Tensor, filtered: Tensor) -> Tensor:
        return level + self.gate * (filtered - level)


class ResidualBranch(nn.Module):
    """3x3 convolutions with skip connections, from three pictures to a correction of the level.

    width: channels in between. depth: residual blocks. Its last convolution starts at zero, so the
      branch starts without effect but with a gradient.
    seed: of the other weights. An even, unchanging picture gets an even, unchanging correction,
      hence no events.
    """

    INPUTS = 3

    def __init__(self, width=6, depth=1, seed=0):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)

        def drawn(outputs, inputs):
            return nn.Parameter(
                torch.randn(outputs, inputs, 3, 3, generator=generator)
                * math.sqrt(2 / (9 * inputs))
            )

        self.first = drawn(width, self.INPUTS)
        self.blocks = nn.ParameterList([drawn(width, width) for _ in range(depth)])
        self.last = nn.Parameter(torch.zeros(1, width, 3, 3))

    def forward(self, pictures):
        """pictures: [B, 3, H, W]; returns [B, 1, H, W]."""
        hidden = _activated(_convolved(pictures, self.first))
        for weight in self.blocks:
            hidden = hidden + _activated(_convolved(hidden, weight))
        return _convolved(hidden, self.last)


def _convolved(pictures, weight):
    return F.conv2d(F.pad(pictures, (1, 1, 1, 1), mode="replicate"), weight.to(pictures))


def _activated(pictures):
    """(x + sqrt(x^2 + 1) - 1)/2: smooth, so that a small change of light makes a small change of
    level; of operations that round alike everywhere."""
    return (pictures + (pictures * pictures + 1).sqrt() - 1) / 2


class NoiseRate(nn.Module):
    """rate = a exp(-b light) events per pixel and second, light = (I + 20)/275, one a per polarity;
    a starts at 0.

    amplitude_hz below 0 counts as 0 but keeps its gradient, so that it finds its way back.
    """

    def __init__(self):
        super().__init__()
        self.amplitude_hz = nn.Parameter(torch.zeros(2))
        self.fade = nn.Parameter(torch.ones(()))

    def forward(self, intensity: Tensor) -> Tensor:
        """intensity: [T, ...]; returns [T, 2, ...], ON first."""
        shape = torch.exp(-self.fade * light_share(intensity))
        on, off = self.amplitude_hz + (self.amplitude_hz.clamp(min=0) - self.amplitude_hz).detach()
        return torch.stack((on * shape, off * shape), dim=1)


def stepwise(function: Callable[[Tensor], Tensor], pictures: Tensor) -> Tensor:
    """Apply a function of pictures to every step of a sequence, so that chunks of time round as the
    whole does.

    The matrix products behind a convolution may round by the number of pictures they get and by
    where these begin in memory (MKL documents equal bits for equal shapes at equally aligned
    addresses). Every step therefore gets a call of its own, on memory of its own, which torch
    aligns to 64 bytes.

    Args:
      function: [B, C, H, W] to [B, C', H, W].
      pictures: [T, B, C, H, W].
    Returns: [T, B, C', H, W]. Gradient: pictures and what the function holds.
    """
    return torch.stack(
        [function(step.clone(memory_format=torch.contiguous_format)) for step in pictures]
    )
