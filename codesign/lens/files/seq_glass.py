"""The private glasses of a .seq file."""

import numpy as np

from codesign.errors import FileFormatError
from codesign.lens.files.text import number, shown
from codesign.lens.glass import WAVELENGTH_UM, Glass


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
            self.tables[_plain(first)] = [number(word, f"an index of {shown(first)}") for word in rest]

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
        if len(table) != len(self.waves_um) or len(set(self.waves_um)) < 2 or min(self.waves_um) <= 0:
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
        return Glass.from_indices(*np.interp(lines, knots, indices).tolist(), name)


def _plain(word):
    return word.strip("'\"")
