"""The plain solve that the closed form is compared with: affine Gauss-Newton on the warped volume with a
small fixed damping, no prior and no noise model."""

import torch
from kornia.filters import gaussian_blur2d
from torch.nn.functional import grid_sample

from codesign.types import FlowField

DAMPING = 1e-3  # of the mean diagonal of the normal matrix


def plain_lk(volume, levels_px=(4.0, 2.0, 1.0), steps=3):
    """Affine flow [B, 2, H, W] by damped least squares. Args: volume: EventVolume. Returns: FlowField on the
    pixels of mid-interval, taken for those of the start."""
    counts = volume.counts
    batch, _, bins, height, width = counts.shape
    span = volume.collected_s.sum()
    share = (volume.collected_s / span).to(counts)[:, None, None]
    time = (volume.centroid_s / span).to(counts)[:, None, None] - 0.5
    rate = (counts[:, 0] - counts[:, 1]) / share
    y, x = torch.meshgrid(torch.arange(height).to(counts), torch.arange(width).to(counts), indexing="ij")
    half = max(height, width) / 2
    basis = torch.stack([torch.ones_like(x), (x - (width - 1) / 2) / half, (y - (height - 1) / 2) / half])
    parameters = torch.zeros(batch, 2, 3).to(counts)
    for sigma in levels_px:
        size = 2 * int(3 * sigma + 0.5) + 1
        blurred = gaussian_blur2d(rate, (size, size), (sigma, sigma))
        for _ in range(steps):
            flow = torch.einsum("bck,khw->bchw", parameters, basis)
            at = torch.stack(
                [
                    (x + time * flow[:, 0, None]) * (2 / (width - 1)) - 1,
                    (y + time * flow[:, 1, None]) * (2 / (height - 1)) - 1,
                ],
                -1,
            )
            inside = (at.abs() <= 1).all(-1).all(1)
            warped = grid_sample(
                blurred.flatten(0, 1)[:, None], at.flatten(0, 1), padding_mode="border", align_corners=True
            ).reshape(blurred.shape)
            mean = (warped * share).sum(1)
            slope = (warped * share * time).sum(1) / (share * time.square()).sum()
            dy, dx = torch.gradient(mean, dim=(1, 2))
            design = (
                torch.cat([dx[:, None] * basis, dy[:, None] * basis], 1).flatten(2)
                * inside.flatten(1)[:, None]
            )
            normal = design @ design.mT
            damping = DAMPING * normal.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] + 1e-9
            change = torch.linalg.solve(
                normal + damping * torch.eye(6), -(design @ slope.flatten(1)[..., None])
            )[..., 0]
            parameters = parameters + change.reshape(batch, 2, 3)
    flow = torch.einsum("bck,khw->bchw", parameters, basis)
    return FlowField(flow, torch.ones_like(flow[:, 0], dtype=torch.bool), float(span))
