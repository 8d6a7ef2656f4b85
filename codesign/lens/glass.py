"""Optical media: refractive index, relative to air, as a function of wavelength
(um, in air at 20 C)."""

import difflib
import functools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

from codesign.errors import DomainError

WAVELENGTH_UM = {"F": 0.4861327, "d": 0.5875618, "C": 0.6562725}
# whose figures are those of a lens, unless another wavelength is asked for
D_UM = WAVELENGTH_UM["d"]
LONGEST_NAME = 80
LONGEST_SOURCE = 200
LEAST_INDEX = 1.0
INDEX_LIMIT = 5.0
_LINES_RANGE_UM = (0.36, 1.1)
# CODE V writes NBK7_SCHOTT; the last three stand for catalogues, not makers
_MAKERS = (
    "SCHOTT",
    "OHARA",
    "HOYA",
    "HIKARI",
    "NIKON",
    "SUMITA",
    "CDGM",
    "CORNING",
    "LIGHTPATH",
    "ZEON",
    "SPECIAL",
    "MISC",
    "PLASTIC",
)
# other spellings in use -> row; CODE V's manufacturer suffixes and all of "-", "_" and " " are
# dropped before a name is looked up
ALIASES = {
    "SILICA": "F-SILICA",
    "FUSED SILICA": "F-SILICA",
    "SIO2": "F-SILICA",
    "HPFS7980": "C79-80",
    "7980": "C79-80",
    "AL2O3": "SAPPHIRE",
    "SSK4": "SSK4A",
    "E48": "E48R",
    "ZEONEX E48R": "E48R",
    "ZEONEX 480R": "480R",
    "PC": "POLYCARB",
    "POLYCARBONATE": "POLYCARB",
    "PS": "POLYSTYR",
    "POLYSTYRENE": "POLYSTYR",
}
_CODE = re.compile(r"([0-9]{3})([0-9]{3})(?:\.[0-9]{3})?|([0-9]{3,9})\.([0-9]{3,9})")
_PAIR = re.compile(r"([0-9]\.[0-9]{1,16}) ?[/:] ?([0-9]{1,3}(?:\.[0-9]{1,16})?)")


def maker_of(text: str) -> str | None:
    """The maker of glass that a text names; None where it names none, or a catalogue of several."""
    found = next((maker for maker in _MAKERS[:-3] if maker in text.upper()), None)
    return "HIKARI" if found == "NIKON" else found  # one catalogue


def _conrady(wavelength_um):
    return 1 / wavelength_um, wavelength_um**-3.5


def _area(a, b, c):
    """Twice the area of a triangle; the shares of three such areas interpolate linearly."""
    return (a[0] - c[0]) * (b[1] - c[1]) - (b[0] - c[0]) * (a[1] - c[1])


def _through_lines(indices, wavelength_um):
    """A + B/w + C/w^3.5 through the indices at F, d and C, exact at each. Source: Conrady, Applied
    Optics and Optical Design."""
    F, d, C, w = (_conrady(x) for x in (*WAVELENGTH_UM.values(), wavelength_um))
    whole = _area(F, d, C)
    return (
        indices[0] * (_area(w, d, C) / whole)
        + indices[1] * (_area(F, w, C) / whole)
        + indices[2] * (_area(F, d, w) / whole)
    )


def _sellmeier(coefficients, wavelength_um):
    """n^2 - 1 = sum of B w^2 / (w^2 - C); coefficients B1, C1 (um^2), B2, C2, ..."""
    square = wavelength_um**2
    return _root(
        1
        + sum(
            b * square / (square - c)
            for b, c in zip(coefficients[::2], coefficients[1::2], strict=True)
        )
    )


def _schott(coefficients, wavelength_um):
    """n^2 = sum of a w^k, k = 0, 2, -2, -4, -6, -8 (Schott before 1992), then -10, -12 and 4
    (Hikari's extension)."""
    return _root(
        sum(
            a * wavelength_um**k
            for a, k in zip(coefficients, (0, 2, -2, -4, -6, -8, -10, -12, 4), strict=False)
        )
    )


def _cauchy(coefficients, wavelength_um):
    """n = A + B/w^2 + C/w^4 + ..."""
    return sum(a * wavelength_um ** (-2 * i) for i, a in enumerate(coefficients))


def _root(square):
    return math.sqrt(square) if square > 0 else math.nan


# model -> (function of coefficients and wavelength, allowed numbers of coefficients)
MODELS = {
    "lines": (_through_lines, (3,)),
    "sellmeier": (_sellmeier, (2, 4, 6, 8, 10, 12)),
    "schott": (_schott, tuple(range(1, 10))),
    "cauchy": (_cauchy, tuple(range(1, 7))),
}


