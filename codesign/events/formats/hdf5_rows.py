"""HDF5 on damaged files and full disks: rows of large datasets, block by block, and new files.

The library trusts its filters and its index: a block that unpacks to fewer bytes than its chunk, a
filter without its parameters, or a damaged index while a block is read ends the process. So stored
bytes are read past it, gzip blocks are unpacked and measured here, and Blosc blocks are handed on
only when their headers say what the chunk needs; other filters are refused.
Source: HDF5 File Format Specification 3.0, "Data Object Header Messages: Filter Pipeline"; c-blosc,
  README_CHUNK_FORMAT.
"""

import contextlib
import io
import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from codesign.errors import FileFormatError
from codesign.optional import optional
from codesign.reading import check_regular, reading

# hdf5plugin registers the Blosc filter that DSEC's published files use
h5py = optional("h5py", "event-files", "reading and writing HDF5 files", "hdf5plugin")

GZIP = 1
SHUFFLE = 2
FLETCHER32 = 3
BLOSC = 32001
# what claims to unpack to more than this is refused, not unpacked
LIMIT_RATIO = 4096
LIMIT_EXTRA_BYTES = 2**20
REMEDY = "it is missing, cut or damaged, or no HDF5 file of this kind"


def chunk_bytes(dataset):
    return math.prod(dataset.chunks) * dataset.dtype.itemsize


