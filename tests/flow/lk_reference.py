"""The closed form's warp, slopes and products written down in torch, which differentiates them."""

import torch
from torch.nn.functional import grid_sample, pad


def moving(rate, flow_px, time, contrast, grid, fade_px):
    batch, bins, rows, columns = rate.shape
    first = (grid.stride - 1) / 2
    y, x = torch.meshgrid(torch.arange(rows).to(rate), torch.arange(columns).to(rate), indexing="ij")
    shift = time[:, None, None, None] * flow_px[:, None]
    at = torch.stack([x, y]) + shift / grid.stride  # [B, n, 2, h, w]
    last = torch.tensor([columns - 1, rows - 1]).to(rate)[:, None, None]
    scaled = torch.where(
        last > 0, 2 * at / last.clamp(min=1) - 1, 0 * at
    )  # -1 and 1 at the outermost samples
    warped = grid_sample(
        rate.flatten(0, 1)[:, None],
        scaled.flatten(0, 1).permute(0, 2, 3, 1),
        padding_mode="border",
        align_corners=True,
    ).reshape(rate.shape)
    mean, slope = torch.einsum("kn,bnyx->kbyx", contrast, warped)
    reach = (torch.tensor([grid.width, grid.height]).to(rate)[:, None, None] - 1) / 2
    off = torch.stack([x, y]) * grid.stride + first + shift[:, [0, -1]] - reach
    inside = ((reach - off.abs()) / fade_px).clamp(0, 1)
    return mean, slope, (inside.square() * (3 - 2 * inside)).prod(2).prod(1)


def slopes(image, dim):
    if image.shape[dim] == 1:
        return torch.zeros_like(image)
    return torch.gradient(image, dim=dim)[0]


def cell_sums(mean, slope, seen, density, grid, cell=1):
    x = slopes(mean, 2) / grid.stride
    y = slopes(mean, 1) / grid.stride
    ones = torch.ones_like(seen)
    terms = seen[:, None] * torch.stack(
        [x * x, x * y, y * y, x * slope, y * slope, slope * slope, ones, density], 1
    )
    rows, columns = grid.shape
    padded = pad(terms, (0, -columns % cell, 0, -rows % cell))
    return padded.unflatten(3, (-1, cell)).unflatten(2, (-1, cell)).sum((3, 5))
