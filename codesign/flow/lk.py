"""Closed-form event flow: coarse-to-fine damped least squares on event volumes.

The signed event rate of a moving texture moves with it, so the volume obeys V_t + u V_x + v V_y = 0 (Lucas and Kanade, 1981,
with event rate in place of intensity). The volume is warped back along the current flow; per pixel, the regression of the
bins over time gives V_t and their mean gives V_x, V_y; all pixels together give the parameters of an affine or quadratic
field. A Gaussian prior on the flow, weighed against the noise seen in the residuals, and a Wiener factor on the slopes keep
the steps small where events are few.
"""

import math

import torch
from kornia.filters import gaussian_blur2d
from torch.nn.functional import grid_sample

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.types import FlowField

_DOUBT, _FALL = 4.0, 8.0  # energy of slopes, over that of scattered events, at which half of them counts as texture; how sharply it falls below
_BASES = {"constant": 1, "affine": 3, "quadratic": 6}


def estimate_lk(volume, model="affine", prior_px=8.0, levels_px=(4.0, 2.0, 1.0), steps=3, noise_floor=0.02):
    """Flow over the volume's interval.

    Args:
      volume: EventVolume, counts [B, 2, bins >= 2, H, W].
      model: "constant", "affine" or "quadratic" field over the image.
      prior_px: standard deviation expected of the flow, px per interval; weak evidence leaves the flow near zero.
      levels_px: Gaussian blur of the volume, coarse to fine. steps: Gauss-Newton steps at each.
      noise_floor: smallest noise assumed in the fit, relative to the mean square of a Poisson volume with these counts.
    Returns: FlowField [B, 2, H, W] px per interval; valid is False for samples without events, whose flow is 0.
    Gradient: counts.
    Raises: ShapeError, DomainError.
    """
    counts = volume.counts
    if counts.ndim != 5 or counts.shape[1] != 2 or counts.shape[2] < 2:
        raise ShapeError(f"an event volume is [B, 2, bins >= 2, H, W], got {tuple(counts.shape)}.")
    if model not in _BASES:
        raise DomainError(f"flow model '{model}' is unknown; choose one of {', '.join(_BASES)}.")
    check_finite(counts, "event volume")
    batch, _, _, height, width = counts.shape
    least = _odd(max(levels_px))[0] // 2 + 1
    if min(height, width) < least:
        raise ShapeError(f"an event volume of {height} x {width} pixels is smaller than the blur of {max(levels_px)} px needs ({least} x {least}); give larger images or finer levels_px.")
    span = volume.collected_s.sum()
    share = (volume.collected_s / span).to(counts)[:, None, None]
    rate = (counts[:, 0] - counts[:, 1]) / share  # events per interval, as if each bin ran over all of it
    time = (volume.centroid_s / span).to(counts) - 0.5
    weight = share * 1.0
    mean_time = (weight[:, 0, 0] * time).sum()
    basis, grid = _basis(model, height, width, counts)
    prior = prior_px**-2 * (basis.square().mean((1, 2)))  # same expected flow from every basis function
    parameters = torch.zeros(batch, 2, basis.shape[0], dtype=counts.dtype, device=counts.device)
    total = counts.sum((1, 2, 3, 4)) / (height * width)
    for sigma in levels_px:
        blurred = gaussian_blur2d(rate, _odd(sigma), (sigma, sigma))
        poisson = total * ((1 / share[:, 0, 0]).mean() / (4 * torch.pi * sigma**2))
        for _ in range(steps):
            flow = torch.einsum("bck,khw->bchw", parameters, basis)
            warped, seen = _warp(blurred, flow, time, grid, sigma)
            mean = (warped * weight).sum(1)
            slope = (warped * weight * (time - mean_time)[:, None, None]).sum(1) / (weight[:, 0, 0] * (time - mean_time).square()).sum()
            change = _solve(slope, *_gradient(mean, total, sigma), seen, basis, parameters, prior, poisson * noise_floor, sigma)
            moved = torch.einsum("bck,khw->bchw", change, basis).square().sum(1).mean((1, 2))
            parameters = parameters + change * (1 + moved / (2 * sigma) ** 2).rsqrt()[:, None, None]  # no step beyond the reach of the linearisation
    flow = torch.einsum("bck,khw->bchw", parameters, basis)
    valid = (counts.detach().sum((1, 2, 3, 4)) > 0)[:, None, None].expand(batch, height, width)
    return FlowField(flow, valid, float(span))


