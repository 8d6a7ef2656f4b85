"""Reader of CODE V .seq files: statements, system data, and the private glasses."""

import math
import re
from collections.abc import Iterator

from codesign.errors import FileFormatError
from codesign.lens.files.seq_surface import IDLE, SURFACE, PrivateGlasses, SeqSurface
from codesign.lens.files.system import FileLens
from codesign.lens.files.text import MOST_SURFACES, at, lines, number, shown, title, whole

UNITS_MM = {"M": 1.0, "MM": 1.0, "C": 10.0, "CM": 10.0, "I": 25.4, "IN": 25.4}
PUPILS = {"EPD": "diameter", "FNO": "working f-number", "NA": "numerical aperture"}
FIELDS = {"AN": "angle", "OB": "object height", "IM": "image height", "RI": "image height"}
WORD = re.compile(r"'[^']*'|\"[^\"]*\"|\S+")
FAR = 1e9  # an object beyond this counts as infinitely far


def read_seq(text: str, name: str) -> FileLens:
    """FileLens of the text of a .seq file.

    Without RDM, the first number of S is a curvature; without STO, the first surface is the stop (the
    program's own defaults). Solves and pickups keep the stored values; PIM is solved again. Raises:
    FileFormatError naming surface or line for what is not understood.
    """
    system = System(name)
    for line, words in statements(text):
        with at(f"line {line}"):
            system.take(words)
    return system.finish()


def statements(text: str) -> Iterator[tuple[int, list[str]]]:
    """Statements of a .seq file as (line number, words): comments from ! dropped, lines ending in & joined,
    statements parted at ;."""
    held = ""
    start = 0
    for at_line, raw in lines(text):
        parts = _split(raw)
        for i, part in enumerate(parts):
            last = i == len(parts) - 1
            start = start if held else at_line
            if last and part.rstrip().endswith("&"):
                held += part.rstrip()[:-1] + " "
                continue
            words = WORD.findall(held + part)
            held = ""
            if words:
                yield start, words
    if held.strip():
        raise FileFormatError(f"line {start}: the statement goes on (&) but the file ends; complete it.")


def _split(line):
    """A line without its comment, parted at semicolons; both only count outside quotes."""
    parts = []
    quote = ""
    begin = 0
    for i, character in enumerate(line):
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        elif character == "!":
            line = line[:i]
            break
        elif character == ";":
            parts.append(line[begin:i])
            begin = i + 1
    return [*parts, line[begin:]]


