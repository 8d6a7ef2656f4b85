"""Mean rate of noise events per polarity and light: what no generator can foresee pixel by pixel, but has to
give in number."""

import torch
from torch import Tensor, nn

from codesign.events.intensity import light_share


class NoiseRate(nn.Module):
    """rate = a exp(-b light) events per pixel and second, light = (I + 20)/275, one a per polarity; a starts
    at 0.

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
