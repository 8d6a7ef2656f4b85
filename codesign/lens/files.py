"""Load a lens by name or from a JSON file, and save it. Files are parsed, never executed."""

import json
import os
from pathlib import Path

import torch

from codesign.errors import CodesignError, FileFormatError
from codesign.lens.catalogue import LENSES, named_surfaces
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import Glass
from codesign.lens.surface import Surface

SCHEMA = "codesign-lens/1"
LARGEST_BYTES, MOST_SURFACES = 1_000_000, 200


def load(source, dtype=torch.float64):
    """Lens from a catalogue name (cooke-triplet, double-gauss, la1509) or a .json file written by ``save``.

    Raises: FileFormatError naming the file, the fault and the remedy.
    """
    if str(source) in LENSES:
        surfaces, diameter = named_surfaces(str(source))
        return GeoLens(surfaces, diameter, dtype, name=str(source))
    path = Path(source)
    if not os.path.exists(path):
        raise FileFormatError(f"lens '{source}' is neither a file nor a known name; known names: {', '.join(LENSES)}.")
    if path.suffix.lower() != ".json":
        raise FileFormatError(f"lens file {path}: extension '{path.suffix}' is not read; give a .json file or one of {', '.join(LENSES)}.")
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise FileFormatError(f"lens file {path} has {size} bytes; a lens file has at most {LARGEST_BYTES}.")
        page = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        if isinstance(error, CodesignError):
            raise
        raise FileFormatError(f"lens file {path} is not readable JSON ({error}); write it again with lens.save.") from error
    return _from_page(page, path, dtype)


def _from_page(page, path, dtype):
    if not isinstance(page, dict) or page.get("schema") != SCHEMA:
        raise FileFormatError(f"lens file {path}: \"schema\" must be \"{SCHEMA}\"; write it with lens.save, or see docs/lens_json.md.")
    rows = page.get("surfaces")
    if not isinstance(rows, list) or not 0 < len(rows) <= MOST_SURFACES:
        raise FileFormatError(f"lens file {path}: \"surfaces\" must be a list of 1 to {MOST_SURFACES} surfaces; add at least one.")
    place = ""
    try:
        diameter = _number(page, "entrance_pupil_diameter_mm")
        soft_edge = _number(page, "soft_edge_mm", 0.2)
        surfaces = []
        for i, row in enumerate(rows):
            place = f", surface {i + 1}"
            surfaces.append(_surface(row))
        place = ""
        return GeoLens(surfaces, diameter, dtype, soft_edge, str(page.get("name", path.stem))[:80])
    except CodesignError as error:
        raise type(error)(f"lens file {path}{place}: {error}") from error
    except KeyError as error:
        raise FileFormatError(f"lens file {path}{place}: the field {error} is missing; see docs/lens_json.md.") from error
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise FileFormatError(f"lens file {path}{place}: a field is of the wrong kind ({error}); see docs/lens_json.md.") from error


def _number(row, key, default=None):
    value = row[key] if default is None else row.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{key} is {str(value)[:40]!r}, a number is needed")
    return float(value)


def _surface(row):
    radius = row["radius_mm"]
    radius = float("inf") if radius is None else _number(row, "radius_mm")
    medium = row.get("medium")
    if isinstance(medium, str):
        medium = Glass.named(medium)
    elif medium is not None:
        medium = Glass.from_indices(_number(medium, "F"), _number(medium, "d"), _number(medium, "C"), str(medium.get("name", "custom"))[:40])
    terms = row.get("asphere", [])
    if not isinstance(terms, list) or len(terms) > 16:
        raise TypeError(f"asphere is {str(terms)[:40]}, a list of at most 16 numbers is needed")
    asphere = tuple(_number({"asphere": a}, "asphere") for a in terms)
    is_stop = row.get("is_stop", False)
    if not isinstance(is_stop, bool):
        raise TypeError(f"is_stop is {str(is_stop)[:40]!r}, true or false is needed")
    return Surface(radius, _number(row, "thickness_mm"), medium, _number(row, "semi_aperture_mm"), _number(row, "conic", 0.0), asphere, is_stop)


def save(lens, path):
    """Write the lens's current values to a .json file (atomically: a file that was there stays until the new one is whole).

    Raises: FileFormatError when the place is not writable; DomainError for values that ``load`` would refuse.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise FileFormatError(f"lens file {path}: extension '{path.suffix}' is not written; use .json.")
    rows = []
    for i, s in enumerate(lens.to_surfaces()):
        s.check(f"{lens.name}, surface {i + 1}")
        medium = None if s.medium is None else {"name": s.medium.name, "F": s.medium.index_F, "d": s.medium.index_d, "C": s.medium.index_C}
        radius = None if s.radius_mm == float("inf") else s.radius_mm
        rows.append({"radius_mm": radius, "thickness_mm": s.thickness_mm, "medium": medium, "semi_aperture_mm": s.semi_aperture_mm, "conic": s.conic, "asphere": list(s.asphere), "is_stop": s.is_stop})
    page = {"schema": SCHEMA, "name": lens.name, "entrance_pupil_diameter_mm": lens.entrance_pupil_diameter_mm, "soft_edge_mm": lens.soft_edge_mm, "surfaces": rows}
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(json.dumps(page, indent=2) + "\n", encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        if os.path.isfile(part):
            part.unlink()
        raise FileFormatError(f"lens file {path} cannot be written ({error.strerror}); choose a folder you may write to.") from error
