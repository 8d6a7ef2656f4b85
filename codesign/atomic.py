"""Files that appear whole or not at all, and stay after a loss of power."""

import contextlib
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from codesign.errors import FileFormatError

UNFINISHED = re.compile(r"\..*-[a-z0-9_]{8}(\.[^.]*)?")  # a name of ``replacing``


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` with the same extension; move it into place when the
    block ends well, remove it otherwise.

    The content reaches the disk before the name does, and the name before this returns.
    Raises: FileFormatError when the folder is missing or not writable; an earlier file at ``path``
      stays as it was.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix
        )
        os.close(handle)
    except OSError as error:
        raise FileFormatError(
            f"cannot write {path}: {error.strerror}; give a file in an existing, writable folder."
        ) from error
    temporary = Path(name)
    try:
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)  # mkstemp makes files private
        _sync(temporary, os.O_RDWR)
        os.replace(temporary, path)
    except OSError as error:
        raise FileFormatError(
            f"cannot write {path}: {error.strerror or error}; is the disk full, or the path a folder?"
        ) from error
    finally:
        with contextlib.suppress(OSError):  # after a failure the sentence above matters more
            temporary.unlink(missing_ok=True)
    # some file systems cannot sync a folder; the file itself is whole
    with contextlib.suppress(OSError):
        _sync(path.parent, os.O_RDONLY)


def remove_unfinished(folder: Path) -> None:
    """Remove what ``replacing`` left in a folder, and below, when its process was killed; for a
    folder that no other process writes to."""
    for path in folder.rglob(".*"):
        if UNFINISHED.fullmatch(path.name) and path.is_file():
            path.unlink(missing_ok=True)


def write_atomic(path: str | Path, content: bytes) -> None:
    """Write ``content`` so that ``path`` holds either the old bytes or all of the new ones,
    whatever happens in between.

    Raises: FileFormatError when it cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _sync(path, access):
    opened = os.open(path, access)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
