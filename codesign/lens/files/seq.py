"""Reader of CODE V .seq files: statements, and a table of the commands about the whole system."""

import itertools
import math
import re
from collections.abc import Iterator
from typing import Any

from codesign.errors import FileFormatError
from codesign.lens.files.seq_surface import IDLE_TABLE, SURFACE, PrivateGlasses, SeqSurface
from codesign.lens.files.system import FileLens, largest_field
from codesign.lens.files.text import (
    MOST_SURFACES,
    Rule,
    all_numbers,
    at,
    lines,
    number,
    one_whole,
    shown,
    take,
    title,
    yes,
)

UNITS_MM = {"M": 1.0, "MM": 1.0, "C": 10.0, "CM": 10.0, "I": 25.4, "IN": 25.4}
PUPILS = {"EPD": "diameter", "FNO": "working f-number", "NA": "numerical aperture"}
FIELDS = {"AN": "angle", "OB": "object height", "IM": "image height", "RI": "image height"}
SURROUNDINGS = {"TEM": 20.0, "PRE": 760.0}
WORD = re.compile(r"'[^']*'|\"[^\"]*\"|\S+")
# a statement, and what ends it: a semicolon, a comment, or the line; the first two only count
# outside quotes
STATEMENT = re.compile(r"((?:'[^']*'?|\"[^\"]*\"?|[^'\";!])*)([;!]|$)")
SURFACE_NAME = re.compile(r"S(\d{1,4}|O|I)", re.ASCII)
# an object beyond this counts as infinitely far
FAR = 1e9


def read_seq(text: str, name: str) -> FileLens:
    """FileLens of the text of a .seq file.

    Without RDM, the first number of S is a curvature; without STO, the first surface is the stop
    (the program's own defaults). Solves and pickups keep the stored values; PIM is solved again.
    Raises: FileFormatError naming surface or line for what is not understood.
    """
    system = System()
    for line, words in statements(text):
        with at(f"line {line}"):
            system.take(words)
    return system.lens(name)


def statements(text: str) -> Iterator[tuple[int, list[str]]]:
    """Statements of a .seq file as (line number, words): comments from ! dropped, lines ending in &
    joined, statements parted at ;."""
    held = ""
    start = 0
    for at_line, line in lines(text):
        for found in STATEMENT.finditer(line):
            start = start if held else at_line
            held += found[1]
            if found[2] != ";" and found[1].rstrip().endswith("&"):
                held = held.rstrip()[:-1] + " "
                break
            words = WORD.findall(held)
            held = ""
            if words:
                yield start, words
            if found[2] != ";":
                break
    if held.strip():
        raise FileFormatError(
            f"line {start}: the statement goes on (&) but the file ends; complete it."
        )


def _title(keyword, words):
    return " ".join(words).strip("'\"")


def _radii(keyword, words):
    return not words or words[0].upper().startswith("Y")


def _unit(keyword, words):
    if words[0].upper() not in UNITS_MM:
        raise FileFormatError(
            f"unit '{shown(words[0])}' is not known; give DIM M (millimetres), C (centimetres) or I (inches)."
        )
    return UNITS_MM[words[0].upper()]


def _pupil(keyword, words):
    return PUPILS[keyword], number(words[0], keyword)


def _fields(keyword, words):
    return {keyword: all_numbers(keyword, words)}


def _zoom(keyword, words):
    raise FileFormatError(
        f"it is a zoom (ZOO {shown(words[0])}), and only one lens at a time is read; save the position you "
        "want as a lens of its own."
    )


def _usual(keyword, words):
    if number(words[0], keyword) != SURROUNDINGS[keyword]:
        raise FileFormatError(
            f"{keyword} is {shown(words[0])}; indices are those at 20 degrees and 760 mm of mercury, so "
            "remove it or design for that."
        )


SYSTEM = {
    **IDLE_TABLE,
    **dict.fromkeys(PUPILS, Rule("pupil", _pupil)),
    **dict.fromkeys((axis + kind for axis in "XY" for kind in FIELDS), Rule("fields", _fields)),
    **dict.fromkeys(SURROUNDINGS, Rule("surroundings", _usual)),
    "RDM": Rule("is_radius", _radii, 0),
    "PRV": Rule("private", yes, 0),
    "PIM": Rule("focus", yes, 0),
    "TIT": Rule("title", _title, 0),
    "LEN": "",
    "ZOO": Rule("zoom", _zoom),
    "DIM": Rule("unit_mm", _unit),
    "NAO": "the pupil is given by the cone of light at a near object (NAO), which says nothing for other "
    "distances; give the entrance pupil diameter (EPD).",
    "WL": Rule("waves_nm", all_numbers),
    "REF": Rule("reference", one_whole),
}


