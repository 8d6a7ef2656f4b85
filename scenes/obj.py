"""What trimesh would read of an .obj as something else than it says: several libraries of
materials, colours that it drops."""

import re

import numpy as np

from codesign.errors import FileFormatError
from scenes.mesh_folder import Folder

LIBRARY = "codesign:all materials"
COLOURED = rb"^v(?:[ \t]+[^\s#]+){6,7}[ \t]*(?:#[^\n]*)?\r?$"
TOLD = rb"^%s[ \t]+(.*?)[ \t\r]*$"


def with_one_library(data: bytes, folder: Folder) -> bytes:
    """The text with one library for all that it names, given to the folder, every colour of it
    written as three numbers. Raises: FileFormatError for a material that none of them has, or a
    colour that is no numbers."""
    names = dict.fromkeys(_told(b"mtllib", data))
    if not names:
        return data
    library = b"\n".join(folder.get(name.decode()) for name in names)
    if lacking := set(_told(b"usemtl", data)) - set(_told(b"newmtl", library)):
        raise FileFormatError(
            f"it uses the material '{min(lacking).decode()}', which its library does not have; export both anew"
        )
    folder.given[LIBRARY] = b"\n".join(map(_readable, library.splitlines()))
    return f"mtllib {LIBRARY}\n".encode() + data


def check_colours(data: bytes) -> None:
    """Raise FileFormatError for colours of vertices that are not from 0 to 1, or of some vertices
    alone."""
    coloured = re.findall(COLOURED, data, re.MULTILINE)
    if not coloured:
        return
    every = len(re.findall(rb"^v[ \t]", data, re.MULTILINE))
    if len(coloured) < every:
        raise FileFormatError(
            f"{len(coloured)} of its {every} vertices have a colour; export it with colours for all of them, or none"
        )
    most = max(float(word) for line in coloured for word in line.split(b"#")[0].split()[-3:])
    if most > 1:
        raise FileFormatError(f"colours of its vertices reach {most:g}; export them from 0 to 1")


def _told(word, data):
    return re.findall(TOLD % word, data, re.MULTILINE)


def _readable(line):
    """A line of a library whose diffuse colour trimesh can read."""
    words = line.split(b"#")[0].split()
    if not words or words[0].lower() != b"kd":
        return line
    try:
        colour = np.array([float(word) for word in words[1:]])
    except ValueError:
        colour = np.empty(0)
    if len(colour) not in (1, 3) or not (np.isfinite(colour).all() and (colour >= 0).all()):
        raise FileFormatError(
            f"its colour '{line.decode(errors='replace').strip()}' is not three numbers; write them with points, such as "
            "Kd 0.3 0.3 0.3"
        )
    return b"Kd " + b" ".join(words[1:] * (3 // len(colour)))
