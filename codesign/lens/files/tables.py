"""Readers of DeepLens JSON and of DiffOptics text tables."""

import re
from typing import Any

from codesign.errors import FileFormatError
from codesign.lens.files import page as p
from codesign.lens.files.page import Page
from codesign.lens.files.system import FileLens, FileSurface
from codesign.lens.files.text import MOST_SURFACES, at, lines, number, shown, title
from codesign.lens.glass import Glass

SHAPES = ("Spheric", "Aspheric", "Aperture", "Stop", "Plane")
AIR = ("air", "vacuum", "occluder")
# positions and sizes given a second time, in brackets where the writer meant them for the eye, and
# how diffraction of the stop was sampled
KNOWN = {
    "idx",
    "type",
    "r",
    "c",
    "roc",
    "d",
    "d_next",
    "k",
    "ai",
    "mat1",
    "mat2",
    "is_square",
    "diffraction",
    *(f"ai{i}" for i in range(2, 34, 2)),
}
FITS_MM = 1e-3  # positions are written in single precision
EQUAL = 1e-6  # two spellings of one number in a file agree to this share


def is_deeplens(page: Any) -> bool:
    """Whether a JSON page is of this format."""
    return (
        isinstance(page, dict)
        and "schema" not in page
        and isinstance(page.get("surfaces"), list)
        and any(isinstance(s, dict) and "d_next" in s for s in page["surfaces"])
    )


def read_deeplens(page: Page, name: str) -> FileLens:
    """FileLens of a page. The stop is the surface of type Stop or Aperture, else the one with the
    smallest aperture (as that program has it); its radius sets the pupil.

    The header's focal length and f-number are not used: they follow from the surfaces. Raises:
    FileFormatError naming surface and field.
    """
    surfaces: list[FileSurface] = []
    stops = []
    for i, row in enumerate(p.rows(page, "surfaces"), 1):
        with at(f"surface {i}"):
            _check_front(row, surfaces[-1].medium if surfaces else None)
            surfaces.append(_surface(row, i))
            stops += [i - 1] if row["type"] in ("Stop", "Aperture") else []
    if len(stops) > 1:
        raise FileFormatError(f"surfaces {[i + 1 for i in stops]} are all stops; keep one.")
    _mark_stop(surfaces, stops)
    _check_places(page)
    info = page.get("info")
    return FileLens(
        name if info in (None, "None") else title(info, name), surfaces, pupil=("stop", 0.0)
    )


def _check_front(row, medium):
    """Raise where ``mat1`` is not the medium behind the surface before."""
    front = _named(row, "mat1") if "mat1" in row else medium
    if front != medium:
        given, behind = (glass.name.lower() if glass else "air" for glass in (front, medium))
        raise FileFormatError(
            f"mat1 is {shown(given)!r}, but the surface before is followed by {shown(behind)!r}; correct "
            "one of them."
        )


def _check_places(page):
    """Raise where the positions ``d`` and ``d_sensor`` contradict the distances ``d_next``."""
    first = p.number(page["surfaces"][0], "d", 0.0)
    z = 0.0
    places = [(f"surface {i}", row) for i, row in enumerate(page["surfaces"], 1)]
    for place, row in (*places, ("the sensor", {"d": page.get("d_sensor")})):
        given = p.number(row, "d") - first if row.get("d") is not None else z
        if abs(given - z) > FITS_MM:
            raise FileFormatError(
                f"{place} lies at {given:.6g} mm, but the distances d_next lead to {z:.6g} mm; correct one of "
                "them."
            )
        z += row.get("d_next", 0.0)


def _mark_stop(surfaces, stops):
    """Mark the surface of the only index in ``stops``, else the first with the smallest
    aperture."""
    at_stop = (
        surfaces[stops[0]] if stops else min(surfaces, key=lambda surface: surface.semi_aperture)
    )
    at_stop.is_stop = True


def _surface(row, label):
    kind = p.present(row, "type")
    if kind not in SHAPES:
        raise FileFormatError(f"type {shown(kind)} is not read; {', '.join(SHAPES)} are.")
    p.only({key: value for key, value in row.items() if not key.startswith("(")}, KNOWN)
    if p.boolean(row, "is_square"):
        raise FileFormatError(
            "its aperture is square, only circles are read; set is_square to false."
        )
    conic = p.number(row, "k", 0.0)
    asphere = _asphere(row)
    if kind != "Aspheric" and (conic or any(asphere)):
        raise FileFormatError(f"a surface of type {kind} has a conic or asphere; make it Aspheric.")
    return FileSurface(
        label,
        _curvature(row),
        p.number(row, "d_next"),
        _named(row, "mat2"),
        p.number(row, "r"),
        True,
        conic,
        asphere,
    )


def _named(row, key):
    """The medium under a key, air when it is missing."""
    medium = row.get(key, "air")
    if not isinstance(medium, str):
        raise FileFormatError(f"{key} is {shown(medium)!r}, a name or 'nd/Vd' is needed.")
    return _medium(medium)


