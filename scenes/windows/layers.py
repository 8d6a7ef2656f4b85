"""Layers of texture over one another, and where their points go, in px from the image's centre.

What moves a layer has ``texels(place, points)``: what is seen at points [H, W, 2] at each time, on
the layer's texture in grid_sample's units, [T, 2, H, W], with place [3, 3] from points at time 0 to
those units; and ``end(points)``: where points of the start are at the window's end, [H, W, 2].
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from codesign.errors import DomainError

BENT_ITERATIONS = 12  # each gains a factor of at least 4
WARP_ITERATIONS = 60
WITHIN_PX = 1e-5  # last change of a warp's inverse


@dataclass(frozen=True)
class Layer:
    """What moves it (or a function that tells, of times), radiance and cover [2, S, S], and where
    points lie on these."""

    motion: Any
    crop: Tensor
    place: Tensor


class Plane:
    """Points move by homographies [T, 3, 3], from those at time 0 to those at each time."""

    def __init__(self, homographies):
        self.homographies = homographies

    def texels(self, place, points):
        return apply(place @ torch.linalg.inv(self.homographies), points)

    def end(self, points):
        return apply(self.homographies[-1], points).movedim(0, -1)


class Bent:
    """A point seen at p + share(t) d(p) at time 0 is seen at H(t) p at time t, with a smooth field
    d.

    Args:
      homographies: [T, 3, 3], centred px.
      displacement_px: [2, h, w] d at points 1 px apart, bilinear in between, centred on the image.
      share: [T], 0 at time 0 and 1 at the window's end.
    """

    def __init__(self, homographies, displacement_px, share):
        self.plane = Plane(homographies)
        self.displacement_px = displacement_px
        self.share = share
        _, height, width = displacement_px.shape
        self.unit = 2 / torch.tensor([float(width), float(height)])

    def texels(self, place, points):
        flat = self.plane.texels(torch.eye(3), points)
        origin = flat + self.share[:, None, None, None] * self._displacement(flat)
        return torch.einsum("ij,tjhw->tihw", place[:2, :2], origin) + place[:2, 2, None, None]

    def end(self, points):
        # p + d(p) = q by fixed point
        start = points.movedim(-1, 0)[None]
        flat = start
        for _ in range(BENT_ITERATIONS):
            flat = start - self._displacement(flat)
        return self.plane.end(flat[0].movedim(0, -1))

    def _displacement(self, points):
        """d at points [T, 2, H, W]."""
        field = self.displacement_px.expand(len(points), -1, -1, -1)
        grid = points.movedim(1, -1) * self.unit
        return grid_sample(field, grid, padding_mode="border", align_corners=False)


class Warp:
    """A point at q at time 0 is at q + share(t) v(q) at time t, with a smooth field v of waves.

    Args:
      wave: [K, 2] radians per px.
      phase: [K].
      size_px: [K, 2] amplitudes of x and y.
      affine: [2, 3], px per (1, px, px).
      share: [T], 0 at time 0 and 1 at the window's end.
    """

    def __init__(self, wave, phase, size_px, affine, share):
        self.wave = wave
        self.phase = phase
        self.size_px = size_px
        self.affine = affine
        self.share = share

    def displacement(self, points):
        """v(q) [..., 2] px at points q [..., 2]."""
        waves = torch.cos(points @ self.wave.T + self.phase) @ self.size_px
        return waves + self.affine[:, 0] + points @ self.affine[:, 1:].T

    def stretch(self, points):
        """Spectral norm [...] of the slope of v at points [..., 2]."""
        slope = -torch.sin(points @ self.wave.T + self.phase)[..., None, None] * (
            self.size_px[:, :, None] * self.wave[:, None, :]
        )
        return torch.linalg.matrix_norm(slope.sum(-3) + self.affine[:, 1:], 2)

    def origins(self, points):
        """Where what is seen at points [H, W, 2] at each time was at time 0: [T, H, W, 2], float32.

        q = x - share v(q) by fixed point in float64, each time from those before. Raises:
        DomainError where the field is so steep that this does not converge.
        """
        points = points.double()
        found = torch.empty(len(self.share), *points.shape)
        known = {1: [], -1: []}  # by sign: (share, displacement) found so far
        for number in self.share.abs().argsort().tolist():
            share = float(self.share[number])
            earlier = known[1 if share > 0 else -1]
            moved = _extrapolated(earlier, share, self.displacement(points))
            for _ in range(WARP_ITERATIONS):
                before = moved
                moved = self.displacement(points - share * before)
                if abs(share) * float((moved - before).abs().max()) < WITHIN_PX:
                    break
            else:
                raise DomainError(
                    "a field of displacement folds over, so frames cannot be looked up along it; give a "
                    "shorter flow_px or larger images."
                )
            earlier.append((share, moved))
            found[number] = points - share * moved
        return found

    def texels(self, place, points):
        return (self.origins(points) @ place[:2, :2].T + place[:2, 2]).movedim(-1, 1)

    def end(self, points):
        points = points.double()
        return (points + self.share[-1] * self.displacement(points)).float()


def _extrapolated(known, share, first):
    """Displacement at a share, along the line through the last two known."""
    if not known:
        return first
    (s0, v0), (s1, v1) = ([(0.0, first), *known])[-2:]
    return v1 + (v1 - v0) * ((share - s1) / (s1 - s0)) if s1 != s0 else v1


def pixels(height_px: int, width_px: int) -> Tensor:
    """Pixels [H, W, 2] in px from the image's centre."""
    y, x = torch.meshgrid(
        torch.arange(height_px) - (height_px - 1) / 2,
        torch.arange(width_px) - (width_px - 1) / 2,
        indexing="ij",
    )
    return torch.stack([x, y], -1)


