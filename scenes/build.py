"""What worlds are made of: painted shapes and lamps, and the light levels at which they can be
shown.

A world is described once. At the level "emissive" every surface shows its picture as radiance; at
"baked" and "path" the same pictures are albedo and the world's lamps light them (see
codesign.render.light). Metres, z up, radiance on the 0..255 scale.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from codesign import backend
from codesign.checks import check_positive
from codesign.errors import DomainError
from codesign.render import MitsubaScene, light
from codesign.render.charts import emissive_mesh
from scenes import bodies, textures

GAP_M = 1e-3  # between things that rest on each other: shapes never interpenetrate
WHITE = 0.95  # albedo of a picture's 255


@dataclass(frozen=True)
class Paint:
    """What is on a surface. picture: [H, W] radiance 0..255, first row at the top; repeat: times
    along u and v; wrap: how it goes on.

    albedo: of a picture's 255 where the world is lit. glow: uniform radiance that the surface emits
      there, on top of what it reflects.
    """

    picture: Any
    repeat: tuple[float, float] = (1.0, 1.0)
    wrap: str = "mirror"
    albedo: float = WHITE
    glow: float = 0.0


@dataclass(frozen=True)
class World:
    """Shapes (name -> (geometry, Paint)) that every level shows; background: sky that every level
    shows;
    lamps: Mitsuba lights of the lit levels; texel_m: size of baked light-map texels that suits its
      things.
    two_sided: whether surfaces show from behind what they show from in front, or where it is lit
      reflect there too."""

    shapes: dict[str, tuple[Any, Paint]]
    background: dict[str, Any] = field(default_factory=dict)
    lamps: dict[str, Any] = field(default_factory=dict)
    texel_m: float = 0.08  # of baked light
    two_sided: bool = False


Light = Callable[[World, str], Any]


def emissive(world, device="cpu"):
    """The world with its pictures as radiance: one ray cast and one lookup per ray, no shading but
    what the pictures hold."""
    mi = backend.mitsuba(device)
    shapes = {}
    for name, (geometry, paint) in world.shapes.items():
        if isinstance(geometry, bodies.Body):
            shapes[name] = _glowing(mi, name, geometry, paint)
        else:
            shapes[name] = {**geometry, "emitter": _glow(mi, paint)}
    scene = MitsubaScene({**shapes, **world.background}, device)
    return scene.two_sided() if world.two_sided else scene


def baked(world, device="cpu", **options):
    """The world lit by its lamps, worked out once; options go to light.bake."""
    return light.bake(
        lit(world, device, world.two_sided), device, **{"texel_m": world.texel_m, **options}
    )


def path(world, device="cpu", **options):
    """The world lit by its lamps, by path tracing for every camera ray; options go to
    light.PathScene."""
    return light.PathScene(lit(world, device, world.two_sided), device, **options)


LEVELS: dict[str, Light] = {"emissive": emissive, "baked": baked, "path": path}


def lit(world, device="cpu", two_sided=False):
    """Mitsuba description of the world as Lambertian surfaces with lamps; meshes reflect on both
    sides where ``two_sided``."""
    mi = backend.mitsuba(device)
    shapes = {}
    for name, (geometry, paint) in world.shapes.items():
        if isinstance(geometry, bodies.Body):
            shapes[name] = _lit_body(mi, name, geometry, paint, two_sided)
            continue
        shapes[name] = {
            **geometry,
            "bsdf": {"type": "diffuse", "reflectance": _reflectance(mi, name, paint)},
        }
        if paint.glow:
            radiance = {"type": "rgb", "value": float(paint.glow)}
            shapes[name]["emitter"] = {"type": "area", "radiance": radiance}
    return {**shapes, **world.background, **world.lamps}


def _check_albedo(name, brightest):
    if not 0 <= brightest <= 1:
        raise DomainError(
            f"shape '{name}': its brightest texel would have albedo {brightest:.3g}; albedos lie in 0..1."
        )


def _glowing(mi, name, body, paint):
    """A body as it shows its paint: by its texture coordinates, or, where it has none, shaded by a
    plain sky."""
    triangles = mi, body.vertices_m, body.faces
    if body.uv is not None:
        return emissive_mesh(*triangles, _glow(mi, paint), body.uv)
    level = _level(name, paint) * body.tint * bodies.skylight(body)
    if not body.smooth:
        return emissive_mesh(*triangles, level)
    source = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_radiance"}}
    mesh = emissive_mesh(*triangles, source)
    mesh.add_attribute("vertex_radiance", 1, np.float32(level))
    return mesh


def _glow(mi, paint):
    return {"type": "area", "radiance": _bitmap(mi, paint, 1.0)}


def _lit_body(mi, name, body, paint, two_sided):
    if body.uv is not None:
        reflectance = _reflectance(mi, name, paint)
    else:
        albedo = paint.albedo * _level(name, paint) / 255 * body.tint
        _check_albedo(name, float(np.max(albedo)))
        attribute = "vertex_albedo" if body.smooth else "face_albedo"
        reflectance = (
            {"type": "rgb", "value": float(albedo)}
            if np.ndim(albedo) == 0
            else {"type": "mesh_attribute", "name": attribute}
        )
    bsdf = {"type": "diffuse", "reflectance": reflectance}
    bsdf = {"type": "twosided", "material": bsdf} if two_sided else bsdf
    mesh = emissive_mesh(mi, body.vertices_m, body.faces, None, body.uv, bsdf=bsdf)
    if body.uv is None and np.ndim(albedo):
        mesh.add_attribute(attribute, 1, np.float32(albedo))
    return mesh


def _reflectance(mi, name, paint):
    _check_albedo(name, paint.albedo * float(np.max(paint.picture)) / 255)
    return _bitmap(mi, paint, paint.albedo / 255)


def _level(name, paint):
    return float(textures.check_texture(paint.picture, f"of '{name}'").mean())


def _bitmap(mi, paint, scale):
    # Mitsuba puts the first row at v = 0, the bottom
    upright = (scale * textures.check_texture(paint.picture, "of the scene"))[::-1, :, None]
    to_uv = mi.ScalarTransform3f().scale([float(n) for n in paint.repeat])
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(upright, dtype=np.float32)),
        "raw": True,
        "wrap_mode": paint.wrap,
        "to_uv": to_uv,
    }


# ---- geometry


def check_sizes(what, **sizes):
    """Raise DomainError unless every size is positive and finite."""
    for name, value in sizes.items():
        check_positive(value, f"{what}: {name}")


def rectangle(mi, centre, normal_to, width_m, height_m, up=(0, 0, 1)):
    """A rectangle at ``centre`` facing ``normal_to``; its picture stands upright along ``up``."""
    check_sizes("rectangle", width_m=width_m, height_m=height_m)
    frame = mi.ScalarTransform4f().look_at(
        origin=list(centre), target=list(normal_to), up=list(up)
    ) @ mi.ScalarTransform4f().scale([width_m / 2, height_m / 2, 1])
    return {"type": "rectangle", "to_world": frame}


def sides(mi, size_m, y=0.0):
    """Six inner sides, by name, of a box of three sizes that stands on z = 0 over (0, y)."""
    width, length, height = size_m
    half, up = height / 2, (0, 1, 0)
    around = {
        "north": ((0, y + length / 2, half), width),
        "south": ((0, y - length / 2, half), width),
        "east": ((width / 2, y, half), length),
        "west": ((-width / 2, y, half), length),
    }
    walls = {
        name: rectangle(mi, at, (0, y, half), wide, height) for name, (at, wide) in around.items()
    }
    for name, z in (("floor", 0), ("ceiling", height)):
        walls[name] = rectangle(mi, (0, y, z), (0, y, half), width, length, up)
    return walls


def block(mi, x, y, bottom_m, half_m, turn_deg=0.0):
    """A cuboid of half sizes ``half_m`` (three numbers) that stands GAP_M over ``bottom_m``."""
    check_sizes("block", **dict(zip(("half_x_m", "half_y_m", "half_z_m"), half_m, strict=True)))
    T = mi.ScalarTransform4f
    return {
        "type": "cube",
        "to_world": T()
        .translate([x, y, bottom_m + GAP_M + half_m[2]])
        .rotate([0, 0, 1], turn_deg)
        .scale(list(half_m)),
    }


def ball(mi, x, y, bottom_m, radius_m):
    """A sphere that rests GAP_M over ``bottom_m``."""
    check_sizes("ball", radius_m=radius_m)
    return {
        "type": "sphere",
        "to_world": mi.ScalarTransform4f()
        .translate([x, y, bottom_m + GAP_M + radius_m])
        .scale(radius_m),
    }


def pole(mi, start, end, radius_m):
    """A cylinder and the disk that closes its far end, as two geometries. start, end: its axis."""
    start = np.array(start, dtype=float)
    end = np.array(end, dtype=float)
    length = float(np.linalg.norm(end - start))
    check_sizes("pole", radius_m=radius_m, length=length)
    helper = [0, 0, 1] if abs(end[2] - start[2]) < 0.9 * length else [1, 0, 0]
    T = mi.ScalarTransform4f
    tube = T().look_at(origin=start.tolist(), target=end.tolist(), up=helper) @ T().scale(
        [radius_m, radius_m, length]
    )
    cap = T().look_at(
        origin=end.tolist(), target=(2 * end - start).tolist(), up=helper
    ) @ T().scale([radius_m, radius_m, 1])
    return {"type": "cylinder", "to_world": tube}, {"type": "disk", "to_world": cap}


def sky(mi, picture):
    """Environment map of an equirectangular picture [H, W], first row at the zenith; columns run
    from +y over +x, as on a compass."""
    values = textures.check_texture(picture, "of the sky")
    bitmap = mi.Bitmap(np.ascontiguousarray(np.repeat(values[..., None], 3, 2)))
    return {
        "type": "envmap",
        "bitmap": bitmap,
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
    }


def sun(irradiance):
    """Parallel light from where the procedural sky has its sun."""
    elevation = math.radians(textures.SUN_ELEVATION_DEG)
    azimuth = math.radians(textures.SUN_AZIMUTH_DEG)
    level = -math.cos(elevation)
    towards = [level * math.sin(azimuth), level * math.cos(azimuth), -math.sin(elevation)]
    return {
        "type": "directional",
        "direction": towards,
        "irradiance": {"type": "rgb", "value": irradiance},
    }
