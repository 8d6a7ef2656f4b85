"""Dense optical flow at one scale: total variation of the flow against the absolute brightness difference, by
alternating closed-form steps."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from codesign.events.upsampling.warp import inside, sampled

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
      warps: how often the brightness difference is made linear about the current flow. iterations: of the
        solver in between.
    Returns: [B, 2, H, W]. Where the flow leaves the picture it follows its neighbours.
    Source: Zach, Pock and Bischof, A duality based approach for realtime TV-L1 optical flow, DAGM 2007;
      gradients averaged over both pictures and a median filter between warps as in Wedel et al., An improved
      algorithm for TV-L1 optical flow, 2009.
    """
    dual_x = torch.zeros_like(flow)
    dual_y = torch.zeros_like(flow)
    buffers = Buffers(flow)
    for _ in range(warps):
        flow = median(flow)
        seen = inside(flow)
        warped = sampled(second, flow)
        gradient = _gradient((warped + first) / 2) * seen
        square = gradient.square().sum(1, keepdim=True) + LEAST_GRADIENT
        constant = (warped - first) * seen - (gradient * flow).sum(1, keepdim=True)
        data = Linear(
            constant,
            gradient,
            gradient / square,
            DATA_WEIGHT * COUPLING * square,
            -DATA_WEIGHT * COUPLING * square,
        )
        for _ in range(iterations):
            _iterate(flow, dual_x, dual_y, data, buffers)
    return median(flow)


def median(field):
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


@dataclass(frozen=True)
class Linear:
    """The brightness difference about a flow: constant + gradient . flow, [B, 1, H, W] and [B, 2, H, W]; the
    step along it and its bounds."""

    constant: Tensor
    gradient: Tensor
    step: Tensor
    most: Tensor
    least: Tensor


class Buffers:
    """Memory that all iterations share: allocating it anew takes longer than the arithmetic."""

    def __init__(self, flow):
        self.residual = flow.new_empty(flow[:, :1].shape)
        self.divergence = torch.empty_like(flow)
        self.size = torch.empty_like(flow)
        # the last column and row stay 0
        self.across = torch.zeros_like(flow)
        self.down = torch.zeros_like(flow)


def _iterate(flow, dual_x, dual_y, data, buffers):
    """One step of the data term, one of the smoothness, in place."""
    residual = buffers.residual
    divergence = buffers.divergence
    size = buffers.size
    across = buffers.across
    down = buffers.down
    torch.addcmul(data.constant, data.gradient[:, :1], flow[:, :1], out=residual)
    residual.addcmul_(data.gradient[:, 1:], flow[:, 1:])
    torch.minimum(residual, data.most, out=residual)
    torch.maximum(residual, data.least, out=residual)
    torch.add(dual_x, dual_y, out=divergence)
    divergence[..., 1:] -= dual_x[..., :-1]
    divergence[..., 1:, :] -= dual_y[..., :-1, :]
    flow.addcmul_(residual, data.step, value=-1).add_(divergence, alpha=COUPLING)
    torch.sub(flow[..., 1:], flow[..., :-1], out=across[..., :-1])
    torch.sub(flow[..., 1:, :], flow[..., :-1, :], out=down[..., :-1, :])
    torch.mul(across, across, out=size).addcmul_(down, down).sqrt_().mul_(DUAL_STEP / COUPLING).add_(1)
    dual_x.add_(across, alpha=DUAL_STEP / COUPLING).div_(size)
    dual_y.add_(down, alpha=DUAL_STEP / COUPLING).div_(size)


def _gradient(picture):
    around = pad(picture, (1, 1, 1, 1), mode="replicate")
    return (
        torch.cat(
            (around[..., 1:-1, 2:] - around[..., 1:-1, :-2], around[..., 2:, 1:-1] - around[..., :-2, 1:-1]),
            1,
        )
        / 2
    )
