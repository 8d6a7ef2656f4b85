"""From a file's description to a GeoLens: focus, pupil, field and apertures where the file leaves
them to be computed."""

import itertools
import math
import warnings
from dataclasses import replace

import torch

from codesign.errors import FileFormatError
from codesign.lens.files.system import FileLens, placed, unfold
from codesign.lens.files.text import MOST_SURFACES
from codesign.lens.geolens import GeoLens
from codesign.lens.paraxial import yu_trace
from codesign.lens.surface import Surface, sag_mm

# an aperture no file states: what the paraxial rays of pupil and field need, and 5 % for what they
# leave out
MARGIN = 1.05
# share of the semi-aperture by which two faces of a glass may cross at the rim: files round
# apertures up, and optimised designs cross where no ray passes
EDGE = 5e-3
# height of the paraxial marginal ray over the stop, from which on the two contradict each other
CUT = 1.25


def assemble(lens: FileLens, dtype: torch.dtype = torch.float64) -> GeoLens:
    """GeoLens of a FileLens.

    Returns: the lens; its soft edges are 2 % of the entrance pupil wide, 0.2 mm at most. A field
      given as a height on the image counts as atan(height / focal length).
    Raises: FileFormatError or DomainError naming the surface, when it cannot exist.
    """
    if not 0 < len(lens.surfaces) <= MOST_SURFACES:
        raise FileFormatError(
            f"it has {len(lens.surfaces)} surfaces between object and image, 1 to {MOST_SURFACES} are read; "
            "is it a lens?"
        )
    rows = unfold(lens)
    optics = Paraxial(_draft(rows, lens.name), lens.wavelength_um)
    if lens.focus:
        turns = sum(row.mirror for row in rows)
        back_focus = optics.trace(1.0, 0.0)[0][-1] * optics.focal_length()
        rows[-1].thickness = back_focus + lens.defocus * lens.unit_mm * (-1) ** turns
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
        """Heights at the surfaces, and the angle behind the last, of a ray that meets the first at
        height y with slope u (in air)."""
        heights, angles = yu_trace(self.power, self.thickness, self.index, y, u)
        return heights, angles[-1] / self.index[-1]

    def focal_length(self) -> float:
        _, u = self.trace(1.0, 0.0)
        if abs(u) < 1e-12:
            raise FileFormatError(
                "its pupil, field or focus is given through a focal length, but the lens is afocal; give "
                "the entrance pupil diameter, field angles and all thicknesses."
            )
        return -1 / u

    def entrance_pupil_mm(self) -> float:
        """Where the entrance pupil lies, from the first vertex."""
        parallel, slanted = (self.trace(*start)[0][self.stop] for start in ((1.0, 0.0), (0.0, 1.0)))
        if abs(parallel) < 1e-12:
            raise FileFormatError(
                "its stop lies where parallel light comes to a focus, so it has no entrance pupil; move the "
                "stop."
            )
        return slanted / parallel


def _draft(rows, name):
    """The lens with apertures so small that only shapes count. Raises: DomainError for surfaces
    that cannot be."""
    surfaces = [
        replace(_surface(row), semi_aperture_mm=1e-9, inner_semi_aperture_mm=0.0) for row in rows
    ]
    for row, surface in zip(rows, surfaces, strict=True):
        surface.check(f"surface {row.label}")
    return GeoLens(surfaces, 1.0, name=name)


def _surface(row):
    return Surface(
        1 / row.curvature if row.curvature else math.inf,
        row.thickness,
        row.medium,
        row.semi_aperture,
        row.conic,
        row.asphere,
        row.is_stop,
        row.mirror,
        row.phase,
        row.decentre,
        row.tilt_deg,
        row.inner,
    )


def _pupil(lens, rows, optics):
    """Entrance pupil diameter, mm."""
    if lens.pupil is None:
        raise FileFormatError(
            "it does not say how wide its beam is; give the entrance pupil diameter (ENPD in .zmx, EPD in "
            ".seq), or FLOA in .zmx where the stop's semi-diameter says it."
        )
    kind, value = lens.pupil
    if kind == "stop":
        heights, _ = optics.trace(1.0, 0.0)
        stop = rows[optics.stop].semi_aperture
        limits = (
            [stop / abs(heights[optics.stop])]
            if stop and heights[optics.stop]
            else [
                r.semi_aperture / abs(y)
                for r, y in zip(rows, heights, strict=True)
                if r.semi_aperture and y
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
    kind, height = lens.field or ("angle", 0.0)
    if height == 0:
        return None
    if kind == "angle":
        found = abs(height)
    else:
        lever_mm = optics.focal_length()
        if kind == "object height":
            lever_mm = lens.object_distance * lens.unit_mm + optics.entrance_pupil_mm()
        found = math.degrees(math.atan(abs(height * lens.unit_mm / lever_mm)))
    if not found < 90:
        raise FileFormatError(f"its half field is {height:g} degrees; it must stay below 90.")
    return found or None


def _open(rows, optics, diameter, half_field):
    """Give every surface without an aperture one that lets the paraxial rays of pupil and field
    pass, as far as its shape and the glass reach; the stop gets the image of the pupil."""
    slope = math.tan(math.radians(half_field or 0.0))
    marginal, _ = optics.trace(diameter / 2, 0.0)
    chief, _ = optics.trace(-slope * optics.entrance_pupil_mm() if slope else 0.0, slope)
    free = [row for row in rows if row.semi_aperture is None]
    needed = abs(marginal[optics.stop])
    if (opening := rows[optics.stop].semi_aperture) and needed > CUT * opening:
        warnings.warn(
            f"the stop, {2 * opening:.4g} mm wide, cuts the beam: an entrance pupil of {diameter:.4g} mm needs "
            f"{2 * needed:.4g} mm there, so pictures are darker than the f-number says; give a smaller pupil.",
            stacklevel=5,
        )
    for row, y, y_chief in zip(rows, marginal, chief, strict=True):
        if row in free:
            needed = abs(y) if row.is_stop else MARGIN * (abs(y) + abs(y_chief))
            square = (1 + row.conic) * row.curvature**2
            reach = 0.98 / math.sqrt(square) if square > 0 else math.inf
            row.semi_aperture = min(max(needed, 1e-3 * diameter), reach)
    for front, back in itertools.pairwise(rows):
        heights, gap = _edge(front, back)
        # the first height where they cross, 0 where they do not
        crossed = int((gap < 0).int().argmax())
        most = float(heights[crossed - 1])
        for row in (front, back) if front.medium is not None and crossed > 1 else ():
            if row in free:
                row.semi_aperture = min(row.semi_aperture, most)


def _edge(front, back):
    """Heights up to the smaller aperture of two neighbours, and the distance along the axis between
    them there, mm."""
    heights = torch.linspace(
        0, min(front.semi_aperture, back.semi_aperture), 65, dtype=torch.float64
    )
    front_mm, back_mm = (
        sag_mm(heights, row.curvature, row.conic, row.asphere) for row in (front, back)
    )
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
