"""NumPy's files (.npy, .npz) from somebody nobody vouches for: what a header announces is compared
with what the file holds before room is taken for it, objects are never built, and what is wrong is
one sentence."""

import math
import re
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from codesign.errors import FileFormatError
from codesign.reading import MOST_BYTES, check_room, open_regular, reading

DEFLATE_RATIO = 1040  # at most 1032 to 1
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
LOCAL_HEADER_BYTES = 30  # PKWARE, .ZIP File Format Specification, 4.3.7
BLOCK_BYTES = 2**24
MOST_HEADER_BYTES = 10_000
HEADER = re.compile(r"\{( *'\w+': *('[^']{1,20}'|True|False|\([0-9, ]{0,400}\)),?){3} *\}\s*")
KINDS = "biufcSU"  # data without pointers


@dataclass(frozen=True)
class Header:
    """shape, dtype: of an array. by_columns: first index fastest. start: bytes before its first
    value."""

    shape: tuple[int, ...]
    dtype: np.dtype
    by_columns: bool
    start: int

    @property
    def end(self) -> int:
        """Bytes of the header and all values."""
        return self.start + math.prod(self.shape) * self.dtype.itemsize


class Npz:
    """The arrays of an open .npz, by their names without .npy. Every method raises FileFormatError
    alone."""

    def __init__(self, path: Path, archive: zipfile.ZipFile, remedy: str) -> None:
        self.path = path
        self._remedy = remedy
        self._archive = archive
        self._entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
        self.names = tuple(self._entries)

    def __contains__(self, name: str) -> bool:
        return name in self._entries

    def header(self, name: str) -> Header:
        """What the array is, without its values."""
        with self._member(name) as (_, header):
            return header

    def read(self, name: str, most_bytes: int = MOST_BYTES) -> np.ndarray:
        """The whole array."""
        with self._member(name) as (member, header):
            check_room(f"{self.path}: {name}", header.shape, header.dtype.itemsize, most_bytes)
            return _filled(member.read, header)

    def rows(self, name: str) -> Iterator[np.ndarray]:
        """The rows of the array one after the other, as many as the archive yields."""
        with self._member(name) as (member, header):
            size = math.prod(header.shape[1:]) * header.dtype.itemsize
            for _ in range(header.shape[0]):
                yield np.frombuffer(member.read(size), header.dtype).reshape(header.shape[1:])

    def mapped(self, name: str, most_bytes: int = MOST_BYTES) -> np.ndarray:
        """The array, left on the disk (read-only) where the archive holds it as it is, else
        read."""
        header = self.header(name)
        entry = self._entries[name]
        if entry.compress_type != zipfile.ZIP_STORED or not math.prod(header.shape):
            return self.read(name, most_bytes)
        with reading(self.path), open(self.path, "rb") as file:
            file.seek(entry.header_offset)
            lengths = struct.unpack("<HH", file.read(LOCAL_HEADER_BYTES)[26:30])
            offset = entry.header_offset + LOCAL_HEADER_BYTES + sum(lengths) + header.start
            order = "F" if header.by_columns else "C"
            return np.memmap(self.path, header.dtype, "r", offset, header.shape, order)

    @contextmanager
    def _member(self, name):
        if name not in self._entries:
            raise FileFormatError(
                f"{self.path} has no array {name}, but {', '.join(self.names)[:200] or 'none'}; {self._remedy}."
            )
        entry = self._entries[name]
        with reading(f"{self.path}: {name}", self._remedy), self._archive.open(entry) as member:
            header = _header(member, f"{self.path}: {name}")
            packed_bytes = min(entry.compress_size, self.path.stat().st_size)
            if header.end != entry.file_size or header.end > DEFLATE_RATIO * packed_bytes + 4096:
                raise FileFormatError(
                    f"{self.path}: array {name} claims {list(header.shape)} values of {header.dtype}, not what the "
                    "file holds; it is damaged."
                )
            yield member, header


@contextmanager
def open_npz(path: str | Path, remedy: str = "use a whole .npz file") -> Iterator[Npz]:
    """Open an .npz of plain numbers and text, stored or deflated. Raises: FileFormatError that ends
    in ``remedy``."""
    with open_regular(path) as file:
        with reading(path, remedy):
            archive = zipfile.ZipFile(file)
            if any(entry.compress_type not in PACKINGS for entry in archive.infolist()):
                raise FileFormatError(
                    f"{path} is packed in a way that NumPy does not use; save it anew."
                )
            if not all(entry.filename.isprintable() for entry in archive.infolist()):
                raise FileFormatError(f"{path} names arrays in no letters; it is damaged.")
        with archive:
            yield Npz(Path(path), archive, remedy)


def read_npz(path: str | Path, remedy: str = "use a whole .npz file") -> dict[str, np.ndarray]:
    """The arrays of an .npz by name. Raises: FileFormatError."""
    with open_npz(path, remedy) as file:
        return {name: file.read(name) for name in file.names}


def read_npy(path: str | Path, mapped: bool = False) -> np.ndarray:
    """The array of an .npy file; with ``mapped``, left on the disk (read-only). Raises:
    FileFormatError."""
    with open_regular(path) as file, reading(path, "use a whole .npy file"):
        header = _header(file, str(path))
        if header.end != Path(path).stat().st_size:
            raise FileFormatError(
                f"{path} claims {list(header.shape)} values of {header.dtype}, not what the file holds; it is damaged."
            )
        if mapped and math.prod(header.shape):
            order = "F" if header.by_columns else "C"
            return np.memmap(path, header.dtype, "r", header.start, header.shape, order)
        check_room(path, header.shape, header.dtype.itemsize)
        return _filled(file.read, header)


def _header(file: IO[bytes], what: str) -> Header:
    version = file.read(8)[6:]
    width = 2 if version == b"\x01\x00" else 4  # of the header's own length
    length = int.from_bytes(file.read(width), "little")
    text = file.read(min(length, MOST_HEADER_BYTES)).decode("latin-1")
    told = HEADER.fullmatch(text)
    parts = dict(re.findall(r"'(\w+)': *('[^']*'|\w+|\([^)]*\))", text)) if told else {}
    if parts.keys() != {"descr", "fortran_order", "shape"}:
        raise FileFormatError(
            f"{what} has no header of an array of plain numbers ({text[:60]!r}); use a whole .npy file."
        )
    shape = [int(size) for size in re.findall(r"[0-9]+", parts["shape"])]
    dtype = np.dtype(parts["descr"].strip("'"))
    by_columns = parts["fortran_order"] == "True"
    if dtype.kind not in KINDS or not dtype.itemsize:
        raise FileFormatError(f"{what} holds {dtype} {shape}; plain numbers are needed.")
    return Header(tuple(shape), dtype, by_columns, file.tell())


def _filled(read, header):
    """The array of the bytes that follow."""
    room = np.empty(header.end - header.start, np.uint8)
    for first in range(0, len(room), BLOCK_BYTES):
        part = room[first : first + BLOCK_BYTES]
        # of another length where the file is cut
        part[:] = np.frombuffer(read(len(part)), np.uint8)
    return room.view(header.dtype).reshape(header.shape, order="F" if header.by_columns else "C")
