"""From a file's description to a GeoLens: focus, pupil, field and apertures where the file leaves them to be
computed."""

import itertools
import math

import torch

from codesign.errors import FileFormatError
from codesign.lens.files.system import FileLens, placed, unfold
from codesign.lens.files.text import MOST_SURFACES
from codesign.lens.geolens import GeoLens
from codesign.lens.surface import Surface, sag_mm

# an aperture no file states: what the paraxial rays of pupil and field need, and 5 % for what they leave out
MARGIN = 1.05
# share of the semi-aperture by which two faces of a glass may cross at the rim: files round apertures up, and
# optimised designs cross where no ray passes
EDGE = 5e-3


def assemble(lens: FileLens, dtype: torch.dtype = torch.float64) -> GeoLens:
    """GeoLens of a FileLens.

    Returns: the lens; its soft edges are 2 % of the entrance pupil wide, 0.2 mm at most. A field given as a
      height on the image counts as atan(height / focal length).
    Raises: FileFormatError or DomainError naming the surface, when it cannot exist.
    """
    if not 0 < len(lens.surfaces) <= MOST_SURFACES:
        raise FileFormatError(
            f"it has {len(lens.surfaces)} surfaces between object and image, 1 to {MOST_SURFACES} are read; "
            "is it a lens?"
        )
    rows = unfold(lens)
    _check(rows)
    optics = Paraxial(_draft(rows, lens.name), lens.wavelength_um)
    if lens.focus:
        turns = sum(row.mirror for row in rows)
        rows[-1].thickness = optics.focus() + lens.defocus * lens.unit_mm * (-1) ** turns
        if not 0 <= rows[-1].thickness < math.inf:
            raise FileFormatError(
                f"its solve for the paraxial focus puts the image {rows[-1].thickness:.6g} mm behind the "
                "last surface; give that distance as a number of at least 0."
            )
        optics = Paraxial(_draft(rows, lens.name), lens.wavelength_um)
    diameter = _pupil(lens, rows, optics)
    half_field = _half_field(lens, optics)
    _open(rows, optics, diameter, half_field)
    _check_glass(rows)
    rows = placed(rows)
    surfaces = [_surface(row).check(f"surface {row.label}") for row in rows]
    if half_field and lens.image_tilt_deg:  # what all directions around the image's normal share
        half_field = half_field - lens.image_tilt_deg if half_field > lens.image_tilt_deg else None
    return GeoLens(surfaces, diameter, dtype, min(0.2, diameter / 50), lens.name, half_field)


class Paraxial:
    """Paraxial rays through a lens at one wavelength, as plain numbers in mm."""

    def __init__(self, draft: GeoLens, wavelength_um: float) -> None:
        self.power = draft.surface_power(wavelength_um).tolist()
        self.thickness = draft.thickness_mm.tolist()
        self.index = draft.index(wavelength_um).tolist()
        self.stop = draft.stop_index

    def trace(self, y: float, u: float) -> tuple[list[float], float]:
        """Heights at the surfaces, and the angle behind the last, of a ray that meets the first at height y
        with slope u (in air)."""
        heights = []
        nu = u
        for power, thickness, index in zip(self.power, self.thickness, self.index[1:], strict=True):
            heights.append(y)
            nu -= y * power
            y += thickness * nu / index
        return heights, nu / self.index[-1]

    def focal_length(self) -> float:
        _, u = self.trace(1.0, 0.0)
        if abs(u) < 1e-12:
            raise FileFormatError(
                "its pupil, field or focus is given through a focal length, but the lens is afocal; give "
                "the entrance pupil diameter, field angles and all thicknesses."
            )
        return -1 / u

    def focus(self) -> float:
        heights, u = self.trace(1.0, 0.0)
        return heights[-1] * self.focal_length()

    def entrance_pupil_mm(self) -> float:
        """Where the entrance pupil lies, from the first vertex."""
        parallel = self.trace(1.0, 0.0)[0][self.stop]
        slanted = self.trace(0.0, 1.0)[0][self.stop]
        if abs(parallel) < 1e-12:
            raise FileFormatError(
                "its stop lies where parallel light comes to a focus, so it has no entrance pupil; move the "
                "stop."
            )
        return slanted / parallel


def _check(rows):
    """Raise for surfaces that cannot exist whatever their aperture."""
    if sum(row.is_stop for row in rows) > 1:
        raise FileFormatError(
            f"surfaces {[row.label for row in rows if row.is_stop]} are all marked as the stop; mark one."
        )
    for row in rows:
        _surface(row, 1e-9, 0.0).check(f"surface {row.label}")


def _draft(rows, name):
    return GeoLens([_surface(row, 1e-9, 0.0) for row in rows], 1.0, name=name)


def _surface(row, semi_aperture=None, inner=None):
    semi_aperture = row.semi_aperture if semi_aperture is None else semi_aperture
    inner = row.inner if inner is None else inner
    radius = 1 / row.curvature if row.curvature else math.inf
    return Surface(
        radius,
        row.thickness,
        row.medium,
        semi_aperture,
        row.conic,
        row.asphere,
        row.is_stop,
        row.mirror,
        row.phase,
        row.decentre,
        row.tilt_deg,
        inner,
    )


