"""Arrays of a large .npz file: their shapes without reading them, and their values from the disk as they are
needed where the file is not packed."""

import math
import struct
import zipfile
from collections.abc import Iterable
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from codesign.errors import FileFormatError

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
LOCAL_HEADER_BYTES = 30  # PKWARE, .ZIP File Format Specification, 4.3.7


def shapes(path: str | Path, names: Iterable[str]) -> dict[str, tuple[int, ...]]:
    """{name: shape} of arrays of numbers, after checking that the file holds what they claim. Raises:
    FileFormatError."""
    with _archive(path, names) as archive:
        found = {}
        for name in names:
            with archive.open(f"{name}.npy") as member:
                shape, _, dtype = HEADERS[np.lib.format.read_magic(member)](member)
                if (
                    dtype.kind not in "fiu"
                    or member.tell() + math.prod(shape) * dtype.itemsize
                    != archive.getinfo(f"{name}.npy").file_size
                ):
                    raise FileFormatError(
                        f"{path}: {name} claims {list(shape)} numbers of {dtype}, not what the file holds; "
                        "it is damaged."
                    )
            found[name] = list(shape)
        return found


def array(path: str | Path, name: str) -> np.ndarray:
    """One array: left on the disk (read-only) where the archive holds it as it is, read into memory as
    float32 or less where it is packed."""
    with _archive(path, [name]) as archive:
        entry = archive.getinfo(f"{name}.npy")
        with archive.open(entry) as member:
            shape, in_columns, dtype = HEADERS[np.lib.format.read_magic(member)](member)
            header_bytes = member.tell()
        if entry.compress_type == zipfile.ZIP_STORED and math.prod(shape):
            with open(path, "rb") as file:
                file.seek(entry.header_offset)
                lengths = struct.unpack("<HH", file.read(LOCAL_HEADER_BYTES)[26:30])
            offset = entry.header_offset + LOCAL_HEADER_BYTES + sum(lengths) + header_bytes
            return np.memmap(path, dtype, "r", offset, tuple(shape), "F" if in_columns else "C")
        with archive.open(entry) as member:
            found = np.lib.format.read_array(member, allow_pickle=False)
        return found.astype(np.float32) if found.ndim == 3 and found.dtype == np.float64 else found


@contextmanager
def _archive(path, names):
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except FileFormatError:
        raise
    except (
        OSError,
        KeyError,
        ValueError,
        EOFError,
        struct.error,
        MemoryError,
        zipfile.BadZipFile,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise FileFormatError(f"{path} is no whole .npz file with {', '.join(names)} ({error}).") from error
