"""A table with many small things on it, seen from near: silhouettes everywhere."""

import math

import numpy as np

from codesign import backend
from codesign.errors import DomainError
from scenes import textures
from scenes.build import GAP_M, Paint, World, ball, block, emissive, pole, rectangle

# height and thickness of the table top
TOP_M = 0.75
THICK_M = 0.04
HALF_X_M = 0.7
HALF_Y_M = 0.45
SPACING_M = 0.012  # least gap between things on the table


def tabletop(
    seed=0, cubes=7, spheres=7, poles=8, fence_posts=14, photo="brick", device="cpu", light=emissive
):
    """A table of 1.4 m x 0.9 m in a room, with cubes, spheres, thin poles and a fence, placed at random
    without touching.

    Poles are 5 to 8 mm thick, fence posts 8 mm; the fence stands along the table's far side. The ceiling is
    the lamp where the world is lit.
    """
    mi = backend.mitsuba(device)
    random = np.random.default_rng(seed)
    wood = textures.softened(textures.speckle(seed + 5, finest_px=12.0, coarsest_px=48.0, contrast=0.2), 3.0)
    shapes = {**_surroundings(mi, photo), **_table(mi, wood)}
    patterns = [
        textures.softened(textures.speckle(seed + 20 + k, 128, finest_px=20.0, contrast=0.25), 2.0) * scale
        for k, scale in enumerate((0.5, 1.0, 1.6, 2.2))
    ]
    patterns = [np.clip(p, 1, 255) for p in patterns]
    places = []
    for k in range(cubes + spheres + poles):
        half = (
            float(random.uniform(0.018, 0.05))
            if k < cubes + spheres
            else float(random.uniform(0.0025, 0.004))
        )
        x, y = _free(random, places, half * math.sqrt(2) if k < cubes else half)
        paint = Paint(patterns[k % len(patterns)])
        if k < cubes:
            shapes[f"cube-{k}"] = (
                block(mi, x, y, TOP_M, (half, half, half), float(random.uniform(0, 90))),
                paint,
            )
        elif k < cubes + spheres:
            shapes[f"sphere-{k}"] = (ball(mi, x, y, TOP_M, half), paint)
        else:
            tube, cap = pole(
                mi, (x, y, TOP_M + GAP_M), (x, y, TOP_M + float(random.uniform(0.12, 0.3))), half
            )
            shapes[f"pole-{k}"], shapes[f"pole-cap-{k}"] = (
                (tube, Paint(patterns[k % 4], (0.2, 2))),
                (cap, Paint(np.full((4, 4), 80.0))),
            )
    return light(World({**shapes, **_fence(mi, fence_posts, patterns[3])}, texel_m=0.03), device)


def _surroundings(mi, photo):
    """A room of 5 m about the table, its pictures fading to one colour."""
    back = textures.faded_to(textures.picture(photo), 60.0)
    plain = textures.faded_to(
        textures.softened(textures.speckle(3, finest_px=40.0, coarsest_px=160.0, contrast=0.3), 3.0), 60.0
    )
    half = 2.5
    high = 2.6
    shapes = {
        "floor": (rectangle(mi, (0, 0, 0), (0, 0, 1), 5, 5, (0, 1, 0)), Paint(plain)),
        "ceiling": (rectangle(mi, (0, 0, high), (0, 0, 0), 5, 5, (0, 1, 0)), Paint(plain, glow=250.0)),
    }
    for name, x, y in (("north", 0, half), ("south", 0, -half), ("east", half, 0), ("west", -half, 0)):
        shapes[name] = (
            rectangle(mi, (x, y, high / 2), (0, 0, high / 2), 5, high),
            Paint(back if name == "north" else plain),
        )
    return shapes


def _table(mi, wood):
    shapes = {
        "top": (block(mi, 0, 0, TOP_M - THICK_M - GAP_M, (HALF_X_M, HALF_Y_M, THICK_M / 2)), Paint(wood))
    }
    height = TOP_M - THICK_M - 3 * GAP_M
    for k, (x, y) in enumerate(((-1, -1), (1, -1), (-1, 1), (1, 1))):
        shapes[f"leg-{k}"] = (
            block(mi, x * (HALF_X_M - 0.05), y * (HALF_Y_M - 0.05), 0.0, (0.025, 0.025, height / 2)),
            Paint(wood, (0.1, 1)),
        )
    return shapes


def _fence(mi, posts, picture):
    """Posts in a row and two rails behind them, a gap apart."""
    shapes = {}
    y = HALF_Y_M - 0.06
    width = 2 * (HALF_X_M - 0.08)
    for k in range(posts):
        x = -width / 2 + width * k / max(posts - 1, 1)
        shapes[f"post-{k}"] = (block(mi, x, y, TOP_M, (0.004, 0.004, 0.07)), Paint(picture, (0.1, 1)))
    if posts:
        for k, z in enumerate((0.04, 0.11)):
            shapes[f"rail-{k}"] = (
                block(mi, 0.0, y + 0.008 + GAP_M, TOP_M + z, (width / 2 + 0.01, 0.004, 0.006)),
                Paint(picture, (3, 0.1)),
            )
    return shapes


def _free(random, places, radius):
    """A place on the table, clear of the edge, the fence and all earlier things; it is added to
    ``places``."""
    for _ in range(10000):
        x = float(random.uniform(-HALF_X_M + 0.08, HALF_X_M - 0.08))
        y = float(random.uniform(-HALF_Y_M + 0.08, HALF_Y_M - 0.14))
        if all(math.hypot(x - px, y - py) > radius + other + SPACING_M for px, py, other in places):
            places.append((x, y, radius))
            return x, y
    raise DomainError("tabletop: there is no room for so many things; ask for fewer.")
