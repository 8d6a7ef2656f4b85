"""One surface of a .seq file: a table of its commands, what of them can be traced, and the file's
own glasses."""

import math
from typing import Any

import numpy as np

from codesign.errors import FileFormatError
from codesign.lens.files.system import FileSurface
from codesign.lens.files.text import IDLE, Rule, number, one_number, shown, take, whole, yes
from codesign.lens.glass import WAVELENGTH_UM, Glass
from codesign.lens.surface import Phase

# half the power of r: A r^4 to J r^20
ASPHERE = {letter: 2 + i for i, letter in enumerate("ABCDEFGHJ")}
# where the last number is 0 they do nothing
OF_NOTHING = ("ADX", "ADY", "ARO", "CUX", "RDX")
REFUSED = {
    "it tilts or shifts everything behind it": "REV",
    "it bends the axis": "BEN",
    "it returns to the axes of another surface": "RET",
    "it is placed in global axes": "GLB",
    "it is toroidal": "XTO YTO",
    "it is cylindrical": "CYL",
    "it is anamorphic": "AAS",
    "it is a special surface": "SPS",
    "its shape is user-defined": "UDS",
    "its shape is a spline": "SPL",
    "its shape is not one of revolution": "ZRN",
    "its index has a gradient": "GRN",
    "it is a two-point hologram": "HOE",
    "it is a ruled grating": "GRT",
    "its shape is deformed": "DEF",
    "it is not sequential": "NSS",
    "its aperture is rectangular": "REX REY",
    "its aperture is elliptical": "ELX ELY",
    "its aperture is off the axis": "ADX ADY",
    "its aperture is turned": "ARO",
    "its two curvatures differ": "CUX RDX",
}


def curvature(word: str, is_radius: bool) -> float:
    """The curvature that a number behind S, RDY or CUY stands for; radius 0 is a plane."""
    value = number(word, "the radius" if is_radius else "the curvature")
    return (1 / value if value else 0.0) if is_radius else value


def filling(keyword: str, words: list[str]) -> dict[str, Any]:
    """What a word says of the space behind a surface: a mirror, or the name of a medium."""
    word = words[0].upper()
    if word in ("REFL", "REFR"):
        return {"mirror": word == "REFL"}
    if word in ("TIRO", "TIR"):
        raise FileFormatError(f"it reflects totally ({shown(word)}); only mirrors (REFL) are read.")
    return {"medium": words[0]}


def _kind(keyword, words):
    return keyword


def _move(keyword, words):
    return {keyword: number(words[0], keyword)}


def _term(keyword, words):
    return {ASPHERE[keyword]: number(words[0], keyword)}


def _shape(keyword, words):
    # a solve; its result stands behind S
    if len(words) > 1 or words[0].isalpha():
        return {}
    if keyword == "THI":
        return {"thickness": number(words[0], keyword)}
    return {"curvature": curvature(words[0], keyword == "RDY")}


def _smooth(keyword, words):
    if number(words[0], "the value"):
        raise FileFormatError(
            f"it is a Fresnel surface on a curved base (CUF {shown(words[0])}), which is not read; use the "
            "smooth surface."
        )


def _circle(keyword, words):
    kinds = [word.upper() for word in words[:-1] if not word.upper().startswith("L'")] or ["CLEAR"]
    if len(kinds) > 1 or kinds[0] not in ("CLEAR", "OBS", "HOL", "EDG"):
        raise FileFormatError(
            f"its aperture CIR {shown(' '.join(words))} is not understood; give CIR, CIR OBS, CIR HOL or CIR "
            "EDG with one radius."
        )
    radius = number(words[-1], keyword)
    if radius <= 0:
        raise FileFormatError(f"the radius of its aperture is {radius:g}; it must be positive.")
    return {(kinds[0], radius): True}


def _diffraction(keyword, words):
    if words[0].upper() != "DOE":
        raise FileFormatError(
            f"it diffracts as {shown(words[0])}; only DIF DOE with a radial phase is read."
        )
    return True


def _radial(keyword, words):
    if words[0].upper() != "R":
        raise FileFormatError(
            f"its phase is of the kind HCT {shown(words[0])}; only radial phases (HCT R) are read."
        )


def _order(keyword, words):
    order = number(words[0], keyword)
    if order != int(order):
        raise FileFormatError(f"its diffraction order is {order:g}; give a whole number (HOR).")
    return int(order)


