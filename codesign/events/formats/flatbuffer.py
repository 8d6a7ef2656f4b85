"""Reading FlatBuffers without generated code, every offset checked against the buffer.

Source: FlatBuffers documentation, "FlatBuffer Internals".
"""

import struct

import numpy as np

from codesign.errors import FileFormatError


class Table:
    """One table of a buffer; fields are asked for by their place in the schema (0, 1, …)."""

    def __init__(self, path, data, at):
        self.path = path
        self.data = data
        self.at = at
        self.slots = at - number(path, data, at, "<i")
        self.slots_bytes = number(path, data, self.slots, "<H")

    def _field(self, place):
        """Where a field lies, or 0 when it is absent."""
        slot = 4 + 2 * place
        offset = number(self.path, self.data, self.slots + slot, "<H") if slot + 2 <= self.slots_bytes else 0
        return self.at + offset if offset else 0

    def scalar(self, place, code, default=0):
        """The number in a field, by its ``struct`` code."""
        at = self._field(place)
        return number(self.path, self.data, at, code) if at else default

    def pair(self, place):
        """Two int32 of a struct in a field."""
        at = self._field(place)
        return (
            (number(self.path, self.data, at, "<i"), number(self.path, self.data, at + 4, "<i"))
            if at
            else (0, 0)
        )

    def array(self, place, dtype) -> np.ndarray:
        """[N] numpy array of a vector of scalars or structs; empty when the field is absent. It shares the
        buffer's memory."""
        at = self._field(place)
        if not at:
            return np.empty(0, dtype)
        at += number(self.path, self.data, at, "<I")
        count = number(self.path, self.data, at, "<I")
        dtype = np.dtype(dtype)
        if at + 4 + count * dtype.itemsize > len(self.data):
            raise damaged(
                self.path, f"a list of {count} entries of {dtype.itemsize} bytes at byte {at}", len(self.data)
            )
        return np.frombuffer(self.data, dtype, count, at + 4)

    def tables(self, place, count):
        """The tables of a vector of tables, of which there must be ``count``."""
        at = self._field(place)
        starts = self.array(place, "<u4")
        if len(starts) != count:
            raise FileFormatError(
                f"{self.path}: a list has {len(starts)} entries where {count} are needed; the file is "
                "damaged."
            )
        first = at + number(self.path, self.data, at, "<I") + 4 if at else 0
        return [Table(self.path, self.data, first + 4 * k + int(start)) for k, start in enumerate(starts)]


def root(path, data, identifier):
    """The root table of a buffer that begins with its size; ``identifier`` is the four letters of its
    schema."""
    size = number(path, data, 0, "<I")
    if size + 4 != len(data) or data[8:12] != identifier:
        raise FileFormatError(
            f"{path}: a block of {len(data)} bytes says {size} and {data[8:12]!r}; {len(data) - 4} and "
            f"{identifier!r} are needed; the file is damaged."
        )
    return Table(path, data, 4 + number(path, data, 4, "<I"))


def number(path, data, at, code):
    """The number at a byte, by its ``struct`` code."""
    if at < 0 or at + struct.calcsize(code) > len(data):
        raise damaged(path, f"a number at byte {at}", len(data))
    return struct.unpack_from(code, data, at)[0]


def damaged(path, what, size):
    """The error for anything that lies outside its block."""
    return FileFormatError(
        f"{path}: a block of {size} bytes points to {what}, outside itself; the file is damaged."
    )
