"""Pictures to classify: a digit in a random font, size, place and contrast on a piece of a photograph, as
light on a sensor behind a slightly soft lens.

Photographs behind training digits are others than those behind the digits of every test.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath
from skimage.draw import polygon as polygon_pixels
from torch import Tensor

from codesign.errors import DomainError
from scenes import textures

CLASSES = 10
FONTS = ("DejaVuSans", "DejaVuSans-BoldOblique", "DejaVuSansMono", "DejaVuSerif", "STIXGeneral", "cmss10")
PHOTOS = {
    "training": ("gravel", "coffee", "astronaut", "rocket", "camera"),
    "test": ("brick", "grass", "chelsea", "hubble_deep_field"),
}
TILE_PX = 64  # the window of the sensor is its middle; the rest moves in and out of sight
BORDER_PX = 8  # here a tile fades to its mean, so that it can be repeated without a seam; never in sight
FINE = 4  # raster points per pixel and axis
HEIGHT_PX = (18.0, 22.0)
OFFSET_PX = 1.5
TURN_DEG = 6.0
CONTRAST = (0.4, 0.9)  # natural log of digit over background, either sign
CLUTTER = 0.15  # exponent of the photograph: 1 leaves it as it is, 0 makes it even
LIGHT = (30.0, 200.0)  # mean intensity of a picture, 0-255 scale
BLUR_PX = 0.7  # standard deviation of the lens's Gaussian blur


@dataclass(frozen=True)
class Pictures:
    """tiles: [N, 64, 64] float32 intensity on the 0-255 scale, periodic and band-limited. labels: [N] int64,
    0 to 9."""

    tiles: Tensor
    labels: Tensor


def draw_pictures(count, photos, seed):
    """Draw pictures, classes in turn.

    Args: count: number of pictures, >= 1. photos: "training" or "test", which photographs lie behind. seed:
      int or sequence of ints >= 0.
    Returns: Pictures; the same for the same arguments.
    Raises: DomainError for a count below 1 or other photographs.
    """
    if photos not in PHOTOS or count < 1:
        raise DomainError(
            f"{count} pictures on photographs {photos!r} were asked for; give a number >= 1 and one of "
            f"{', '.join(map(repr, PHOTOS))}."
        )
    random = np.random.default_rng(seed)
    tiles = np.stack([_tile(index % CLASSES, photos, random) for index in range(count)])
    return Pictures(torch.from_numpy(softened(tiles).astype(np.float32)), torch.arange(count) % CLASSES)


def softened(tiles):
    """Tiles [N, K, K] behind a Gaussian blur of BLUR_PX, exact for the periodic band-limited picture."""
    frequency = np.fft.fftfreq(tiles.shape[-1])
    fade = np.exp(-2 * (np.pi * BLUR_PX * frequency) ** 2)
    return np.fft.ifft2(np.fft.fft2(tiles) * fade[:, None] * fade).real


def coverage(label, font, height_px, turn_deg, centre_px):
    """Share of each pixel of a tile that a digit covers, [64, 64]. centre_px: (x, y) from the middle of the
    tile."""
    angle = np.deg2rad(turn_deg)
    turn = height_px * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    inside = np.zeros((TILE_PX * FINE,) * 2, dtype=bool)
    for outline in _outlines(label, font):
        x, y = (
            outline @ turn.T + np.asarray(centre_px) + TILE_PX / 2
        ).T * FINE - 0.5  # raster points lie in the middle of their cells
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


@cache
def _photo(name):
    return textures.shrunk(textures.photo(name), 2)


def _tile(label, photos, random):
    """One picture before the lens."""
    photo = _photo(PHOTOS[photos][random.integers(len(PHOTOS[photos]))])
    row, column = (random.integers(size - TILE_PX + 1) for size in photo.shape)
    behind = photo[row : row + TILE_PX, column : column + TILE_PX].astype(np.float64) ** CLUTTER
    behind = behind.mean() + (behind - behind.mean()) * _fade()
    height_px = random.uniform(*HEIGHT_PX)
    turn_deg = random.uniform(-TURN_DEG, TURN_DEG)
    font = FONTS[random.integers(len(FONTS))]
    covered = coverage(label, font, height_px, turn_deg, random.uniform(-OFFSET_PX, OFFSET_PX, 2))
    contrast = random.uniform(*CONTRAST) * (1 if random.random() < 0.5 else -1)
    mean = np.exp(random.uniform(*np.log(LIGHT)))
    return behind / behind.mean() * mean * (1 + np.expm1(contrast) * covered)


@cache
def _fade():
    """[64, 64] weight that falls from 1 to 0 over the border."""
    at = np.arange(TILE_PX) + 0.5
    rise = np.clip(np.minimum(at, TILE_PX - at) / BORDER_PX, 0, 1)
    ramp = (1 - np.cos(np.pi * rise)) / 2
    return ramp[:, None] * ramp
