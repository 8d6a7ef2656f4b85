"""Load a lens by name or from a file, and save one."""

import json
import math
import os
import warnings
from pathlib import Path

import torch

from codesign.atomic import replacing
from codesign.errors import FileFormatError
from codesign.lens import catalogue
from codesign.lens.files import page
from codesign.lens.files.assemble import assemble
from codesign.lens.files.native import read_native, to_page
from codesign.lens.files.optiland import is_optiland, read_optiland
from codesign.lens.files.seq import read_seq
from codesign.lens.files.tables import is_deeplens, read_deeplens, read_diffoptics
from codesign.lens.files.text import at, read_text, title
from codesign.lens.files.zmx import read_zmx
from codesign.lens.files.zmx_write import to_zmx
from codesign.lens.geolens import GeoLens
from codesign.reading import reading

TEXTS = {".zmx": read_zmx, ".seq": read_seq, ".txt": read_diffoptics}

# share of its semi-aperture by which a stop may stand beside the axis without a word
SEEN = 1e-3


def load(source: str | Path, dtype: torch.dtype = torch.float64) -> GeoLens:
    """Lens from a catalogue name (cooke-triplet, double-gauss, la1509) or a file;
    docs/lens_files.md says what is read of each.

    Args:
      source: name, or path with the extension .json (native, DeepLens or optiland), .zmx, .seq, or
        .txt (DiffOptics).
      dtype: precision of the lens.
    Returns: GeoLens. Files are parsed, never executed; at most 2 MB and 500 surfaces are read.
    Warns: when coordinate breaks of a .zmx file put the stop beside the axis, and when nd and Vd
      beside a glass of its first catalogue are those of another; when the stop cuts the pupil.
    Raises: FileFormatError or DomainError, one sentence naming file, place, fault and remedy;
      nothing is half loaded or dropped.

    Example:
    >>> from codesign import lens
    >>> geo = lens.load("cooke-triplet")
    >>> len(geo.surfaces), geo.half_field_deg
    (6, 20.0)
    """
    if str(source) in catalogue.LENSES:
        surfaces, diameter = catalogue.named_surfaces(str(source))
        return GeoLens(
            surfaces,
            diameter,
            dtype,
            name=str(source),
            half_field_deg=catalogue.half_field_deg(str(source)),
        )
    path = Path(source)
    if not os.path.exists(path):
        raise FileFormatError(
            f"lens '{str(source)[:200]}' is neither a file nor a known name; known names: "
            f"{', '.join(catalogue.LENSES)}."
        )
    with at(f"lens file {path}"):
        suffix = path.suffix.lower()
        if suffix not in (".json", *TEXTS):
            raise FileFormatError(
                f"extension '{path.suffix}' is not read; give .json, {', '.join(TEXTS)}, or one of "
                f"{', '.join(catalogue.LENSES)}."
            )
        text = read_text(path)
        name = title(path.stem, "lens")
        with reading("a value", "it is of the wrong kind or size; see docs/lens_files.md"):
            geo = (
                _from_json(text, name, dtype)
                if suffix == ".json"
                else assemble(TEXTS[suffix](text, name), dtype)
            )
    beside_mm = math.hypot(*geo.decentre_mm[geo.stop_index].tolist())
    if suffix == ".zmx" and beside_mm > SEEN * float(geo.semi_aperture_mm[geo.stop_index]):
        warnings.warn(
            f"lens file {path}: the centre of the stop lies {beside_mm:.4g} mm beside the axis, the normal "
            "of the image plane through its centre; first-order figures and pupils are those of that "
            "axis, so trace rays of your own or aim them (camera_rays(aim=True)).",
            stacklevel=3,
        )
    return geo


def _from_json(text, name, dtype):
    found = page.parse(text)
    if is_optiland(found):
        return assemble(read_optiland(found, name), dtype)
    if is_deeplens(found):
        return assemble(read_deeplens(found, name), dtype)
    return read_native(found, name, dtype)


WRITERS = {
    ".json": lambda lens: json.dumps(to_page(lens), indent=2, allow_nan=False) + "\n",
    ".zmx": to_zmx,
}


def save(lens: GeoLens, path: str | Path) -> None:
    """Write the lens's current values to a .json file, exactly, or to a .zmx file for other
    programs (docs/lens_files.md says what that keeps).

    A file that was there stays until the new one is whole.
    Raises: FileFormatError when the place is not writable or the format cannot hold the lens;
      DomainError for values that ``load`` would refuse.

    Example:
    >>> from codesign import lens
    >>> lens.save(lens.load("cooke-triplet").scaled(0.5), "half.json")
    >>> round(lens.load("half.json").first_order().efl_mm.item(), 1)  # half of 50 mm
    25.0
    """
    path = Path(path)
    text = text_of(lens, path)
    with at(f"lens file {path}"), replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def text_of(lens: GeoLens, path: Path) -> str:
    """What ``save`` writes to such a file."""
    if path.suffix.lower() not in WRITERS:
        raise FileFormatError(
            f"lens file {path}: extension '{path.suffix}' is not written; use {' or '.join(WRITERS)}."
        )
    return WRITERS[path.suffix.lower()](lens)
