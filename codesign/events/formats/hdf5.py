"""Event streams in HDF5: DSEC's layout (a group ``events`` of t, x, y, p; read and written), v2e's
(a dataset ``events`` of rows t, x, y, p in microseconds) and MVSEC's (``davis/left/events``, rows
x, y, t, p in seconds).

DSEC: t is uint32 microseconds since t_offset (int64), x and y uint16, p uint8 (1 ON, 0 OFF);
ms_to_idx[k] is the first event with t >= 1000 k. What is written carries the sensor size as
attributes height_px and width_px of the group; published files have none.
Sources: Gehrig et al., "DSEC: A Stereo Event Camera Dataset for Driving Scenarios", RA-L 2021; its
  published description of the data format. v2e, class EventEmulator, output ``dvs_h5``
  (Hu et al., CVPRW 2021). Zhu et al., "The Multivehicle Stereo Event Camera Dataset", RA-L 2018.
"""

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats.arrival import (
    DISORDER_US,
    Arrival,
    Asked,
    check_nothing_told,
    columns,
    microseconds,
    settled_order,
    settled_unit,
    signed,
)
from codesign.events.formats.hdf5_rows import REMEDY, Rows, h5py, new_hdf5, own, scalar
from codesign.reading import check_regular, reading

LAST_T = 2**32 - 1
MVSEC = "davis/left"
EVENTS_PER_CHUNK = 2**17
PACKING = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
BLOCK = 2**20  # events that are read at once
FINE = 4096  # events that are read to find one


def check_index(path, t, first, index):
    """Raise FileFormatError unless ms_to_idx parts the times ``t`` of the events from number
    ``first`` on:
    none before an entry at or after its millisecond, none behind it earlier."""
    limit_us = 1000 * np.arange(len(index), dtype=np.int64)
    at = index[1:] - first
    inside, behind = (at >= 0) & (at < len(t)), (at > 0) & (at <= len(t))
    early = t[at[inside]] < limit_us[1:][inside]
    late = t[at[behind] - 1] >= limit_us[1:][behind]
    if bool(early.any() or late.any()):
        raise FileFormatError(
            f"{path}: ms_to_idx does not give the first event of each millisecond; the file is damaged."
        )


def pixels(path, attributes, name):
    """A sensor side from the attributes of the group."""
    value = np.asarray(attributes.get(name))
    if (
        value.dtype.kind not in "iu"
        or value.size != 1
        or not 1 <= int(value.reshape(-1)[0]) <= 2**16
    ):
        raise FileFormatError(
            f"{path}: attribute {name} is {value}; a whole number from 1 to 65536 is needed."
        )
    return int(value.reshape(-1)[0])


