"""Reader of optiland JSON files."""

import math
from typing import Any

from codesign.errors import FileFormatError
from codesign.lens.files import page as p
from codesign.lens.files.page import Page
from codesign.lens.files.system import FileLens, FileSurface, largest_field
from codesign.lens.files.text import at, shown, title
from codesign.lens.glass import AIR, Glass

SHAPES = ("Plane", "StandardGeometry", "EvenAsphere")
PUPILS = {
    "EPD": "diameter",
    "imageFNO": "f-number",
    "paraxialImageFNO": "working f-number",
    "imageNA": "numerical aperture",
}
FIELDS = {
    "angle": "angle",
    "object_height": "object height",
    "paraxial_image_height": "image height",
    "real_image_height": "image height",
    # as version 0.6 writes them
    "AngleField": "angle",
    "ObjectHeightField": "object height",
    "ParaxialImageHeightField": "image height",
    "RealImageHeightField": "image height",
}
SURFACE_WORDS = """
type geometry material_pre material_post is_stop aperture is_reflective interaction_model comment
surface_type thickness semi_aperture radius conic
"""
SURFACE = set(SURFACE_WORDS.split())


def is_optiland(page: Any) -> bool:
    """Whether a JSON page is of this format."""
    return isinstance(page, dict) and isinstance(page.get("surface_group"), dict)


def read_optiland(page: Page, name: str) -> FileLens:
    """FileLens of a page; solves and pickups keep the stored values. Raises: FileFormatError naming
    surface and field."""
    entries = []
    for i, row in enumerate(p.rows(p.entry(page, "surface_group"), "surfaces", first=0)):
        with at(f"surface {i}"):
            entries.append((row, _place(row, infinite=i == 0)))
    if len(entries) < 3:
        raise FileFormatError(
            f"it has {len(entries)} surfaces; a lens needs at least object, one surface and image."
        )
    surfaces = []
    for i, (row, z) in enumerate(entries[1:-1], 1):
        with at(f"surface {i}"):
            surfaces.append(_surface(row, i, entries[i + 1][1][2] - z[2], z))
    with at("the image surface"):
        row, (x, y, _) = entries[-1]
        if x or y or _curvature(p.entry(row, "geometry")) or boolean_mirror(row):
            raise FileFormatError(
                "it is curved, shifted or reflects; only a flat image plane on the axis is read."
            )
    if sum(s.is_stop for s in surfaces) != 1:
        raise FileFormatError(
            f"surfaces {[s.label for s in surfaces if s.is_stop]} are marked as the stop; mark one with "
            "is_stop."
        )
    with at("the object surface"):
        if (
            entries[0][0].get("material_post") is not None
            and _medium(entries[0][0], "material_post") is not None
        ):
            raise FileFormatError("the object does not lie in air; only objects in air are read.")
    lens = FileLens(name, surfaces, object_distance=abs(entries[1][1][2] - entries[0][1][2]))
    lens.name = title(page.get("name") or "", name)
    _take_pupil(lens, p.entry(page, "aperture"), surfaces)
    _take_field(lens, page.get("fields"))
    _take_wavelength(lens, page.get("wavelengths"))
    return lens


def _take_pupil(lens, aperture, surfaces):
    kind = p.present(aperture, "type")
    value = p.number(aperture, "value")
    _check_pupil(aperture)
    if kind == "float_by_stop_size":
        next(s for s in surfaces if s.is_stop).semi_aperture = value / 2
        lens.pupil = "stop", 0.0
    elif kind in PUPILS:
        lens.pupil = PUPILS[kind], value
    else:
        raise FileFormatError(
            f"the aperture is given as {shown(kind)}, which says nothing for other object distances or is "
            "not known; give it as EPD."
        )


def _check_pupil(row):
    if p.boolean(row, "object_space_telecentric") or p.boolean(row, "telecentric"):
        raise FileFormatError(
            "the object space is telecentric, so its pupil is not that of the stop; switch that off in the "
            "file."
        )


def _take_field(lens, fields):
    if (
        not isinstance(fields, dict)
        or not isinstance(fields.get("fields"), list)
        or not fields["fields"]
    ):
        return
    first = fields["fields"][0] if isinstance(fields["fields"][0], dict) else {}
    given = [
        page.get(key) for page in (fields, first) for key in ("field_definition", "field_type")
    ]
    kind = next((kind for kind in given if kind is not None), None)
    kind = kind.get("field_type") if isinstance(kind, dict) else kind
    if not isinstance(kind, str) or kind not in FIELDS:
        raise FileFormatError(
            f"the fields are given as {shown(kind)}; known are {', '.join(FIELDS)}."
        )
    _check_pupil(fields)
    points = [f for f in fields["fields"] if isinstance(f, dict)]
    lens.field = largest_field(
        FIELDS[kind], ((p.number(f, "x", 0.0), p.number(f, "y", 0.0)) for f in points)
    )


