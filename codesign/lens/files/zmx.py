"""Reader of OpticStudio .zmx files (sequential mode)."""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np

from codesign.errors import FileFormatError
from codesign.lens.files.system import FileLens, FileSurface
from codesign.lens.files.text import MOST_SURFACES, at, lines, number, shown, title, whole
from codesign.lens.files.zmx_surface import KEYWORDS, Entry, along, place

UNITS_MM = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "INCH": 25.4, "M": 1000.0, "METER": 1000.0}
FIELDS = ("angle", "object height", "image height", "image height")


def read_zmx(text: str, name: str) -> FileLens:
    """FileLens of the text of a .zmx file.

    Outside the surfaces only mode, unit, pupil, field, wavelengths and telecentric or afocal spaces are read:
    all else there describes analyses. Several configurations (a zoom) are refused.
    Raises: FileFormatError naming surface and reason for anything in a surface that is not understood, or
      that no GeoLens can be.
    """
    header = Header(name)
    entries = []
    ended = False
    for at_line, line in lines(text):
        keyword, *words = line.split() or [""]
        if keyword == "MNUM" and words and whole(words[0], keyword) > 1:
            raise FileFormatError(
                f"it holds {whole(words[0], keyword)} configurations (MNUM), and only one lens at a time is "
                "read; save "
                "the one you want as a lens of its own."
            )
        if keyword == "SURF":
            if ended or len(entries) > MOST_SURFACES + 1:
                raise FileFormatError(
                    f"line {at_line}: it holds more than {MOST_SURFACES} surfaces, or one behind the end of "
                    "the list; is it a lens?"
                )
            entries.append(_entry(words, len(entries)))
        elif entries and not ended and (line[0:1].isspace() or keyword in KEYWORDS) and keyword:
            with at(f"surface {entries[-1].label}"):
                entries[-1].take(keyword, words)
        elif entries and keyword:
            if keyword in KEYWORDS and line[0:1].isspace():
                raise FileFormatError(
                    f"line {at_line}: '{shown(keyword)}' stands behind the end of the surfaces; move it to "
                    "its surface."
                )
            ended = True  # operands, tolerances, configurations
        elif keyword:
            with at(f"line {at_line}"):
                header.take(keyword, words)
    return header.finish(entries)


def _entry(words, expected):
    label = whole(words[0], "the number of a surface") if words else -1
    if label != expected:
        raise FileFormatError(
            f"surface {expected} is missing, or surface {label} comes twice; number the surfaces 0, 1, 2, ..."
        )
    return Entry(label)


