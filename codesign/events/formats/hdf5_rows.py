"""Rows of large HDF5 datasets, block by block, with the guard of hdf5_chunks against damaged files."""

from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats import hdf5_chunks as chunks
from codesign.events.formats.hdf5_chunks import h5py
from codesign.reading import check_regular, reading

REMEDY = "it is missing, cut or damaged, or no HDF5 file of this kind"


def own(path, file, name):
    """The object of a name, which must lie in this file, all along its path. Raises: FileFormatError."""
    found = file
    for part in name.split("/"):
        if not isinstance(found, h5py.Group) or not isinstance(found.get(part, getlink=True), h5py.HardLink):
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
    """A dataset of numbers in a file, read by ranges of its first axis. The file is open only while it is
    read.

    Args: path: the file. name: the dataset. columns: shape of a row (None: any). count: number of rows that
      it must have (None: any).
    Raises: FileFormatError when it is absent, of another shape, cut, packed by a filter that is not trusted,
      or kept in other files.
    """

    def __init__(
        self, path: str | Path, name: str, columns: Sequence[int] | None = None, count: int | None = None
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
                raise FileFormatError(f"{path}: {name} has shape {list(dataset.shape)}, {wanted} is needed.")
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
        for place in chunks.places_of(self.path, dataset, self.name, size):
            self.places.setdefault(place[0][0], []).append(place)
        plist = dataset.id.get_create_plist()
        self.filters = [plist.get_filter(k) for k in range(plist.get_nfilters())]
        kinds = [kind for kind, *_ in self.filters]
        trusted = {chunks.GZIP, chunks.SHUFFLE, chunks.FLETCHER32}
        if kinds != [chunks.BLOSC] and (not set(kinds) <= trusted or len(set(kinds)) < len(kinds)):
            raise FileFormatError(
                f"{self.path}: {self.name} went through the filters {kinds}; gzip, shuffle, fletcher32, or "
                "Blosc alone are read; write it anew with gzip."
            )

    def read(self, first: int, last: int) -> np.ndarray:
        """Rows first to last - 1 as a numpy array, in the file's type. Raises: FileFormatError for a range
        outside, and for damaged blocks."""
        if not 0 <= first <= last <= len(self):
            raise FileFormatError(
                f"{self.path}: rows {first} to {last} of {self.name} were asked for, which has {len(self)}."
            )
        with self._dataset() as dataset:
            if dataset.shape != self.shape or (dataset.chunks and tuple(dataset.chunks)) != self.block_shape:
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
                        *(slice(a, a + n) for a, n in zip(at[1:], self.block_shape[1:], strict=True)),
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
        at, mask, _ = place
        if self.filters and self.filters[0][0] == chunks.BLOSC:
            chunks.check_blosc(self.path, dataset, self.name, [place], self.filters[0][2])
            return np.asarray(
                dataset[tuple(slice(a, a + n) for a, n in zip(at, self.block_shape or (), strict=True))]
            )
        data = dataset.id.read_direct_chunk(at)[1]
        size = chunks.chunk_bytes(dataset)
        for k in reversed(range(len(self.filters))):
            if not mask >> k & 1:
                data = chunks.undone(self.path, self.name, self.filters[k][0], self.filters[k][2], data, size)
        if len(data) != size:
            raise chunks.damaged(self.path, self.name, at)
        return np.frombuffer(data, dataset.dtype).reshape(self.block_shape)
