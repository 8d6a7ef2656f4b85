"""Flow errors as the field defines them. Conventions are in each docstring, since published code disagrees."""

import torch

from codesign.errors import DomainError, ShapeError


def endpoint_error(flow, truth):
    """Length of the difference of two flows [..., 2, H, W] -> [..., H, W] px."""
    _check(flow, truth)
    return torch.linalg.vector_norm(flow - truth, dim=-3)  # its gradient at zero error is 0, not NaN


def _check(flow, truth):
    if flow.shape != truth.shape or flow.ndim < 3 or flow.shape[-3] != 2:
        raise ShapeError(f"flows must both be [..., 2, H, W]; got {tuple(flow.shape)} and {tuple(truth.shape)}.")


def _masked_mean(values, mask):
    if mask is None:
        return values.mean()
    if mask.shape != values.shape:
        raise ShapeError(f"the mask must be {tuple(values.shape)}, one entry per pixel, got {tuple(mask.shape)}.")
    if not bool(mask.any()):
        raise DomainError("the mask selects no pixel, so the error is undefined; check the valid and event masks.")
    return values[mask].mean()


def aee(flow, truth, mask=None):
    """Average endpoint error, px: mean over the masked pixels of all samples together. Source: Baker et al., IJCV 2011."""
    return _masked_mean(endpoint_error(flow, truth), mask)


def outlier_percent(flow, truth, mask=None):
    """Share of pixels, in percent, whose endpoint error is above 3 px AND above 5 % of the true length (KITTI 2015)."""
    error, length = endpoint_error(flow, truth), truth.square().sum(-3).sqrt()
    return 100 * _masked_mean(((error > 3) & (error > 0.05 * length)).to(error.dtype), mask)


def npe(flow, truth, pixels, mask=None):
    """Share of pixels, in percent, whose endpoint error is above ``pixels``."""
    error = endpoint_error(flow, truth)
    return 100 * _masked_mean((error > pixels).to(error.dtype), mask)


def angular_error_deg(flow, truth, mask=None):
    """Mean angle in space-time between (u, v, 1) and the truth, degrees (Barron et al., 1994), by atan2 for accuracy at small angles."""
    _check(flow, truth)
    one = torch.ones_like(flow[..., :1, :, :])
    a, b = torch.cat([flow, one], -3), torch.cat([truth, one], -3)
    angle = torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(a, b, dim=-3), dim=-3), (a * b).sum(-3))
    return _masked_mean(torch.rad2deg(angle), mask)
