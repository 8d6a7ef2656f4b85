"""Event streams that tests make and compare, and files of them put together by the published
layouts."""

import io
import struct
from dataclasses import replace

import numpy as np
import torch

from codesign.events.stream import ordered

FIELDS = ("t_us", "x", "y", "p")
DAT = b"% Data file containing CD events\n% Version 2\n% Width 640\n% Height 480\n\x0c\x08"


def rows(stream):
    """Events as tuples, in order."""
    return [
        tuple(row) for row in torch.stack([getattr(stream, name) for name in FIELDS], 1).tolist()
    ]


def same(first, second):
    """Whether two streams hold the same events."""
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in FIELDS)


def stream_of(*events, height_px=480, width_px=640):
    """Stream of (t_us, x, y, p)."""
    return ordered(*torch.tensor(events).unbind(1), height_px, width_px)


def part(stream, which):
    """Some of the events of a stream."""
    return replace(stream, **{name: getattr(stream, name)[which] for name in FIELDS})


def random_stream(count, height_px, width_px, last_us, first_us=0, seed=0):
    """Events anywhere, with many equal times, from first_us to first_us + last_us."""
    generator = torch.Generator().manual_seed(seed)
    sizes = (last_us + 1, width_px, height_px, 2)
    t_us, x, y, p = (torch.randint(0, size, (count,), generator=generator) for size in sizes)
    return ordered(first_us + t_us, x, y, 2 * p - 1, height_px, width_px)


def evt3(*words, geometry=True):
    """A RAW file of words (type, 12 bits)."""
    size = b"% format EVT3;height=720;width=1280\n% geometry 1280x720\n" * geometry
    body = np.array([kind << 12 | load for kind, load in words], "<u2").tobytes()
    return b"% evt 3.0\n" + size + b"% end\n" + body


def evt2_event(t_us, x, y, p):
    return p << 28 | (t_us & 63) << 22 | x << 11 | y


def evt2(*words):
    return b"% evt 2.0\n% geometry 640x480\n% end\n" + np.array(words, "<u4").tobytes()


def dat(*events):
    """A DAT file of (t_us, x, y, 1 or 0)."""
    return (
        DAT + np.array([(t_us, p << 28 | y << 14 | x) for t_us, x, y, p in events], "<u4").tobytes()
    )


def packed_aedat4(data, code, packet):
    """An AEDAT 4.0 file of one packet of this compression, whose recording was interrupted: it has
    no table."""
    start = 18 + struct.unpack_from("<I", data, 14)[0]
    changed = bytearray(data[:start] + struct.pack("<ii", 0, len(packet)) + packet)
    struct.pack_into("<i", changed, 14 + 32, code)
    struct.pack_into("<q", changed, 14 + 40, -1)
    return bytes(changed)


def in_hdf5(datasets, fill=None, userblock=0, **packing):
    """Bytes of an HDF5 file of datasets, None: left out; fill: what else is done to it; userblock:
    bytes of another program's at its start."""
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w", userblock_size=userblock) as file:
        for name, values in datasets.items():
            if values is not None:
                file.create_dataset(name, data=values, **(packing if np.ndim(values) else {}))
        if fill is not None:
            fill(file)
    return buffer.getvalue()
