"""Published dispersion coefficients of optical glasses and plastics: glasses.txt, one per line.

Each row: name, model (see ``codesign.lens.glass.MODELS``), first and last wavelength (um) of the published
  range, the nd and Vd
that the same publication states beside the coefficients (kept to check them), coefficients. A line that
starts with # names
the source of the rows below it. Indices are relative to air at 20 to 25 C, wavelengths in air, as the
catalogues state.
Coefficients are facts of the makers' catalogues; read from the refractiveindex.info database (CC0) and public
catalogue files.
"""

from collections.abc import Iterator
from importlib.resources import files

# other spellings in use -> row; CODE V's manufacturer suffixes and all of "-", "_" and " " are dropped before
# a name is looked up
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


def rows() -> Iterator[tuple[str, str, tuple[float, float], tuple[float, float], tuple[float, ...], str]]:
    """Name, model, range in um, published (nd, Vd), coefficients and source of each entry."""
    source = ""
    for line in files("codesign.lens").joinpath("glasses.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            source = line[2:]
            continue
        name, model, *numbers = line.split()
        first, last, nd, abbe, *coefficients = map(float, numbers)
        yield name, model, (first, last), (nd, abbe), tuple(coefficients), source
