"""One surface of a .zmx file: a table of its keywords, and what of them can be traced."""

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from codesign.errors import FileFormatError
from codesign.lens.files.breaks import coordinate_break
from codesign.lens.files.system import FileSurface
from codesign.lens.files.text import (
    IDLE,
    Rule,
    all_numbers,
    all_words,
    at,
    number,
    one_number,
    shown,
    take,
    whole,
    yes,
)
from codesign.lens.glass import Glass, maker_of
from codesign.lens.surface import Phase

TYPES = ("STANDARD", "EVENASPH", "BINARY_2")
REASONS = {
    "PARAXIAL": "an ideal thin lens has no shape to trace",
    "TOROIDAL": "its two curvatures differ, and only surfaces of revolution are traced",
    "BICONICX": "its two curvatures differ, and only surfaces of revolution are traced",
    "QED_TYPE": "Forbes polynomials are not read",
    "ODDASPHE": "odd powers of the height are not read",
    "DGRATING": "a ruled grating has no axis of revolution",
}
# solves, pickups, tolerances, drawing, coatings, mechanical sizes and labels: the values they lead
# to stand in the file, or no ray changes
IDLE_WORDS = """
SLAB HIDE MIRR POPS FIMP COAT COMM PZUP PPAR VPAR VDSZ VCON PKUP MAZH MARG EDGE MEMA OEMA TCMM TCED CHZN
SCOL SOPA DRAW NOTE RCMF
"""
UNUSED = [1.5, 40.0], [0.0, 0.0]  # nd and Vd beside names where no model glass was
APERTURES = {
    "rectangular": "SQAP SQOB",
    "elliptical": "ELAP ELOB",
    "user-defined": "UDAP UDAD USAP",
    "spider": "SPID",
}


def _word(keyword, words):
    return words[0].upper()


def _distance(keyword, words):
    return math.inf if words[0].upper() == "INFINITY" else number(words[0], keyword)


def _indexed(keyword, words):
    return {whole(words[0], keyword): number(words[1], f"{keyword} {shown(words[0])}")}


def _semi_diameter(keyword, words):
    value = number(words[0], keyword)
    if value < 0:
        raise FileFormatError(f"its semi-diameter is {value:g}; it must be positive.")
    # 0: not computed yet
    return value or None


def _ring(keyword, words):
    """Inner and outer radius."""
    if len(words) < 2:
        raise FileFormatError(f"{keyword} needs two radii; give them.")
    inner, outer = all_numbers(keyword, words[:2])
    if not 0 <= inner <= outer:
        raise FileFormatError(
            f"{keyword} has the radii {inner:g} and {outer:g}; the first must be at least 0 and smaller "
            "than the second."
        )
    if keyword == "OBSC" and inner > 0:
        raise FileFormatError(
            f"it blocks a ring from {inner:g} to {outer:g} (OBSC); only a central disc is read."
        )
    return inner, outer


def _centred(keyword, words):
    if any(all_numbers(keyword, words)):
        raise FileFormatError(
            "its aperture is off the axis (OBDC); only circles around the axis are read."
        )


def _straight(keyword, words):
    if any(all_numbers(keyword, words[3:])):
        raise FileFormatError(
            "it tilts or shifts what is behind it (SCBD); write that as surfaces COORDBRK of their own."
        )


SURFACE = {
    **dict.fromkeys(IDLE_WORDS.split(), IDLE),
    **{
        keyword: f"its aperture is {shape} ({keyword}), only circles around the axis are read; replace it by "
        "its circle."
        for shape, keywords in APERTURES.items()
        for keyword in keywords.split()
    },
    "TYPE": Rule("kind", _word),
    "CURV": Rule("curvature", one_number),
    "DISZ": Rule("thickness", _distance),
    "CONI": Rule("conic", one_number),
    "GLAS": Rule("glass", all_words),
    "STOP": Rule("is_stop", yes, 0),
    # DIAM alone may only draw; FLAP and CLAP stop rays
    "DIAM": Rule("semi_diameter", _semi_diameter),
    "FLAP": Rule("ring", _ring),
    "CLAP": Rule("ring", _ring),
    "OBSC": Rule("disc", _ring),
    "OBDC": Rule("centred", _centred),
    "SCBD": Rule("straight", _straight),
    "PARM": Rule("parameters", _indexed, 2),
    "XDAT": Rule("extra", _indexed, 2),
}


