"""Optical flow between two frames, both ways, from coarse to fine: total variation of the flow
against the absolute brightness difference at every scale, and block matches at a coarse one, which
find what a coarse picture no longer shows.
"""

import math

import torch
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, pad

DATA_WEIGHT = 20.0  # lambda, for pictures of natural-log units
COUPLING = 0.3  # theta: how far the solution of the data term may leave the smooth one
DUAL_STEP = 0.25  # largest stable step of the dual variable, Chambolle 2004
LEAST_GRADIENT = 1e-6  # squared; keeps the step finite on even surfaces
# sorting network that leaves the median in place 4 (Paeth, Graphics Gems I, 1990)
MEDIAN_OF_NINE = (
    (1, 2), (4, 5), (7, 8), (0, 1), (3, 4), (6, 7), (1, 2), (4, 5), (7, 8), (0, 3), (5, 8), (4, 7), (3, 6), (1, 4), (2, 5), (4, 7), (4, 2), (6, 4), (4, 2),
)  # fmt: skip
RADIUS_PX = 9  # displacements looked at, at the scale of matching
WINDOW_PX = 1  # neighbours on each side
# log units; larger differences count as this, so that an occluded corner does not decide
MOST = 0.5
STILLNESS = 5e-4  # log units per pixel: of equals the smaller displacement is taken
# a match replaces the flow where its difference is below this share of the flow's, by at least this
BETTER = 0.7
MARGIN = 0.02
AGREEMENT_PX = 1.5  # and where both directions agree
# on the 0-255 scale: flow is found on ln(I + 12), so that dark edges count about as the sensor sees
# them
DARK_OFFSET = 12.0
SMALLEST_PX = 12  # shorter side of the coarsest scale
# matches are sought at the first scale whose shorter side is at most this: there they reach a ninth
# of it or more
MATCHED_PX = 80
PREFILTER_PX = 1.04  # standard deviation of the blur before every halving
WARPS = 4
ITERATIONS = 20


def places(field):
    """[2, H, W] column and row of every pixel, of the type of ``field`` [..., H, W]."""
    height, width = field.shape[-2:]
    y, x = torch.meshgrid(
        *(torch.arange(size, dtype=field.dtype, device=field.device) for size in (height, width)),
        indexing="ij",
    )
    return torch.stack((x, y))


def sampled(pictures, displacement_px, mode="bicubic"):
    """Pictures read at every pixel plus its displacement; outside, the nearest edge.

    Args:
      pictures: [B, C, H, W].
      displacement_px: [B, 2, H, W], +x right, +y down.
      mode: "bicubic" (Keys' kernel with -0.75: sharp, and off by at most 0.048 px on a slope),
        "bilinear" or "nearest".
    Gradient: pictures (linear in them), and the displacement.
    """
    height, width = pictures.shape[-2:]
    at = places(displacement_px) + displacement_px
    size = torch.tensor([max(width - 1, 1), max(height - 1, 1)], dtype=at.dtype, device=at.device)
    return grid_sample(
        pictures,
        at.permute(0, 2, 3, 1) * (2 / size) - 1,
        mode=mode,
        padding_mode="border",
        align_corners=True,
    )


def inside(displacement_px):
    """[B, 1, H, W] 1 where a pixel plus its displacement lies in the picture, to its edge half a
    pixel from the outermost centres, else 0."""
    at = places(displacement_px) + displacement_px
    size = torch.tensor([at.shape[-1], at.shape[-2]], dtype=at.dtype, device=at.device)[
        :, None, None
    ]
    return ((at >= -0.5) & (at <= size - 0.5)).all(1, keepdim=True).to(at.dtype)


