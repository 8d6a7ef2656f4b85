"""Glasses of .seq files: catalogue names, codes such as 569.631, and the private catalogue PRV ... END."""

import itertools
import re

from codesign.errors import FileFormatError
from codesign.lens.files.text import number, shown
from codesign.lens.glass import WAVELENGTH_UM, Glass

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
