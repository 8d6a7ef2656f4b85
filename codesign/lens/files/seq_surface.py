"""One surface of a .seq file: its commands, what of them can be traced, and the private glasses."""

import itertools
import math
import re
from dataclasses import dataclass, field

from codesign.errors import FileFormatError
from codesign.lens.files.system import FileSurface
from codesign.lens.files.text import number, shown, whole
from codesign.lens.glass import WAVELENGTH_UM, Glass
from codesign.lens.surface import Phase

CODE = re.compile(r"(\d{3,9})\.(\d{3,9})", re.ASCII)


class PrivateGlasses:
    """The private catalogue of a file; ``open`` while its lines are being read."""

    def __init__(self) -> None:
        self.open = False
        self.waves_um: list[float] = []
        self.tables: dict[str, list[float] | str] = {}

    def take(self, words: list[str]) -> None:
        """Take one line of the catalogue."""
        if words[0].upper() == "END":
            self.open = False
        elif words[0].upper() == "PWL":
            self.waves_um = [round(number(w, "PWL") * 1e-3, 12) for w in words[1:]]  # nm
        elif len(words) > 1 and words[1].isalpha():
            self.tables[_plain(words[0])] = words[1]  # a formula: refused where it is used
        else:
            self.tables[_plain(words[0])] = [number(w, f"an index of {shown(words[0])}") for w in words[1:]]

    def named(self, word: str) -> Glass | None:
        """Glass (or None for air) by the word behind a surface."""
        name = _plain(word)
        if name.upper() == "AIR":
            return None
        if name in self.tables:
            return self._private(name)
        code = CODE.fullmatch(name)
        if code:  # 569.631: nd 1.569, Vd 63.1
            return Glass.from_abbe(
                1 + int(code[1]) / 10 ** len(code[1]), int(code[2]) / 10 ** (len(code[2]) - 2), name
            )
        return Glass.named(name)

    def _private(self, name):
        table = self.tables[name]
        if isinstance(table, str):
            raise FileFormatError(
                f"its glass {shown(name)} is given by a formula ({shown(table)}), which is not read; give "
                "its indices at wavelengths (PWL)."
            )
        if len(table) != len(self.waves_um) or len(set(self.waves_um)) < 2 or min(self.waves_um) <= 0:
            raise FileFormatError(
                f"its glass {shown(name)} has {len(table)} indices for {len(self.waves_um)} wavelengths; "
                "give one each, for at least two positive wavelengths."
            )
        points = sorted(zip(self.waves_um, table, strict=True))
        F, d, C = (_between(points, w, name) for w in WAVELENGTH_UM.values())
        return Glass.from_indices(F, d, C, name)


def _between(points, wavelength_um, name):
    """Index at a wavelength, linear in 1 / wavelength^2 between its neighbours."""
    for (a, n_a), (b, n_b) in itertools.pairwise(points):
        if a <= wavelength_um <= b and a < b:
            share = (wavelength_um**-2 - a**-2) / (b**-2 - a**-2)
            return n_a + share * (n_b - n_a)
    raise FileFormatError(
        f"its glass {shown(name)} is given from {points[0][0]:g} to {points[-1][0]:g} um, without "
        f"{wavelength_um:g} um; give more indices (PWL)."
    )


def _plain(word):
    return word.strip("'\"")


ASPHERE = {letter: 2 + i for i, letter in enumerate("ABCDEFGHJ")}  # half the power of r: A r^4 to J r^20
MOVES = ("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE")
REFUSED = {
    "REV": "it tilts or shifts everything behind it",
    "BEN": "it bends the axis",
    "RET": "it returns to the axes of another surface",
    "GLB": "it is placed in global axes",
    "XTO": "it is toroidal",
    "YTO": "it is toroidal",
    "CYL": "it is cylindrical",
    "AAS": "it is anamorphic",
    "SPS": "it is a special surface",
    "UDS": "its shape is user-defined",
    "SPL": "its shape is a spline",
    "ZRN": "its shape is not one of revolution",
    "GRN": "its index has a gradient",
    "HOE": "it is a two-point hologram",
    "GRT": "it is a ruled grating",
    "DEF": "its shape is deformed",
    "NSS": "it is not sequential",
    "REX": "its aperture is rectangular",
    "REY": "its aperture is rectangular",
    "ELX": "its aperture is elliptical",
    "ELY": "its aperture is elliptical",
    "ADX": "its aperture is off the axis",
    "ADY": "its aperture is off the axis",
    "ARO": "its aperture is turned",
    "CUX": "its two curvatures differ",
    "RDX": "its two curvatures differ",
}
OWN_WORDS = """
SPH CON ASP K CUF CIR DAR THI RDY CUY GLA DIF HOR HWL HCT HCO RMD
"""
OWN = {*OWN_WORDS.split(), *ASPHERE, *MOVES}
SURFACE = OWN | set(REFUSED)
# labels, weights, variables, couplings, vignetting of the bundle, colours, solves and pickups: the values
# they lead to stand in the file, or no ray changes
IDLE_WORDS = """
INI WTW WTF WTX WTY VUX VLX VUY VLY SLB CCY CCX THC CUC GLC KC AC BC CC DC EC FC GC HC JC HCC XDC YDC ZDC
ADC BDC CDC CUM THM GLM DER CLS PIK POL CA GO COM CWL PTC
"""
IDLE = set(IDLE_WORDS.split())