class Hdf5Events:
    """The events of a file in any of the layouts, by number or by time.

    Args:
      path: file.
      asked: see Asked.
    size_px: (height, width) where the file tells, else None. rows: of t, x, y, p, or of all four
      together ("rows").
    Raises: FileFormatError for another layout, damage, and data kept in other files.
    """

    def __init__(self, path, asked=None):
        self.path = check_regular(path)
        self.asked = Asked() if asked is None else asked
        self.index = None
        self.offset_us = 0
        with reading(path, REMEDY), h5py.File(path, "r", locking=False) as file:
            names = set(file.keys())
            name = f"{MVSEC}/events" if "davis" in names else "events"
            events = own(path, file, name)
            grouped = isinstance(events, h5py.Group)
            pictures = f"{MVSEC}/image_raw" if "davis" in names else "frame"
            beside = own(path, file, pictures) if not grouped and pictures in file else None
            self.size_px = tuple(beside.shape[1:]) if getattr(beside, "ndim", 0) == 3 else None
            if grouped and {"height_px", "width_px"} & set(events.attrs):
                self.size_px = tuple(
                    pixels(path, events.attrs, name) for name in ("height_px", "width_px")
                )
            self.size_from = "the file" if grouped else "its frames"
        if not grouped:
            self.rows = {"rows": Rows(path, name, [4])}
            first = self.rows["rows"].read(0, min(BLOCK, len(self)))
            self.order = settled_order(
                path, first, self.asked.columns, "xytp" if "davis" in names else "txyp"
            )
            unit = (
                "s" if "davis" in names and self.asked.time_unit == "auto" else self.asked.time_unit
            )
            self.unit = settled_unit(first[:, self.order.index("t")], unit)
            return
        check_nothing_told(path, self.asked, "they are for files of rows")
        self.rows = {"t": Rows(path, "events/t", [])}
        self.rows |= {key: Rows(path, f"events/{key}", [], len(self)) for key in "xyp"}
        if any(rows.dtype.kind not in "iu" for rows in self.rows.values()):
            raise FileFormatError(
                f"{path}: t, x, y, p under events are no whole numbers, as in DSEC's layout."
            )
        self.offset_us = scalar(path, "t_offset") if "t_offset" in names else 0
        if "ms_to_idx" in names:
            index = Rows(path, "ms_to_idx", [])
            self.index = index.read(0, len(index)).astype(np.int64)
            if bool((np.diff(self.index, prepend=0, append=len(self)) < 0).any()):
                raise FileFormatError(
                    f"{path}: ms_to_idx is no index of its {len(self)} events; the file is damaged."
                )

    def __len__(self):
        return len(next(iter(self.rows.values())))

    def packet(self, first, last):
        """t_us, x, y, p of the events first to last - 1."""
        if "rows" in self.rows:
            table = self.rows["rows"].read(first, last)
            t, x, y, p = (table[:, self.order.index(letter)] for letter in "txyp")
            return microseconds(t, self.unit), x, y, p
        t, x, y, p = (self.rows[letter].read(first, last) for letter in "txyp")
        return signed(t) + self.offset_us, x, y, p

    def columns(self):
        """EventColumns of all."""
        arrival = Arrival(self.path, self.asked, self.size_px, self.size_from)
        for first in range(0, len(self), BLOCK):
            packet = self.packet(first, min(first + BLOCK, len(self)))
            arrival.add(*packet)
            if self.index is not None:
                check_index(self.path, packet[0] - self.offset_us, first, self.index)
        return arrival.columns()

    def window(self, t0_us, t1_us, size_px):
        """EventStream of the events from t0_us to t1_us, both included, of a sensor of ``size_px``;
        a few blocks are read, not the file."""
        if self.index is not None:
            edges = (t0_us - self.offset_us) // 1000, (t1_us - self.offset_us) // 1000 + 1
            # an index may end before the events do: behind its last entry lie all that follow
            last = self.index[-1] if len(self.index) else 0
            low, high = (
                int(self.index[k] if k < len(self.index) else beyond)
                for k, beyond in zip((max(k, 0) for k in edges), (last, len(self)), strict=True)
            )
        else:
            low, high = self._place(t0_us - DISORDER_US), self._place(t1_us + DISORDER_US + 1)
        packet = self.packet(low, high)
        inside = np.flatnonzero((packet[0] >= t0_us) & (packet[0] <= t1_us))
        arrival = Arrival(self.path, Asked(*size_px))
        arrival.add(*(values[inside] for values in packet), places=low + inside)
        return arrival.columns().stream()

    def _place(self, t_us):
        """Number of an event not before a time, behind one before it, by bisection."""
        low = 0
        high = len(self)
        while high - low > FINE:
            middle = (low + high) // 2
            before = self.packet(middle, middle + 1)[0][0] < t_us
            low, high = (middle, high) if before else (low, middle)
        return low + int(np.searchsorted(self.packet(low, high)[0], t_us))


def read_hdf5(path, asked):
    """EventColumns of ``path``. Raises: FileFormatError, as Hdf5Events, and what arrival
    refuses."""
    return Hdf5Events(path, asked).columns()


def write_hdf5(path, stream):
    """Write events to ``path`` in DSEC's layout, with checksums; t_offset is the time of the first
    event.

    Raises: FileFormatError for a stream longer than 2^32 us, because t has 32 bits, and for a
      sensor beyond 65536 x 65536.
    """
    t_us, x, y, p = columns(stream, "DSEC's layout", 2**16, -(2**61), 2**61)
    offset_us = int(t_us[0]) if t_us.size else 0
    t = t_us - offset_us
    last_us = int(t[-1]) if t.size else -1000
    if last_us > LAST_T:
        raise FileFormatError(
            f"the stream lasts {last_us} us; DSEC's times have 32 bits (71 minutes); split it or write "
            ".npz instead."
        )
    # the last entry closes the last millisecond
    milliseconds = np.arange(last_us // 1000 + 2, dtype=np.int64)
    arrays = {
        "events/t": t.astype(np.uint32),
        "events/x": x.astype(np.uint16),
        "events/y": y.astype(np.uint16),
        "events/p": (p > 0).astype(np.uint8),
        "t_offset": np.array(offset_us, np.int64),
        "ms_to_idx": np.searchsorted(t, milliseconds * 1000).astype(np.uint64),
    }
    # from 1.10 on, HDF5 keeps checksums of its own structure too
    with new_hdf5(path, libver=("v110", "v110")) as file:
        for name, array in arrays.items():
            packing = (
                PACKING | {"chunks": (min(len(array), EVENTS_PER_CHUNK),)} if array.size > 1 else {}
            )
            file.create_dataset(name, data=array, **packing)
        file["events"].attrs.update(height_px=stream.height_px, width_px=stream.width_px)
