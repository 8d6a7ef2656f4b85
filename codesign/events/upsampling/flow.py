"""Optical flow between two frames, both ways, from coarse to fine."""

import torch
from kornia.filters import gaussian_blur2d
from torch.nn.functional import interpolate

from codesign.events.upsampling.match import with_matches
from codesign.events.upsampling.tvl1 import refined

# on the 0-255 scale: flow is found on ln(I + 12), so that dark edges count about as the sensor sees them
DARK_OFFSET = 12.0
SMALLEST_PX = 12  # shorter side of the coarsest scale
# matches are sought at the first scale whose shorter side is at most this: there they reach a ninth of it or
# more
MATCHED_PX = 80
PREFILTER_PX = 1.04  # standard deviation of the blur before every halving
WARPS = 4
ITERATIONS = 20


@torch.no_grad()
def flow_both_ways(first, second):
    """Dense flow between two frames.

    Args: first, second: [H, W] linear intensity on the 0-255 scale.
    Returns: [2, 2, H, W]: from the first to the second, and from the second to the first; pixels, +x right,
      +y down. Exactly 0 for equal frames.
    Gradient: none.
    """
    if torch.equal(first, second):
        return first.new_zeros(2, 2, *first.shape)
    scales = [flow_levels(first, second)[:, None]]
    while min(scales[-1].shape[-2:]) >= 2 * SMALLEST_PX:
        scales.append(_halved(scales[-1]))
    matched = next(
        (number for number, levels in enumerate(scales) if min(levels.shape[-2:]) <= MATCHED_PX),
        len(scales) - 1,
    )
    flow = torch.zeros_like(scales[-1]).repeat(1, 2, 1, 1)
    for number in reversed(range(len(scales))):
        levels = scales[number]
        size = levels.shape[-2:]
        if flow.shape[-2:] != size:
            growth = torch.tensor(
                [size[1] / flow.shape[3], size[0] / flow.shape[2]], dtype=flow.dtype, device=flow.device
            )
            flow = interpolate(flow, size, mode="bilinear", align_corners=False) * growth[:, None, None]
        if number == matched:
            flow = with_matches(levels, flow)
        flow = refined(levels, levels.flip(0), flow, WARPS, ITERATIONS)
    return flow


def flow_levels(first, second):
    """[2, H, W] log levels of two frames [H, W] in which motion is looked for; light that changed everywhere
    alike (their median) is taken out."""
    levels = (torch.stack((first, second)).detach() + DARK_OFFSET).log()
    levels[1] -= (levels[1] - levels[0]).median()
    return levels


def _halved(levels):
    height, width = levels.shape[-2:]
    return interpolate(
        blurred(levels, PREFILTER_PX),
        (round(height / 2), round(width / 2)),
        mode="bilinear",
        align_corners=False,
    )


def blurred(field, deviation_px):
    """Gaussian blur of [B, 1, H, W], the border repeated."""
    size = 2 * int(3 * deviation_px + 0.5) + 1
    return gaussian_blur2d(field, (size, size), (deviation_px, deviation_px), "replicate")
