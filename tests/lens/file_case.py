"""Lens files to read and to spoil: the good files and the faults of files.txt, and exchanges within them."""

import re
from pathlib import Path

from codesign import lens

ENDINGS = {"deeplens": "json", "optiland": "json", "native": "json", "table": "txt"}


def plain(text):
    """The text that a table's spelling stands for."""
    text = text.replace(r"\n", "\n").replace(r"\x00", "\0").replace(r"\x01", "\1")
    return re.sub(r"\{([^*{]+)\*(\d+)\}", lambda found: found[1] * int(found[2]), text)


def edited(text, exchanges):
    """A text with the first places of some words exchanged: "old => new ;; old => new"."""
    for exchange in filter(None, exchanges.split(" ;; ")):
        old, new = (plain(side) for side in re.split(r" =>(?: |$)", exchange))
        assert old == "*" or old in text, f"{old!r} is not in the file"
        text = new if old == "*" else text.replace(old, new, 1)
    return text


def _sections():
    """Good files by format, and rows (format, exchanges, pattern) of faults."""
    files, faults = {}, []
    for section in Path(__file__).with_name("files.txt").read_text().split("\n[")[1:]:
        kind, rest = section.split("]\n", 1)
        files[kind], rows = rest.split("--\n")
        faults += [(kind, *re.split(r" ?\| ", row, maxsplit=1)) for row in rows.splitlines() if row]
    return files, faults


FILES, FAULTS = _sections()


def load(folder, kind, exchanges="", content=None):
    """The lens of a good file after exchanges, or of other content of that format."""
    path = folder / f"lens.{ENDINGS.get(kind, kind)}"
    content = edited(FILES[kind], exchanges) if content is None else content
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return lens.load(path)
