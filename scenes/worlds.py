"""Worlds: one function each, in metres, z up, radiance on the 0..255 scale. WORLDS names those that
need no argument.

Worlds with a ``light`` argument can be shown at three levels (scenes.build.LEVELS): emissive (their
pictures as radiance), baked and path (their pictures as albedo under their own lamps). Things that
rest on each other keep a gap of 1 mm, and no two shapes interpenetrate. Pictures may be arrays,
paths, names of textures.PHOTOS, or "speckle-<seed>"; those from files are softened by two texels,
because at the grain of a photograph bilinear texels have kinks and gradients, though right, are as
rough as the grain.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from codesign import backend
from codesign.checks import check_choice
from codesign.doors import explain
from codesign.errors import DomainError
from codesign.render import MitsubaScene, TexturedPlane
from scenes import bodies, textures
from scenes.build import (
    GAP_M,
    Light,
    Paint,
    World,
    ball,
    block,
    check_sizes,
    emissive,
    pole,
    rectangle,
    sides,
    sky,
    sun,
)
from scenes.foreign import from_mitsuba, view_of
from scenes.from_mesh import from_mesh
from scenes.tabletop import tabletop

Picture = str | Path | np.ndarray
PAINT = 60.0  # the wall colour that pictures fade to
ROOM_M = (4.0, 4.0, 2.6)
OBJECTS_M = (2.6, 3.0, 0.65)  # the least room that its objects fit into
CORRIDOR_M = (14.0, 2.2, 2.6)  # length, width, height
GROUND_M = 14.0  # half width of the outdoor world
TRIES = 10_000  # to find a place for one more thing there
SPOTS = 10  # of light in the dark room
DARK, BRIGHT = 1.5, 255.0  # radiance there

__all__ = [
    "VIEWS",
    "WORLDS",
    "blank_room",
    "checkerboard",
    "corridor",
    "dark_room",
    "from_mesh",
    "from_mitsuba",
    "ground",
    "outdoor",
    "room",
    "smooth_plane",
    "tabletop",
    "view_of",
    "wall",
]


def wall(
    texture: Picture,
    texel_m: float = 0.002,
    half_width_m: float = 8.0,
    wrap: str = "mirror",
    device: str = "cpu",
) -> MitsubaScene:
    """One endless-looking wall, the plane y = 0 seen from y < 0, tiled (wrap "mirror" or "repeat")
    with a picture (an array, a path such as "photo.jpg", or a name) at ``texel_m`` per texel, of a
    file: per pixel of the file. The first tile begins at the wall's corner, x = -half_width_m."""
    return _plane("wall", texture, texel_m, half_width_m, (0, -1, 0), (0, 0, 1), wrap, device)


def checkerboard(square_m: float = 0.1, device: str = "cpu") -> MitsubaScene:
    """The seed project's scene: a checkerboard wall, to be seen by a camera that translates."""
    return wall(textures.checkerboard(), square_m / 32, wrap="repeat", device=device)


def ground(
    texture: Picture, texel_m: float = 0.004, half_width_m: float = 12.0, device: str = "cpu"
) -> MitsubaScene:
    """Textured ground, the plane z = 0 seen from above."""
    return _plane("ground", texture, texel_m, half_width_m, (0, 0, 1), (0, 1, 0), "mirror", device)


def _plane(name, texture, texel_m, half_width_m, towards, up, wrap, device):
    check_sizes(name, texel_m=texel_m, half_width_m=half_width_m)
    check_choice(wrap, f"{name}: wrap", ("mirror", "repeat"))
    size = None
    if isinstance(texture, str | Path):
        # a damaged file gets the sentence of the picture
        texture, size = textures.picture(texture), textures.file_size(texture)
    else:
        texture = textures.check_texture(texture, "of the scene")
    height, width = size or texture.shape
    side_m = 2 * half_width_m
    repeat = (side_m / (texel_m * width), side_m / (texel_m * height))
    shape = rectangle(backend.mitsuba(device), (0, 0, 0), towards, side_m, side_m, up)
    return emissive(World({name: (shape, Paint(texture, repeat, wrap))}), device)


def _walls(mi, paints, size_m):
    return {
        name: (side, paint)
        for (name, side), paint in zip(sides(mi, size_m).items(), paints, strict=True)
    }


