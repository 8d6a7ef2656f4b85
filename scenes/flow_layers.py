"""Layers of texture over one another, and where their points go."""

import numpy as np
import torch
from torch.nn.functional import grid_sample


class Plane:
    """A layer whose points [.., 2] px from the image's centre move by homographies [T, 3, 3], the first at
    time 0 to those at each time."""

    def __init__(self, homographies):
        self.homographies = homographies

    def texels(self, place, points):
        """What is seen at points [H, W, 2] at each time, on its texture in grid_sample's units: [T, 2, H, W].

        place: [3, 3] from points at time 0 to those units.
        """
        return apply(place @ torch.linalg.inv(self.homographies), points)

    def end(self, points):
        """Where points [H, W, 2] of the start are at the window's end, [H, W, 2]."""
        return apply(self.homographies[-1], points).movedim(0, -1)


def mirrored(values, size):
    """[H, W] continued by reflection to [size, size]."""
    rows, columns = (torch.arange(size) % (2 * extent - 2) for extent in values.shape)
    rows, columns = (
        torch.where(at < extent, at, 2 * extent - 2 - at)
        for at, extent in zip((rows, columns), values.shape, strict=True)
    )
    return values[rows][:, columns]


def cover(draw, size, scale, image_px):
    """A few blobs or bars, 0 or 1 [size, size], of 0.15 to 0.7 of the image across."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    cover = np.zeros((size, size), bool)
    for _ in range(int(draw.integers(1, 4))):
        cx, cy = draw.uniform(-0.5, 0.5, 2) * image_px * scale
        radius = draw.uniform(0.08, 0.35) * image_px * scale
        angle = draw.uniform(0, np.pi)
        dx = x - cx
        dy = y - cy
        along = dx * np.cos(angle) + dy * np.sin(angle)
        across = dy * np.cos(angle) - dx * np.sin(angle)
        shape = draw.integers(3)
        flat = draw.uniform(0.15, 1.0)
        if shape == 0:
            bearing = np.arctan2(across, along)
            wave = sum(
                draw.normal(0, 0.15) * np.cos(n * bearing + draw.uniform(0, 2 * np.pi)) for n in (2, 3, 5)
            )
            cover |= np.hypot(along, across) < radius * (1 + wave)
        elif shape == 1:
            cover |= (np.abs(along) < radius) & (np.abs(across) < flat * radius)
        else:
            cover |= (np.abs(across) < flat * radius / 2) & (
                np.abs(along) < 4 * radius
            )  # a post across the image
    return torch.from_numpy(cover.astype(np.float32))


def gaussian(images, sigma):
    """[N, S, S] blurred (periodic) by a Gaussian of this standard deviation, through the Fourier
    transform."""
    size = images.shape[-1]
    fx = torch.fft.rfftfreq(size)
    fy = torch.fft.fftfreq(size)
    low_pass = torch.exp(-2 * np.pi**2 * sigma**2 * (fy[:, None].square() + fx.square()))
    return torch.fft.irfft2(torch.fft.rfft2(images) * low_pass, s=(size, size)).clamp_min(0)


def apply(homography, points):
    """Homographies [..., 3, 3] on centred points [H, W, 2] -> [..., 2, H, W]."""
    height, width, _ = points.shape
    columns = torch.cat([points.reshape(-1, 2).T, torch.ones(1, height * width)])
    moved = (homography.reshape(-1, 3) @ columns).reshape(*homography.shape[:-2], 3, height, width)
    return moved[..., :2, :, :] / moved[..., 2:, :, :]


def lookup(crop, units):
    """A texture [1, C, S, S] at grid_sample's units [T, 2, H, W] -> [T, C, H, W]; mirrored beyond the
    border."""
    times, _, height, width = units.shape
    grid = units.permute(0, 2, 3, 1).reshape(1, times * height, width, 2)
    found = grid_sample(crop, grid, padding_mode="reflection", align_corners=False)
    return found.reshape(-1, times, height, width).transpose(0, 1)


def compose(sample, points):
    """Frames [T, H, W]: each layer over those behind it."""
    frames = torch.zeros(())
    for layer, (motion, crop, place) in enumerate(
        zip(sample["motion"], sample["crop"], sample["place"], strict=True)
    ):
        units = motion.texels(place, points)
        if layer == 0:
            frames = lookup(crop[None, :1], units)[:, 0]
        else:
            seen, cover = lookup(crop[None], units).unbind(1)
            frames = seen + (1 - cover) * frames
    return frames
