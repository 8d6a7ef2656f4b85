"""Reader of OpticStudio .zmx files (sequential mode)."""

import itertools
from typing import Any

import numpy as np

from codesign.errors import FileFormatError
from codesign.lens.files.breaks import along, place
from codesign.lens.files.system import FileLens, largest_field
from codesign.lens.files.text import (
    MOST_SURFACES,
    Rule,
    all_numbers,
    all_words,
    at,
    lines,
    number,
    one_whole,
    shown,
    take,
    title,
    whole,
)
from codesign.lens.files.zmx_surface import SURFACE, Entry

UNITS_MM = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "INCH": 25.4, "M": 1000.0, "METER": 1000.0}
FIELDS = ("angle", "object height", "image height", "image height")


def _name(keyword, words):
    return " ".join(words).strip('"')


def _sequential(keyword, words):
    if words[0] != "SEQ":
        raise FileFormatError(
            f"mode '{shown(words[0])}' is not sequential; only MODE SEQ describes a lens surface by surface."
        )


def _unit(keyword, words):
    if words[0].upper() not in UNITS_MM:
        raise FileFormatError(
            f"unit '{shown(words[0])}' is not known; known are {', '.join(UNITS_MM)}."
        )
    return UNITS_MM[words[0].upper()]


def _pupil(keyword, words):
    if keyword == "FLOA":
        return "stop", 0.0
    if keyword == "ENPD":
        return "diameter", number(words[0], keyword)
    working = len(words) > 1 and whole(words[1], "the kind of FNUM") == 1
    return "working f-number" if working else "f-number", number(words[0], keyword)


def _field_type(keyword, words):
    kind, telecentric, count, *_, afocal = [*(whole(w, keyword) for w in words), *[0] * 7][:7]
    if kind >= len(FIELDS):
        raise FileFormatError(f"field type {kind} is not known; give field angles (FTYP 0).")
    if telecentric:
        raise FileFormatError(
            "the object space is telecentric, so its pupil is not that of the stop; switch that off in the "
            "file (second number of FTYP)."
        )
    if afocal:
        raise FileFormatError(
            "the image space is afocal, so there is no image plane; switch that off in the file (seventh "
            "number of FTYP)."
        )
    return FIELDS[kind], count or None


def _waves(keyword, words):
    if keyword == "WAVL":
        return dict(enumerate(all_numbers(keyword, words), 1))
    return {whole(words[0], keyword): number(words[1], keyword)} if len(words) > 1 else {}


def _surroundings(keyword, words):
    if len(words) > 2 and words[2] == "1" and all_numbers(keyword, words[:2]) != [20.0, 1.0]:
        raise FileFormatError(
            "its indices are for another temperature or pressure than 20 degrees and 1 atm (ENVD), which is "
            "not computed; switch that off in the file."
        )


def _one_lens(keyword, words):
    if words and whole(words[0], keyword) > 1:
        raise FileFormatError(
            f"it holds {whole(words[0], keyword)} configurations (MNUM), and only one lens at a time is "
            "read; save the one you want as a lens of its own."
        )


# what else stands there describes analyses
HEADER = {
    **{
        keyword: f"the pupil is given by the cone of light at a near object ({keyword}), which says nothing "
        "for other distances; give the entrance pupil diameter (ENPD)."
        for keyword in ("OBNA", "ANAC", "OCNA")
    },
    "NAME": Rule("name", _name, 0),
    "MODE": Rule("mode", _sequential),
    "UNIT": Rule("unit_mm", _unit),
    "ENPD": Rule("pupil", _pupil),
    "FNUM": Rule("pupil", _pupil),
    "FLOA": Rule("pupil", _pupil, 0),
    "FTYP": Rule("field", _field_type),
    "XFLN": Rule("x", all_numbers, 0),
    "YFLN": Rule("y", all_numbers, 0),
    "WAVL": Rule("waves", _waves, 0),
    "WAVM": Rule("waves", _waves),
    "ENVD": Rule("surroundings", _surroundings, 0),
    "PWAV": Rule("primary", one_whole),
    "GCAT": Rule("catalogues", all_words, 0),
}


def read_zmx(text: str, name: str) -> FileLens:
    """FileLens of the text of a .zmx file; several configurations (a zoom) are refused.

    Raises: FileFormatError naming surface and reason for anything in a surface that is not
      understood, or that no GeoLens can be.
    """
    header: dict[str, Any] = {}
    entries: list[Entry] = []
    ended = False
    for at_line, line in lines(text):
        keyword, *words = line.split() or [""]
        inside = line[:1].isspace() or keyword in SURFACE
        if keyword == "MNUM":
            _one_lens(keyword, words)
        if keyword == "SURF":
            if ended or len(entries) > MOST_SURFACES + 1:
                raise FileFormatError(
                    f"line {at_line}: it holds more than {MOST_SURFACES} surfaces, or one behind the end of "
                    "the list; is it a lens?"
                )
            entries.append(Entry(words, len(entries)))
        elif entries and not ended and inside and keyword:
            with at(f"surface {entries[-1].label}"):
                entries[-1].take(keyword, words)
        elif entries and keyword:
            if keyword in SURFACE and line[:1].isspace():
                raise FileFormatError(
                    f"line {at_line}: '{shown(keyword)}' stands behind the end of the surfaces; move it to "
                    "its surface."
                )
            # operands, tolerances, configurations
            ended = True
        elif keyword in HEADER:
            with at(f"line {at_line}"):
                take(header, HEADER, keyword, words)
    return _lens(header, entries, name)


def _lens(header, entries, name):
    """FileLens of the values of the header and the entries of the surfaces, object and image
    included."""
    if len(entries) < 3:
        raise FileFormatError(
            f"it has {len(entries)} surfaces; a lens needs at least object, one surface and image (SURF "
            "0, 1, 2)."
        )
    if "unit_mm" not in header:
        raise FileFormatError("it names no unit of length; add the line UNIT MM.")
    stops = [entry.label for entry in entries if "is_stop" in entry.values]
    if len(stops) != 1 or not 0 < stops[0] < len(entries) - 1:
        raise FileFormatError(
            f"surfaces {stops or 'none'} are marked as the stop; mark one between object and image with STOP."
        )
    kind, count = header.get("field", (FIELDS[0], None))
    pairs = itertools.zip_longest(header.get("x", []), header.get("y", []), fillvalue=0.0)
    found = FileLens(
        title(header.get("name", ""), name),
        [],
        header["unit_mm"],
        header.get("pupil"),
        largest_field(kind, list(pairs)[:count]),
        header.get("waves", {}).get(header.get("primary", 1), 0.5875618),
        entries[0].get("thickness", 0.0),
    )
    entries[0].check_object()
    entries[-1].check_image()
    frames = []
    frame = np.eye(4)
    for entry in entries[1:-1]:
        with at(f"surface {entry.label}"):
            if entry.kind != "COORDBRK":
                found.surfaces.append(entry.surface(header.get("catalogues", ())))
                frames.append(frame)
            else:
                frame = frame @ entry.coordinate_break()
                if found.surfaces:
                    found.surfaces[-1].thickness += entry.values["thickness"]
                else:
                    found.object_distance += entry.values["thickness"]
            frame = frame @ along(entry.values["thickness"])
    if any(entry.kind == "COORDBRK" and entry.moves() for entry in entries):
        found.image_tilt_deg = place(found.surfaces, frames, frame)
    return found