@dataclasses.dataclass
class Header:
    """What stands before the first surface."""

    name: str
    mode: str = "SEQ"
    unit: str | None = None
    pupil: tuple[str, float] | None = None
    kind: int = 0
    count: int | None = None
    heights: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    waves: dict[int, float] = dataclasses.field(default_factory=dict)
    primary: int = 1

    def take(self, keyword: str, words: list[str]) -> None:
        def numbers():
            return [number(w, keyword) for w in words]

        if keyword in ("UNIT", "MODE", "ENPD", "FNUM", "FTYP", "PWAV", "WAVM") and not words:
            raise FileFormatError(f"{keyword} has no value; give one.")
        if keyword == "NAME":
            self.name = title(" ".join(words).strip('"'), self.name)
        elif keyword == "MODE" and words[0] != "SEQ":
            raise FileFormatError(
                f"mode '{shown(words[0])}' is not sequential; only MODE SEQ describes a lens surface by "
                "surface."
            )
        elif keyword == "UNIT":
            self.unit = words[0].upper()
            if self.unit not in UNITS_MM:
                raise FileFormatError(
                    f"unit '{shown(words[0])}' is not known; known are {', '.join(UNITS_MM)}."
                )
        elif keyword == "ENPD":
            self.pupil = "diameter", number(words[0], keyword)
        elif keyword == "FNUM":
            working = len(words) > 1 and whole(words[1], "the kind of FNUM") == 1
            self.pupil = "working f-number" if working else "f-number", number(words[0], keyword)
        elif keyword == "FLOA":
            self.pupil = "stop", 0.0
        elif keyword in ("OBNA", "ANAC", "OCNA"):
            raise FileFormatError(
                f"the pupil is given by the cone of light at a near object ({keyword}), which says nothing "
                "for other distances; give the entrance pupil diameter (ENPD)."
            )
        elif keyword == "FTYP":
            self._take_field_type([whole(w, keyword) for w in words])
        elif keyword in ("XFLN", "YFLN"):
            self.heights[keyword] = numbers()
        elif keyword == "WAVL":
            self.waves.update(enumerate(numbers(), 1))
        elif keyword == "WAVM" and len(words) > 1:
            self.waves[whole(words[0], keyword)] = number(words[1], keyword)
        elif (
            keyword == "ENVD"
            and len(words) > 2
            and words[2] == "1"
            and (number(words[0], keyword), number(words[1], keyword)) != (20.0, 1.0)
        ):
            raise FileFormatError(
                "its indices are for another temperature or pressure than 20 degrees and 1 atm (ENVD), "
                "which is not computed; switch that off in the file."
            )
        elif keyword == "PWAV":
            self.primary = whole(words[0], keyword)

    def _take_field_type(self, words):
        words += [0] * (7 - len(words))
        self.kind = words[0]
        self.count = words[2] or None
        if self.kind >= len(FIELDS):
            raise FileFormatError(f"field type {self.kind} is not known; give field angles (FTYP 0).")
        if words[1]:
            raise FileFormatError(
                "the object space is telecentric, so its pupil is not that of the stop; switch that off in "
                "the file (second number of FTYP)."
            )
        if words[6]:
            raise FileFormatError(
                "the image space is afocal, so there is no image plane; switch that off in the file "
                "(seventh number of FTYP)."
            )

    def finish(self, entries: Sequence[Entry]) -> FileLens:
        """FileLens of this header and the entries of the surfaces, object and image included."""
        if len(entries) < 3:
            raise FileFormatError(
                f"it has {len(entries)} surfaces; a lens needs at least object, one surface and image (SURF "
                "0, 1, 2)."
            )
        if self.unit is None:
            raise FileFormatError("it names no unit of length; add the line UNIT MM.")
        stops = [e.label for e in entries if e.is_stop]
        if len(stops) != 1 or not 0 < stops[0] < len(entries) - 1:
            raise FileFormatError(
                f"surfaces {stops} are marked as the stop; mark one between object and image with STOP."
            )
        pairs = itertools.zip_longest(
            self.heights.get("XFLN", []), self.heights.get("YFLN", []), fillvalue=0.0
        )
        height = max((math.hypot(x, y) for x, y in list(pairs)[: self.count]), default=0.0)
        entries[0].check_object()
        entries[-1].check_image()
        surfaces: list[FileSurface] = []
        frames = []
        frame = np.eye(4)
        object_distance = entries[0].thickness
        for entry in entries[1:-1]:
            with at(f"surface {entry.label}"):
                if entry.kind == "COORDBRK":
                    frame = frame @ entry.coordinate_break()
                    if surfaces:
                        surfaces[-1].thickness += entry.thickness
                    else:
                        object_distance += entry.thickness
                else:
                    surfaces.append(entry.surface())
                    frames.append(frame)
                frame = frame @ along(entry.thickness)
        moved = any(entry.kind == "COORDBRK" and entry.moves() for entry in entries)
        return FileLens(
            self.name,
            surfaces,
            UNITS_MM[self.unit],
            self.pupil,
            (FIELDS[self.kind], height),
            self.waves.get(self.primary, 0.5875618),
            object_distance,
            image_tilt_deg=place(surfaces, frames, frame) if moved else 0.0,
        )
