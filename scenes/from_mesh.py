"""Worlds out of mesh files: a room, a street, a scan, a thing, as modelling programs export
them."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from codesign import backend
from codesign.errors import DomainError
from scenes import bodies, mesh_files, textures, units
from scenes.build import LEVELS, Light, Paint, World, sky, sun

SUN_IRRADIANCE = 800.0
TEXELS_ACROSS = 60  # of baked light, along the longest side


def from_mesh(
    path: str | Path,
    *,
    unit_m: float | None = None,
    up: str | None = None,
    root: str | Path | None = None,
    radiance: float | None = None,
    texture_px: int = 1024,
    blur_texels: float = 0.0,
    light: str | Light = "emissive",
    background: Any = None,
    lamps: dict[str, Any] | None = None,
    device: str = "cpu",
) -> Any:
    """The world in a mesh file: .obj with its .mtl, .ply, .stl, .dae, .gltf or .glb, every mesh at
    its place.

    What a material is called base or diffuse colour, times its picture where it has one, is its
    luminance, from 2 (black) to 255 (white): as radiance where ``light`` is "emissive", as albedo
    (255 is 0.95) otherwise. Meshes without texture coordinates show, where nothing is lit, the
    share of a plain sky that each face sees, so that their shape is seen. Gloss, transparency,
    normal maps, lamps and cameras of the file are left.

    Args:
      path, unit_m, up, root: as ``mesh_files.read`` has them.
      radiance: one radiance 0..255 for all; materials and pictures are not read then. What has no
        colour has that of a linear luminance of one half.
      texture_px: most rows and columns of a picture; larger ones are averaged over areas.
        blur_texels: standard deviation of a Gaussian over pictures: detail finer than a pixel makes
        frames and gradients noisy.
      light: "emissive", "baked", "path", or a function as in scenes.build.LEVELS.
      background: what lies at infinity: a number (radiance), a picture [H, W] or the path of an
        equirectangular .hdr or .exr; None is nothing (radiance 0) where ``light`` is "emissive",
        else a procedural sky.
      lamps: Mitsuba lights for "baked" and "path"; None is a sun where the sky is the procedural
        one.
    Returns: a scene for ``render.frames``; z up, metres. Surfaces show on both sides.
    Gradient: to the camera's lens and poses, with silhouettes by gradient="boundary"
      (not at "path").
    Raises: FileFormatError and DomainError as ``mesh_files.read`` and the light level do. Warns in
      a sentence where the size is hardly in metres.
    """
    level = LEVELS.get(light) if isinstance(light, str) else light
    if level is None:
        raise DomainError(f"light = '{light}' is no level; give one of {', '.join(LEVELS)}.")
    if radiance is not None and not 0 <= radiance <= 255:
        raise DomainError(f"radiance = {radiance} must lie in 0..255.")
    if not texture_px >= 1 or not 0 <= blur_texels < float("inf"):
        raise DomainError(
            f"texture_px = {texture_px} must be at least 1 and blur_texels = {blur_texels} at least 0 and finite."
        )
    parts = mesh_files.read(path, unit_m, up, root=root, materials=radiance is None)
    low = np.min([part.vertices_m.min(0) for part in parts], 0)
    high = np.max([part.vertices_m.max(0) for part in parts], 0)
    units.hint(low, high, f"the mesh '{path}'", unit_m or 1.0)
    mi = backend.mitsuba(device)
    above = (
        {} if background is None and level is LEVELS["emissive"] else _background(mi, background)
    )
    if lamps is None:
        lamps = {"sun": sun(SUN_IRRADIANCE)} if background is None else {}
    shapes = shapes_of(parts, radiance, texture_px, blur_texels)
    texel_m = float((high - low).max()) / TEXELS_ACROSS
    return level(World(shapes, above, lamps, texel_m, two_sided=True), device)


def shapes_of(
    parts: list[mesh_files.Part],
    radiance: float | None = None,
    texture_px: int = 1024,
    blur_texels: float = 0.0,
) -> dict[str, tuple[Any, Paint]]:
    """Painted bodies of the parts of a file, by names that Mitsuba takes."""
    shapes = {}
    for number, part in enumerate(parts):
        if part.uv is not None:
            picture = textures.reduced(part.colour, texture_px)
            if blur_texels:
                beside = "wrap" if part.wrap == "repeat" else "nearest"
                picture = textures.softened(picture, blur_texels, beside)
            body = bodies.Body(part.vertices_m, part.faces, part.uv)
            paint = Paint(_radiance(picture), wrap=part.wrap)
        else:
            level, tint = radiance, 1.0
            if radiance is None:
                level, tint = 255.0, _radiance(part.colour) / 255
            body = bodies.Body(part.vertices_m, part.faces, None, tint, part.smooth)
            paint = Paint(np.full((1, 1), level))
        shapes[f"{number}-{re.sub(r'[^A-Za-z0-9_-]', '_', part.name)}"] = (body, paint)
    return shapes


def _radiance(luminance):
    return np.clip(textures.LIFT + (255 - textures.LIFT) * luminance, 0, 255)


def _background(mi, given):
    if isinstance(given, int | float) and not isinstance(given, bool):
        if not 0 <= given < float("inf"):
            raise DomainError(f"background = {given} must be a radiance of at least 0.")
        return {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": float(given)}}}
    if given is None:
        given = textures.sky()
    elif isinstance(given, str | Path):
        given = textures.environment(given)
    return {"sky": sky(mi, given)}