def _path(keyword, words):
    if len(words) != 2 or words[0][:1].upper() != "C":
        raise FileFormatError(
            f"HCO {shown(' '.join(words))} is not understood; give HCO C1 with its value."
        )
    term = whole(words[0][1:], "the number of a phase coefficient", 16)
    if term == 0:
        raise FileFormatError("HCO C0 is not understood; coefficients count from C1.")
    return {term: number(words[1], keyword)}


SURFACE = {
    **{
        keyword: f"{reason} ({keyword}), which is not read; use a design of centred surfaces of revolution "
        "with circular apertures."
        for reason, keywords in REFUSED.items()
        for keyword in keywords.split()
    },
    **dict.fromkeys(ASPHERE, Rule("terms", _term)),
    **dict.fromkeys(("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE"), Rule("moves", _move)),
    **dict.fromkeys(("SPH", "CON", "ASP"), Rule("kind", _kind, 0)),
    **dict.fromkeys(("THI", "RDY", "CUY"), Rule("shape", _shape)),
    **dict.fromkeys(("GLA", "RMD"), Rule("filling", filling)),
    "DAR": Rule("returns", yes, 0),
    "K": Rule("conic", one_number),
    "CUF": Rule("smooth", _smooth),
    "CIR": Rule("apertures", _circle),
    "DIF": Rule("diffractive", _diffraction),
    "HCT": Rule("radial", _radial),
    "HOR": Rule("order", _order),
    "HWL": Rule("wavelength_nm", one_number),
    "HCO": Rule("path", _path),
}
# labels, weights, variables, couplings, vignetting of the bundle, colours, solves and pickups: the
# values they lead to stand in the file, or no ray changes
IDLE_WORDS = """
INI WTW WTF WTX WTY VUX VLX VUY VLY SLB CCY CCX THC CUC GLC KC AC BC CC DC EC FC GC HC JC HCC XDC YDC ZDC
ADC BDC CDC CUM THM GLM DER CLS PIK POL CA GO COM CWL PTC
"""
IDLE_TABLE = dict.fromkeys(IDLE_WORDS.split(), IDLE)


class PrivateGlasses:
    """The private catalogue of a file; ``open`` while its lines are being read."""

    def __init__(self) -> None:
        self.open = False
        self.waves_um: list[float] = []
        self.tables: dict[str, list[float] | str] = {}

    def take(self, words: list[str]) -> None:
        """Take one line of the catalogue."""
        first, *rest = words
        if first.upper() == "END":
            self.open = False
        elif first.upper() == "PWL":
            self.waves_um = [round(number(word, "PWL") * 1e-3, 12) for word in rest]  # nm
        elif rest and rest[0].isalpha():
            # a formula: refused where it is used
            self.tables[_plain(first)] = rest[0]
        else:
            self.tables[_plain(first)] = [
                number(word, f"an index of {shown(first)}") for word in rest
            ]

    def named(self, word: str) -> Glass | None:
        """Glass (or None for air) by the word behind a surface."""
        name = _plain(word)
        if name.upper() == "AIR":
            return None
        return self._private(name) if name in self.tables else Glass.named(name)

    def _private(self, name):
        table = self.tables[name]
        if isinstance(table, str):
            raise FileFormatError(
                f"its glass {shown(name)} is given by a formula ({shown(table)}), which is not read; give "
                "its indices at wavelengths (PWL)."
            )
        if (
            len(table) != len(self.waves_um)
            or len(set(self.waves_um)) < 2
            or min(self.waves_um) <= 0
        ):
            raise FileFormatError(
                f"its glass {shown(name)} has {len(table)} indices for {len(self.waves_um)} wavelengths; "
                "give one each, for at least two positive wavelengths."
            )
        waves_um, indices = zip(*sorted(zip(self.waves_um, table, strict=True)), strict=True)
        beyond = [w for w in WAVELENGTH_UM.values() if not waves_um[0] <= w <= waves_um[-1]]
        if beyond:
            raise FileFormatError(
                f"its glass {shown(name)} is given from {waves_um[0]:g} to {waves_um[-1]:g} um, without "
                f"{beyond[0]:g} um; give more indices (PWL)."
            )
        # linear in 1 / wavelength^2
        lines, knots = (-1 / np.square(list(w)) for w in (WAVELENGTH_UM.values(), waves_um))
        F, d, C = np.interp(lines, knots, indices).tolist()
        return Glass.from_indices(F, d, C, name)


