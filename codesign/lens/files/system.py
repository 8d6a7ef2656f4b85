"""A lens as files describe it, and its way to light that always travels along +z in millimetres.

Files are signed along a fixed axis, in a unit of their own, with pupil and field given in many
ways."""

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from codesign.errors import FileFormatError
from codesign.lens.glass import Glass
from codesign.lens.surface import Phase, scaled_asphere, scaled_phase


@dataclass
class FileSurface:
    """One surface in the convention of lens files: +z fixed, so curvature and thickness change sign
    behind a mirror. Lengths in the file's unit.

    label: its number in the file. semi_aperture: None where the file says nothing. fixed: whether
      that aperture stops rays.
    tilt_deg: right-handed about +x, then about +y. inner: radius of a central obstruction.
    depth: of the vertex along the axis of the image plane, from there, where coordinate breaks tilt
      or shift; the thickness stays the one along the light.
    """

    label: int | str
    curvature: float = 0.0
    thickness: float = 0.0
    medium: Glass | None = None
    semi_aperture: float | None = None
    fixed: bool = False
    conic: float = 0.0
    asphere: tuple[float, ...] = ()
    is_stop: bool = False
    mirror: bool = False
    phase: Phase | None = None
    decentre: tuple[float, float] = (0.0, 0.0)
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    inner: float = 0.0
    depth: float | None = None


@dataclass
class FileLens:
    """All a file says of a lens; the object and the image surface are not among the surfaces.

    pupil: ("diameter" | "f-number" | "working f-number" | "numerical aperture" | "stop", value; the
      last needs none).
    field: ("angle" degrees | "object height" | "image height", value) or None. object_distance:
      from the object to the first surface.
    focus: whether the last thickness is to be solved for the paraxial focus. defocus: added to the
      last thickness. image_tilt_deg: between the axes of object and image plane.
    """

    name: str = "lens"
    surfaces: list[FileSurface] = field(default_factory=list)
    unit_mm: float = 1.0
    pupil: tuple[str, float] | None = None
    field: tuple[str, float] | None = None
    wavelength_um: float = 0.5875618
    object_distance: float = math.inf
    focus: bool = False
    defocus: float = 0.0
    image_tilt_deg: float = 0.0


def largest_field(kind: str, points: Iterable[tuple[float, float]]) -> tuple[str, float]:
    """The field of a FileLens: the point furthest from the axis, from its x and y. Angles in x and y
    are those of the slopes in x and y."""

    def radial(x, y):
        if kind != "angle" or not (x and y) or max(abs(x), abs(y)) >= 90:
            return math.hypot(x, y)
        return math.degrees(math.atan(math.hypot(*(math.tan(math.radians(a)) for a in (x, y)))))

    return kind, max((radial(x, y) for x, y in points), default=0.0)


# of a length in the file's unit; a gap negative by less is a rounding error and counts as none
ROUNDING = 1e-9


def unfold(lens: FileLens) -> list[FileSurface]:
    """The surfaces with lengths in millimetres and all signs along the light; dummy planes at which
    the light steps back are folded away.

    Args:
      lens: FileLens.
    Returns: list of FileSurface; the last thickness is 0 where the paraxial focus is to be solved
      for.
    Raises: FileFormatError when the light would have to travel backwards.
    """
    found = []
    sign = 1.0
    medium = None
    for surface in lens.surfaces:
        before = sign
        sign = -sign if surface.mirror else sign
        medium = medium if surface.mirror else surface.medium
        found.append(
            dataclasses.replace(
                in_mm(surface, lens.unit_mm, before),
                thickness=surface.thickness * lens.unit_mm * sign,
                medium=medium,
            )
        )
    if found:
        defocused = found[-1].thickness + lens.defocus * lens.unit_mm * sign
        found[-1].thickness = 0.0 if lens.focus else defocused
    return _without_steps_back(found)


def placed(surfaces: list[FileSurface]) -> list[FileSurface]:
    """The surfaces of ``unfold`` with thicknesses along the axis of the image plane, where
    coordinate breaks moved some; as they were elsewhere. Raises: FileFormatError as there."""
    depths = [surface.depth for surface in surfaces] + [0.0]
    found = []
    sign = 1.0
    for surface, depth, behind in zip(surfaces, depths, depths[1:], strict=False):
        if depth is None or behind is None:
            return surfaces
        sign = -sign if surface.mirror else sign
        found.append(dataclasses.replace(surface, thickness=sign * (behind - depth) + 0.0))
    return _without_steps_back(found)


def in_mm(surface: FileSurface, unit_mm: float, sign: float) -> FileSurface:
    """The surface in millimetres, its shape and tilt mirrored in z where ``sign`` is -1; its
    thickness is left alone."""
    aperture = None if surface.semi_aperture is None else surface.semi_aperture * unit_mm
    x, y = surface.decentre
    about_x, about_y = surface.tilt_deg
    return dataclasses.replace(
        surface,
        curvature=sign * surface.curvature / unit_mm,
        asphere=scaled_asphere([sign * a for a in surface.asphere], unit_mm),
        phase=scaled_phase(surface.phase, unit_mm),
        semi_aperture=aperture,
        inner=surface.inner * unit_mm,
        decentre=(x * unit_mm, y * unit_mm),
        depth=None if surface.depth is None else surface.depth * unit_mm,
        tilt_deg=(sign * about_x + 0.0, sign * about_y + 0.0),
    )


def is_dummy(surface: FileSurface, medium_before: Glass | None) -> bool:
    """Whether a surface does nothing to any ray: a plane within one medium that neither stops nor
    turns light."""
    plain = (
        surface.curvature == 0
        and not any(surface.asphere)
        and surface.phase is None
        and not surface.mirror
    )
    return (
        plain
        and surface.medium == medium_before
        and not surface.is_stop
        and not surface.fixed
        and surface.inner == 0
    )


def _without_steps_back(surfaces):
    i = 0
    while i < len(surfaces):
        if surfaces[i].thickness >= 0:
            i += 1
        elif surfaces[i].thickness > -ROUNDING:
            surfaces[i].thickness = 0.0
        elif is_dummy(surfaces[i], surfaces[i - 1].medium if i else None):
            gap = surfaces.pop(i).thickness
            if i:
                i -= 1
                surfaces[i].thickness += gap
        elif i + 1 < len(surfaces) and is_dummy(surfaces[i + 1], surfaces[i].medium):
            surfaces[i].thickness += surfaces.pop(i + 1).thickness
        else:
            raise FileFormatError(
                f"surface {surfaces[i].label}: the light would travel {-surfaces[i].thickness:.6g} mm "
                "backwards behind it; give every thickness along the light (its sign turns at each "
                "mirror)."
            )
    if not surfaces or not all(math.isfinite(s.thickness) for s in surfaces):
        raise FileFormatError(
            "no surface is left between object and image, or one lies infinitely far; give finite distances "
            "between real surfaces."
        )
    return surfaces
