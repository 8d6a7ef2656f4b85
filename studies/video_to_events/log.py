"""A file that events are appended to while they are made, and read from in pieces: memory stays flat however
many there are."""

import os
from bisect import bisect_right

import numpy as np
import torch

from codesign.errors import CodesignError, FileFormatError
from codesign.types import EventStream

RECORD = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])  # 13 bytes


class EventLog:
    """Events in order of time.

    path: the file. count: events in it that count; later ones, written before a run was killed, are cut off.
      height_px, width_px: sensor size.
    Raises: FileFormatError when the file holds fewer than ``count``.
    """

    def __init__(self, path, count, height_px, width_px):
        self.path = path
        self.count = count
        self.height_px = height_px
        self.width_px = width_px
        held = path.stat().st_size if path.exists() else 0
        if held < count * RECORD.itemsize:
            raise FileFormatError(
                f"'{path}' holds {held // RECORD.itemsize} of the {count} events made so far; it was "
                "damaged: start a new run."
            )
        with path.open("ab") as file:
            file.truncate(count * RECORD.itemsize)

    def append(self, stream):
        """Add the events of the next chunk."""
        records = np.empty(len(stream), RECORD)
        for name, values in (("t", stream.t_us), ("x", stream.x), ("y", stream.y), ("p", stream.p)):
            records[name] = values.cpu().numpy()
        try:
            with self.path.open("ab") as file:  # closed before the number of events is stored elsewhere
                file.write(records.tobytes())
        except OSError as error:
            raise CodesignError(
                f"cannot write to '{self.path}' ({error.strerror}); free space there, or choose another "
                "folder with --out."
            ) from error
        self.count += len(stream)

    def read(self, first, last):
        """EventStream of the events ``first`` to ``last`` - 1."""
        return self._stream(
            np.fromfile(self.path, RECORD, max(last - first, 0), offset=first * RECORD.itemsize)
        )

    def pick(self, indices):
        """EventStream of single events, by increasing index (a tensor)."""
        with self.path.open("rb") as file:
            return self._stream(
                np.frombuffer(b"".join(_record(file, index) for index in indices.tolist()), RECORD)
            )

    def positions(self, times_us):
        """For each time, the number of events at or before it."""
        with self.path.open(
            "rb"
        ) as file:  # single reads and no memory map, whose pages would count as memory of the process

            def time_at(index):
                return int(np.frombuffer(_record(file, index), RECORD)["t"][0])

            return [bisect_right(range(self.count), time_us, key=time_at) for time_us in times_us]

    def _stream(self, records):
        t_us, x, y, p = (torch.from_numpy(records[name].astype(np.int64)) for name in "txyp")
        return EventStream(t_us, x, y, p, self.height_px, self.width_px)


def _record(file, index):
    return os.pread(file.fileno(), RECORD.itemsize, index * RECORD.itemsize)
