"""Values of an HDF5 dataset from a file nobody vouches for.

The library trusts its filters: a block that unpacks to fewer bytes than its chunk, or a filter without its
parameters, ends the process. So gzip blocks are unpacked and measured here, and Blosc blocks are handed on
only when their headers say what the chunk needs; other filters are refused.
Source: HDF5 File Format Specification 3.0, "Data Object Header Messages: Filter Pipeline"; c-blosc,
  README_CHUNK_FORMAT.
"""

import math
import struct
import zlib

import numpy as np

from codesign.errors import FileFormatError
from codesign.optional import optional

# hdf5plugin registers the Blosc filter that DSEC's published files use
h5py = optional("h5py", "event-files", "reading and writing HDF5 files", "hdf5plugin")

GZIP = 1
SHUFFLE = 2
FLETCHER32 = 3
BLOSC = 32001
# what claims to unpack to more than this is refused, not unpacked
LIMIT_RATIO = 4096
LIMIT_EXTRA_BYTES = 2**20


def chunk_bytes(dataset):
    return math.prod(dataset.chunks) * dataset.dtype.itemsize


def places_of(path, dataset, name, file_bytes):
    """[(first indices, mask of filters left out, stored bytes)] of all blocks, which must cover the dataset
    once."""
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
    dataset.id.chunk_iter(lambda info: places.append((tuple(info.chunk_offset), info.filter_mask, info.size)))
    sides = tuple(zip(dataset.chunks, dataset.shape, strict=True))
    inside = all(
        first % chunk == 0 and 0 <= first < length
        for at, _, _ in places
        for first, (chunk, length) in zip(at, sides, strict=True)
    )
    if (
        not inside
        or len({at for at, _, _ in places}) != needed
        or len(places) != needed
        or any(size > file_bytes for _, _, size in places)
    ):
        raise FileFormatError(
            f"{path}: {name} needs {needed} blocks and lacks some; the file was cut or is damaged."
        )
    return places


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
    words = np.frombuffer(data[:-4] + bytes(len(data) % 2), ">u2").astype(
        np.int64
    )  # an odd last byte is the high half of a word
    low, high = struct.unpack("<HH", data[-4:])
    if (int(words.sum()) - low) % 65535 or (
        int((words * np.arange(len(words), 0, -1) % 65535).sum()) - high
    ) % 65535:
        raise FileFormatError(f"{path}: a block of {name} fails its checksum; the file is damaged.")
    return data[:-4]


def check_blosc(path, dataset, name, places, options):
    """Every block must unpack to its chunk by its own header, and the filter must have been told so."""
    width = dataset.dtype.itemsize
    size = chunk_bytes(dataset)
    if len(options) < 4 or tuple(options[2:4]) != (width, size):
        raise damaged(path, name, "Blosc's parameters")
    for at, mask, stored in places:
        data = dataset.id.read_direct_chunk(at)[1]
        if mask & 1:
            fits = stored == size
        else:
            version, _, _, typesize, unpacked, block, packed = (
                struct.unpack_from("<4B3I", data) if len(data) >= 16 else (0,) * 7
            )
            fits = (version, typesize, unpacked, packed) == (2, width, size, len(data)) and 0 < block <= max(
                size, 1
            )
        if not fits:
            raise damaged(path, name, at)


def damaged(path, name, where):
    return FileFormatError(
        f"{path}: a block of {name} ({where}) does not unpack to what it should; the file is damaged."
    )