def splatted(values, displacement_px):
    """Sum of what lands on every pixel when each value moves by its displacement and is shared
    among the four pixels around its place.

    Args:
      values: [H, W, C].
      displacement_px: [2, H, W].
    Returns: [H, W, C]; what lands outside is gone.
    """
    height, width, channels = values.shape
    at = places(displacement_px) + displacement_px
    # one pixel of margin takes what lands outside
    x = at[0].clamp(-1, width).add(1)
    y = at[1].clamp(-1, height).add(1)
    column = x.long().clamp(max=width)
    row = y.long().clamp(max=height)
    right = (x - column).reshape(-1, 1)
    down = (y - row).reshape(-1, 1)
    total = values.new_zeros((height + 2) * (width + 2), channels)
    index = (row * (width + 2) + column).reshape(-1)
    upper = values.reshape(-1, channels) * (1 - down)
    lower = values.reshape(-1, channels) * down
    for part, step in ((upper, 0), (lower, width + 2)):
        total.index_add_(0, index + step, part * (1 - right))
        total.index_add_(0, index + step + 1, part * right)
    return total.reshape(height + 2, width + 2, channels)[1:-1, 1:-1]


def refined(first, second, flow, warps, iterations):
    """Flow from ``first`` to ``second``, starting from a guess.

    Args:
      first, second: [B, 1, H, W] log levels. flow: [B, 2, H, W] guess, pixels, +x right, +y down.
      warps: how often the brightness difference is made linear about the current flow. iterations:
        of the solver in between.
    Returns: [B, 2, H, W]. Where the flow leaves the picture it follows its neighbours.
    Source: Zach, Pock and Bischof, A duality based approach for realtime TV-L1 optical flow, DAGM
      2007; gradients averaged over both pictures and a median_of_nine filter between warps as in
      Wedel et al., An improved algorithm for TV-L1 optical flow, 2009.
    """
    dual_x = torch.zeros_like(flow)
    dual_y = torch.zeros_like(flow)
    # memory that all iterations share: allocating it anew takes longer than the arithmetic
    buffers = [flow.new_empty(flow[:, :1].shape), *(torch.zeros_like(flow) for _ in range(4))]
    for _ in range(warps):
        flow = median_of_nine(flow)
        seen = inside(flow)
        warped = sampled(second, flow)
        gradient = _gradient((warped + first) / 2) * seen
        square = gradient.square().sum(1, keepdim=True) + LEAST_GRADIENT
        constant = (warped - first) * seen - (gradient * flow).sum(1, keepdim=True)
        most = DATA_WEIGHT * COUPLING * square
        data = constant, gradient, gradient / square, most, -most
        for _ in range(iterations):
            _iterate(flow, dual_x, dual_y, data, buffers)
    return median_of_nine(flow)


def median_of_nine(field):
    """Median over 3 x 3 pixels of [B, C, H, W], the border repeated."""
    height, width = field.shape[-2:]
    around = pad(field, (1, 1, 1, 1), mode="replicate")
    values = [around[..., y : y + height, x : x + width] for y in range(3) for x in range(3)]
    for low, high in MEDIAN_OF_NINE:
        values[low], values[high] = (
            torch.minimum(values[low], values[high]),
            torch.maximum(values[low], values[high]),
        )
    return values[4]


def _iterate(flow, dual_x, dual_y, data, buffers):
    """One step of the data term, one of the smoothness, in place.

    Args:
      data: of the brightness difference constant + gradient . flow, these two, the step along it,
        and its bounds.
      buffers: five tensors to work in; the last column and row of the last two stay 0.
    """
    constant, gradient, step, most, least = data
    residual, divergence, size, across, down = buffers
    torch.addcmul(constant, gradient[:, :1], flow[:, :1], out=residual)
    residual.addcmul_(gradient[:, 1:], flow[:, 1:])
    torch.minimum(residual, most, out=residual)
    torch.maximum(residual, least, out=residual)
    torch.add(dual_x, dual_y, out=divergence)
    divergence[..., 1:] -= dual_x[..., :-1]
    divergence[..., 1:, :] -= dual_y[..., :-1, :]
    flow.addcmul_(residual, step, value=-1).add_(divergence, alpha=COUPLING)
    torch.sub(flow[..., 1:], flow[..., :-1], out=across[..., :-1])
    torch.sub(flow[..., 1:, :], flow[..., :-1, :], out=down[..., :-1, :])
    torch.mul(across, across, out=size).addcmul_(down, down).sqrt_().mul_(
        DUAL_STEP / COUPLING
    ).add_(1)
    dual_x.add_(across, alpha=DUAL_STEP / COUPLING).div_(size)
    dual_y.add_(down, alpha=DUAL_STEP / COUPLING).div_(size)