def places_of(path, dataset, name, file_bytes):
    """[(first indices, mask of filters left out, first byte, stored bytes)] of all blocks, which
    must cover the dataset once and lie inside the file."""
    needed = math.prod(
        -(-length // chunk) for length, chunk in zip(dataset.shape, dataset.chunks, strict=True)
    )
    if (
        needed > file_bytes
        or max(needed * chunk_bytes(dataset), dataset.size * dataset.dtype.itemsize)
        > LIMIT_RATIO * file_bytes + LIMIT_EXTRA_BYTES
    ):
        raise FileFormatError(
            f"{path}: {name} claims {list(dataset.shape)} values, out of proportion to a file of "
            f"{file_bytes} bytes; it is damaged."
        )
    places = []
    # byte_offset counts from the start of the file, its user block included
    dataset.id.chunk_iter(
        lambda info: places.append(
            (tuple(info.chunk_offset), info.filter_mask, info.byte_offset, info.size)
        )
    )
    sides = tuple(zip(dataset.chunks, dataset.shape, strict=True))
    inside = all(
        first % chunk == 0 and 0 <= first < length
        for at, *_ in places
        for first, (chunk, length) in zip(at, sides, strict=True)
    )
    if (
        not inside
        or len({at for at, *_ in places}) != needed
        or len(places) != needed
        or any(start is None or start + size > file_bytes for _, _, start, size in places)
    ):
        raise FileFormatError(
            f"{path}: {name} needs {needed} blocks and lacks some; the file was cut or is damaged."
        )
    return places


def stored_bytes(path, name, place):
    """A block as it lies in the file."""
    _, _, start, size = place
    with open(path, "rb") as file:
        file.seek(start)
        data = file.read(size)
    if len(data) != size:
        raise damaged(path, name, "cut")
    return data


def undone(path, name, kind, options, data, limit_bytes):
    """One filter undone."""
    if kind == GZIP:
        unpacker = zlib.decompressobj()
        data = unpacker.decompress(data, limit_bytes + 4)
        if not unpacker.eof or unpacker.unused_data:
            raise damaged(path, name, "gzip")
        return data
    if kind == SHUFFLE:
        width = options[0] if options else 0
        if not 0 < width <= 8 or len(data) % width:
            raise damaged(path, name, "shuffle")
        return np.frombuffer(data, np.uint8).reshape(width, -1).T.tobytes()
    if len(data) < 4:
        raise damaged(path, name, "fletcher32")
    # an odd last byte is the high half of a word
    words = np.frombuffer(data[:-4] + bytes(len(data) % 2), ">u2").astype(np.int64)
    low, high = struct.unpack("<HH", data[-4:])
    if (int(words.sum()) - low) % 65535 or (
        int((words * np.arange(len(words), 0, -1) % 65535).sum()) - high
    ) % 65535:
        raise FileFormatError(f"{path}: a block of {name} fails its checksum; the file is damaged.")
    return data[:-4]


def check_blosc(path, dataset, name, place, options):
    """A block must unpack to its chunk by its own header, and the filter must have been told so."""
    width = dataset.dtype.itemsize
    size = chunk_bytes(dataset)
    if len(options) < 4 or tuple(options[2:4]) != (width, size):
        raise damaged(path, name, "Blosc's parameters")
    at, mask, _, stored = place
    data = stored_bytes(path, name, place)
    header = struct.unpack_from("<4B3I", data) if len(data) >= 16 else (0,) * 7
    version, _, _, typesize, unpacked, block, packed = header
    fits = (version, typesize, unpacked, packed) == (2, width, size, len(data))
    fits = fits and 0 < block <= max(size, 1)
    if not (stored == size if mask & 1 else fits):
        raise damaged(path, name, at)


def damaged(path, name, where):
    return FileFormatError(
        f"{path}: a block of {name} ({where}) does not unpack to what it should; the file is damaged."
    )


def own(path, file, name):
    """The object of a name, which must lie in this file, all along its path. Raises:
    FileFormatError."""
    found = file
    for part in name.split("/"):
        if not isinstance(found, h5py.Group) or not isinstance(
            found.get(part, getlink=True), h5py.HardLink
        ):
            raise FileFormatError(
                f"{path}: {name} is absent or a link to another file; files must hold their own data."
            )
        found = found[part]
    return found


def scalar(path, name):
    """One whole number of a file, within 61 bits. Raises: FileFormatError."""
    with reading(path, REMEDY), h5py.File(path, "r", locking=False) as file:
        held = own(path, file, name)
        number = (
            int(held[()].reshape(-1)[0])
            if getattr(held, "size", 0) == 1 and held.dtype.kind in "iu"
            else None
        )
        if number is None or not abs(number) <= 2**61:
            raise FileFormatError(
                f"{path}: {name} is {number or held}; one whole number of 61 bits is needed."
            )
        return number


class Rows:
    """A dataset of numbers in a file, read by ranges of its first axis. The file is open only while
    it is read.

    Args:
      path: the file.
      name: the dataset.
      columns: shape of a row (None: any).
      count: number of rows that it must have (None: any).
    Raises: FileFormatError when it is absent, of another shape, cut, packed by a filter that is not
      trusted, or kept in other files.
    """

    def __init__(
        self,
        path: str | Path,
        name: str,
        columns: Sequence[int] | None = None,
        count: int | None = None,
    ) -> None:
        self.path = check_regular(path)
        self.name = name
        self.block_shape = None
        self.places = {}
        self.filters = []
        with self._dataset() as dataset:
            if (columns is not None and dataset.shape[1:] != tuple(columns)) or (
                count is not None and len(dataset) != count
            ):
                wanted = [
                    count if count is not None else "N",
                    *(columns if columns is not None else dataset.shape[1:]),
                ]
                raise FileFormatError(
                    f"{path}: {name} has shape {list(dataset.shape)}, {wanted} is needed."
                )
            self.shape = dataset.shape
            self.dtype = dataset.dtype
            self._find_blocks(dataset)

    def __len__(self) -> int:
        return self.shape[0]

    @contextmanager
    def _dataset(self):
        with reading(self.path, REMEDY), h5py.File(self.path, "r", locking=False) as file:
            dataset = own(self.path, file, self.name)
            if (
                not isinstance(dataset, h5py.Dataset)
                or dataset.shape is None
                or dataset.ndim < 1
                or dataset.dtype.kind not in "iufb"
            ):
                raise FileFormatError(f"{self.path}: {self.name} is no list of numbers.")
            if dataset.is_virtual or dataset.external:
                raise FileFormatError(
                    f"{self.path}: {self.name} is kept in other files; files must hold their own data."
                )
            yield dataset

    def _find_blocks(self, dataset):
        size = self.path.stat().st_size
        if dataset.chunks is None:
            if dataset.size * dataset.dtype.itemsize > size:
                raise FileFormatError(
                    f"{self.path}: {self.name} claims {dataset.size} values, more than the file has; it was "
                    "cut or is damaged."
                )
            return
        self.block_shape = tuple(dataset.chunks)
        for place in places_of(self.path, dataset, self.name, size):
            self.places.setdefault(place[0][0], []).append(place)
        plist = dataset.id.get_create_plist()
        self.filters = [plist.get_filter(k) for k in range(plist.get_nfilters())]
        kinds = [kind for kind, *_ in self.filters]
        trusted = {GZIP, SHUFFLE, FLETCHER32}
        if kinds != [BLOSC] and (not set(kinds) <= trusted or len(set(kinds)) < len(kinds)):
            raise FileFormatError(
                f"{self.path}: {self.name} went through the filters {kinds}; gzip, shuffle, fletcher32, or "
                "Blosc alone are read; write it anew with gzip."
            )

    def read(self, first: int, last: int) -> np.ndarray:
        """Rows first to last - 1 as a numpy array, in the file's type. Raises: FileFormatError for
        a range outside, and for damaged blocks."""
        if not 0 <= first <= last <= len(self):
            raise FileFormatError(
                f"{self.path}: rows {first} to {last} of {self.name} were asked for, which has {len(self)}."
            )
        with self._dataset() as dataset:
            block_shape = dataset.chunks and tuple(dataset.chunks)
            if (dataset.shape, block_shape) != (self.shape, self.block_shape):
                raise FileFormatError(f"{self.path} changed while it was in use.")
            if self.block_shape is None:
                return np.asarray(dataset[first:last])
            found = np.empty((last - first, *self.shape[1:]), dataset.dtype)
            depth = self.block_shape[0]
            for start in range(first // depth * depth, last, depth):
                for place in self.places[start]:
                    at = place[0]
                    low = max(first, at[0])
                    high = min(last, at[0] + depth)
                    target = (
                        slice(low - first, high - first),
                        *(
                            slice(a, a + n)
                            for a, n in zip(at[1:], self.block_shape[1:], strict=True)
                        ),
                    )
                    room = found[target].shape[1:]  # blocks at the end reach beyond the dataset
                    found[target] = self._block(dataset, place)[
                        (slice(low - at[0], high - at[0]), *(slice(0, n) for n in room))
                    ]
            return found

    def __getitem__(self, index: int) -> np.ndarray:
        """One row."""
        return self.read(index, index + 1)[0]

    def _block(self, dataset, place):
        """One unpacked block, after checking that it is what it claims."""
        at, mask, *_ = place
        if self.filters and self.filters[0][0] == BLOSC:
            check_blosc(self.path, dataset, self.name, place, self.filters[0][2])
            return np.asarray(
                dataset[
                    tuple(slice(a, a + n) for a, n in zip(at, self.block_shape or (), strict=True))
                ]
            )
        data = stored_bytes(self.path, self.name, place)
        size = chunk_bytes(dataset)
        for k in reversed(range(len(self.filters))):
            if not mask >> k & 1:
                data = undone(
                    self.path, self.name, self.filters[k][0], self.filters[k][2], data, size
                )
        if len(data) != size:
            raise damaged(self.path, self.name, at)
        return np.frombuffer(data, dataset.dtype).reshape(self.block_shape)


@contextlib.contextmanager
def new_hdf5(path: str | Path, **options: Any) -> Iterator[Any]:
    """Yield a new HDF5 file, open for writing.

    Args:
        path: of the file; what is there is lost.
        options: of ``h5py.File``.

    Raises:
        OSError: when the block ends, if something could not be written. HDF5 itself ends the
            process where it fails while it closes a file, so it is not told.
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