def _curvature(row):
    """Curvature from ``c``, from ``roc`` (0 is a plane), or from both where they agree."""
    found = []
    if "c" in row:
        found.append(p.number(row, "c"))
    if "roc" in row:
        radius = p.number(row, "roc", infinite=True)
        found.append(1 / radius if radius else 0.0)
    if len(found) == 2 and abs(found[0] - found[1]) > EQUAL * max(map(abs, found)):
        raise FileFormatError(
            f"c is {found[0]:.9g} but 1 / roc is {found[1]:.9g}; keep the right one."
        )
    if not found and row["type"] in ("Spheric", "Aspheric"):
        raise FileFormatError("it has neither c nor roc; give one.")
    return found[0] if found else 0.0


def _asphere(row):
    """Coefficients of r^2, r^4, ...: the list ``ai`` begins at r^2, unless the single fields show
    that it begins at r^4."""
    terms = p.numbers(row, "ai")
    single = {int(key[2:]) // 2: p.number(row, key) for key in row if re.fullmatch(r"ai\d+", key)}
    if not single:
        return terms
    last = max(len(terms), *single)
    for shift in (0, 1):
        listed = (0.0,) * shift + terms
        if all(
            abs(value - (listed[i - 1] if i <= len(listed) else 0.0)) <= EQUAL * abs(value)
            for i, value in single.items()
        ):
            return listed
    if terms:
        raise FileFormatError(
            "the list ai and the fields ai2, ai4, ... disagree; keep one of them."
        )
    return tuple(single.get(i, 0.0) for i in range(1, last + 1))


def _medium(text):
    if text.lower() in AIR:
        return None
    pair = text.split("/")
    if len(pair) == 2:
        return Glass.from_abbe(
            number(pair[0].strip(), "the index nd"),
            number(pair[1].strip(), "the Abbe number"),
            text,
        )
    return Glass.named(text)


def read_diffoptics(text: str, name: str) -> FileLens:
    """FileLens of the text of a table.

    The distance of a row leads to it from the row before; radius 0 is a plane; the numbers behind
    the material are the conic constant and the coefficients of r^4, r^6, ... The row A is the stop,
    else the surface with the smallest diameter. Raises: FileFormatError naming the row.
    """
    table = [(i, line.split()) for i, line in lines(text) if line.strip()]
    if len(table) < 4 or [w.lower() for w in table[1][1][:3]] != ["type", "distance", "roc"]:
        raise FileFormatError(
            "it is not a table of surfaces; its second line must be: type distance roc diameter material."
        )
    if len(table) > MOST_SURFACES + 4:
        raise FileFormatError(
            f"it has {len(table)} lines, at most {MOST_SURFACES} surfaces are read; is it a lens?"
        )
    surfaces: list[FileSurface] = []
    stops = []
    image = None
    for line, words in table[2:]:
        with at(f"line {line}"):
            if image is not None:
                raise FileFormatError(
                    f"'{shown(' '.join(words))}' stands behind the image (I), which must be the last row."
                )
            if len(words) < 5:
                raise FileFormatError(
                    f"'{shown(' '.join(words))}' has fewer than the five columns type, distance, roc, "
                    "diameter, material."
                )
            kind = words[0].upper()
            distance = number(words[1], "the distance")
            if surfaces:
                surfaces[-1].thickness = distance
            if kind == "I":
                image = _check_image(words)
            elif kind != "O":
                stops += [len(surfaces)] if kind == "A" else []
                surfaces.append(_table_surface(kind, words, len(surfaces) + 1))
    if image is None or not surfaces or len(stops) > 1:
        raise FileFormatError(
            f"it has {len(surfaces)} surfaces, {len(stops)} stops (A) and {'an' if image else 'no'} image "
            "(I); it needs surfaces, at most one stop, and an image."
        )
    _mark_stop(surfaces, stops)
    return FileLens(title(" ".join(table[0][1]), name), surfaces, pupil=("stop", 0.0))


def _check_image(words):
    if number(words[2], "the radius"):
        raise FileFormatError("the image surface is curved; only a flat image plane is read.")
    return True


def _table_surface(kind, words, label):
    if kind not in ("S", "A", "X"):
        raise FileFormatError(
            f"type {shown(kind)} is not read; O, S, A, I are, and X without coefficients."
        )
    radius = number(words[2], "the radius")
    diameter = number(words[3], "the diameter")
    rest = [number(w, "a coefficient") for w in words[5:]]
    if kind == "X" and any(rest):
        raise FileFormatError(
            "its shape is a polynomial in x and y, and only surfaces of revolution are read."
        )
    if len(rest) > 16:
        raise FileFormatError(f"it has {len(rest)} coefficients, at most 16 are read.")
    asphere = (0.0, *rest[1:]) if kind == "S" and any(rest[1:]) else ()
    conic = rest[0] if kind == "S" and rest else 0.0
    return FileSurface(
        label,
        1 / radius if radius else 0.0,
        0.0,
        _medium(words[4]),
        diameter / 2,
        True,
        conic,
        asphere,
    )
