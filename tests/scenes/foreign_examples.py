"""Five scenes as other people write them in Mitsuba: y up, white at 1, surfaces that shine, mirror
and let light through, lamps of every kind. They need no files and stand for those that come from
elsewhere."""

from collections.abc import Callable
from typing import Any

import numpy as np

from codesign import backend
from codesign.render.charts import emissive_mesh
from scenes import textures


def cornell() -> dict[str, Any]:
    """Mitsuba's own Cornell box: coloured walls, two cubes, an area lamp."""
    return backend.mitsuba().cornell_box()


def terrace() -> dict[str, Any]:
    """A tiled floor, a glossy vase of triangles, a ball of `principled` and a table of two-sided
    sheets under a sky from a picture."""
    mi = backend.mitsuba()
    T = mi.ScalarTransform4f()
    wood = {"type": "principled", "base_color": _picture(mi, 3), "roughness": 0.6, "specular": 0.4}
    vase = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": _rgb(0.7, 0.2, 0.1)}
    return {
        "sensor": _sensor(mi, [1.6, 1.5, 2.4], [0, 0.35, 0], 45),
        "floor": _sheet(
            mi,
            [0, 0, 0],
            [0, 1, 0],
            6,
            {"type": "diffuse", "reflectance": _picture(mi, 1, tiles=3)},
        ),
        "top": _sheet(mi, [0, 0.5, 0], [0, 1, 0], 0.9, {"type": "twosided", "bsdf": wood}),
        "back": _sheet(
            mi, [0, 0.25, -0.4], [0, 0, 1], 0.45, {"type": "twosided", "bsdf": _grey(0.6)}
        ),
        "vase": _turned(mi, [0.15, 0.501, 0.05], vase),
        "ball": {
            "type": "sphere",
            "to_world": T.translate([-0.22, 0.621, 0.1]).scale(0.12),
            "bsdf": {
                "type": "principled",
                "base_color": _rgb(0.2, 0.4, 0.8),
                "roughness": 0.4,
                "clearcoat": 0.5,
            },
        },
        "sky": {"type": "envmap", "bitmap": _sky(mi), "scale": 1.0},
    }


def cellar() -> dict[str, Any]:
    """A closed room of two-sided walls, a textured cube, a pillar and a mesh, lit by a point lamp
    and a spot."""
    mi = backend.mitsuba()
    T = mi.ScalarTransform4f()
    wall = {"type": "twosided", "bsdf": _grey(0.7)}
    painted = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _picture(mi, 2)}}
    return {
        "sensor": _sensor(mi, [0.3, 1.4, 1.8], [-0.1, 0.8, -1], 65),
        "floor": _sheet(mi, [0, 0, 0], [0, 1, 0], 4, painted),
        "ceiling": _sheet(mi, [0, 2.4, 0], [0, 1, 0], 4, wall),
        "north": _sheet(mi, [0, 1.2, -2], [0, 0, 1], 4, painted),
        "south": _sheet(mi, [0, 1.2, 2], [0, 0, 1], 4, wall),
        "west": _sheet(mi, [-2, 1.2, 0], [1, 0, 0], 4, wall),
        "east": _sheet(mi, [2, 1.2, 0], [1, 0, 0], 4, wall),
        "crate": {
            "type": "cube",
            "to_world": T.translate([-0.6, 0.302, -0.6]).rotate([0, 1, 0], 30).scale(0.3),
            "bsdf": {"type": "plastic", "diffuse_reflectance": _picture(mi, 4)},
        },
        "pillar": {
            "type": "cylinder",
            "p0": [0.7, 0.001, -0.9],
            "p1": [0.7, 2.399, -0.9],
            "radius": 0.12,
            "bsdf": _grey(0.4),
        },
        "vase": _turned(mi, [0.2, 0.001, -0.3], _grey(0.8)),
        "bulb": {"type": "point", "position": [-0.5, 2.0, 0.3], "intensity": _rgb(2.0, 1.8, 1.4)},
        "spot": {
            "type": "spot",
            "to_world": T.look_at(origin=[1.2, 2.2, 0.8], target=[-0.3, 0.3, -0.8], up=[0, 0, 1]),
            "intensity": _rgb(6.0, 6.0, 6.0),
            "cutoff_angle": 30,
        },
    }


def mirrors() -> dict[str, Any]:
    """The cellar with a mirror on its wall, a ball of glass and one of rough metal."""
    mi = backend.mitsuba()
    return cellar() | {
        "mirror": _sheet(
            mi, [-1.99, 1.2, -0.6], [1, 0, 0], 1.0, {"type": "conductor", "material": "Ag"}
        ),
        "glass": {
            "type": "sphere",
            "center": [0.1, 0.222, 0.3],
            "radius": 0.22,
            "bsdf": {"type": "dielectric"},
        },
        "metal": {
            "type": "sphere",
            "center": [-0.6, 0.803, -0.6],
            "radius": 0.2,
            "bsdf": {"type": "roughconductor", "material": "Cu", "alpha": 0.2},
        },
    }


