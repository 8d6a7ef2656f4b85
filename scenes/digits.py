"""Digits on pieces of photographs, moved by saccades in front of a small sensor, exact at any time:
recordings to classify, in the manner of N-MNIST and N-Caltech101."""

import math
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath
from skimage.draw import polygon as polygon_pixels

from scenes import textures

CLASSES = 10
FONTS = (
    "DejaVuSans",
    "DejaVuSans-BoldOblique",
    "DejaVuSansMono",
    "DejaVuSerif",
    "STIXGeneral",
    "cmss10",
)
PHOTOS = {
    "training": ("gravel", "coffee", "astronaut", "rocket", "camera"),
    "test": ("brick", "grass", "chelsea", "hubble_deep_field"),
}
TILE_PX = 64  # the window of the sensor is its middle; the rest moves in and out of sight
WINDOW_PX = 32
# here a tile fades to its mean, so that it can be repeated without a seam; never in sight
BORDER_PX = 8
FINE = 4  # raster points of a digit per pixel and axis
CLUTTER = 0.15  # exponent of the photograph: 1 leaves it as it is, 0 makes it even
BLUR_PX = 0.7  # of the lens
SIDE_PX = 4.0  # of the triangle of saccades
LEG_S = 0.06  # duration of one saccade


def draw_pictures(count, photos, seed):
    """Tiles [N, 64, 64], intensity on the 0-255 scale, periodic and band-limited: a digit in a
    random font, size, place and contrast on a piece of a photograph behind a soft lens. Labels [N],
    in turn."""
    random = np.random.default_rng(seed)
    tiles = softened(np.stack([_tile(index % CLASSES, photos, random) for index in range(count)]))
    return torch.from_numpy(tiles.astype(np.float32)), torch.arange(count) % CLASSES


def softened(tiles):
    """Tiles [N, K, K] behind a Gaussian blur of BLUR_PX, exact for the periodic band-limited
    picture."""
    fade = np.exp(-2 * (np.pi * BLUR_PX * np.fft.fftfreq(tiles.shape[-1])) ** 2)
    return np.fft.ifft2(np.fft.fft2(tiles) * fade[:, None] * fade).real


def coverage(label, font, height_px, turn_deg, centre_px):
    """Share of each pixel of a tile that a digit covers, [64, 64]. centre_px: (x, y) from the
    tile's middle."""
    angle = np.deg2rad(turn_deg)
    turn = height_px * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    inside = np.zeros((TILE_PX * FINE,) * 2, dtype=bool)
    for outline in _outlines(label, font):
        # raster points lie in the middle of their cells
        x, y = (outline @ turn.T + np.asarray(centre_px) + TILE_PX / 2).T * FINE - 0.5
        within = np.zeros_like(inside)
        within[polygon_pixels(y, x, within.shape)] = True
        inside ^= within  # an outline within another is a hole
    return inside.reshape(TILE_PX, FINE, TILE_PX, FINE).mean((1, 3))


@cache
def _outlines(label, font):
    """Closed polygons [P, 2] of a digit, y down, of height 1 and centred on 0."""
    file = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / f"{font}.ttf"
    polygons = TextPath((0, 0), str(label), size=100, prop=FontProperties(fname=file)).to_polygons()
    low, high = (end(np.concatenate(polygons), axis=0) for end in (np.min, np.max))
    return [(np.asarray(p) - (low + high) / 2) / (high[1] - low[1]) * (1, -1) for p in polygons]


def _tile(label, photos, random):
    """One picture before the lens."""
    photo = _photo(PHOTOS[photos][random.integers(len(PHOTOS[photos]))])
    row, column = (random.integers(size - TILE_PX + 1) for size in photo.shape)
    behind = photo[row : row + TILE_PX, column : column + TILE_PX].astype(np.float64) ** CLUTTER
    at = np.arange(TILE_PX) + 0.5
    ramp = (1 - np.cos(np.pi * np.clip(np.minimum(at, TILE_PX - at) / BORDER_PX, 0, 1))) / 2
    behind = behind.mean() + (behind - behind.mean()) * (ramp[:, None] * ramp)
    height_px, turn_deg = random.uniform(18.0, 22.0), random.uniform(-6.0, 6.0)
    font = FONTS[random.integers(len(FONTS))]
    covered = coverage(label, font, height_px, turn_deg, random.uniform(-1.5, 1.5, 2))
    # natural log of digit over background, either sign; mean intensity
    contrast = random.uniform(0.4, 0.9) * (1 if random.random() < 0.5 else -1)
    mean = np.exp(random.uniform(*np.log((30.0, 200.0))))
    return behind / behind.mean() * mean * (1 + np.expm1(contrast) * covered)


@cache
def _photo(name):
    return textures.shrunk(textures.photo(name), 2)


def frame_times(rate_hz):
    """[T] times, seconds, of the three saccades."""
    return torch.linspace(0, 3 * LEG_S, round(3 * LEG_S * rate_hz) + 1, dtype=torch.float64)


def position_px(t_s):
    """Where a picture has moved to at [T] times: [T, 2] pixels (x right, y down). Three legs of an
    equilateral triangle, as for N-MNIST (Orchard et al. 2015), each with the course of minimum jerk
    (Flash and Hogan 1985)."""
    corners = (
        torch.tensor([[0, 0], [0.5, math.sqrt(0.75)], [1, 0], [0, 0]], dtype=torch.float64)
        * SIDE_PX
    )
    leg = (t_s / LEG_S).floor().clamp(max=2).long()
    u = t_s / LEG_S - leg
    share = u**3 * (10 - 15 * u + 6 * u**2)
    return corners[leg] + share[:, None] * (corners[leg + 1] - corners[leg])


def frames(tiles, t_s):
    """What a window in the middle of moving tiles [N, K, K] sees, [T, N, WINDOW_PX, WINDOW_PX]: a
    tile's own trigonometric polynomial at pixel - position, exact at any fraction of a pixel."""
    side = tiles.shape[-1]
    window = (side - WINDOW_PX) // 2 + torch.arange(WINDOW_PX, dtype=torch.float64)
    place = window - position_px(t_s).T[..., None]  # [2, T, W]
    x = place[..., None] - torch.arange(side, dtype=torch.float64)
    x = x - side * (x / side).round()
    on_sample = x.abs() < 1e-12
    safe = torch.where(on_sample, 0.5, x)
    # Dirichlet kernel of an even number of samples
    kernel = torch.sin(math.pi * safe) / (side * torch.tan(math.pi * safe / side))
    across, down = torch.where(on_sample, 1.0, kernel).to(tiles)
    moved = tiles.flatten(0, 1) @ across.flatten(0, 1).T
    moved = moved.unflatten(0, tiles.shape[:2]).unflatten(-1, across.shape[:2])  # [N, K, T, W]
    return torch.einsum("tik,nktj->tnij", down, moved)
