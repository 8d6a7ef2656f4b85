"""Dense optical flow at one scale: total variation of the flow against the absolute brightness difference, by alternating closed-form steps."""

import torch
from torch.nn.functional import pad

from codesign.events.upsample_warp import inside, sampled

DATA_WEIGHT = 20.0  # lambda, for pictures of natural-log units
COUPLING = 0.3  # theta: how far the solution of the data term may leave the smooth one
DUAL_STEP = 0.25  # largest stable step of the dual variable, Chambolle 2004
LEAST_GRADIENT = 1e-6  # squared; keeps the step finite on even surfaces
MEDIAN_OF_NINE = (  # sorting network that leaves the median in place 4 (Paeth, Graphics Gems I, 1990)
    (1, 2), (4, 5), (7, 8), (0, 1), (3, 4), (6, 7), (1, 2), (4, 5), (7, 8), (0, 3), (5, 8), (4, 7), (3, 6), (1, 4), (2, 5), (4, 7), (4, 2), (6, 4), (4, 2),
)  # fmt: skip


def refined(first, second, flow, warps, iterations):
    """Flow from ``first`` to ``second``, starting from a guess.

    Args:
      first, second: [B, 1, H, W] log levels. flow: [B, 2, H, W] guess, pixels, +x right, +y down.
      warps: how often the brightness difference is made linear about the current flow. iterations: of the solver in between.
    Returns: [B, 2, H, W]. Where the flow leaves the picture it follows its neighbours.
    Source: Zach, Pock and Bischof, A duality based approach for realtime TV-L1 optical flow, DAGM 2007; gradients averaged over both pictures and
      a median filter between warps as in Wedel et al., An improved algorithm for TV-L1 optical flow, 2009.
    """
    dual_x, dual_y = torch.zeros_like(flow), torch.zeros_like(flow)
    limit = DATA_WEIGHT * COUPLING
    for _ in range(warps):
        flow = median(flow)
        seen = inside(flow)
        warped = sampled(second, flow)
        gradient = _gradient((warped + first) / 2) * seen
        square = gradient.square().sum(1, keepdim=True) + LEAST_GRADIENT
        along, most = gradient / square, limit * square
        constant = (warped - first) * seen - (gradient * flow).sum(1, keepdim=True)
        for _ in range(iterations):
            residual = torch.addcmul(torch.addcmul(constant, gradient[:, :1], flow[:, :1]), gradient[:, 1:], flow[:, 1:])
            flow = flow - torch.minimum(torch.maximum(residual, -most), most) * along + COUPLING * _divergence(dual_x, dual_y)
            dx, dy = pad(flow.diff(dim=3), (0, 1)), pad(flow.diff(dim=2), (0, 0, 0, 1))
            scale = 1 / (1 + DUAL_STEP / COUPLING * torch.sqrt(dx * dx + dy * dy))
            dual_x, dual_y = (dual_x + DUAL_STEP / COUPLING * dx) * scale, (dual_y + DUAL_STEP / COUPLING * dy) * scale
    return median(flow)


def median(field):
    """Median over 3 x 3 pixels of [B, C, H, W], the border repeated."""
    height, width = field.shape[-2:]
    around = pad(field, (1, 1, 1, 1), mode="replicate")
    values = [around[..., y : y + height, x : x + width] for y in range(3) for x in range(3)]
    for low, high in MEDIAN_OF_NINE:
        values[low], values[high] = torch.minimum(values[low], values[high]), torch.maximum(values[low], values[high])
    return values[4]


def _gradient(picture):
    around = pad(picture, (1, 1, 1, 1), mode="replicate")
    return torch.cat((around[..., 1:-1, 2:] - around[..., 1:-1, :-2], around[..., 2:, 1:-1] - around[..., :-2, 1:-1]), 1) / 2


def _divergence(dual_x, dual_y):
    total = dual_x + dual_y
    total[..., 1:] -= dual_x[..., :-1]
    total[..., 1:, :] -= dual_y[..., :-1, :]
    return total
