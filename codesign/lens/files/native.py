"""The native JSON format: what a GeoLens is, to the last bit."""

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


def read_native(page: Any, name: str, dtype: torch.dtype) -> GeoLens:
    """GeoLens of a page. Raises: FileFormatError or DomainError naming surface and field."""
    if not isinstance(page, dict) or page.get("schema") not in SCHEMAS:
        raise FileFormatError(
            f'"schema" must be "{SCHEMAS[0]}" or "{SCHEMAS[1]}"; write it with lens.save, or see '
            "docs/lens_files.md."
        )
    p.only(
        page, {"schema", "name", "entrance_pupil_diameter_mm", "soft_edge_mm", "half_field_deg", "surfaces"}
    )
    surfaces = []
    for i, row in enumerate(p.rows(page, "surfaces"), 1):
        with at(f"surface {i}"):
            surfaces.append(_surface(row).check("its shape"))
    diameter = p.number(page, "entrance_pupil_diameter_mm", infinite=True)
    soft_edge = p.number(page, "soft_edge_mm", 0.2)
    half_field = p.number(page, "half_field_deg") if page.get("half_field_deg") is not None else None
    return GeoLens(surfaces, diameter, dtype, soft_edge, title(page.get("name", name), name), half_field)


def _surface(row):
    p.only(
        row,
        {
            "radius_mm",
            "thickness_mm",
            "medium",
            "semi_aperture_mm",
            "conic",
            "asphere",
            "is_stop",
            "mirror",
            "phase",
            "decentre_mm",
            "tilt_deg",
            "inner_semi_aperture_mm",
        },
    )
    radius = math.inf if p.present(row, "radius_mm") is None else p.number(row, "radius_mm", infinite=True)
    return Surface(
        radius,
        p.number(row, "thickness_mm"),
        _medium(row.get("medium")),
        p.number(row, "semi_aperture_mm"),
        p.number(row, "conic", 0.0),
        p.numbers(row, "asphere"),
        p.boolean(row, "is_stop"),
        p.boolean(row, "mirror"),
        _phase(row.get("phase")),
        _pair(row, "decentre_mm"),
        _pair(row, "tilt_deg"),
        p.number(row, "inner_semi_aperture_mm", 0.0),
    )


def _medium(medium):
    if medium is None:
        return None
    if isinstance(medium, str):
        return Glass.named(medium)
    return Glass.from_dict(medium)


def _phase(phase):
    if phase is None:
        return None
    if not isinstance(phase, dict):
        raise FileFormatError(f"phase is {shown(phase)!r}, an object is needed; see docs/lens_files.md.")
    p.only(phase, {"coefficients", "order", "blaze_um"})
    order = phase.get("order", 1)
    if isinstance(order, bool) or not isinstance(order, int) or abs(order) > 10_000:
        raise FileFormatError(f"order is {shown(order)!r}, a whole number is needed; correct it.")
    return Phase(
        p.numbers(phase, "coefficients"),
        order,
        None if phase.get("blaze_um") is None else p.number(phase, "blaze_um"),
    )


def _pair(row, key):
    pair = p.numbers(row, key)
    if len(pair) not in (0, 2):
        raise FileFormatError(f"{key} has {len(pair)} numbers, two (x and y) are needed; correct it.")
    return (pair[0], pair[1]) if pair else (0.0, 0.0)


def to_page(lens: GeoLens) -> Page:
    """The page of a lens: plain JSON types. Raises: DomainError for values that ``read_native`` would
    refuse."""
    rows = []
    for i, s in enumerate(lens.to_surfaces(), 1):
        s.check(f"{lens.name}, surface {i}")
        row = {
            "radius_mm": None if math.isinf(s.radius_mm) else s.radius_mm,
            "thickness_mm": s.thickness_mm,
            "medium": s.medium and s.medium.to_dict(),
            "semi_aperture_mm": s.semi_aperture_mm,
            "conic": s.conic,
            "asphere": list(s.asphere),
            "is_stop": s.is_stop,
        }
        phase = s.phase and {
            "coefficients": list(s.phase.coefficients),
            "order": s.phase.order,
            "blaze_um": s.phase.blaze_um,
        }
        rare = {
            "mirror": (s.mirror, False),
            "phase": (phase, None),
            "decentre_mm": (list(s.decentre_mm), [0.0, 0.0]),
            "tilt_deg": (list(s.tilt_deg), [0.0, 0.0]),
            "inner_semi_aperture_mm": (s.inner_semi_aperture_mm, 0.0),
        }
        rows.append(row | {key: value for key, (value, usual) in rare.items() if value != usual})
    return {
        "schema": SCHEMAS[1],
        "name": lens.name,
        "entrance_pupil_diameter_mm": lens.entrance_pupil_diameter_mm,
        "soft_edge_mm": lens.soft_edge_mm,
        "half_field_deg": lens.half_field_deg,
        "surfaces": rows,
    }