@dataclass(frozen=True)
class Glass:
    """A medium: a dispersion model of ``MODELS``, its coefficients, and the wavelengths (um) they
    hold for.

    offset: added to the model's index at every wavelength (melt data, or an index that was
      optimised).
    Raises: DomainError for a name, model, coefficients or range that cannot be, or an index outside
      [1, 5) at F, d or C.
    """

    name: str
    model: str
    coefficients: tuple[float, ...]
    range_um: tuple[float, float] = _LINES_RANGE_UM
    source: str = ""
    offset: float = 0.0

    def __post_init__(self) -> None:
        if (
            not isinstance(self.name, str)
            or not 0 < len(self.name) <= LONGEST_NAME
            or not self.name.isprintable()
        ):
            raise DomainError(
                f"glass name {_cut(self.name)} must be 1 to {LONGEST_NAME} printable characters."
            )
        if not isinstance(self.source, str) or len(self.source) > LONGEST_SOURCE:
            raise DomainError(
                f"glass {self.name}: source {_cut(self.source)} must be a text of at most {LONGEST_SOURCE} "
                "characters."
            )
        if not isinstance(self.model, str) or self.model not in MODELS:
            raise DomainError(
                f"glass {self.name}: model {_cut(self.model)} is not known; known models: "
                f"{', '.join(MODELS)}."
            )
        counts = MODELS[self.model][1]
        coefficients = _numbers(self, "coefficients", self.coefficients)
        span = _numbers(self, "range_um", self.range_um)
        if len(coefficients) not in counts:
            raise DomainError(
                f"glass {self.name}: model {self.model} takes {' or '.join(map(str, counts))} coefficients, "
                f"{len(coefficients)} were given."
            )
        if len(span) != 2 or not 0.1 <= span[0] < span[1] <= 100:
            raise DomainError(
                f"glass {self.name}: range_um {span} must be two increasing wavelengths in micrometres, 0.1 "
                "to 100."
            )
        if self.model == "sellmeier" and any(
            span[0] ** 2 <= c <= span[1] ** 2 for c in coefficients[1::2]
        ):
            raise DomainError(
                f"glass {self.name}: a resonance lies inside {span[0]:g} to {span[1]:g} um, where the index "
                "is infinite; give a range on one side of it."
            )
        object.__setattr__(self, "coefficients", coefficients)
        object.__setattr__(self, "range_um", span)
        object.__setattr__(self, "offset", _numbers(self, "offset", (self.offset,))[0])
        lines = [w for w in WAVELENGTH_UM.values() if span[0] <= w <= span[1]] or [sum(span) / 2]
        for wavelength_um in lines:
            self.index(wavelength_um)

    @staticmethod
    def from_indices(F: float, d: float, C: float, name: str = "custom") -> "Glass":
        """Glass from its indices at the F, d and C lines, each in [1, 5); exact there, valid from
        0.36 to 1.1 um.

        Errors over the catalogue, median and 95th percentile: 2e-5, 1.5e-4 from 0.45 to 0.70 um;
        7e-5, 1.4e-4 at 0.85 um.
        Source: Conrady's three-term formula. Raises: DomainError.
        """
        if not all(_is_number(n) and LEAST_INDEX <= n < INDEX_LIMIT for n in (F, d, C)):
            raise DomainError(
                f"glass {_cut(name)}: indices F={_cut(F)}, d={_cut(d)}, C={_cut(C)} must lie in [1, 5); "
                "check the catalogue page."
            )
        return Glass(name, "lines", (F, d, C))

    @staticmethod
    def from_abbe(nd: float, Vd: float, name: str | None = None) -> "Glass":
        """Glass from nd and the Abbe number Vd = (nd - 1) / (nF - nC), which it has exactly.

        The third condition is the partial dispersion (nF - nd) / (nF - nC) = 0.6831 + 0.7828 / Vd,
        the least-squares line over 429 glasses of the catalogue: they scatter about it by 0.0019
        (about a line in Vd by 0.0028). Errors over these glasses, median, 95th percentile and
        worst: 1.6e-5, 5e-5, 3.3e-4 at F and C; 6e-5, 1.7e-4, 7e-4 from 0.45 to 0.70 um; 9e-5,
        2.8e-4, 6e-4 at g (0.4358 um); 1.1e-4, 3.7e-4, 2.2e-3 at 0.85 um. The normal line P_gF =
        0.6438 - 0.001682 Vd in its place has the same medians, but 3.0e-4 and 1.5e-3 from 0.45 to
        0.70 um: dense flints lie far from it.
        Args: nd in (1, 5); Vd from 10 to 150.
        Raises: DomainError.
        """
        numbers = _is_number(nd) and _is_number(Vd)
        if not (numbers and LEAST_INDEX < nd < INDEX_LIMIT and 10 <= Vd <= 150):
            raise DomainError(
                f"glass {'' if name is None else _cut(name) + ': '}nd={_cut(nd)}, Vd={_cut(Vd)}: nd must "
                "lie in (1, 5) and Vd in 10 to 150; for a medium without dispersion use Glass.from_indices."
            )
        spread = (nd - 1) / Vd
        index_F = nd + (0.6831 + 0.7828 / Vd) * spread
        return Glass.from_indices(index_F, nd, index_F - spread, name or f"{nd:.6g}/{Vd:.5g}")

    @staticmethod
    def named(name: str, catalogues: Sequence[str] = ()) -> "Glass":
        """Glass by its catalogue name; case, "-", "_", spaces and a manufacturer suffix
        (NBK7_SCHOTT) do not matter.

        catalogues: that a file takes its glasses from (GCAT of a .zmx: makers, SUMITA_AUG2011).
          Where all of them are makers known here, a glass of that name by another maker is refused;
          one that the catalogue keeps apart (SF15_HIKARI) is that of the first that made one.

        What looks like a code stands for nd and Vd, as in ``from_abbe``: 517642, 517.642,
        517642.251, 517000.642000, 1.5168/64.17.
        Raises: DomainError that offers the three nearest names.

        Example:
        >>> from codesign import lens
        >>> glass = lens.Glass.named("nbk7_schott")
        >>> glass.name, round(glass.index_d, 5), round(glass.abbe_number, 2)
        ('N-BK7', 1.5168, 64.17)
        """
        if not isinstance(name, str) or len(name) > LONGEST_NAME:
            raise DomainError(
                f"glass name {_cut(name)} must be a text of at most {LONGEST_NAME} characters."
            )
        text = name.strip().upper()
        stem, _, maker = text.rpartition("_")
        known = _by_key()
        keys = (_key(f"{text}_{maker_of(catalogue)}") for catalogue in catalogues)
        glass = next((known[key] for key in keys if key in known), known.get(_key(text)))
        if glass is None and maker in _MAKERS:
            found = known.get(_key(stem))
            # LAF20 of Hoya is not LAF20 of Schott
            if found is not None and (maker in found.source.upper() or maker in _MAKERS[-3:]):
                glass = found
        if glass is None:
            glass = _from_code(text)
        if glass is None:
            near = difflib.get_close_matches(_key(text), known, n=8, cutoff=0.0)
            offers = ", ".join(list(dict.fromkeys(known[key].name for key in near))[:3])
            raise DomainError(
                f"glass {_cut(name)} is not in the catalogue; the nearest names are {offers}; else give "
                "Glass.from_indices or Glass.from_abbe, in a .zmx a line such as GLAS ___BLANK 1 0 nd Vd."
            )
        told = [maker_of(catalogue) for catalogue in catalogues]
        maker = maker_of(glass.source)
        if told and maker and None not in told and maker not in told:
            raise DomainError(
                f"glass {_cut(name)} is that of {maker.title()} in the catalogue, and the file takes its glasses from "
                f"{_cut(' '.join(catalogues))}; give its indices, in a .zmx as GLAS ___BLANK 1 0 nd Vd."
            )
        return glass

    @staticmethod
    def from_dict(page: dict[str, Any]) -> "Glass":
        """Glass from what ``dataclasses.asdict`` gives of one, or from {"name", "F", "d", "C"};
        anything else is a DomainError."""
        if not isinstance(page, dict):
            raise DomainError(
                f"glass {_cut(page)} must be an object with name, model, coefficients and range_um, or with "
                "F, d and C."
            )
        needed, free = (
            (("name", "model", "coefficients", "range_um"), ("source", "offset"))
            if "model" in page
            else (("F", "d", "C"), ("name",))
        )
        wrong = [f"'{key}' is missing" for key in needed if key not in page]
        wrong += [f"{_cut(key)} is not known" for key in page if key not in (*needed, *free)]
        if wrong:
            raise DomainError(
                f"glass {_cut(page.get('name', 'custom'))}: the field {wrong[0]}; it has "
                f"{', '.join((*needed, *free))}."
            )
        return Glass(**page) if "model" in page else Glass.from_indices(**page)

    def shifted(self, offset: float) -> "Glass":
        """The same medium with its index larger by ``offset`` at every wavelength."""
        return replace(self, offset=self.offset + offset)

    def index(self, wavelength_um: float) -> float:
        """Index at a wavelength in micrometres. Raises: DomainError outside the range of the glass,
        or where the model leaves [1, 5)."""
        first, last = self.range_um
        if not first <= wavelength_um <= last:
            raise DomainError(
                f"glass {self.name}: wavelength {wavelength_um:g} um lies outside {first:g} to {last:g} um, "
                "where it is known; give a wavelength in micrometres."
            )
        value = MODELS[self.model][0](self.coefficients, wavelength_um) + self.offset
        if not LEAST_INDEX <= value < INDEX_LIMIT:
            raise DomainError(
                f"glass {self.name}: index {value:.6g} at {wavelength_um:g} um must lie in [1, 5); check "
                "coefficients and offset."
            )
        return value

    @property
    def index_F(self) -> float:
        return self.index(WAVELENGTH_UM["F"])

    @property
    def index_d(self) -> float:
        return self.index(D_UM)

    @property
    def index_C(self) -> float:
        return self.index(WAVELENGTH_UM["C"])

    @property
    def abbe_number(self) -> float:
        """Vd = (nd - 1) / (nF - nC); infinite without dispersion."""
        spread = self.index_F - self.index_C
        return (self.index_d - 1) / spread if spread else math.inf


