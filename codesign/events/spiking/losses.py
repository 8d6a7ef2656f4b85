"""Distances between event counts over time, differentiable: van Rossum's, and a chi-square of
pooled counts."""

import torch.nn.functional as F
from torch import Tensor

from codesign.checks import FLOATS, check, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.events.spiking.srm import alpha_response


def van_rossum(found: Tensor, target: Tensor, *, tau_s: Tensor | float, dt: float = 1.0) -> Tensor:
    """Van Rossum distance 1/2 int (eps * (s - s^))^2 dt with eps(t) = t/tau exp(1 - t/tau), summed
    over pixels and polarities.

    Args:
      found, target: [T, 2, ...] counts or spikes per step of length ``dt``, ON first.
      tau_s: time constant, in the unit of dt.
    Returns: 0-dim loss, in the unit of dt; a lone wrong event costs 1/2 sum_k (k h)^2
      exp(2 - 2 k h) dt, about e^2 tau/8.
    Gradient: found, target.
    Raises: ShapeError when the two differ in shape; DomainError for NaN, infinity or time constants
      that are not positive.
    Source: van Rossum, Neural Computation 2001; alpha kernel as in Shrestha and Orchard, SLAYER,
      NeurIPS 2018.
    """
    response, _ = alpha_response(_difference(found, target), tau_s=tau_s, dt=dt)
    return response.square().sum() * (dt / 2)


def count_loss(found: Tensor, target: Tensor, *, side_px: int = 8, steps: int = 10) -> Tensor:
    """Half the chi-square of counts pooled over blocks of space and time: 1/2 sum (n - n^)^2 /
    (n^ + 1), per polarity.

    Args:
      found, target: [T, 2, ..., H, W] counts, ON first.
      side_px, steps: size of a block; what fills no block at the far ends is left out.
    Returns: 0-dim loss >= 0, about 1/2 per block where the counts differ by counting noise alone.
    Gradient: found.
    Raises: ShapeError when the two differ in shape or hold no whole block.
    """
    _difference(found, target)
    side_px, steps = check_whole(side_px, "side_px"), check_whole(steps, "steps")
    if len(found) < steps or min(found.shape[-2:]) < side_px:
        raise ShapeError(
            f"blocks of {steps} steps and {side_px} x {side_px} px do not fit into counts of shape "
            f"{list(found.shape)}; choose smaller ones."
        )
    now, wanted = (_pooled(counts, side_px, steps) for counts in (found, target.detach()))
    return ((now - wanted).square() / (wanted + 1)).sum() / 2


def _pooled(counts, side_px, steps):
    # [2 ..., T, H, W]
    by_polarity = counts.reshape(len(counts), -1, *counts.shape[-2:]).transpose(0, 1)
    return F.avg_pool3d(by_polarity, (steps, side_px, side_px)) * (steps * side_px**2)


def _difference(found, target):
    for counts in (found, target):
        check(counts, "T ...", "counts", FLOATS, finite=True)
    if found.shape != target.shape:
        raise ShapeError(
            f"counts of shape {list(found.shape)} and {list(target.shape)} have no distance; give the same "
            "steps, polarities and pixels."
        )
    if found.ndim < 2 or found.shape[1] != 2:
        raise DomainError(
            f"counts have shape {list(found.shape)}; [T, 2, ...] is needed, ON first."
        )
    return found - target