def _take_wavelength(lens, waves):
    listed = (
        [w for w in waves["wavelengths"] if isinstance(w, dict)]
        if isinstance(waves, dict) and isinstance(waves.get("wavelengths"), list)
        else []
    )
    for wave in listed:
        if p.boolean(wave, "is_primary"):
            unit = wave.get("unit", "um")
            if unit not in ("um", "nm", "mm"):
                raise FileFormatError(
                    f"the unit of a wavelength is {shown(unit)}; give um, nm or mm."
                )
            lens.wavelength_um = p.number(wave, "value") * {"um": 1.0, "nm": 1e-3, "mm": 1e3}[unit]


def _place(row, infinite):
    """Vertex (x, y, z); z of the object may be infinite."""
    axes = p.entry(p.entry(row, "geometry"), "cs")
    if axes.get("reference_cs") is not None:
        raise FileFormatError(
            "its axes refer to those of another surface (reference_cs), which is not read; give global axes."
        )
    if any(p.number(axes, key, 0.0) for key in ("rx", "ry")):
        raise FileFormatError(
            "it is tilted (rx, ry), which is not read; only untilted surfaces are."
        )
    return (
        p.number(axes, "x", 0.0),
        p.number(axes, "y", 0.0),
        p.number(axes, "z", infinite=infinite),
    )


def _surface(row, label, thickness, place):
    p.only(row, SURFACE)
    if p.present(row, "type") not in ("Surface", "StandardSurface"):
        raise FileFormatError(f"type {shown(row['type'])} is not read; only Surface is.")
    shape = p.entry(row, "geometry")
    mirror = boolean_mirror(row)
    aperture, inner = _aperture(row.get("aperture"))
    asphere = p.numbers(shape, "coefficients") if shape["type"] == "EvenAsphere" else ()
    return FileSurface(
        label,
        _curvature(shape),
        thickness,
        None if mirror else _medium(row, "material_post"),
        aperture,
        aperture is not None,
        p.number(shape, "conic", 0.0),
        asphere,
        p.boolean(row, "is_stop"),
        mirror,
        decentre=place[:2],
        inner=inner,
    )


def boolean_mirror(row: Page) -> bool:
    """Whether the surface reflects, in the older or the newer spelling."""
    model = row.get("interaction_model")
    if model is None:
        return p.boolean(row, "is_reflective")
    if (
        not isinstance(model, dict)
        or model.get("type", "RefractiveReflectiveModel") != "RefractiveReflectiveModel"
    ):
        raise FileFormatError(
            f"its interaction {shown(model.get('type') if isinstance(model, dict) else model)} is not read; "
            "only refraction and reflection are."
        )
    return p.boolean(model, "is_reflective")


def _curvature(shape):
    if p.present(shape, "type") not in SHAPES:
        raise FileFormatError(
            f"geometry {shown(shape['type'])} is not read; {', '.join(SHAPES)} are."
        )
    radius = p.number(shape, "radius", math.inf, infinite=True)
    if radius == 0:
        raise FileFormatError("its radius is 0; a plane has the radius Infinity.")
    return 1 / radius


def _aperture(aperture):
    """Outer and inner radius."""
    if aperture is None:
        return None, 0.0
    if not isinstance(aperture, dict) or aperture.get("type") != "RadialAperture":
        raise FileFormatError(
            "its aperture is not a circle around the axis (RadialAperture), and only those are read; "
            "replace it."
        )
    inner = p.number(aperture, "r_min", 0.0)
    outer = p.number(aperture, "r_max", infinite=True)
    return (outer if math.isfinite(outer) else None), inner


def _medium(row, key):
    material = p.entry(row, key)
    kind = p.present(material, "type")
    if kind == "IdealMaterial":
        index = p.number(material, "index")
        # without dispersion at any wavelength
        return None if index == 1 else Glass(f"{index:.6g}", "cauchy", (index,), AIR.range_um)
    if kind == "AbbeMaterial":
        return Glass.from_abbe(p.number(material, "index"), p.number(material, "abbe"))
    if kind == "Material" and isinstance(material.get("name"), str):
        maker = material.get("reference")
        return Glass.named(material["name"], [maker] if isinstance(maker, str) else ())
    raise FileFormatError(
        f"its material {shown(kind)} is not read; IdealMaterial, AbbeMaterial and Material are."
    )
