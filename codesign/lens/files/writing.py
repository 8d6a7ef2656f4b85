"""Save a lens to a file, which appears whole or not at all."""

import json
from pathlib import Path

from codesign.atomic import replacing
from codesign.errors import FileFormatError
from codesign.lens.files.native import to_page
from codesign.lens.files.text import at
from codesign.lens.files.zmx_write import to_zmx
from codesign.lens.geolens import GeoLens

WRITERS = {".json": lambda lens: json.dumps(to_page(lens), indent=2, allow_nan=False) + "\n", ".zmx": to_zmx}


def save(lens: GeoLens, path: str | Path) -> None:
    """Write the lens's current values to a .json file, exactly, or to a .zmx file for other programs
    (docs/lens_files.md says what that keeps).

    A file that was there stays until the new one is whole.
    Raises: FileFormatError when the place is not writable or the format cannot hold the lens; DomainError for
      values that ``load`` would refuse.

    Example:
    >>> from codesign import lens
    >>> lens.save(lens.load("cooke-triplet").scaled(0.5), "half.json")
    >>> round(lens.load("half.json").first_order().efl_mm.item(), 1)  # half of 50 mm
    25.0
    """
    path = Path(path)
    if path.suffix.lower() not in WRITERS:
        raise FileFormatError(
            f"lens file {path}: extension '{path.suffix}' is not written; use {' or '.join(WRITERS)}."
        )
    text = WRITERS[path.suffix.lower()](lens)
    with at(f"lens file {path}"), replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