def room(
    photos: Sequence[Picture] = ("brick", "gravel", "grass", "camera", "coffee", "astronaut"),
    size_m: Sequence[float] = ROOM_M,
    objects: bool = True,
    device: str = "cpu",
    light: Light = emissive,
) -> Any:
    """A room with photographs on its four walls, floor and ceiling, and two crates and a ball when
    ``objects``.

    Every picture fades to one wall colour at its border, so walls meet without a jump of radiance;
    without objects the image has no discontinuities that move, and its interior gradient is the
    whole gradient. Where it is lit, its ceiling is the lamp. Raises: DomainError for a room that its
    objects do not fit into.
    """
    if objects and any(size < least for size, least in zip(size_m, OBJECTS_M, strict=True)):
        raise DomainError(
            f"room: its objects need {' x '.join(map(str, OBJECTS_M))} m, got {' x '.join(map(str, size_m))} m; "
            "make it larger, or leave them out with objects=False."
        )
    if not photos:
        raise DomainError("room: there are no photos; give at least one picture.")
    mi = backend.mitsuba(device)
    pictures = [textures.faded_to(textures.picture(p), PAINT) for p in photos]
    paints = [Paint(pictures[i % len(pictures)], glow=250.0 * (i == 5)) for i in range(6)]
    shapes = _walls(mi, paints, size_m)
    if objects:
        shapes["crate"] = (block(mi, -0.9, 0.9, 0.0, (0.3, 0.3, 0.3), 25), Paint(pictures[0]))
        box = block(mi, 0.8, 1.2, 0.0, (0.35, 0.2, 0.2), -15)
        shapes["box"] = (box, Paint(pictures[1 % len(pictures)]))
        shapes["ball"] = (ball(mi, 0.1, 0.5, 0.0, 0.25), Paint(pictures[2 % len(pictures)]))
    return light(World(shapes), device)


def blank_room(
    level: float = PAINT,
    size_m: Sequence[float] = ROOM_M,
    device: str = "cpu",
    light: Light = emissive,
) -> Any:
    """A closed room whose every surface has one radiance: the negative control, in which no motion
    makes an event.

    Where it is lit it stays so: its walls reflect a half and emit the other half of their radiance
    (a white furnace).
    """
    even = Paint(
        np.full((8, 8), level, dtype=np.float32),
        albedo=0.5 * 255 / level if level > 0 else 0.0,
        glow=level / 2,
    )
    return light(World(_walls(backend.mitsuba(device), [even] * 6, size_m)), device)


def corridor(device: str = "cpu", light: Light = emissive) -> Any:
    """A corridor along +y, entered at y = 0, with pillars on both sides. Luminous ceiling where it
    is lit."""
    mi = backend.mitsuba(device)
    length_m, width_m, height_m = CORRIDOR_M
    side, floor, column = (textures.picture(p) for p in ("brick", "gravel", "speckle-4"))
    bright = textures.softened(textures.speckle(9, finest_px=24.0, contrast=0.1), 4.0)
    along, across = length_m / height_m, width_m / height_m
    walls = sides(mi, (width_m, length_m, height_m), length_m / 2)
    shapes = {
        "west": (walls["west"], Paint(side, (along, 1))),
        "east": (walls["east"], Paint(side, (along, 1))),
        "floor": (walls["floor"], Paint(floor, (across, along))),
        "ceiling": (walls["ceiling"], Paint(bright, (across, along), glow=250.0)),
        "end": (walls["north"], Paint(column)),
        "start": (walls["south"], Paint(column)),
    }
    for k, y in enumerate(np.arange(2.0, length_m - 0.5, 2.0)):
        for x in (-1, 1):
            half = (0.08, 0.12, height_m / 2 - GAP_M)
            shapes[f"pillar-{k}{'w' if x < 0 else 'e'}"] = (
                block(mi, x * (width_m / 2 - half[0] - GAP_M), y, 0.0, half),
                Paint(column, (0.3, 3)),
            )
    return light(World(shapes), device)


