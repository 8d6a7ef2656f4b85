"""One surface of a .zmx file, and the rigid frame that coordinate breaks carry from surface to surface."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from codesign.errors import FileFormatError
from codesign.lens.files.system import FileSurface
from codesign.lens.files.text import at, number, shown, whole
from codesign.lens.glass import Glass
from codesign.lens.surface import Phase

# rounding of a frame that was left and entered again: rad, and per length of the lens
NO_TILT = 1e-14
NO_SHIFT = 1e-14


def along(distance: float) -> np.ndarray:
    """The frame [4, 4] further along z. Raises: FileFormatError where that is infinitely far."""
    if math.isinf(distance):
        raise FileFormatError(
            "its thickness is infinite, which only that of the object may be; give a finite one (DISZ)."
        )
    frame = np.eye(4)
    frame[2, 3] = distance
    return frame


def coordinate_break(parameters: Mapping[int, float]) -> np.ndarray:
    """The frame [4, 4] behind a break, in the one before it.

    PARM 1, 2: decentre x, y. PARM 3, 4, 5: right-handed tilts about the x, y, z in force, degrees. PARM 6 is
      0: decentre, then x, y, z; 1, which undoes it: z, y, x, then decentre.
    Raises: FileFormatError for other parameters.
    """
    strange = [
        i for i, v in parameters.items() if (v and i not in range(1, 7)) or (i == 6 and v not in (0, 1))
    ]
    if strange:
        raise FileFormatError(
            f"its PARM {strange[0]} is {parameters[strange[0]]:g}, which is not understood; a coordinate "
            "break has PARM 1 "
            "to 5 and the order PARM 6, 0 or 1."
        )
    shift = np.eye(4)
    shift[:2, 3] = [parameters.get(i, 0.0) for i in (1, 2)]
    steps = [shift, *(_turn(axis, parameters.get(3 + axis, 0.0)) for axis in range(3))]
    return np.linalg.multi_dot(steps[::-1] if parameters.get(6) else steps)


def _turn(axis, angle_deg):
    """Right-handed turn about x, y or z (0, 1, 2)."""
    sine, cosine = math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(4)
    turn[j, j] = turn[k, k] = cosine
    turn[k, j], turn[j, k] = sine, -sine
    return turn


def place(surfaces: Sequence[FileSurface], frames: Sequence[np.ndarray], image: np.ndarray) -> float:
    """Write decentres, tilts and depths into the surfaces, seen from the image plane, whose normal through
    its centre is the axis of the model.

    Args: frames: of the surfaces, and ``image``, in that of the object.
    Returns: angle between the object's axis and the image's, degrees.
    Raises: FileFormatError where a surface turns by 90 degrees or more.
    """
    back = np.linalg.inv(image)
    length = max(float(np.abs(frame[:3, 3]).max()) for frame in (*frames, image))
    for surface, frame in zip(surfaces, frames, strict=True):
        seen = back @ frame
        x, y, z = seen[:3, 2]
        if z <= NO_TILT:
            raise FileFormatError(
                f"surface {surface.label}: its axis stands at {math.degrees(math.acos(max(z, -1.0))):.4g} "
                "degrees to that "
                "of the image plane, less than 90 are traced; use a design that is not folded by coordinate "
                "breaks."
            )
        surface.tilt_deg = _rounded(math.atan2(-y, z)), _rounded(math.atan2(x, math.hypot(y, z)))
        across = np.where(np.abs(seen[:2, 3]) > NO_SHIFT * length, seen[:2, 3], 0.0)
        surface.decentre = float(across[0]), float(across[1])
        surface.depth = float(seen[2, 3])
    return _rounded(math.atan2(math.hypot(*back[:2, 2]), back[2, 2]))


def _rounded(angle):
    return math.degrees(angle) if abs(angle) > NO_TILT else 0.0


TYPES = ("STANDARD", "EVENASPH", "BINARY_2")
REASONS = {
    "PARAXIAL": "an ideal thin lens has no shape to trace",
    "TOROIDAL": "its two curvatures differ, and only surfaces of revolution are traced",
    "BICONICX": "its two curvatures differ, and only surfaces of revolution are traced",
    "QED_TYPE": "Forbes polynomials are not read",
    "ODDASPHE": "odd powers of the height are not read",
    "DGRATING": "a ruled grating has no axis of revolution",
}
# solves, pickups, tolerances, drawing, coatings, mechanical sizes and labels: the values they lead to stand
# in the file, or no ray changes
IDLE_WORDS = """
SLAB HIDE MIRR POPS FIMP COAT COMM PZUP PPAR VPAR VDSZ VCON PKUP MAZH MARG EDGE MEMA OEMA TCMM TCED CHZN
SCOL SOPA DRAW NOTE RCMF
"""
IDLE = set(IDLE_WORDS.split())
APERTURES = {
    "SQAP": "rectangular",
    "ELAP": "elliptical",
    "UDAP": "user-defined",
    "UDAD": "user-defined",
    "USAP": "user-defined",
    "SQOB": "rectangular",
    "ELOB": "elliptical",
    "SPID": "spider",
}
OWN_WORDS = "TYPE CURV DISZ GLAS CONI STOP DIAM FLAP CLAP OBSC OBDC SCBD PARM XDAT"
KEYWORDS = IDLE | set(APERTURES) | set(OWN_WORDS.split())


@dataclass
class Entry:
    """The lines of one surface, object and image included."""

    label: int
    kind: str = "STANDARD"
    curvature: float = 0.0
    thickness: float = 0.0
    conic: float = 0.0
    glass: list[str] = field(default_factory=list)
    semi_aperture: float | None = None
    aperture: float | None = None  # of FLAP or CLAP, which stop rays; DIAM alone may only draw
    inner: float = 0.0
    is_stop: bool = False
    parameters: dict[int, float] = field(default_factory=dict)
    extra: dict[int, float] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set)

    def take(self, keyword: str, words: list[str]) -> None:
        """Take one line. Raises: FileFormatError when it is not understood, comes twice, or asks for what
        cannot be traced."""
        if keyword in IDLE:
            return
        if keyword not in KEYWORDS:
            raise FileFormatError(
                f"keyword '{shown(keyword)}' is not understood; delete the line if it changes no ray."
            )
        if keyword in APERTURES:
            raise FileFormatError(
                f"its aperture is {APERTURES[keyword]} ({keyword}), only circles around the axis are read; "
                "replace it by its circle."
            )
        once = f"{keyword} {words[0]}" if keyword in ("PARM", "XDAT") and words else keyword
        if once in self.seen:
            raise FileFormatError(f"{once} comes twice; keep one.")
        self.seen.add(once)
        if keyword == "STOP":
            self.is_stop = True
            return
        if not words or (keyword in ("PARM", "XDAT") and len(words) < 2):
            raise FileFormatError(f"{keyword} has no value; give one.")
        getattr(self, f"_take_{keyword.lower()}")(words)

    def _take_type(self, words):
        self.kind = words[0].upper()

    def _take_curv(self, words):
        self.curvature = number(words[0], "CURV")

    def _take_disz(self, words):
        self.thickness = math.inf if words[0].upper() == "INFINITY" else number(words[0], "DISZ")

    def _take_coni(self, words):
        self.conic = number(words[0], "CONI")

    def _take_glas(self, words):
        self.glass = words

    def _take_diam(self, words):
        value = number(words[0], "DIAM")
        self.semi_aperture = value or None  # 0: not computed yet
        if value < 0:
            raise FileFormatError(f"its semi-diameter is {value:g}; it must be positive.")

    def _take_circle(self, words, keyword):
        """A circle or ring: inner and outer radius."""
        if len(words) < 2:
            raise FileFormatError(f"{keyword} needs two radii; give them.")
        inner = number(words[0], keyword)
        outer = number(words[1], keyword)
        if not 0 <= inner <= outer:
            raise FileFormatError(
                f"{keyword} has the radii {inner:g} and {outer:g}; the first must be at least 0 and smaller "
                "than the second."
            )
        return inner, outer

    def _take_flap(self, words):
        self.inner, self.aperture = self._take_circle(words, "FLAP")

    def _take_clap(self, words):
        self.inner, self.aperture = self._take_circle(words, "CLAP")

    def _take_obsc(self, words):
        inner, outer = self._take_circle(words, "OBSC")
        if inner > 0:
            raise FileFormatError(
                f"it blocks a ring from {inner:g} to {outer:g} (OBSC); only a central disc is read."
            )
        self.inner = max(self.inner, outer)

    def _take_obdc(self, words):
        if any(number(w, "OBDC") for w in words):
            raise FileFormatError(
                "its aperture is off the axis (OBDC); only circles around the axis are read."
            )

    def _take_scbd(self, words):
        if any(number(w, "SCBD") for w in words[3:]):
            raise FileFormatError(
                "it tilts or shifts what is behind it (SCBD); write that as surfaces COORDBRK of their own."
            )

    def _take_parm(self, words):
        self.parameters[whole(words[0], "PARM")] = number(words[1], f"PARM {shown(words[0])}")

    def _take_xdat(self, words):
        self.extra[whole(words[0], "XDAT")] = number(words[1], f"XDAT {shown(words[0])}")

    def check_object(self) -> None:
        if self.glass:
            raise FileFormatError(
                f"the object lies in '{shown(self.glass[0])}'; only objects in air are read."
            )

    def check_image(self) -> None:
        if self.curvature or self.kind not in TYPES or any(self.parameters.values()):
            raise FileFormatError(
                f"surface {self.label} is a curved or special image surface; only a flat image plane is read."
            )

    def _check_lines(self):
        missing = [keyword for keyword in ("CURV", "DISZ") if keyword not in self.seen]
        if missing:
            raise FileFormatError(f"the line {missing[0]} is missing; add it (CURV 0 is a plane).")

    def moves(self) -> bool:
        """Whether a coordinate break tilts or shifts; PARM 6 is the order in which."""
        return any(v for i, v in self.parameters.items() if i != 6)

    def coordinate_break(self) -> np.ndarray:
        """The frame [4, 4] behind this coordinate break, before its thickness; the light stays in its
        medium."""
        self._check_lines()
        if self.is_stop or self.glass or any(self.extra.values()):
            raise FileFormatError(
                "it is a coordinate break with a stop, a glass or extra data; give those to a surface of "
                "its own."
            )
        return coordinate_break(self.parameters)

    def surface(self) -> FileSurface:
        """FileSurface of this entry."""
        self._check_lines()
        if self.kind not in TYPES:
            raise FileFormatError(
                f"type {shown(self.kind)} is not read "
                f"({REASONS.get(self.kind, 'only STANDARD, EVENASPH and BINARY_2 are')}); replace it, or "
                "use a design without it."
            )
        if (self.kind != "BINARY_2" and any(self.extra.values())) or (
            self.kind == "STANDARD" and self.moves()
        ):
            raise FileFormatError(
                f"parameters or extra data (PARM, XDAT) on a surface of type {self.kind} are not "
                "understood; delete them if they change no ray."
            )
        asphere = tuple(self.parameters.get(i, 0.0) for i in range(1, 9)) if self.kind != "STANDARD" else ()
        if max(self.parameters, default=0) > 8 and any(v for i, v in self.parameters.items() if i > 8):
            raise FileFormatError(
                "it has parameters beyond PARM 8, which are not understood; delete them if they change no "
                "ray."
            )
        mirror = bool(self.glass) and self.glass[0].upper() == "MIRROR"
        semi_aperture = self.aperture if self.aperture is not None else self.semi_aperture
        return FileSurface(
            self.label,
            self.curvature,
            self.thickness,
            None if mirror else self._medium(),
            semi_aperture,
            self.aperture is not None or self.inner > 0,
            self.conic,
            asphere if any(asphere) else (),
            self.is_stop,
            mirror,
            self._phase() if self.kind == "BINARY_2" else None,
            inner=self.inner,
        )

    def _medium(self):
        if not self.glass or self.glass[0].upper() == "AIR":
            return None
        name = self.glass[0]
        if name != "___BLANK":
            return Glass.named(name)
        if len(self.glass) < 5:
            raise FileFormatError(
                "its model glass has no index and Abbe number; write GLAS ___BLANK 1 0 nd Vd."
            )
        return Glass.from_abbe(
            number(self.glass[3], "the index nd"), number(self.glass[4], "the Abbe number")
        )

    def _phase(self):
        count = self.extra.get(1, 0.0)
        radius = self.extra.get(2, 1.0)
        if count != int(count) or not 0 <= count <= 16 or radius <= 0:
            raise FileFormatError(
                f"its diffractive phase has {count:g} terms over a radius of {radius:g}; give 0 to 16 terms "
                "and a positive radius (XDAT 1 and 2)."
            )
        terms = tuple(self.extra.get(3 + i, 0.0) / radius ** (2 * i + 2) for i in range(int(count)))
        order = self.parameters.get(0, 1.0)
        if order != int(order):
            raise FileFormatError(f"its diffraction order is {order:g}; give a whole number (PARM 0).")
        with at("diffractive phase"):
            return Phase(terms, int(order)) if any(terms) else None
