"""Arrays of numbers of a MATLAB file (.mat, versions 5 to 7); text, cells, structures and the rest
are passed over.

Source: MathWorks, "MAT-File Format" (level 5).
"""

import math
import struct
import zlib
from pathlib import Path

import numpy as np

from codesign.arrays import DEFLATE_RATIO
from codesign.errors import FileFormatError
from codesign.reading import check_room, read_bytes, reading

MOST_BYTES = 2**32
HEADER_BYTES = 128
STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
MATRIX, PACKED = 14, 15
NUMBERS = {
    6: "f8",
    7: "f4",
    8: "i1",
    9: "u1",
    10: "i2",
    11: "u2",
    12: "i4",
    13: "u4",
    14: "i8",
    15: "u8",
}
COMPLEX = 0x800


def read_mat(path: str | Path) -> dict[str, np.ndarray]:
    """{name: array} of the real arrays of a file. Raises: FileFormatError."""
    data = read_bytes(path, MOST_BYTES)
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None or data[124:126][:: 1 if order == ">" else -1] != b"\x01\x00":
        raise FileFormatError(f"{path} is no MATLAB file of version 5 to 7; save it with -v7.")
    with reading(path, "the file is damaged"):
        found = (_matrix(path, body, order) for body in _matrices(path, data, order))
        return {name: values for name, values in found if values is not None and name}


def _matrices(path, data, order):
    for kind, body in _elements(data[HEADER_BYTES:], order, 1):
        if kind == PACKED:
            limit = DEFLATE_RATIO * len(body) + 4096
            unpacker = zlib.decompressobj()
            plain = unpacker.decompress(body, limit)
            if not unpacker.eof:
                raise FileFormatError(
                    f"{path} is cut, or unpacks to more than {limit} bytes; it is damaged."
                )
            kind, body = next(_elements(plain, order, 8))
        if kind == MATRIX:
            yield body


def _elements(data, order, align):
    """(kind, bytes, bytes) of the elements that follow one another."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        start = at + 8
        if kind >> 16:  # up to four bytes stand beside their kind
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        if size > (4 if start == at + 4 else len(data) - start):
            raise ValueError(f"an element of {size} bytes")
        yield kind, data[start : start + size]
        at = at + 8 if start == at + 4 else start + -(-size // align) * align


def _matrix(path, body, order):
    (_, flags), (_, sides), (_, name), *values = _elements(body, order, 8)
    told = struct.unpack_from(order + "I", flags)[0]
    shape = np.frombuffer(sides, order + "i4").tolist()
    if told & 0xFF not in NUMBERS or told & COMPLEX or not values:
        return "", None
    wanted = np.dtype(NUMBERS[told & 0xFF])
    check_room(path, tuple(shape), wanted.itemsize)
    stored = np.frombuffer(values[0][1], np.dtype(STORED[values[0][0]]).newbyteorder(order))
    if len(stored) != math.prod(shape):
        raise ValueError(f"{len(stored)} values for {shape}")
    return name.decode("ascii"), stored.astype(wanted).reshape(shape, order="F")
