"""Worlds: a checkerboard, a textured wall, a textured room, textured ground, a smooth plane. Metres; z is up; radiance on the 0..255 scale."""

import numpy as np

from codesign import backend
from codesign.render import MitsubaScene, TexturedPlane
from scenes import textures


def _emitter(mi, texture, repeat=(1.0, 1.0), wrap="mirror"):
    upright = textures.check_texture(texture, "of the scene")[::-1, :, None]  # Mitsuba puts the first row at v = 0, the bottom
    bitmap = mi.Bitmap(np.ascontiguousarray(upright))
    scale = mi.ScalarTransform3f().scale([float(repeat[0]), float(repeat[1])])
    return {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": wrap, "to_uv": scale}}


def _rectangle(mi, texture, centre, normal_to, width, height, up, repeat=(1.0, 1.0), wrap="mirror"):
    """A rectangle at ``centre`` facing ``normal_to``."""
    frame = mi.ScalarTransform4f().look_at(origin=list(centre), target=list(normal_to), up=list(up)) @ mi.ScalarTransform4f().scale([width / 2, height / 2, 1])
    return {"type": "rectangle", "to_world": frame, "emitter": _emitter(mi, texture, repeat, wrap)}


def wall(texture, texel_m=0.002, half_width_m=8.0, wrap="mirror", device="cpu"):
    """One endless-looking wall, the plane y = 0 seen from y < 0, tiled (wrap "mirror" or "repeat") with a texture at ``texel_m`` per texel."""
    mi = backend.mitsuba(device)
    repeat = [2 * half_width_m / (texel_m * n) for n in (texture.shape[1], texture.shape[0])]
    return MitsubaScene({"wall": _rectangle(mi, texture, (0, 0, 0), (0, -1, 0), 2 * half_width_m, 2 * half_width_m, (0, 0, 1), repeat, wrap)}, device)


def checkerboard(square_m=0.1, device="cpu"):
    """The seed project's scene: a checkerboard wall, to be seen by a camera that translates."""
    return wall(textures.checkerboard(), square_m / 32, wrap="repeat", device=device)


def ground(texture, texel_m=0.004, half_width_m=12.0, device="cpu"):
    """Textured ground, the plane z = 0 seen from above."""
    mi = backend.mitsuba(device)
    repeat = [2 * half_width_m / (texel_m * n) for n in (texture.shape[1], texture.shape[0])]
    return MitsubaScene({"ground": _rectangle(mi, texture, (0, 0, 0), (0, 0, 1), 2 * half_width_m, 2 * half_width_m, (0, 1, 0), repeat)}, device)


def room(photos=("brick", "gravel", "grass", "camera", "coffee", "astronaut"), size_m=(4.0, 4.0, 2.6), objects=True, device="cpu"):
    """A room with photographs on its four walls, floor and ceiling, and two crates and a ball when ``objects``.

    Every picture fades to one wall colour at its border, so walls meet without a jump of radiance; without objects the image
    has no discontinuities that move, and its interior gradient is the whole gradient. Photographs given by name are softened by
    two texels: at the grain of a photograph bilinear texels have kinks, and gradients, though right, are as rough as the grain.
    """
    mi = backend.mitsuba(device)
    x, y, z = (s / 2 for s in size_m)
    paint = 60.0
    pictures = [textures.faded_to(textures.softened(textures.photo(p), 2.0) if isinstance(p, str) else p, paint) for p in photos]
    sides = [
        ("north", (0, y, z), (0, -y, z), 2 * x, 2 * z, (0, 0, 1)), ("south", (0, -y, z), (0, y, z), 2 * x, 2 * z, (0, 0, 1)),
        ("east", (x, 0, z), (-x, 0, z), 2 * y, 2 * z, (0, 0, 1)), ("west", (-x, 0, z), (x, 0, z), 2 * y, 2 * z, (0, 0, 1)),
        ("floor", (0, 0, 0), (0, 0, 1), 2 * x, 2 * y, (0, 1, 0)), ("ceiling", (0, 0, 2 * z), (0, 0, 0), 2 * x, 2 * y, (0, 1, 0)),
    ]
    shapes = {name: _rectangle(mi, pictures[i % len(pictures)], *rest) for i, (name, *rest) in enumerate(sides)}
    if objects:
        T = mi.ScalarTransform4f
        shapes["crate"] = {"type": "cube", "to_world": T().translate([-0.9, 0.9, 0.3]).rotate([0, 0, 1], 25).scale(0.3), "emitter": _emitter(mi, pictures[0])}
        shapes["box"] = {"type": "cube", "to_world": T().translate([0.8, 1.2, 0.2]).rotate([0, 0, 1], -15).scale([0.35, 0.2, 0.2]), "emitter": _emitter(mi, pictures[1 % len(pictures)])}
        shapes["ball"] = {"type": "sphere", "center": [0.1, 0.5, 0.25], "radius": 0.25, "emitter": _emitter(mi, pictures[2 % len(pictures)])}
    return MitsubaScene(shapes, device)


def smooth_plane(seed=0, T_world_plane=None, **options):
    """A band-limited analytic wall in the plane z = 0 of its frame; options go to textures.waves."""
    return TexturedPlane(*textures.waves(seed, **options), T_world_plane=T_world_plane)
