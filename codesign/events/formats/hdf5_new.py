"""New HDF5 files on disks that may fill up."""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from codesign.events.formats.hdf5_chunks import h5py


@contextlib.contextmanager
def new_hdf5(path: str | Path, **options: Any) -> Iterator[Any]:
    """Yield a new HDF5 file, open for writing.

    Args:
        path: of the file; what is there is lost.
        options: of ``h5py.File``.

    Raises:
        OSError: when the block ends, if something could not be written. HDF5 itself ends the process where it fails
            while it closes a file, so it is not told.
    """
    with h5py.File(path, "w"):  # HDF5 refuses a file that somebody reads
        pass
    with _Disk(path, "r+") as disk:
        try:
            with h5py.File(disk, "w", **options) as file:
                yield file
        finally:
            if disk.failure:
                raise disk.failure


class _Disk(io.FileIO):
    """A file whose first failure is kept; what is written after it goes nowhere."""

    failure: OSError | None = None

    def write(self, content) -> int:
        left = memoryview(content).cast("B")
        try:
            while len(left) and self.failure is None:
                left = left[super().write(left) :]
        except OSError as error:
            self.failure = error
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = self.failure or error
            return size or 0