def rows() -> Iterator[
    tuple[str, str, tuple[float, float], tuple[float, float], tuple[float, ...], str]
]:
    """Name, model, range in um, published (nd, Vd), coefficients and source of each entry of
    glasses.txt.

    A row there holds them in this order; a line that starts with # names the source of the rows
    below it. Indices are relative to air at 20 to 25 C, wavelengths in air, as the catalogues
    state. Coefficients are facts of the makers' catalogues; read from the refractiveindex.info
    database (CC0) and public catalogue files.
    """
    source = ""
    for line in (
        files("codesign.lens").joinpath("glasses.txt").read_text(encoding="utf-8").splitlines()
    ):
        if line.startswith("#"):
            source = line[2:]
            continue
        name, model, *numbers = line.split()
        first, last, nd, abbe, *coefficients = map(float, numbers)
        yield name, model, (first, last), (nd, abbe), tuple(coefficients), source


def names() -> tuple[str, ...]:
    """The names of the catalogue, in its order."""
    return tuple(dict.fromkeys(glass.name for glass in _by_key().values()))


@functools.cache
def _by_key():
    found = {
        _key(name): Glass(name, model, coefficients, span, source)
        for name, model, span, _, coefficients, source in rows()
    }
    found |= {_key(alias): found[_key(name)] for alias, name in ALIASES.items()}
    return found | {"AIR": AIR}