@dataclass
class SeqSurface:
    """The commands of one surface, object and image included."""

    label: int | str
    curvature: float = 0.0
    thickness: float = 0.0
    medium: Glass | None = None
    mirror: bool = False
    conic: float = 0.0
    kind: str = "SPH"
    terms: dict[int, float] = field(default_factory=dict)
    apertures: dict[str, float] = field(default_factory=dict)
    moves: dict[str, float] = field(default_factory=dict)
    returns: bool = False
    is_stop: bool = False
    diffractive: bool = False
    order: int = 1
    wavelength_nm: float | None = None
    path: dict[int, float] = field(default_factory=dict)
    glasses: PrivateGlasses = field(default_factory=PrivateGlasses)

    def shape(self, values: list[str], radius_mode: bool, glasses: PrivateGlasses) -> None:
        """The numbers behind S: radius or curvature, thickness, and glass or REFL."""
        self.glasses = glasses
        self.curvature = _curvature(values[0], radius_mode) if values else 0.0
        self.thickness = number(values[1], "the thickness") if len(values) > 1 else 0.0
        for word in values[2:]:
            self._medium(word)

    def _medium(self, word):
        if word.upper() in ("REFL", "REFR"):
            self.mirror = word.upper() == "REFL"
        elif word.upper() in ("TIRO", "TIR"):
            raise FileFormatError(f"it reflects totally ({shown(word)}); only mirrors (REFL) are read.")
        else:
            self.medium = self.glasses.named(word)

    def take(self, command: str, values: list[str]) -> None:
        """Take one command. Raises: FileFormatError for what cannot be traced."""
        first = values[0].upper() if values else ""
        if command in REFUSED:
            off_axis_by_nothing = (
                command in ("ADX", "ADY", "ARO", "CUX", "RDX") and values and _is_zero(values[-1])
            )
            if not off_axis_by_nothing:
                raise FileFormatError(
                    f"{REFUSED[command]} ({command}), which is not read; use a design of centred surfaces "
                    "of revolution with circular apertures."
                )
        elif command in ("SPH", "CON", "ASP"):
            self.kind = command
        elif command == "DAR":
            self.returns = True
        elif not values:
            raise FileFormatError(f"{command} has no value; give one.")
        elif command == "K":
            self.conic = number(first, command)
        elif command in ASPHERE:
            self.terms[ASPHERE[command]] = number(first, command)
        elif command in MOVES:
            self.moves[command] = number(first, command)
        elif command == "CUF" and not _is_zero(first):
            raise FileFormatError(
                f"it is a Fresnel surface on a curved base (CUF {shown(first)}), which is not read; use the "
                "smooth surface."
            )
        elif command == "CIR":
            self._take_circle(values)
        elif command in ("THI", "RDY", "CUY", "GLA", "RMD"):
            self._take_shape(command, values)
        elif command in ("DIF", "HOR", "HWL", "HCT", "HCO"):
            self._take_diffraction(command, values)

    def _take_shape(self, command, values):
        if command in ("GLA", "RMD"):
            self._medium(values[0])
        elif len(values) > 1 or values[0].isalpha():
            return  # a solve; its result stands behind S
        elif command == "THI":
            self.thickness = number(values[0], command)
        else:
            self.curvature = _curvature(values[0], command == "RDY")

    def _take_circle(self, values):
        words = [v.upper() for v in values[:-1] if not v.upper().startswith("L'")]
        kind = words[0] if words else "CLEAR"
        if len(words) > 1 or kind not in ("CLEAR", "OBS", "HOL", "EDG"):
            raise FileFormatError(
                f"its aperture CIR {shown(' '.join(values))} is not understood; give CIR, CIR OBS, CIR HOL "
                "or CIR EDG with one radius."
            )
        radius = number(values[-1], "CIR")
        if radius <= 0:
            raise FileFormatError(f"the radius of its aperture is {radius:g}; it must be positive.")
        self.apertures[kind] = (
            min(radius, self.apertures.get(kind, math.inf))
            if kind == "CLEAR"
            else max(radius, self.apertures.get(kind, 0.0))
        )

    def _take_diffraction(self, command, values):
        if command == "DIF":
            if values[0].upper() != "DOE":
                raise FileFormatError(
                    f"it diffracts as {shown(values[0])}; only DIF DOE with a radial phase is read."
                )
            self.diffractive = True
        elif command == "HCT" and values[0].upper() != "R":
            raise FileFormatError(
                f"its phase is of the kind HCT {shown(values[0])}; only radial phases (HCT R) are read."
            )
        elif command == "HOR":
            order = number(values[0], command)
            if order != int(order):
                raise FileFormatError(f"its diffraction order is {order:g}; give a whole number (HOR).")
            self.order = int(order)
        elif command == "HWL":
            self.wavelength_nm = number(values[0], command)
        elif command == "HCO":
            if len(values) != 2 or values[0][:1].upper() != "C":
                raise FileFormatError(
                    f"HCO {shown(' '.join(values))} is not understood; give HCO C1 with its value."
                )
            term = whole(values[0][1:], "the number of a phase coefficient", 16)
            if term == 0:
                raise FileFormatError("HCO C0 is not understood; coefficients count from C1.")
            self.path[term] = number(values[1], "HCO")

    def check_image(self) -> None:
        if self.curvature or self.medium is not None or self.mirror or any(self.moves.values()):
            raise FileFormatError(
                "the image surface is curved, tilted, shifted or followed by glass; only a flat image plane "
                "across the axis is read."
            )

    def check_object(self) -> None:
        if self.medium is not None or self.mirror:
            raise FileFormatError("the object does not lie in air; only objects in air are read.")

    def finish(self, unit_mm: float) -> FileSurface:
        """FileSurface of this surface, for a file in units of ``unit_mm``."""
        # a turn about its own axis changes nothing
        moved = any(v for name, v in self.moves.items() if name != "CDE")
        if moved and not self.returns:
            raise FileFormatError(
                "it shifts or tilts everything behind it (a decentre without DAR); only single surfaces "
                "that move are read."
            )
        if self.moves.get("ZDE"):
            raise FileFormatError("it is shifted along the axis (ZDE); put that into the thicknesses.")
        if (self.conic and self.kind == "SPH") or (any(self.terms.values()) and self.kind != "ASP"):
            raise FileFormatError(
                f"it has a conic constant or asphere terms, but its shape is {self.kind}; add CON or ASP, "
                "or remove them."
            )
        top = max(self.terms, default=0) if self.kind == "ASP" else 0

        def move(name):
            return self.moves.get(name, 0.0)

        inner = max(self.apertures.get("OBS", 0.0), self.apertures.get("HOL", 0.0))
        # ADE and BDE turn left-handed about +x and +y
        return FileSurface(
            self.label,
            self.curvature,
            self.thickness,
            self.medium,
            self.apertures.get("CLEAR"),
            "CLEAR" in self.apertures or inner > 0,
            self.conic,
            tuple(self.terms.get(i, 0.0) for i in range(1, top + 1)),
            self.is_stop,
            self.mirror,
            self._phase(unit_mm),
            (move("XDE"), move("YDE")),
            (-move("ADE"), -move("BDE")),
            inner,
        )

    def _phase(self, unit_mm):
        if not any(self.path.values()):
            return None
        if not self.diffractive:
            raise FileFormatError(
                "it has phase coefficients (HCO), but does not diffract; add DIF DOE, or remove them."
            )
        if self.wavelength_nm is None or self.wavelength_nm <= 0:
            raise FileFormatError("its diffractive phase has no design wavelength; give HWL in nanometres.")
        wave_number = 2 * math.pi * unit_mm / (self.wavelength_nm * 1e-6)  # radians per unit of path
        return Phase(
            tuple(wave_number * self.path.get(i, 0.0) for i in range(1, max(self.path) + 1)), self.order
        )


def _curvature(word, is_radius):
    value = number(word, "the radius" if is_radius else "the curvature")
    return (1 / value if value else 0.0) if is_radius else value


def _is_zero(word):
    return number(word, "the value") == 0