class System:
    """What has been read so far."""

    def __init__(self, name: str) -> None:
        self.lens = FileLens(name)
        self.surfaces: list[SeqSurface] = []
        self.object = SeqSurface(0)
        self.image = SeqSurface("image")
        self.current: SeqSurface | None = None
        self.radius_mode = False
        self.waves = [587.5618]
        self.reference = 1
        self.fields: dict[str, list[float]] = {}
        self.glasses = PrivateGlasses()

    def take(self, words: list[str]) -> None:
        if self.glasses.open:
            self.glasses.take(words)
            return
        command = words[0].upper()
        values = words[1:]
        if re.fullmatch(r"S(\d{1,4}|O|I)?", command, re.ASCII):
            self._take_surface(command, values)
            return
        command = command if command in SURFACE else command[:3] if command[0] not in "'\"" else command
        if command in SURFACE:
            target, values = self._target(values)
            with at(f"surface {target.label}"):
                target.take(command, values)
        elif command == "STO":
            target, _ = self._target(values)
            target.is_stop = True
        elif command == "PIM":
            self.lens.focus = True
        elif command not in IDLE:
            self._take_system(command, values)

    def _target(self, values):
        """The surface a command is about: the one named by a first word S3, or the current one."""
        named = re.fullmatch(r"S(\d{1,4}|O|I)", values[0].upper(), re.ASCII) if values else None
        if named is None:
            if self.current is None:
                raise FileFormatError("it stands before any surface; move it behind its S.")
            return self.current, values
        if named[1] in "OI":
            return (self.object if named[1] == "O" else self.image), values[1:]
        if not 0 < int(named[1]) <= len(self.surfaces):
            raise FileFormatError(f"there is no surface {named[0]} so far; define it first.")
        return self.surfaces[int(named[1]) - 1], values[1:]

    def _take_surface(self, command, values):
        if command == "SO":
            self.current = self.object
        elif command == "SI":
            self.current = self.image
        else:
            if command[1:] and int(command[1:]) != len(self.surfaces) + 1:
                raise FileFormatError(
                    f"{command} comes where surface {len(self.surfaces) + 1} is due; number the surfaces in "
                    "order, once each."
                )
            if len(self.surfaces) >= MOST_SURFACES:
                raise FileFormatError(f"it holds more than {MOST_SURFACES} surfaces; is it a lens?")
            self.current = SeqSurface(len(self.surfaces) + 1)
            self.surfaces.append(self.current)
        with at(f"surface {self.current.label}"):
            self.current.shape(values, self.radius_mode, self.glasses)

    def _take_system(self, command, values):
        if command == "RDM":
            self.radius_mode = not values or values[0].upper().startswith("Y")
        elif command == "PRV":
            self.glasses.open = True
        elif command in ("TIT", "LEN"):
            self.lens.name = (
                title(" ".join(values).strip("'\""), self.lens.name) if command == "TIT" else self.lens.name
            )
        elif not values:
            raise FileFormatError(
                f"command '{shown(command)}' has no value, or is not understood; delete it if it changes no "
                "ray."
            )
        elif command == "ZOO":
            raise FileFormatError(
                f"it is a zoom (ZOO {shown(values[0])}), and only one lens at a time is read; save the "
                "position you "
                "want as a lens of its own."
            )
        elif command == "DIM":
            if values[0].upper() not in UNITS_MM:
                raise FileFormatError(
                    f"unit '{shown(values[0])}' is not known; give DIM M (millimetres), C (centimetres) or "
                    "I (inches)."
                )
            self.lens.unit_mm = UNITS_MM[values[0].upper()]
        elif command in PUPILS:
            self.lens.pupil = PUPILS[command], number(values[0], command)
        elif command == "NAO":
            raise FileFormatError(
                "the pupil is given by the cone of light at a near object (NAO), which says nothing for "
                "other distances; give the entrance pupil diameter (EPD)."
            )
        elif command == "WL":
            self.waves = [number(v, command) for v in values]
        elif command == "REF":
            self.reference = whole(values[0], command)
        elif command[1:] in FIELDS and command[0] in "XY":
            self.fields[command] = [number(v, command) for v in values]
        elif command in ("TEM", "PRE"):
            if number(values[0], command) != {"TEM": 20.0, "PRE": 760.0}[command]:
                raise FileFormatError(
                    f"{command} is {shown(values[0])}; indices are those at 20 degrees and 760 mm of "
                    "mercury, so remove it or design for that."
                )
        else:
            raise FileFormatError(
                f"command '{shown(command)}' is not understood; delete it if it changes no ray."
            )

    def finish(self) -> FileLens:
        """FileLens of all that was read."""
        lens = self.lens
        stops = [s.label for s in self.surfaces if s.is_stop]
        if not self.surfaces:
            raise FileFormatError("it has no surface (a line such as S 50 3 N-BK7); is it a lens?")
        if len(stops) > 1 or self.object.is_stop or self.image.is_stop:
            raise FileFormatError(
                f"surfaces {stops} are marked as the stop (STO); mark one between object and image."
            )
        if not stops:
            self.surfaces[0].is_stop = True
        self.image.check_image()
        self.object.check_object()
        for surface in self.surfaces:
            with at(f"surface {surface.label}"):
                lens.surfaces.append(surface.finish(lens.unit_mm))
        lens.defocus = self.image.thickness
        lens.object_distance = self.object.thickness if abs(self.object.thickness) < FAR else math.inf
        if not 1 <= self.reference <= len(self.waves):
            raise FileFormatError(
                f"the reference wavelength is number {self.reference} of {len(self.waves)}; correct REF."
            )
        lens.wavelength_um = self.waves[self.reference - 1] * 1e-3
        for kind, label in FIELDS.items():
            x = self.fields.get(f"X{kind}", [])
            y = self.fields.get(f"Y{kind}", [])
            if x or y:
                count = max(len(x), len(y))
                lens.field = (
                    label,
                    max(
                        math.hypot(*pair)
                        for pair in zip(
                            x + [0.0] * (count - len(x)), y + [0.0] * (count - len(y)), strict=True
                        )
                    ),
                )
        return lens
