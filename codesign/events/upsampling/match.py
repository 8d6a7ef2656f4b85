"""Block matching: which of many whole-pixel displacements fits a neighbourhood best. It finds what a coarse
picture no longer shows."""

import math

import torch
from torch.nn.functional import avg_pool2d, pad

from codesign.events.upsampling.warp import sampled

RADIUS_PX = 9  # displacements looked at, at the scale of matching
WINDOW_PX = 1  # neighbours on each side
MOST = 0.5  # log units; larger differences count as this, so that an occluded corner does not decide
STILLNESS = 5e-4  # log units per pixel: of equals the smaller displacement is taken
# a match replaces the flow where its difference is below this share of the flow's, by at least this
BETTER = 0.7
MARGIN = 0.02
AGREEMENT_PX = 1.5  # and where both directions agree


def with_matches(levels, flow):
    """The flow, with matches where they fit much better.

    Args: levels: [2, 1, H, W] log levels of both frames. flow: [2, 2, H, W] from the first to the second, and
      back, pixels of this scale.
    Returns: [2, 2, H, W].
    Source: the idea of Xu, Jia and Matsushita, Motion detail preserving optical flow estimation, 2012.
    """
    found = _best(levels)
    better = _misfit(levels, found) < BETTER * _misfit(levels, flow) - MARGIN
    agree = (found + sampled(found.flip(0), found, "bilinear")).norm(dim=1, keepdim=True) <= AGREEMENT_PX
    return torch.where(better & agree, found, flow)


def _best(levels):
    height, width = levels.shape[-2:]
    other = pad(levels.flip(0), (RADIUS_PX,) * 4, mode="replicate")
    least = torch.full_like(levels, math.inf)
    chosen = torch.zeros_like(levels)
    steps = range(-RADIUS_PX, RADIUS_PX + 1)
    moves = torch.tensor([(x, y) for y in steps for x in steps], dtype=levels.dtype, device=levels.device)
    for index, (x, y) in enumerate((x, y) for y in steps for x in steps):
        shifted = other[..., RADIUS_PX + y : RADIUS_PX + y + height, RADIUS_PX + x : RADIUS_PX + x + width]
        cost = _mean((levels - shifted).abs_().clamp_(max=MOST)).add_(STILLNESS * math.hypot(x, y))
        better = cost < least
        least = torch.where(better, cost, least)
        chosen.masked_fill_(better, index)
    return moves[chosen[:, 0].long()].permute(0, 3, 1, 2).contiguous()


def _misfit(levels, flow):
    return _mean((levels - sampled(levels.flip(0), flow, "bilinear")).abs().clamp(max=MOST))


def _mean(field):
    return avg_pool2d(pad(field, (WINDOW_PX,) * 4, mode="replicate"), 2 * WINDOW_PX + 1, 1)