def mirrored(values, size):
    """[H, W] continued by reflection to [size, size]."""

    def folded(extent):
        at = torch.arange(size) % (2 * extent - 2)
        return torch.where(at < extent, at, 2 * extent - 2 - at)

    rows, columns = (folded(extent) for extent in values.shape)
    return values[rows][:, columns]


def cover(draw, size, scale, image_px):
    """A few blobs or bars, 0 or 1 [size, size], of 0.15 to 0.7 of the image across."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    cover = np.zeros((size, size), bool)
    for _ in range(int(draw.integers(1, 4))):
        cx, cy = draw.uniform(-0.5, 0.5, 2) * image_px * scale
        radius = draw.uniform(0.08, 0.35) * image_px * scale
        along, across = turned(x - cx, y - cy, draw.uniform(0, np.pi))
        shape = draw.integers(3)
        flat = draw.uniform(0.15, 1.0)
        if shape == 0:
            bearing = np.arctan2(across, along)
            wave = sum(
                draw.normal(0, 0.15) * np.cos(n * bearing + draw.uniform(0, 2 * np.pi))
                for n in (2, 3, 5)
            )
            cover |= np.hypot(along, across) < radius * (1 + wave)
        elif shape == 1:
            cover |= (np.abs(along) < radius) & (np.abs(across) < flat * radius)
        else:
            # a post across the image
            cover |= (np.abs(across) < flat * radius / 2) & (np.abs(along) < 4 * radius)
    return torch.from_numpy(cover.astype(np.float32))


def turned(dx, dy, angle):
    """Offsets along and across a direction."""
    return dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)


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
    """A texture [C, S, S] at grid_sample's units [T, 2, H, W] -> [T, C, H, W]; mirrored beyond the
    border."""
    times, _, height, width = units.shape
    grid = units.permute(0, 2, 3, 1).reshape(1, times * height, width, 2)
    found = grid_sample(crop[None], grid, padding_mode="reflection", align_corners=False)
    return found.reshape(-1, times, height, width).transpose(0, 1)


def compose(layers: Sequence[Layer], points: Tensor) -> Tensor:
    """Frames [T, H, W]: each layer over those behind it, the first is the background."""
    background, *others = layers
    frames = lookup(background.crop[:1], background.motion.texels(background.place, points))[:, 0]
    for layer in others:
        seen, cover = lookup(layer.crop, layer.motion.texels(layer.place, points)).unbind(1)
        frames = seen + (1 - cover) * frames
    return frames


def topmost(layers: Sequence[Layer], look: Callable[[Layer], tuple[Tensor, Tensor]]) -> Tensor:
    """Values [2, H, W] of the layer that each pixel shows. look: layer -> its values, and where the
    pixels' points were at time 0, [H, W, 2]."""
    found = None
    for layer in layers:
        value, origin = look(layer)
        if found is None:
            found = value
        else:
            covered = lookup(layer.crop[1:], apply(layer.place, origin)[None])[0, 0]
            found = torch.where(covered > 0.5, value, found)
    assert found is not None
    return found
