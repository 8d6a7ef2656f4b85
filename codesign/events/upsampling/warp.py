"""Pictures seen along a displacement, and values carried along one: backward sampling and forward
splatting."""

import torch
from torch.nn.functional import grid_sample


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

    Args: pictures: [B, C, H, W]. displacement_px: [B, 2, H, W], +x right, +y down. mode: "bicubic" (Keys'
      kernel with -0.75: sharp, and off by at most 0.048 px on a slope), "bilinear" or "nearest".
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
    """[B, 1, H, W] 1 where a pixel plus its displacement lies in the picture, to its edge half a pixel from
    the outermost centres, else 0."""
    at = places(displacement_px) + displacement_px
    size = torch.tensor([at.shape[-1], at.shape[-2]], dtype=at.dtype, device=at.device)[:, None, None]
    return ((at >= -0.5) & (at <= size - 0.5)).all(1, keepdim=True).to(at.dtype)


def splatted(values, displacement_px):
    """Sum of what lands on every pixel when each value moves by its displacement and is shared among the four
    pixels around its place.

    Args: values: [H, W, C]. displacement_px: [2, H, W].
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
        total.index_add_(0, index + step, part * (1 - right)).index_add_(0, index + step + 1, part * right)
    return total.reshape(height + 2, width + 2, channels)[1:-1, 1:-1]
