"""Files that appear whole or not at all."""

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path

from codesign.errors import FileFormatError


@contextmanager
def replacing(path):
    """Yield a temporary path beside ``path`` with the same extension; move it into place when the block ends
    well, remove it otherwise.

    Raises: FileFormatError when the folder is missing or not writable; an earlier file at ``path`` stays as
      it was.
    """
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
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
        temporary.replace(path)
    except OSError as error:
        raise FileFormatError(
            f"cannot write {path}: {error.strerror or error}; is the disk full, or the path a folder?"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)