def _gradient(picture):
    around = pad(picture, (1, 1, 1, 1), mode="replicate")
    across = around[..., 1:-1, 2:] - around[..., 1:-1, :-2]
    down = around[..., 2:, 1:-1] - around[..., :-2, 1:-1]
    return torch.cat((across, down), 1) / 2


def with_matches(levels, flow):
    """The flow, with matches where they fit much better.

    Args:
      levels: [2, 1, H, W] log levels of both frames.
      flow: [2, 2, H, W] from the first to the second, and back, pixels of this scale.
    Returns: [2, 2, H, W].
    Source: the idea of Xu, Jia and Matsushita, Motion detail preserving optical flow estimation,
      2012.
    """
    found = _best(levels)
    better = _misfit(levels, found) < BETTER * _misfit(levels, flow) - MARGIN
    agree = (found + sampled(found.flip(0), found, "bilinear")).norm(
        dim=1, keepdim=True
    ) <= AGREEMENT_PX
    return torch.where(better & agree, found, flow)


def _best(levels):
    height, width = levels.shape[-2:]
    other = pad(levels.flip(0), (RADIUS_PX,) * 4, mode="replicate")
    least = torch.full_like(levels, math.inf)
    chosen = torch.zeros_like(levels)
    steps = range(-RADIUS_PX, RADIUS_PX + 1)
    moves = torch.tensor(
        [(x, y) for y in steps for x in steps], dtype=levels.dtype, device=levels.device
    )
    for index, (x, y) in enumerate((x, y) for y in steps for x in steps):
        shifted = other[
            ..., RADIUS_PX + y : RADIUS_PX + y + height, RADIUS_PX + x : RADIUS_PX + x + width
        ]
        cost = _mean((levels - shifted).abs_().clamp_(max=MOST)).add_(STILLNESS * math.hypot(x, y))
        better = cost < least
        least = torch.where(better, cost, least)
        chosen.masked_fill_(better, index)
    return moves[chosen[:, 0].long()].permute(0, 3, 1, 2).contiguous()


def _misfit(levels, flow):
    return _mean((levels - sampled(levels.flip(0), flow, "bilinear")).abs().clamp(max=MOST))


def _mean(field):
    return avg_pool2d(pad(field, (WINDOW_PX,) * 4, mode="replicate"), 2 * WINDOW_PX + 1, 1)


@torch.no_grad()
def flow_both_ways(first, second):
    """Dense flow between two frames.

    Args:
      first, second: [H, W] linear intensity on the 0-255 scale.
    Returns: [2, 2, H, W]: from the first to the second, and from the second to the first; pixels,
      +x right, +y down. Exactly 0 for equal frames.
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
                [size[1] / flow.shape[3], size[0] / flow.shape[2]],
                dtype=flow.dtype,
                device=flow.device,
            )
            flow = (
                interpolate(flow, size, mode="bilinear", align_corners=False)
                * growth[:, None, None]
            )
        if number == matched:
            flow = with_matches(levels, flow)
        flow = refined(levels, levels.flip(0), flow, WARPS, ITERATIONS)
    return flow


def flow_levels(first, second):
    """[2, H, W] log levels of two frames [H, W] in which motion is looked for; light that changed
    everywhere alike (their median) is taken out."""
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
    from kornia.filters import gaussian_blur2d

    size = 2 * int(3 * deviation_px + 0.5) + 1
    return gaussian_blur2d(field, (size, size), (deviation_px, deviation_px), "replicate")