class Entry:
    """The values of one surface, object and image included."""

    def __init__(self, words: list[str], expected: int) -> None:
        self.label = whole(words[0], "the number of a surface") if words else -1
        if self.label != expected:
            raise FileFormatError(
                f"surface {expected} is missing, or surface {self.label} comes twice; number the surfaces 0, "
                "1, 2, ..."
            )
        self.values: dict[str, Any] = {}
        self.get = self.values.get
        self.seen: set[str] = set()

    def take(self, keyword: str, words: list[str]) -> None:
        """Take one line. Raises: FileFormatError when it is not understood, comes twice, or asks
        for what cannot be traced."""
        if keyword not in SURFACE:
            raise FileFormatError(
                f"keyword '{shown(keyword)}' is not understood; delete the line if it changes no ray."
            )
        once = " ".join([keyword, *(words[:1] if keyword in ("PARM", "XDAT") else [])])
        if once in self.seen and SURFACE[keyword] != IDLE:
            raise FileFormatError(f"{once} comes twice; keep one.")
        self.seen.add(once)
        take(self.values, SURFACE, keyword, words)

    @property
    def kind(self) -> str:
        return self.get("kind", "STANDARD")

    def check_object(self) -> None:
        if "glass" in self.values:
            raise FileFormatError(
                f"the object lies in '{shown(self.values['glass'][0])}'; only objects in air are read."
            )

    def check_image(self) -> None:
        if (
            self.get("curvature")
            or self.kind not in TYPES
            or any(self.get("parameters", {}).values())
        ):
            raise FileFormatError(
                f"surface {self.label} is a curved or special image surface; only a flat image plane is read."
            )

    def _check_lines(self):
        for keyword in ("CURV", "DISZ"):
            if keyword not in self.seen:
                raise FileFormatError(f"the line {keyword} is missing; add it (CURV 0 is a plane).")

    def moves(self) -> bool:
        """Whether a coordinate break tilts or shifts; PARM 6 is the order in which."""
        return any(value for i, value in self.get("parameters", {}).items() if i != 6)

    def coordinate_break(self) -> np.ndarray:
        """The frame [4, 4] behind this coordinate break, before its thickness; the light stays in
        its medium."""
        self._check_lines()
        if {"is_stop", "glass"} & self.values.keys() or any(self.get("extra", {}).values()):
            raise FileFormatError(
                "it is a coordinate break with a stop, a glass or extra data; give those to a surface of "
                "its own."
            )
        return coordinate_break(self.get("parameters", {}))

    def surface(self, catalogues: Sequence[str] = ()) -> FileSurface:
        """FileSurface of this entry, in a file that names these catalogues of glass."""
        self._check_lines()
        kind = self.kind
        if kind not in TYPES:
            raise FileFormatError(
                f"type {shown(kind)} is not read "
                f"({REASONS.get(kind, 'only STANDARD, EVENASPH and BINARY_2 are')}); replace it, or "
                "use a design without it."
            )
        parameters, extra = self.get("parameters", {}), self.get("extra", {})
        if (kind != "BINARY_2" and any(extra.values())) or (kind == "STANDARD" and self.moves()):
            raise FileFormatError(
                f"parameters or extra data (PARM, XDAT) on a surface of type {kind} are not "
                "understood; delete them if they change no ray."
            )
        if any(value for i, value in parameters.items() if i > 8 and kind != "STANDARD"):
            raise FileFormatError(
                "it has parameters beyond PARM 8, which are not understood; delete them if they change no "
                "ray."
            )
        asphere = tuple(parameters.get(i, 0.0) for i in range(1, 9)) if kind != "STANDARD" else ()
        inner, outer = self.get("ring", (0.0, None))
        inner = max(inner, self.get("disc", (0.0, 0.0))[1])
        glass = self.get("glass", ["AIR"])
        mirror = glass[0].upper() == "MIRROR"
        return FileSurface(
            self.label,
            self.values["curvature"],
            self.values["thickness"],
            None if mirror else _medium(glass, catalogues),
            self.get("semi_diameter") if outer is None else outer,
            outer is not None or inner > 0,
            self.get("conic", 0.0),
            asphere if any(asphere) else (),
            "is_stop" in self.values,
            mirror,
            _phase(parameters, extra) if kind == "BINARY_2" else None,
            inner=inner,
        )


def _medium(words, catalogues):
    if words[0].upper() == "AIR":
        return None
    if words[0] != "___BLANK":
        return _named(words, catalogues)
    if any(number(word, "dPgF") for word in words[5:6]):
        raise FileFormatError("its model glass has a dPgF, which is not read; write 0, or a name.")
    if len(words) < 5:
        raise FileFormatError(
            "its model glass has no index and Abbe number; write GLAS ___BLANK 1 0 nd Vd."
        )
    return Glass.from_abbe(number(words[3], "the index nd"), number(words[4], "the Abbe number"))


def _named(words, catalogues):
    """Glass by its name; where its line says the nd and Vd of another, its maker must come first."""
    glass = Glass.named(words[0], catalogues)
    said = [number(word, "nd or Vd of its glass") for word in words[3:5]]
    nd, Vd = glass.index_d, glass.abbe_number
    if len(said) < 2 or said in UNUSED or (abs(said[0] - nd) <= 1e-3 and abs(said[1] - Vd) <= 1):
        return glass
    has = f"glass '{shown(words[0])}' has nd {nd:.5f} and Vd {Vd:.2f} in the catalogue"
    told = f"{has}, and its line says {said[0]:.6g} and {said[1]:.6g}"
    if maker_of(glass.source) not in {maker_of(each) for each in catalogues[:1]} - {None}:
        raise FileFormatError(
            f"{told}; give GLAS ___BLANK 1 0 nd Vd, or 1.5 40 if the name counts."
        )
    warnings.warn(f"{told}, as a model glass leaves behind; the name counts.", stacklevel=2)
    return glass


def _phase(parameters, extra):
    count = extra.get(1, 0.0)
    radius = extra.get(2, 1.0)
    if count != int(count) or not 0 <= count <= 16 or radius <= 0:
        raise FileFormatError(
            f"its diffractive phase has {count:g} terms over a radius of {radius:g}; give 0 to 16 terms "
            "and a positive radius (XDAT 1 and 2)."
        )
    terms = tuple(extra.get(3 + i, 0.0) / radius ** (2 * i + 2) for i in range(int(count)))
    order = parameters.get(0, 1.0)
    if order != int(order):
        raise FileFormatError(f"its diffraction order is {order:g}; give a whole number (PARM 0).")
    with at("diffractive phase"):
        return Phase(terms, int(order)) if any(terms) else None
