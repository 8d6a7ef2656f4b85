"""The deeper branch of Spike-ESIM: a small residual network that adds to the level; nothing before it is
trained."""

import math

import torch
import torch.nn.functional as F
from torch import nn


class ResidualBranch(nn.Module):
    """3x3 convolutions with skip connections, from three pictures to a correction of the level.

    width: channels in between. depth: residual blocks. Its last convolution starts at zero, so the branch
      starts without effect but with a gradient.
    seed: of the other weights. An even, unchanging picture gets an even, unchanging correction, hence no
      events.
    """

    INPUTS = 3

    def __init__(self, width=6, depth=1, seed=0):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)

        def drawn(outputs, inputs):
            return nn.Parameter(
                torch.randn(outputs, inputs, 3, 3, generator=generator) * math.sqrt(2 / (9 * inputs))
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
    """(x + sqrt(x^2 + 1) - 1)/2: smooth, so that a small change of light makes a small change of level; of
    operations that round alike everywhere."""
    return (pictures + (pictures * pictures + 1).sqrt() - 1) / 2
