"""Hot pixels weighed down.

A pixel counts by k = 1 / (1 + e^2), e = max(0, n - 4 q - m) / (q + m): n events of the pixel, q the
mean of the 24 pixels around it, m = 5 events. Moving texture puts events on several pixels; a hot
pixel has them alone.
"""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

# the factor 4 and m: they take 0.05 % off the events of moving textures at most
LONELY = 4.0
HOT_EVENTS = 5.0
# px, of the surroundings
SIDE = 5


def weighed_down(counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Counts by what their pixels count.

    Args:
      counts: [B, 2, n, H, W].
    Returns: ON less OFF [B, n, H, W], events of both signs and all bins [B, H, W], both weighed, and
      the weights [B, H, W].
    Gradient: counts.
    """
    events = counts.sum((1, 2))
    pixels = _boxes(torch.ones_like(events[:1, :, :1])) * _boxes(torch.ones_like(events[:1, :1]))
    # relu: no slope where the surroundings have no event
    around = torch.relu(_boxes(events) - events) / (pixels - 1)
    excess = torch.relu(events - LONELY * around - HOT_EVENTS) / (around + HOT_EVENTS)
    weights = 1 / (1 + excess.square())
    on, off = counts.unbind(1)
    return weights[:, None] * (on - off), weights * events, weights


def _boxes(images):
    """Sums over the 5 x 5 pixels around each of [B, H, W], or as many of them as there are."""
    across = avg_pool2d(images, (1, SIDE), 1, (0, SIDE // 2), divisor_override=1)
    return avg_pool2d(across, (SIDE, 1), 1, (SIDE // 2, 0), divisor_override=1)