def _pupil(lens, rows, optics):
    """Entrance pupil diameter, mm."""
    if lens.pupil is None:
        raise FileFormatError(
            "it does not say how wide its beam is; give the entrance pupil diameter (ENPD in .zmx, EPD in "
            ".seq), or "
            "FLOA in .zmx where the stop's semi-diameter says it."
        )
    kind, value = lens.pupil
    if kind == "stop":
        heights, _ = optics.trace(1.0, 0.0)
        stop = rows[optics.stop].semi_aperture
        limits = (
            [stop / abs(heights[optics.stop])]
            if stop and heights[optics.stop]
            else [
                r.semi_aperture / abs(y) for r, y in zip(rows, heights, strict=True) if r.semi_aperture and y
            ]
        )
        if not limits:
            raise FileFormatError(
                "nothing in it says how wide its beam is; give the entrance pupil diameter, or the "
                "semi-diameter of the stop."
            )
        return 2 * min(limits)
    if not 0 < value < math.inf:
        raise FileFormatError(f"its {kind} is {value:g}; it must be positive.")
    if kind == "diameter":
        return value * lens.unit_mm
    if optics.index[-1] != 1:
        raise FileFormatError(
            f"its {kind} is counted in the image space, which is glass here; give the entrance pupil "
            "diameter."
        )
    # of the marginal ray in the image space
    slope = value if kind == "numerical aperture" else 1 / (2 * value)
    if kind == "f-number" or math.isinf(lens.object_distance):
        return 2 * slope * abs(optics.focal_length())
    distance = lens.object_distance * lens.unit_mm
    _, u = optics.trace(distance, 1.0)
    if abs(u) < 1e-12 or distance + optics.entrance_pupil_mm() <= 0:
        raise FileFormatError(
            f"its {kind} belongs to an image at infinity or an object inside the lens; give the entrance "
            "pupil diameter."
        )
    return 2 * slope / abs(u) * (distance + optics.entrance_pupil_mm())


def _half_field(lens, optics):
    """Half field of view in degrees, or None where the file gives none."""
    kind, value = lens.field if lens.field is not None else ("angle", 0.0)
    if value == 0:
        return None
    if kind == "image height":
        value = math.degrees(math.atan(abs(value * lens.unit_mm / optics.focal_length())))
    elif kind == "object height":
        distance = lens.object_distance * lens.unit_mm + optics.entrance_pupil_mm()
        value = (
            math.degrees(math.atan(abs(value * lens.unit_mm / distance))) if math.isfinite(distance) else 0.0
        )
    if not 0 <= abs(value) < 90:
        raise FileFormatError(f"its half field is {value:g} degrees; it must stay below 90.")
    return abs(value) or None


def _open(rows, optics, diameter, half_field):
    """Give every surface without an aperture one that lets the paraxial rays of pupil and field pass, as far
    as its shape and the glass reach; the stop gets the image of the pupil."""
    slope = math.tan(math.radians(half_field or 0.0))
    marginal, _ = optics.trace(diameter / 2, 0.0)
    chief, _ = optics.trace(-slope * optics.entrance_pupil_mm() if slope else 0.0, slope)
    unknown = [row.semi_aperture is None for row in rows]
    for row, y, y_chief in zip(rows, marginal, chief, strict=True):
        if row.semi_aperture is None:
            needed = max(abs(y) if row.is_stop else MARGIN * (abs(y) + abs(y_chief)), 1e-3 * diameter)
            reach = (
                0.98 / (abs(row.curvature) * math.sqrt(1 + row.conic))
                if row.curvature and row.conic > -1
                else math.inf
            )
            row.semi_aperture = min(needed, reach)
    for front, back, *free in zip(rows, rows[1:], unknown, unknown[1:], strict=False):
        heights, gap = _edge(front, back)
        crossed = int((gap < 0).int().argmax())  # the first height where they cross, 0 where they do not
        if front.medium is not None and crossed and any(free):
            for row, is_free in zip((front, back), free, strict=True):
                row.semi_aperture = (
                    min(row.semi_aperture, float(heights[crossed - 1]) or row.semi_aperture)
                    if is_free
                    else row.semi_aperture
                )


def _edge(front, back):
    """Heights up to the smaller aperture of two neighbours, and the distance along the axis between them
    there, mm."""
    heights = torch.linspace(0, min(front.semi_aperture, back.semi_aperture), 65, dtype=torch.float64)
    front_mm, back_mm = (sag_mm(heights, row.curvature, row.conic, row.asphere) for row in (front, back))
    # behind a mirror its shape is seen from the other side
    return heights, back_mm + front.thickness - (-front_mm if front.mirror else front_mm)


def _check_glass(rows):
    """Raise where two faces of one piece of glass cross inside the clear aperture of both."""
    for front, back in itertools.pairwise(rows):
        heights, gap = _edge(front, back)
        worst = int(gap.argmin())
        if front.medium is not None and float(gap[worst]) < -EDGE * float(heights[-1]):
            raise FileFormatError(
                f"surface {front.label}: the glass behind it is {float(gap[worst]):.4g} mm thick at "
                f"{float(heights[worst]):.4g} mm from the axis, inside the clear aperture; "
                "make it thicker or its apertures smaller."
            )
