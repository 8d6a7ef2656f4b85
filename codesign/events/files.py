"""Event streams to and from files; the extension says the format."""

from pathlib import Path

from codesign.atomic import replacing
from codesign.errors import FileFormatError
from codesign.events.file_csv import read_csv, write_csv
from codesign.events.file_npz import read_npz, write_npz

READERS = {".csv": read_csv, ".npz": read_npz}
WRITERS = {".csv": write_csv, ".npz": write_npz}


def read(path, *, height_px=None, width_px=None):
    """Read an event stream.

    Args:
      path: file ending in .csv (header t,x,y,p; microseconds) or .npz.
      height_px, width_px: sensor size. Needed for formats without one (.csv: else the smallest that holds the events); checked against the others.
    Returns: EventStream sorted by (t, y, x, p).
    Raises: FileFormatError when the file is missing, malformed (with the line where there are lines) or of another kind.
    """
    path = Path(path)
    reader = _choose(READERS, path, "read")
    if not path.is_file():
        raise FileFormatError(f"no event file at {path}; check the path.")
    try:
        return reader(path, height_px, width_px)
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}.") from error


def write(path, stream):
    """Write an event stream; the file appears whole or not at all, and an earlier one stays when writing fails.

    Args: path: file ending in .csv or .npz, in an existing folder. stream: EventStream.
    Raises: FileFormatError for an unknown extension or a folder that is missing or not writable.
    """
    writer = _choose(WRITERS, Path(path), "written")
    with replacing(path) as temporary:
        writer(temporary, stream)


def _choose(table, path, verb):
    choice = table.get(path.suffix.lower())
    if choice is None:
        raise FileFormatError(f"{path} ends in {path.suffix or 'nothing'!r}; event files that can be {verb} end in {', '.join(sorted(table))}.")
    return choice