def outdoor(
    seed: int = 0,
    clutter: int = 48,
    environment: str | Path | None = None,
    meshes: Sequence[tuple[Any, ...]] = (),
    device: str = "cpu",
    light: Light = emissive,
) -> Any:
    """Open ground with crates, balls and posts under a sky; a clear lane along x = 0 to drive or
    fly in.

    Args:
      clutter: how many things.
      environment: path of an equirectangular .hdr or .exr map; None is a procedural sky with a sun.
      meshes: robot bodies as (path, x, y, turn_deg) or (path, x, y, turn_deg, scale), each resting
        on the ground. Where it is lit, the sky lights it, with a sun of its own when the sky is
        procedural. The sky lies at infinity: no point of it has a depth.
    Raises: DomainError where the ground has no place for so many things.
    """
    mi = backend.mitsuba(device)
    random = np.random.default_rng(seed)
    tile = 512 * 0.012
    shapes: dict = {
        "ground": (
            rectangle(mi, (0, 0, 0), (0, 0, 1), 2 * GROUND_M, 2 * GROUND_M, (0, 1, 0)),
            Paint(textures.picture("gravel"), (2 * GROUND_M / tile, 2 * GROUND_M / tile)),
        )
    }
    pictures = [textures.picture(p) for p in ("brick", "speckle-1", "speckle-2", "grass")]
    places = []
    for k, (path, x, y, turn_deg, *scale) in enumerate(meshes):
        body = bodies.read(path, *scale).placed(x, y, GAP_M, turn_deg)
        shapes[f"body-{k}"] = (body, Paint(np.full((4, 4), 120.0)))
        places.append((float(x), float(y), float(np.ptp(body.vertices_m[:, :2], axis=0).max()) / 2))
    tries = 0
    while len(places) < clutter + len(meshes):
        if tries == TRIES:
            raise DomainError(
                f"outdoor: the ground has no place for {clutter} things, {len(places) - len(meshes)} are there; "
                "give a smaller clutter."
            )
        tries += 1
        x, y = random.uniform(-0.5, 0.5, 2) * GROUND_M
        size = random.uniform(0.15, 0.5)
        if abs(x) < 0.7 + 1.5 * size or any(
            math.hypot(x - px, y - py) < 1.8 * (size + other) for px, py, other in places
        ):
            continue
        k = len(places)
        tries = 0
        places.append((x, y, size))
        paint = Paint(pictures[k % 4])
        if k % 3 == 0:
            half = (size, size, size * random.uniform(0.6, 1.6))
            shapes[f"crate-{k}"] = (block(mi, x, y, 0.0, half, random.uniform(0, 90)), paint)
        elif k % 3 == 1:
            shapes[f"ball-{k}"] = (ball(mi, x, y, 0.0, size), paint)
        else:
            top = (x, y, random.uniform(1.2, 3.0))
            tube, cap = pole(mi, (x, y, GAP_M), top, 0.03 + 0.1 * size)
            shapes[f"post-{k}"] = (tube, replace(paint, repeat=(1, 4)))
            shapes[f"cap-{k}"] = (cap, Paint(np.full((4, 4), 90.0)))
    above = textures.sky(seed) if environment is None else textures.environment(environment)
    lamps = {"sun": sun(800.0)} if environment is None else {}
    return light(World(shapes, {"sky": sky(mi, above)}, lamps, texel_m=0.08), device)


def dark_room(seed: int = 0, device: str = "cpu", light: Light = emissive) -> Any:
    """A room near darkness (mean radiance DARK) with a few small bright balls in the air, placed at
    random without touching."""
    mi = backend.mitsuba(device)
    random = np.random.default_rng(seed)
    paints = []
    for k in range(6):
        speckle = textures.speckle(seed + k, finest_px=16.0, contrast=0.35)
        dim = textures.faded_to(textures.softened(speckle, 2.0), PAINT) * (DARK / PAINT)
        paints.append(Paint(dim, albedo=0.25 * 255 / float(dim.max())))
    shapes = _walls(mi, paints, ROOM_M)
    low, high = np.array([-1.6, -1.6, 0.4]), np.array([1.6, 1.6, ROOM_M[2] - 0.4])
    places = []
    while len(places) < SPOTS:
        place = random.uniform(low, high)
        if (
            all(np.linalg.norm(place - other) > 0.4 for other in places)
            and np.linalg.norm(place - [0, -1.2, 1.3]) > 0.7
        ):
            places.append(place)
            radius = random.uniform(0.015, 0.04)
            shapes[f"spot-{len(places)}"] = (
                ball(mi, *map(float, place), radius),
                Paint(np.full((4, 4), BRIGHT, dtype=np.float32), albedo=0.0, glow=BRIGHT),
            )
    return light(World(shapes), device)


def smooth_plane(
    seed: int = 0,
    T_world_plane: Tensor | None = None,
    **options: Any,
) -> TexturedPlane:
    """A band-limited analytic wall in the plane z = 0 of its frame; options go to
    textures.waves."""
    return TexturedPlane(*textures.waves(seed, **options), T_world_plane=T_world_plane)


WORLDS = {
    "checkerboard": checkerboard,
    "room": room,
    "corridor": corridor,
    "outdoor": outdoor,
    "tabletop": tabletop,
    "blank-room": blank_room,
    "dark-room": dark_room,
}
# where a camera of about 45 degrees stands, and what it looks at, to see what a world has
VIEWS = {
    "checkerboard": ((0.13, -2.0, 0.08), (0.13, 0.0, 0.08)),
    "room": ((0.4, -1.5, 1.3), (-0.1, 1.0, 0.7)),
    "corridor": ((0.2, 0.6, 1.4), (-0.1, 8.0, 1.2)),
    "outdoor": ((0.0, -7.5, 1.6), (0.0, 0.0, 0.9)),
    "tabletop": ((0.3, -1.0, 1.25), (0.0, 0.05, 0.78)),
    "blank-room": ((0.4, -1.5, 1.3), (-0.1, 1.0, 0.7)),
    "dark-room": ((0.0, -1.5, 1.3), (0.0, 1.0, 1.1)),
}

explain(globals())
