"""What baked light must know of each surface of a scene: its chart, its sides, whether it shines, its pictures."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from codesign.errors import DomainError
from codesign.render.atlas import Nodes
from codesign.render.charts import Chart, chart_of

LAMBERTIAN = ("DiffuseReflection", "FrontSide", "BackSide", "SpatiallyVarying")


@dataclass(frozen=True)
class Surface:
    """name, shape: of the Mitsuba scene. chart: of its points. sides: 1, or 2 where it reflects from behind too.
    shiny: whether its radiance depends on the direction. texels_per_uv: rows and columns of its finest picture per
    unit of its texture coordinates, (0, 0) without pictures, infinite where patterns have no resolution."""

    name: str
    shape: Any
    chart: Chart | Nodes
    sides: int
    shiny: bool
    texels_per_uv: tuple[float, float]


def surfaces_of(mi: Any, scene: Any, texel: float, fine: int, matte: bool) -> list[Surface]:
    """The surfaces of a Mitsuba scene whose light is kept in texels of this size, and pictures in finer ones.

    Raises: DomainError for surfaces that no texture can stand for: mirrors, glass and masks unless ``matte``, media,
      shapes without charts.
    """
    found = {}
    for shape in scene.shapes():
        name = shape.id() or shape.class_name()  # those of files need no id
        if name in found:
            name = next(other for k in itertools.count(2) if (other := f"{name}-{k}") not in found)
        found[name] = _surface(mi, name, shape, texel, fine, matte)
    return list(found.values())


def _surface(mi, name, shape, texel, fine, matte):
    bsdf = shape.bsdf()
    flags = 0 if bsdf is None else int(bsdf.flags())
    if shape.interior_medium() is not None or shape.exterior_medium() is not None:
        raise DomainError(
            f"bake: shape '{name}' holds a medium, which no texture shows; leave it out, or use paths."
        )

    def has(*names):
        return any(flags & int(getattr(mi.BSDFFlags, kind)) for kind in names)

    through = has("DeltaTransmission", "GlossyTransmission", "DiffuseTransmission", "Null")
    mirror = has("DeltaReflection") and not has("DiffuseReflection")
    if (through or mirror) and not matte:
        raise DomainError(
            f"bake: what one sees on shape '{name}', a {bsdf.class_name()}, lies behind it or before it and moves as "
            "one moves; use the level 'path', or matte=True to show it as a matte surface of its mean radiance."
        )
    shiny = bool(flags & ~sum(int(getattr(mi.BSDFFlags, kind)) for kind in LAMBERTIAN))
    pictures = _pictures(mi.traverse(shape))
    if not pictures and has("SpatiallyVarying"):
        pictures = [(np.inf, np.inf)]
    detail = texel / fine if pictures else None
    chart = chart_of(mi, shape, texel, detail)
    finest = tuple(max((row[k] for row in pictures), default=0.0) for k in (0, 1))
    return Surface(name, shape, chart, 2 if has("BackSide") else 1, shiny, finest)


def _pictures(parameters):
    """Rows and columns per unit of texture coordinates of every bitmap of a shape."""
    found = []
    for key in list(parameters.keys()):
        if key.endswith(".data") and len(parameters[key].shape) == 3:
            rows, columns, _ = parameters[key].shape
            to_uv = parameters.get(key.removesuffix("data") + "to_uv")
            scale = np.eye(3) if to_uv is None else np.array(to_uv.matrix, dtype=float).reshape(3, 3)
            found.append((rows * np.linalg.norm(scale[1, :2]), columns * np.linalg.norm(scale[0, :2])))
    return found
