"""The kernels of the closed form (lk_kernel) as operations of torch: slower, for programs that run without this
package (export), and to compare with."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, pad

from codesign.flow.lk_lanes import Grid

_WANTED = ContextVar("plain operations", default=False)


@contextmanager
def plain_operations() -> Iterator[None]:
    """Within it the functions of lk_kernel are those of this file, so that what they do can be recorded."""
    token = _WANTED.set(True)
    try:
        yield
    finally:
        _WANTED.reset(token)


def wanted() -> bool:
    """Whether a ``plain_operations`` is open."""
    return _WANTED.get()


def moving(
    rate: Tensor, flow_px: Tensor, time: Tensor, contrast: Tensor, grid: Grid, fade_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    """As lk_kernel.moving."""
    rows, columns = rate.shape[2:]
    y, x = torch.meshgrid(torch.arange(rows).to(rate), torch.arange(columns).to(rate), indexing="ij")
    shift = time.to(rate)[:, None, None, None] * flow_px[:, None]
    at = torch.stack([x, y]) + shift / grid.stride  # [B, n, 2, h, w]
    last = torch.tensor([max(columns - 1, 1), max(rows - 1, 1)]).to(rate)[:, None, None]
    scaled = 2 * at / last - 1  # -1 and 1 at the outermost samples; any value where there is one
    warped = grid_sample(
        rate.flatten(0, 1)[:, None],
        scaled.flatten(0, 1).permute(0, 2, 3, 1),
        padding_mode="border",
        align_corners=True,
    ).reshape(rate.shape)
    mean, slope = torch.einsum("kn,bnyx->kbyx", contrast.to(rate), warped).unbind(0)
    reach = (torch.tensor([grid.width, grid.height]).to(rate)[:, None, None] - 1) / 2
    first = (grid.stride - 1) / 2
    off = torch.stack([x, y]) * grid.stride + first + shift[:, [0, -1]] - reach
    inside = ((reach - off.abs()) / fade_px).clamp(0, 1)
    window = inside.square() * (3 - 2 * inside)
    window = window[:, 0] * window[:, 1]
    return mean, slope, window[:, 0] * window[:, 1]


def cell_sums(
    mean: Tensor, slope: Tensor, seen: Tensor, density: Tensor, grid: Grid, cell: int = 1
) -> Tensor:
    """As lk_kernel.cell_sums."""
    x = _slopes(mean) / grid.stride
    y = _slopes(mean.mT).mT / grid.stride
    ones = torch.ones_like(seen)
    parts = [x * x, x * y, y * y, x * slope, y * slope, slope * slope, ones, density]
    terms = seen[:, None] * torch.stack(parts, 1)
    rows, columns = grid.shape
    padded = pad(terms, (0, -columns % cell, 0, -rows % cell))
    return padded.unflatten(3, (-1, cell)).unflatten(2, (-1, cell)).sum((3, 5))


def blurred(images: Tensor, grid: Grid, taps: Sequence[float]) -> Tensor:
    """As lk_kernel.blurred."""
    pooled = avg_pool2d(images, grid.stride) if grid.stride > 1 else images
    return _along_rows(_along_rows(pooled, taps).mT, taps).mT


def _along_rows(images, taps):
    """A symmetric kernel along the last axis, mirrored about the outermost samples as often as need be."""
    size = images.shape[-1]
    place = torch.arange(size)
    found = taps[0] * images
    for shift, tap in enumerate(taps[1:], 1):
        for side in (-shift, shift):
            found = found + tap * images[..., _mirrored(place + side, size)]
    return found


def _mirrored(place, size):
    if size == 1:
        return torch.zeros_like(place)
    place = place % (2 * size - 2)
    return torch.minimum(place, 2 * size - 2 - place)


def _slopes(image):
    """Central differences along the last axis, one-sided at both ends; 0 where there is one sample."""
    if image.shape[-1] == 1:
        return torch.zeros_like(image)
    step = image.diff(dim=-1)
    return torch.cat([step[..., :1], (step[..., 1:] + step[..., :-1]) / 2, step[..., -1:]], -1)
