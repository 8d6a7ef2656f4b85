"""Frames between two frames: each scene point on its straight way from one to the other, hidden ones taken
from the frame that shows them."""

import torch
from torch.nn.functional import max_pool2d

from codesign.events.upsampling.flow import blurred
from codesign.events.upsampling.warp import inside, sampled, splatted

# forward and backward flow agree to about this much, plus this share of the motion
TOLERANCE_PX = 0.5
TOLERANCE_SHARE = 0.05
HIDDEN = 0.05  # weight of what has no counterpart in the other frame: it shows where nothing else does
LEAST = 1e-4  # weight below which a pixel counts as empty
HOLE_PX = (
    1.5  # standard deviation of the blur that fills pixels on which nothing lands; grows until none is left
)


def visibility(flows):
    """How well a pixel of either frame is seen in the other, from the agreement of both flows.

    Args: flows: [2, 2, H, W] from the first to the second frame, and back.
    Returns: [2, H, W] in HIDDEN..1.
    """
    gap = (flows + sampled(flows.flip(0), flows, "bilinear")).square().sum(1)
    allowed = (TOLERANCE_PX + TOLERANCE_SHARE * flows.norm(dim=1)).square()
    return HIDDEN + (1 - HIDDEN) * torch.exp(-gap / (2 * allowed)) * inside(flows)[:, 0]


def between(first, second, flows, seen, share):
    """The frame at a share of the interval between two frames.

    Args:
      first, second: [H, W] linear intensity. flows: [2, 2, H, W] from ``flow_both_ways``. seen: [2, H, W]
        from ``visibility``. share: 0..1.
    Returns: [H, W]. What the bicubic kernel makes darker or brighter than all nine pixels around is set to
      the darkest or brightest of them: next to a sharp edge its overshoot would be many thresholds of a dark
      pixel.
    Gradient: first and second (piecewise linear in them), for fixed flows.
    Source: flow carried forward to the time asked for, Baker et al., A database and evaluation methodology
      for optical flow, 2011, section 3.3.
    """
    motion, weight = _motion_at(flows, seen, share)
    pictures = torch.stack((first, second))[:, None]
    moved = torch.stack((-share * motion, (1 - share) * motion))
    darkest, brightest = (
        sampled(bound, moved, "nearest")
        for bound in (-max_pool2d(-pictures, 3, 1, 1), max_pool2d(pictures, 3, 1, 1))
    )
    early, late = sampled(pictures, moved).maximum(darkest).minimum(brightest)[:, 0]
    weight = share * weight[1] / ((1 - share) * weight[0] + share * weight[1])
    return early + weight * (late - early)


@torch.no_grad()
def _motion_at(flows, seen, share):
    """Motion per interval [2, H, W] of what is seen at a time in between, and how much either frame knows of
    it, [2, H, W]."""
    carried = []
    for flow, weight, part in ((flows[0], seen[0], share), (-flows[1], seen[1], share - 1)):
        carried.append(splatted(torch.cat((flow * weight, weight[None])).permute(1, 2, 0), part * flow))
    total = carried[0] + carried[1]
    motion = total[..., :2].permute(2, 0, 1)
    mass = total[..., 2]
    empty = mass < LEAST
    width = HOLE_PX
    if bool(empty.all()):  # everything left the picture: blend where it stands
        return torch.zeros_like(motion), torch.ones_like(seen)
    motion = motion / mass.clamp(min=LEAST)
    while bool(empty.any()):
        known = (~empty).to(motion.dtype)
        spread = blurred(torch.cat((motion * known, known[None]))[:, None], width)[:, 0]
        motion = torch.where(empty & (spread[2] > LEAST), spread[:2] / spread[2].clamp(min=LEAST), motion)
        empty = empty & (spread[2] <= LEAST)
        width = 2 * width
    weight = torch.stack([each[..., 2] for each in carried]).clamp(max=1)
    return motion, torch.where(weight.sum(0) < LEAST, torch.ones_like(weight), weight.clamp(min=LEAST**2))