def _plain(word):
    return word.strip("'\"")


class SeqSurface:
    """The values of one surface, object and image included."""

    def __init__(self, label: int | str, glasses: PrivateGlasses) -> None:
        self.label = label
        self.glasses = glasses
        self.values: dict[str, Any] = {"shape": {}, "filling": {}, "moves": {}}
        self.get = self.values.get

    def start(self, words: list[str], is_radius: bool) -> None:
        """Take the words behind S: radius or curvature, thickness, and glass or REFL."""
        shape = self.values["shape"]
        if words:
            shape["curvature"] = curvature(words[0], is_radius)
        if len(words) > 1:
            shape["thickness"] = number(words[1], "the thickness")
        for word in words[2:]:
            self.values["filling"] |= filling("S", [word])

    def take(self, keyword: str, words: list[str]) -> None:
        """Take one command. Raises: FileFormatError for what cannot be traced."""
        if not (keyword in OF_NOTHING and words and number(words[-1], "the value") == 0):
            take(self.values, SURFACE, keyword, words)

    @property
    def thickness(self) -> float:
        return self.values["shape"].get("thickness", 0.0)

    @property
    def curvature(self) -> float:
        return self.values["shape"].get("curvature", 0.0)

    @property
    def mirror(self) -> bool:
        return self.values["filling"].get("mirror", False)

    @property
    def medium(self) -> Glass | None:
        return self.glasses.named(self.values["filling"].get("medium", "AIR"))

    def check_image(self) -> None:
        if (
            self.curvature
            or self.medium is not None
            or self.mirror
            or any(self.values["moves"].values())
        ):
            raise FileFormatError(
                "the image surface is curved, tilted, shifted or followed by glass; only a flat image plane "
                "across the axis is read."
            )

    def check_object(self) -> None:
        if self.medium is not None or self.mirror:
            raise FileFormatError("the object does not lie in air; only objects in air are read.")

    def surface(self, unit_mm: float, is_stop: bool) -> FileSurface:
        """FileSurface of this surface, for a file in units of ``unit_mm``."""
        moves = self.values["moves"]
        # a turn about its own axis changes nothing
        if (
            any(value for name, value in moves.items() if name != "CDE")
            and "returns" not in self.values
        ):
            raise FileFormatError(
                "it shifts or tilts everything behind it (a decentre without DAR); only single surfaces "
                "that move are read."
            )
        if moves.get("ZDE"):
            raise FileFormatError(
                "it is shifted along the axis (ZDE); put that into the thicknesses."
            )
        kind, conic, terms = self.get("kind", "SPH"), self.get("conic", 0.0), self.get("terms", {})
        if (conic and kind == "SPH") or (any(terms.values()) and kind != "ASP"):
            raise FileFormatError(
                f"it has a conic constant or asphere terms, but its shape is {kind}; add CON or ASP, "
                "or remove them."
            )
        circles = self.get("apertures", {})
        clear = min((radius for of, radius in circles if of == "CLEAR"), default=None)
        inner = max((radius for of, radius in circles if of in ("OBS", "HOL")), default=0.0)
        top = max(terms, default=0) if kind == "ASP" else 0
        x, y, about_x, about_y = (moves.get(name, 0.0) for name in ("XDE", "YDE", "ADE", "BDE"))
        return FileSurface(
            self.label,
            self.curvature,
            self.thickness,
            self.medium,
            clear,
            clear is not None or inner > 0,
            conic,
            tuple(terms.get(i, 0.0) for i in range(1, top + 1)),
            is_stop,
            self.mirror,
            self._phase(unit_mm),
            (x, y),
            # ADE and BDE turn left-handed about +x and +y
            (-about_x, -about_y),
            inner,
        )

    def _phase(self, unit_mm):
        path = self.get("path", {})
        if not any(path.values()):
            return None
        if "diffractive" not in self.values:
            raise FileFormatError(
                "it has phase coefficients (HCO), but does not diffract; add DIF DOE, or remove them."
            )
        wavelength_nm = self.get("wavelength_nm", 0.0)
        if wavelength_nm <= 0:
            raise FileFormatError(
                "its diffractive phase has no design wavelength; give HWL in nanometres."
            )
        # radians per unit of path
        wave_number = 2 * math.pi * unit_mm / (wavelength_nm * 1e-6)
        return Phase(
            tuple(wave_number * path.get(i, 0.0) for i in range(1, max(path) + 1)),
            self.get("order", 1),
        )
