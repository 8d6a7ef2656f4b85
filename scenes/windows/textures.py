"""Textures to learn flow on (procedural) and to judge it on (photographs and unseen speckle)."""

from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter

from codesign.errors import DomainError
from scenes import textures
from scenes.windows.layers import turned

SIZE = 512
PROCEDURAL_COUNT = 48
EVERYDAY_PILES = 5
STRIPE_COUNT = 8
POOLS = ("procedural", "fine", "mixed", "everyday", "stripes")


@lru_cache(maxsize=4)
def pool(name):
    """Textures of a kind, as a tuple of [H, W] float32 radiances (0..255 scale).

    "procedural": speckle of many spectra and piles of discs and bars with smooth areas between;
    what networks are trained on. "fine": gravel, grass, brick and three speckles with seeds of
    their own: detail everywhere. "mixed": camera, chelsea, coffee, astronaut, rocket: photographs
    with large smooth areas. "everyday": those and as many piles of few, mostly smooth shapes with
    seeds of their own: what a camera sees in rooms. "stripes": lines of several widths that all run
    the same way, so that motion along them is not seen. No photograph is in "procedural".
    """
    if name == "fine":
        return tuple(textures.photo(source) for source in ("gravel", "grass", "brick")) + tuple(
            textures.speckle(90_000 + k, finest_px=f, coarsest_px=24.0)
            for k, f in enumerate((4.0, 6.0, 8.0))
        )
    if name == "mixed":
        return tuple(
            textures.photo(source)
            for source in ("camera", "chelsea", "coffee", "astronaut", "rocket")
        )
    if name == "everyday":
        return pool("mixed") + tuple(
            pile(np.random.default_rng((90_100, k)), shapes=150) for k in range(EVERYDAY_PILES)
        )
    if name == "stripes":
        return tuple(_stripes(np.random.default_rng((90_200, k))) for k in range(STRIPE_COUNT))
    if name == "procedural":
        return tuple(_procedural(seed) for seed in range(PROCEDURAL_COUNT))
    raise DomainError(f"texture pool {name!r} is unknown; there are {', '.join(POOLS)}.")


def _procedural(seed):
    """Two in three are piles of shapes, one in three is speckle."""
    draw = np.random.default_rng((7, seed))
    if seed % 3 == 0:
        finest = draw.uniform(3.0, 12.0)
        return textures.speckle(
            seed,
            finest_px=finest,
            coarsest_px=finest * draw.uniform(3, 16),
            contrast=draw.uniform(0.2, 0.7),
        )
    return pile(draw)


def _stripes(draw):
    """Half of them of one period, half of random widths."""
    x = np.arange(SIZE, dtype=np.float32)
    if draw.random() < 0.5:
        line = np.sin(2 * np.pi * x / draw.uniform(8, 24))
    else:
        line = gaussian_filter(draw.standard_normal(SIZE), draw.uniform(1.5, 5), mode="wrap")
        line = line / line.std()
    values = np.exp(4 + draw.uniform(0.3, 0.8) * line).astype(np.float32)
    return textures.check_texture(
        np.broadcast_to(values, (SIZE, SIZE)).clip(textures.LIFT, 255.0), "stripes"
    )


def pile(draw, shapes=1500):
    """Discs and bars of many sizes, each hiding what lies below, over a soft ramp; some carry
    grain, most are smooth.

    Occluding shapes with sizes of density r^-3 have the statistics of natural images (Lee, Mumford
    and Huang, IJCV 2001).
    """
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    log_level = np.float32(draw.uniform(3.0, 4.5)) + _ramp(x, y, draw)
    grain = gaussian_filter(
        draw.standard_normal((SIZE, SIZE)), draw.uniform(0.7, 2.5), mode="wrap"
    ).astype(np.float32)
    grain /= grain.std()
    smallest = draw.uniform(2, 6)
    largest = draw.uniform(60, 160)
    share = draw.uniform(0, 0.6)  # of shapes with grain
    for _ in range(int(shapes * draw.uniform(0.1, 1.0))):
        u = draw.random()
        radius = (smallest**-2 * (1 - u) + largest**-2 * u) ** -0.5
        cx, cy = draw.uniform(-0.05 * SIZE, 1.05 * SIZE, 2)
        x0, x1 = (int(np.clip(cx + s * 2 * radius, 0, SIZE)) for s in (-1, 1))
        y0, y1 = (int(np.clip(cy + s * 2 * radius, 0, SIZE)) for s in (-1, 1))
        if x1 <= x0 or y1 <= y0:
            continue
        here = (slice(y0, y1), slice(x0, x1))
        dx = x[here] - cx
        dy = y[here] - cy
        if draw.random() < 0.5:
            inside = dx * dx + dy * dy < radius * radius
        else:
            angle = draw.uniform(0, np.pi)
            flat = draw.uniform(0.1, 1.0)
            along, across = turned(dx, dy, angle)
            inside = (np.abs(along) < radius) & (np.abs(across) < flat * radius)
        value = np.float32(draw.uniform(1.5, 5.4)) + 0.5 * _ramp(
            dx * (SIZE / (4 * radius)) + SIZE / 2, dy * (SIZE / (4 * radius)) + SIZE / 2, draw
        )
        if draw.random() < share:
            value = value + np.float32(draw.uniform(0.05, 0.4)) * grain[here]
        log_level[here] = np.where(inside, value, log_level[here])
    return textures.check_texture(np.clip(np.exp(log_level), textures.LIFT, 255.0), "pile")


def _ramp(x, y, draw):
    """A gentle slope of log radiance across the picture."""
    a, b = draw.normal(0, 0.3, 2)
    size = np.float32(SIZE)
    return (np.float32(a) * (x / size - 0.5) + np.float32(b) * (y / size - 0.5)).astype(np.float32)