def market() -> dict[str, Any]:
    """What exporters write: bumps, blends and masks on meshes and sheets, beside a sun and an even
    sky."""
    mi = backend.mitsuba()
    T = mi.ScalarTransform4f()
    bumps = {
        "type": "bumpmap",
        "arbitrary": _picture(mi, 5, tiles=2),
        "scale": 0.02,
        "bsdf": _grey(0.6),
    }
    blend = {
        "type": "blendbsdf",
        "weight": _picture(mi, 6),
        "a": _grey(0.7),
        "b": {"type": "roughplastic"},
    }
    leaves = {
        "type": "mask",
        "opacity": _picture(mi, 7),
        "bsdf": {"type": "twosided", "bsdf": _grey(0.4)},
    }
    return {
        "sensor": _sensor(mi, [1.2, 1.2, 2.6], [0, 0.5, 0], 42),
        "ground": _sheet(mi, [0, 0, 0], [0, 1, 0], 5, bumps),
        "stall": {
            "type": "cube",
            "to_world": T.translate([-0.5, 0.402, -0.2]).scale([0.3, 0.4, 0.3]),
            "bsdf": blend,
        },
        "vase": _turned(
            mi, [0.35, 0.001, 0.2], {"type": "principled", "base_color": _rgb(0.3, 0.6, 0.3)}
        ),
        "hedge": _sheet(mi, [0.4, 0.5, -0.7], [0, 0, 1], 0.9, leaves),
        "sun": {
            "type": "directional",
            "direction": [0.4, -1.0, -0.5],
            "irradiance": _rgb(2.0, 1.9, 1.7),
        },
        "sky": {"type": "constant", "radiance": _rgb(0.3, 0.35, 0.45)},
    }


FOREIGN: dict[str, Callable[[], dict[str, Any]]] = {
    "cornell": cornell,
    "terrace": terrace,
    "cellar": cellar,
    "mirrors": mirrors,
    "market": market,
}


def _rgb(*value):
    return {"type": "rgb", "value": list(value)}


def _grey(albedo):
    return {"type": "diffuse", "reflectance": _rgb(albedo, albedo, albedo)}


def _picture(mi, seed, tiles=1):
    """A colour picture whose white is 1."""
    values = textures.softened(textures.speckle(seed, 96, finest_px=8.0), 1.5) / 255
    colour = np.stack([np.clip(values * tint, 0.02, 0.95) for tint in (1.0, 0.9, 0.7)], 2)
    to_uv = mi.ScalarTransform3f().scale([tiles, tiles])
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.float32(colour)), "raw": True, "to_uv": to_uv}


def _sky(mi):
    """Radiance 0.2 at the horizon to 1 above, with a bright patch: [H, W, 3]."""
    v, u = np.meshgrid(
        np.linspace(0, np.pi, 64), np.linspace(0, 2 * np.pi, 128, endpoint=False), indexing="ij"
    )
    up = np.cos(v)
    patch = 6 * np.exp(-(((u - 2.0) / 0.4) ** 2) - ((v - 0.8) / 0.3) ** 2)
    grey = np.where(up > 0, 0.3 + 0.7 * up, 0.15) + patch
    return mi.Bitmap(np.float32(grey[..., None] * [0.9, 1.0, 1.1]))


def _sheet(mi, centre, normal, size, bsdf):
    up = [0, 0, -1] if normal[1] else [0, 1, 0]
    target = [c + n for c, n in zip(centre, normal, strict=True)]
    frame = mi.ScalarTransform4f().look_at(origin=centre, target=target, up=up)
    return {
        "type": "rectangle",
        "to_world": frame @ mi.ScalarTransform4f().scale(size / 2),
        "bsdf": bsdf,
    }


def _turned(mi, foot, bsdf):
    """A closed vase of triangles, its axis along y, 0.3 high."""
    import trimesh

    radius = [0, 0.06, 0.09, 0.1, 0.08, 0.05, 0.04, 0.06, 0]
    height = [0, *np.linspace(0, 0.3, 7), 0.3]
    vase = trimesh.creation.revolve(np.stack([radius, height], 1), sections=24)
    upright = vase.vertices[:, [1, 2, 0]] + foot
    return emissive_mesh(mi, upright, vase.faces, None, bsdf=bsdf)


def _sensor(mi, origin, target, fov):
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 320, "height": 240},
    }
