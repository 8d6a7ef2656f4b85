"""The native JSON format: what a GeoLens is, to the last bit."""

import dataclasses
import functools
import math
from typing import Any

import torch

from codesign.errors import FileFormatError
from codesign.lens.files import page as p
from codesign.lens.files.page import Page
from codesign.lens.files.text import at, shown, title
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import Glass
from codesign.lens.surface import Phase, Surface

SCHEMAS = ("codesign-lens/1", "codesign-lens/2")
# left out where they are as usual
RARE = ("mirror", "phase", "decentre_mm", "tilt_deg", "inner_semi_aperture_mm")


def read_native(page: Any, name: str, dtype: torch.dtype) -> GeoLens:
    """GeoLens of a page. Raises: FileFormatError or DomainError naming surface and field."""
    if not isinstance(page, dict) or page.get("schema") not in SCHEMAS:
        raise FileFormatError(
            f'"schema" must be "{SCHEMAS[0]}" or "{SCHEMAS[1]}"; write it with lens.save, or see '
            "docs/lens_files.md."
        )
    p.only(
        page,
        {
            "schema",
            "name",
            "entrance_pupil_diameter_mm",
            "soft_edge_mm",
            "half_field_deg",
            "surfaces",
        },
    )
    surfaces = []
    for i, row in enumerate(p.rows(page, "surfaces"), 1):
        with at(f"surface {i}"):
            p.only(row, FIELDS)
            fields = {key: read(row, key) for key, read in FIELDS.items()}
            surfaces.append(Surface(**fields).check("its shape"))
    diameter = p.number(page, "entrance_pupil_diameter_mm", infinite=True)
    soft_edge = p.number(page, "soft_edge_mm", 0.2)
    half_field = (
        p.number(page, "half_field_deg") if page.get("half_field_deg") is not None else None
    )
    return GeoLens(
        surfaces, diameter, dtype, soft_edge, title(page.get("name", name), name), half_field
    )


def _radius(row, key):
    return math.inf if p.present(row, key) is None else p.number(row, key, infinite=True)


def _medium(row, key):
    medium = row.get(key)
    if medium is None:
        return None
    return Glass.named(medium) if isinstance(medium, str) else Glass.from_dict(medium)


def _phase(row, key):
    phase = row.get(key)
    if phase is None:
        return None
    if not isinstance(phase, dict):
        raise FileFormatError(
            f"phase is {shown(phase)!r}, an object is needed; see docs/lens_files.md."
        )
    p.only(phase, {"coefficients", "order", "blaze_um"})
    order = phase.get("order", 1)
    if isinstance(order, bool) or not isinstance(order, int) or abs(order) > 10_000:
        raise FileFormatError(f"order is {shown(order)!r}, a whole number is needed; correct it.")
    blaze = None if phase.get("blaze_um") is None else p.number(phase, "blaze_um")
    return Phase(p.numbers(phase, "coefficients"), order, blaze)


def _pair(row, key):
    pair = p.numbers(row, key)
    if len(pair) not in (0, 2):
        raise FileFormatError(
            f"{key} has {len(pair)} numbers, two (x and y) are needed; correct it."
        )
    return pair or (0.0, 0.0)


_number_or_0 = functools.partial(p.number, default=0.0)
# field of a Surface -> function of a row and the field's name
FIELDS = {
    "radius_mm": _radius,
    "thickness_mm": p.number,
    "medium": _medium,
    "semi_aperture_mm": p.number,
    "conic": _number_or_0,
    "asphere": p.numbers,
    "is_stop": p.boolean,
    "mirror": p.boolean,
    "phase": _phase,
    "decentre_mm": _pair,
    "tilt_deg": _pair,
    "inner_semi_aperture_mm": _number_or_0,
}


def to_page(lens: GeoLens) -> Page:
    """The page of a lens, as json writes it. Raises: DomainError for values that ``read_native``
    would refuse."""
    usual = {
        field.name: field.default for field in dataclasses.fields(Surface) if field.name in RARE
    }
    rows = []
    for i, s in enumerate(lens.to_surfaces(), 1):
        row = dataclasses.asdict(s.check(f"{lens.name}, surface {i}"))
        row["radius_mm"] = None if math.isinf(s.radius_mm) else s.radius_mm
        rows.append(
            {key: value for key, value in row.items() if key not in usual or value != usual[key]}
        )
    return {
        "schema": SCHEMAS[1],
        "name": lens.name,
        "entrance_pupil_diameter_mm": lens.entrance_pupil_diameter_mm,
        "soft_edge_mm": lens.soft_edge_mm,
        "half_field_deg": lens.half_field_deg,
        "surfaces": rows,
    }