def _key(name):
    return re.sub(r"[-_\s]", "", name.upper())


def _from_code(text):
    """Glass of a six-digit code (517642 is nd 1.517, Vd 64.2) or an nd/Vd pair; None when it is
    neither."""
    if pair := _PAIR.fullmatch(text):
        return Glass.from_abbe(float(pair[1]), float(pair[2]), text)
    if code := _CODE.fullmatch(text):
        index, abbe = (code[1], code[2]) if code[1] else (code[3], code[4])
        nd = 1 + int(index) / 10 ** len(index)
        # no glass lies below 1.28, so 003283 is nd 2.003
        return Glass.from_abbe(
            nd if nd >= 1.28 else nd + 1, int(abbe) / 10 ** (len(abbe) - 2), text
        )
    return None


def _is_number(value):
    # an integer of 400 digits is no float
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= 1e6


def _numbers(glass, field, values):
    if (
        not isinstance(values, (tuple, list))
        or len(values) > 12
        or not all(map(_is_number, values))
    ):
        raise DomainError(
            f"glass {glass.name}: {field} {_cut(values)} must be at most 12 finite numbers of at most 1e6."
        )
    return tuple(map(float, values))


def _cut(value):
    """A value in quotes, short enough for a sentence."""
    if isinstance(value, (list, tuple, dict)):
        return f"({type(value).__name__} of {len(value)})"
    if isinstance(value, int) and abs(value) > 10**20:
        return "(an integer of more than 20 digits)"
    text = (
        repr(value) if not isinstance(value, str) or len(value) <= 40 else repr(value[:40]) + "..."
    )
    return text if len(text) <= 60 else text[:60] + "..."


AIR = Glass("air", "cauchy", (1.0,), (0.1, 100.0))