class System:
    """What has been read so far."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {"unit_mm": 1.0, "waves_nm": [587.5618], "reference": 1}
        self.glasses = PrivateGlasses()
        self.surfaces: list[SeqSurface] = []
        self.object = SeqSurface(0, self.glasses)
        self.image = SeqSurface("image", self.glasses)
        self.current: SeqSurface | None = None
        self.stops: list[SeqSurface] = []

    def take(self, words: list[str]) -> None:
        """Take one statement."""
        if self.glasses.open:
            self.glasses.take(words)
            return
        command, *rest = words
        command = command.upper()
        if command == "S" or SURFACE_NAME.fullmatch(command):
            self.current = self._started(command)
            with at(f"surface {self.current.label}"):
                self.current.start(rest, self.values.get("is_radius", False))
            return
        command = command if command in SURFACE or command[0] in "'\"" else command[:3]
        if command in SURFACE:
            target, rest = self._target(rest)
            with at(f"surface {target.label}"):
                target.take(command, rest)
        elif command == "STO":
            self.stops.append(self._target(rest)[0])
        elif command in SYSTEM:
            take(self.values, SYSTEM, command, rest)
            self.glasses.open = command == "PRV"
        else:
            raise FileFormatError(
                f"command '{shown(command)}' is not understood; delete it if it changes no ray."
            )

    def _target(self, words):
        """The surface a command is about: the one named by a first word S3, or the current one."""
        named = SURFACE_NAME.fullmatch(words[0].upper()) if words else None
        if named is None:
            if self.current is None:
                raise FileFormatError("it stands before any surface; move it behind its S.")
            return self.current, words
        if named[1] in "OI":
            return (self.object if named[1] == "O" else self.image), words[1:]
        if not 0 < int(named[1]) <= len(self.surfaces):
            raise FileFormatError(f"there is no surface {named[0]} so far; define it first.")
        return self.surfaces[int(named[1]) - 1], words[1:]

    def _started(self, command):
        """The surface that a statement S, S3, SO or SI begins."""
        if command in ("SO", "SI"):
            return self.object if command == "SO" else self.image
        due = len(self.surfaces) + 1
        if command[1:] and int(command[1:]) != due:
            raise FileFormatError(
                f"{command} comes where surface {due} is due; number the surfaces in order, once each."
            )
        if due > MOST_SURFACES:
            raise FileFormatError(f"it holds more than {MOST_SURFACES} surfaces; is it a lens?")
        self.surfaces.append(SeqSurface(due, self.glasses))
        return self.surfaces[-1]

    def lens(self, name: str) -> FileLens:
        """FileLens of all that was read."""
        if not self.surfaces:
            raise FileFormatError("it has no surface (a line such as S 50 3 N-BK7); is it a lens?")
        stops = self.stops or self.surfaces[:1]
        if any(stop is not stops[0] for stop in stops) or stops[0] in (self.object, self.image):
            labels = sorted(stop.label for stop in set(stops) - {self.object, self.image})
            raise FileFormatError(
                f"surfaces {labels} are marked as the stop (STO); mark one between object and image."
            )
        self.image.check_image()
        self.object.check_object()
        unit_mm, waves, reference = (
            self.values[name] for name in ("unit_mm", "waves_nm", "reference")
        )
        found = []
        for surface in self.surfaces:
            with at(f"surface {surface.label}"):
                found.append(surface.surface(unit_mm, surface is stops[0]))
        if not 1 <= reference <= len(waves):
            raise FileFormatError(
                f"the reference wavelength is number {reference} of {len(waves)}; correct REF."
            )
        far = abs(self.object.thickness) >= FAR
        return FileLens(
            title(self.values.get("title", ""), name),
            found,
            unit_mm,
            self.values.get("pupil"),
            self._field(),
            waves[reference - 1] * 1e-3,
            math.inf if far else self.object.thickness,
            "focus" in self.values,
            self.image.thickness,
        )

    def _field(self):
        fields = self.values.get("fields", {})
        found = None
        for kind, label in FIELDS.items():
            axes = [fields.get(axis + kind, []) for axis in "XY"]
            points = itertools.zip_longest(*axes, fillvalue=0.0)
            found = largest_field(label, points) if any(axes) else found
        return found