def _odd(sigma):
    size = 2 * int(3 * sigma + 0.5) + 1
    return size, size


def _basis(model, height, width, like):
    """Polynomials [K, H, W] on coordinates scaled to [-1, 1], and the pixel grid [H, W, 2] (x, y)."""
    y, x = torch.meshgrid(torch.arange(height, dtype=like.dtype, device=like.device), torch.arange(width, dtype=like.dtype, device=like.device), indexing="ij")
    half = max(height, width) / 2
    u, v = (x - (width - 1) / 2) / half, (y - (height - 1) / 2) / half
    terms = [torch.ones_like(u), u, v, u * u, u * v, v * v][: _BASES[model]]
    return torch.stack(terms), torch.stack([x, y], -1)


def _warp(volume, flow, time, grid, sigma):
    """Bins carried back to mid-interval along the flow, and a smooth window that fades where they leave the image."""
    batch, bins, height, width = volume.shape
    at = grid + time[None, :, None, None, None] * flow.permute(0, 2, 3, 1)[:, None]
    size = torch.tensor([width - 1, height - 1], dtype=volume.dtype, device=volume.device)
    unit = (2 * at / size - 1).reshape(batch * bins, height, width, 2)
    warped = grid_sample(volume.reshape(batch * bins, 1, height, width), unit, padding_mode="border", align_corners=True).reshape(volume.shape)
    margin = 1.0 + sigma
    inside = torch.minimum(at, size - at)[:, [0, -1]] / margin
    return warped, (inside.clamp(0, 1).square() * (3 - 2 * inside.clamp(0, 1))).prod(-1).prod(1)


def _gradient(image, density, sigma):
    """Central differences d/dx, d/dy of [B, H, W] (one-sided at the border), less what scattered events alone would show.

    As many events per pixel [B] scattered at random give, after the Gaussian, a mean square slope s = density (1 - exp(-1 / sigma^2)) /
    (8 pi sigma^2). Taken for texture they would give flows of many pixels, so slopes of mean square e count by 1 / (1 + (_DOUBT s / e)^_FALL):
    a smooth Wiener factor, 1 for texture.
    """
    dy, dx = torch.gradient(image, dim=(1, 2))
    scattered = density * ((1 - math.exp(-(sigma**-2))) / (8 * math.pi * sigma**2))
    measured = (dx.square() + dy.square()).mean((1, 2)) / 2
    excess = measured.clamp_min(1e-30).log() - (_DOUBT * scattered).clamp_min(1e-30).log()
    texture = torch.sigmoid(_FALL * excess)[:, None, None]
    return texture * dx, texture * dy


def _solve(slope, dx, dy, seen, basis, parameters, prior, floor, sigma):
    """Gauss-Newton change of the parameters [B, 2, K]: noise-weighted normal equations with the prior on the whole field."""
    batch, _, count = parameters.shape
    design = torch.cat([dx[:, None] * basis, dy[:, None] * basis], 1).flatten(2)
    weight = seen.flatten(1)
    normal = torch.einsum("bip,bp,bjp->bij", design, weight, design)
    right = -torch.einsum("bip,bp,bp->bi", design, weight, slope.flatten(1))
    area = weight.sum(1).clamp_min(1.0)
    energy = (weight * slope.flatten(1).square()).sum(1) / area
    start = torch.linalg.solve(normal + torch.diag_embed(torch.ones_like(right) * (1e-6 * normal.diagonal(dim1=1, dim2=2).mean(1, keepdim=True) + 1e-12)), right)
    left = (energy - (start * right).sum(1) / area).clamp_min(0.0)  # mean square of the residual
    noise = (left + floor) * (4 * torch.pi * sigma**2)  # blurred noise is alike over 4 pi sigma^2 pixels
    damping = (noise[:, None] * prior.repeat(2) + 1e-12)
    now = parameters.reshape(batch, 2 * count)
    return torch.linalg.solve(normal + torch.diag_embed(damping), right - damping * now).reshape(batch, 2, count)
