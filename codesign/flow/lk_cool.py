"""Hot pixels weighed down.

A pixel counts by k = 1 / (1 + e^2), e = max(0, n - 4 q - m) / (q + m): n events of the pixel, q the mean of the 24 pixels
around it, m = 5 events. Moving texture puts events on several pixels; a hot pixel has them alone.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.nn.functional import avg_pool2d

from codesign.flow.lk_lanes import first_only

# the factor 4 and m: they take 0.05 % off the events of moving textures at most
LONELY = 4.0
HOT_EVENTS = 5.0
SIDE = 5  # px, of the surroundings


def cooled(counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Counts by what their pixels count.

    Args: counts: [B, 2, n, H, W].
    Returns: ON less OFF [B, n, H, W], events of both signs and all bins [B, H, W], both weighed, and the weights
      [B, H, W].
    Gradient: counts; exact, the first one, by hand: counts are the largest tensor of the closed form.
    """
    return _Cooled.apply(counts)


class _Weights(NamedTuple):
    """kept: k. excess: e. around: q + m. events: n. total: of the pixel and those around it."""

    kept: Tensor
    excess: Tensor
    around: Tensor
    events: Tensor
    total: Tensor


class _Cooled(Function):
    @staticmethod
    def forward(ctx, counts):
        weights = _weights(counts.sum((1, 2)))
        ctx.save_for_backward(counts, *weights)
        on, off = counts.unbind(1)
        return weights.kept[:, None] * (on - off), weights.kept * weights.events, weights.kept

    @staticmethod
    def backward(ctx, by_signed, by_events, by_kept):  # pyright: ignore[reportIncompatibleMethodOverride]
        counts, *rest = ctx.saved_tensors
        weights = _Weights(*rest)
        on, off = counts.unbind(1)
        by_kept = by_kept + by_events * weights.events + (by_signed * (on - off)).sum(1)
        by_density = (by_events * weights.kept + _back(weights, by_kept))[:, None]
        found = torch.empty_like(counts)
        for sign, part in zip((1, -1), found.unbind(1), strict=True):
            torch.addcmul(by_density, by_signed, weights.kept[:, None], value=sign, out=part)
        return first_only([found], counts, by_signed, by_events, by_kept)[0]


def _weights(events):
    total = _boxes(events)
    mean = (total - events).clamp_min(0) / (_number(events) - 1)
    around = mean + HOT_EVENTS
    excess = (events - LONELY * mean - HOT_EVENTS).clamp_min(0) / around
    return _Weights(1 / (1 + excess.square()), excess, around, events, total)


def _back(weights, by_kept):
    """Gradient of the events [B, H, W] through the weights."""
    kept, excess, around, events, total = weights
    by_events = -2 * by_kept * excess * kept.square() / around  # 0 where nothing exceeds
    by_total = -by_events * (LONELY + excess) / (_number(events) - 1) * (total > events)
    return by_events - by_total + _boxes(by_total)


def _number(events):
    """Pixels [1, H, W] of the squares that lie in the image."""
    return _boxes(torch.ones_like(events[:1, :, :1])) * _boxes(torch.ones_like(events[:1, :1]))


def _boxes(images):
    """Sums over the 5 x 5 pixels around each of [B, H, W], or as many of them as there are."""
    across = avg_pool2d(images, (1, SIDE), 1, (0, SIDE // 2), divisor_override=1)
    return avg_pool2d(across, (SIDE, 1), 1, (SIDE // 2, 0), divisor_override=1)
