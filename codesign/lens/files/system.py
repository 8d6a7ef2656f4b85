"""A lens as files describe it: signed along a fixed axis, in the file's unit, with pupil and field given in
many ways."""

import math
from dataclasses import dataclass, field

from codesign.lens.glass import Glass
from codesign.lens.surface import Phase


@dataclass
class FileSurface:
    """One surface in the convention of lens files: +z fixed, so curvature and thickness change sign behind a
    mirror. Lengths in the file's unit.

    label: its number in the file. semi_aperture: None where the file says nothing. fixed: whether that
      aperture stops rays.
    tilt_deg: right-handed about +x, then about +y. inner: radius of a central obstruction.
    depth: of the vertex along the axis of the image plane, from there, where coordinate breaks tilt or shift; the
      thickness stays the one along the light.
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

    pupil: ("diameter" | "f-number" | "working f-number" | "numerical aperture" | "stop", value; the last
      needs none).
    field: ("angle" degrees | "object height" | "image height", value) or None. object_distance: from the
      object to the first surface.
    focus: whether the last thickness is to be solved for the paraxial focus. defocus: added to the last
      thickness. image_tilt_deg: between the axes of object and image plane.
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
