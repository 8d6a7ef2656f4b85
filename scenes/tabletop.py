"""A table with many small things on it, seen from near: silhouettes everywhere."""

import math
from typing import Any

import numpy as np

from codesign import backend
from scenes import textures
from scenes.build import GAP_M, Light, Paint, World, ball, block, emissive, pole, sides

# height and thickness of the table top
TOP_M = 0.75
THICK_M = 0.04
HALF_X_M = 0.7
HALF_Y_M = 0.45
SPACING_M = 0.012  # least gap between things on the table
CUBES = SPHERES = 7
POLES = 8
POSTS = 14  # of the fence


def tabletop(seed: int = 0, device: str = "cpu", light: Light = emissive) -> Any:
    """A table of 1.4 m x 0.9 m in a room, with cubes, spheres, thin poles and a fence, placed at
    random without touching.

    Poles are 5 to 8 mm thick, fence posts 8 mm; the fence stands along the table's far side. The
    ceiling is the lamp where the world is lit.
    """
    mi = backend.mitsuba(device)
    random = np.random.default_rng(seed)
    wood = textures.softened(
        textures.speckle(seed + 5, finest_px=12.0, coarsest_px=48.0, contrast=0.2), 3.0
    )
    shapes = {**_surroundings(mi), **_table(mi, wood)}
    patterns = []
    for k, scale in enumerate((0.5, 1.0, 1.6, 2.2)):
        speckle = textures.speckle(seed + 20 + k, 128, finest_px=20.0, contrast=0.25)
        patterns.append(np.clip(scale * textures.softened(speckle, 2.0), 1, 255))
    places = []
    for k in range(CUBES + SPHERES + POLES):
        slim = k >= CUBES + SPHERES
        half = random.uniform(0.0025, 0.004) if slim else random.uniform(0.018, 0.05)
        x, y = _free(random, places, half * math.sqrt(2) if k < CUBES else half)
        pattern = patterns[k % len(patterns)]
        if k < CUBES:
            cube = block(mi, x, y, TOP_M, (half, half, half), random.uniform(0, 90))
            shapes[f"cube-{k}"] = (cube, Paint(pattern))
        elif not slim:
            shapes[f"sphere-{k}"] = (ball(mi, x, y, TOP_M, half), Paint(pattern))
        else:
            top = (x, y, TOP_M + random.uniform(0.12, 0.3))
            tube, cap = pole(mi, (x, y, TOP_M + GAP_M), top, half)
            shapes[f"pole-{k}"] = (tube, Paint(pattern, (0.2, 2)))
            shapes[f"pole-cap-{k}"] = (cap, Paint(np.full((4, 4), 80.0)))
    return light(World({**shapes, **_fence(mi, patterns[3])}, texel_m=0.03), device)


def _surroundings(mi):
    """A room of 5 m about the table, its pictures fading to one colour."""
    back = textures.faded_to(textures.picture("brick"), 60.0)
    speckle = textures.speckle(3, finest_px=40.0, coarsest_px=160.0, contrast=0.3)
    plain = textures.faded_to(textures.softened(speckle, 3.0), 60.0)
    paints = {"north": Paint(back), "ceiling": Paint(plain, glow=250.0)}
    walls = sides(mi, (5.0, 5.0, 2.6))
    order = ("floor", "ceiling", "north", "south", "east", "west")
    return {name: (walls[name], paints.get(name, Paint(plain))) for name in order}


def _table(mi, wood):
    top = block(mi, 0, 0, TOP_M - THICK_M - GAP_M, (HALF_X_M, HALF_Y_M, THICK_M / 2))
    shapes = {"top": (top, Paint(wood))}
    half = (0.025, 0.025, (TOP_M - THICK_M - 3 * GAP_M) / 2)
    for k, (x, y) in enumerate(((-1, -1), (1, -1), (-1, 1), (1, 1))):
        leg = block(mi, x * (HALF_X_M - 0.05), y * (HALF_Y_M - 0.05), 0.0, half)
        shapes[f"leg-{k}"] = (leg, Paint(wood, (0.1, 1)))
    return shapes


def _fence(mi, picture):
    """Posts in a row and two rails behind them, a gap apart."""
    shapes = {}
    y = HALF_Y_M - 0.06
    width = 2 * (HALF_X_M - 0.08)
    for k in range(POSTS):
        x = -width / 2 + width * k / (POSTS - 1)
        post = block(mi, x, y, TOP_M, (0.004, 0.004, 0.07))
        shapes[f"post-{k}"] = (post, Paint(picture, (0.1, 1)))
    for k, z in enumerate((0.04, 0.11)):
        rail = block(mi, 0.0, y + 0.008 + GAP_M, TOP_M + z, (width / 2 + 0.01, 0.004, 0.006))
        shapes[f"rail-{k}"] = (rail, Paint(picture, (3, 0.1)))
    return shapes


def _free(random, places, radius):
    """A place on the table, clear of the edge, the fence and all earlier things; it is added to
    ``places``."""
    while True:
        x = random.uniform(-HALF_X_M + 0.08, HALF_X_M - 0.08)
        y = random.uniform(-HALF_Y_M + 0.08, HALF_Y_M - 0.14)
        if all(math.hypot(x - px, y - py) > radius + other + SPACING_M for px, py, other in places):
            places.append((x, y, radius))
            return x, y
