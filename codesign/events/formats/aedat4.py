"""Events in AEDAT 4.0 files: packets of 16-byte events with 64-bit microseconds.

Source: iniVation documentation, "AEDAT file formats", AEDAT 4.0 (the container is in aedat4_container).
"""

import struct

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.formats import flatbuffer
from codesign.events.formats.aedat4_container import LZ4, MAGIC, lz4_frame, read_container
from codesign.events.formats.arrival import arranged, columns

EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "on"],
        "formats": ["<i8", "<i2", "<i2", "u1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
EVENTS_PER_PACKET = 8192
SIDE_PX = 2**15
TABLE_ENTRY = np.dtype(
    [
        ("slots", "<i4"),
        ("at", "<i8"),
        ("elements", "<i8"),
        ("first_us", "<i8"),
        ("last_us", "<i8"),
        ("stream", "<i4"),
        ("size", "<i4"),
        ("pad", "<u4"),
    ]
)
INFO = """<dv version="2.0">
    <node name="outInfo" path="/mainloop/Recorder/outInfo/">
        <node name="0" path="/mainloop/Recorder/outInfo/0/">
            <attr key="compression" type="string">LZ4</attr>
            <attr key="originalModuleName" type="string">codesign</attr>
            <attr key="originalOutputName" type="string">events</attr>
            <attr key="typeDescription" type="string">Array of events (polarity ON/OFF).</attr>
            <attr key="typeIdentifier" type="string">EVTS</attr>
            <node name="info" path="/mainloop/Recorder/outInfo/0/info/">
                <attr key="sizeX" type="int">{width_px}</attr>
                <attr key="sizeY" type="int">{height_px}</attr>
                <attr key="source" type="string">codesign</attr>
                <attr key="tsOffset" type="long">0</attr>
            </node>
        </node>
    </node>
</dv>
"""


def read_aedat4(path, asked):
    """EventColumns of ``path``; the sensor size is the header's. Frames, inertial data and triggers are
    other streams (frames: see aedat4_frames).

    Raises: FileFormatError for damage, for a file cut short, without a single stream of events, or whose
      times go back (see arrival).
    """
    packets, size, rows = read_container(path, "EVTS")
    parts = [flatbuffer.root(path, packet.body, b"EVTS").array(0, EVENT) for packet in packets]
    for part, row in zip(parts, rows or (), strict=rows is not None):
        if len(part) != row[3] or (len(part) and (part["t"][0], part["t"][-1]) != row[4:]):
            raise FileFormatError(
                f"{path}: a packet of {len(part)} events is listed with {row[3]} from {row[4]} to {row[5]} "
                "us, which it does not hold; the file is damaged."
            )
    events = np.concatenate(parts) if parts else np.empty(0, EVENT)
    return arranged(path, asked, *(events[name] for name in ("t", "x", "y", "on")), size=size)


def write_aedat4(path, stream):
    """Write events to ``path``, LZ4-compressed with a checksum per packet, and the table of packets.

    Raises: FileFormatError for a sensor beyond 32768 x 32768.
    """
    t_us, x, y, p = columns(
        stream,
        height_limit_px=SIDE_PX,
        width_limit_px=SIDE_PX,
        first_us=-(2**63),
        last_us=2**63 - 1,
        name="AEDAT 4.0",
    )
    events = np.zeros(len(t_us), EVENT)
    events["t"], events["x"], events["y"], events["on"] = t_us, x, y, p > 0
    info = INFO.format(height_px=stream.height_px, width_px=stream.width_px).encode("ascii")
    with open(path, "wb") as file:
        file.write(MAGIC + _header(info, 0))
        parts = [
            events[first : first + EVENTS_PER_PACKET] for first in range(0, len(events), EVENTS_PER_PACKET)
        ]
        table = np.zeros(len(parts), TABLE_ENTRY)
        for entry, part in zip(table, parts, strict=True):
            body = _packed(_packet(part))
            file.write(struct.pack("<ii", 0, len(body)))
            entry["at"], entry["size"], entry["elements"] = file.tell(), len(body), len(part)
            entry["first_us"], entry["last_us"] = part["t"][0], part["t"][-1]
            file.write(body)
        table_at = file.tell()
        file.write(_packed(_table(table)))
        file.seek(0)
        file.write(MAGIC + _header(info, table_at))


def _packed(body):
    return lz4_frame.compress(body, content_checksum=True)


def _packet(events):
    """FlatBuffer: size, root at 20, EVTS, slots of one field at 14, table at 20 whose field points to the
    vector at 28; events lie at 32, on 8 bytes."""
    body = events.tobytes()
    return struct.pack("<II4s2xHHHiII", 28 + len(body), 16, b"EVTS", 6, 8, 4, 6, 4, len(events)) + body


def _header(info, table_at):
    """FlatBuffer: size, root at 28, IOHE, slots of three fields at 18, table (compression, text, position of
    the table), text with its closing zero."""
    text = info + bytes(4 - len(info) % 4)
    fields = struct.pack(
        "<II4s6xHHHHHiiIqI", 48 + len(text), 24, b"IOHE", 10, 20, 4, 12, 8, 10, LZ4, 12, table_at, len(info)
    )
    return fields + text


def _table(entries):
    """FlatBuffer: size, root at 32, FTAB, slots of the root at 12, slots shared by all entries at 18, root
    table, offsets of the entries, entries."""
    first = 44 + 4 * len(entries)
    first += (
        4 - first
    ) % 8  # entries begin four bytes before a multiple of eight, where their 64-bit numbers begin
    at = first + TABLE_ENTRY.itemsize * np.arange(len(entries))
    entries["slots"] = at - 18
    offsets = (at - (44 + 4 * np.arange(len(entries)))).astype("<u4").tobytes()
    size = first + entries.nbytes
    head = struct.pack(
        "<II4sHHHHHHHHHHiII", size - 4, 28, b"FTAB", 6, 8, 4, 14, 44, 4, 36, 12, 20, 28, 20, 4, len(entries)
    )
    return head + offsets + bytes(first - len(head) - len(offsets)) + entries.tobytes()
