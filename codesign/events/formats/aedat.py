"""AEDAT 4.0: packets of 16-byte events with 64-bit microseconds, and the frames that DAVIS cameras
record beside them. AEDAT 2.0 as jAER reads it for DAVIS cameras, written only.

Layout of 4.0: the line ``#!AER-DAT4.0``, an IOHeader (FlatBuffer: compression, position of the
  table, XML that names the streams), packets of (stream, size) and a compressed FlatBuffer each,
  and a compressed FileDataTable that lists the packets once more. FlatBuffers are read without
  generated code, every offset checked.
Source: iniVation documentation, "AEDAT file formats", AEDAT 4.0; FlatBuffers schemas of
  dv-processing; FlatBuffers documentation, "FlatBuffer Internals".

Layout of 2.0: '#' lines, then big-endian pairs of 32-bit address and 32-bit microseconds. Bits of
  the address: 22 to 30 the row, counted from the bottom; 12 to 21 the column, counted from the
  right; 11 the polarity; 31 (frame sample) and 10 (external) are zero for an event of a pixel.
Source: iniVation documentation, "AEDAT file formats", AEDAT 2.0; jAER, DavisBaseCamera
  (mirrored columns); v2e, aedat2_output.
"""

import re
import struct
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign.checks import check_path
from codesign.errors import FileFormatError
from codesign.events.formats.arrival import arranged, columns
from codesign.optional import optional
from codesign.reading import check_regular, open_regular, reading

lz4_frame = optional("lz4.frame", "event-files", "reading and writing .aedat4")
zstandard = optional("zstandard", "event-files", "reading .aedat4 packed by Zstandard")
MAGIC = b"#!AER-DAT4.0\r\n"
NONE, LZ4, LZ4_HIGH, ZSTD, ZSTD_HIGH = range(5)
STREAM_NUMBER = re.compile(r"[0-9]{1,5}")
SIDE = re.compile(r"[1-9][0-9]{0,4}")
# LZ4 packs at most 255 to 1; what claims to unpack to more than this is refused, not unpacked
LIMIT_RATIO = 1024
LIMIT_EXTRA_BYTES = 4096
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
CHIPS = {(260, 346): "DAVIS346", (180, 240): "DAVIS240C"}
EXTERNAL = 1 << 10
HEADER = (
    "#!AER-DAT2.0\r\n# Data format is int32 address, int32 timestamp (8 bytes total), repeated for each "
    "event\r\n# Timestamps tick is 1 us\r\n# AEChip: {}\r\n#End Of ASCII Header\r\n"
)
# places in the schema
TIMESTAMP = 0
EXPOSURE_START = 3
EXPOSURE_END = 4
FORMAT = 5
WIDTH = 6
HEIGHT = 7
LEFT = 8
TOP = 9
PIXELS = 10
EXPOSURE = 11
GRAY = 0


class Block:
    """Bytes of a file, of which every place that is read is checked."""

    def __init__(self, path, data):
        self.path = path
        self.data = data

    def number(self, at, code):
        """The number at a byte, by its ``struct`` code."""
        if at < 0 or at + struct.calcsize(code) > len(self.data):
            raise self.damaged(f"points to byte {at}, outside itself")
        return struct.unpack_from(code, self.data, at)[0]

    def root(self, identifier):
        """The root table of a buffer that begins with its size; ``identifier`` is the four letters
        of its schema."""
        size = self.number(0, "<I")
        if size + 4 != len(self.data) or self.data[8:12] != identifier:
            raise self.damaged(
                f"says {size} and {self.data[8:12]!r}; {len(self.data) - 4} and {identifier!r} are needed"
            )
        return Table(self, 4 + self.number(4, "<I"))

    def damaged(self, what):
        return damaged(self.path, f"a block of {len(self.data)} bytes {what}")


class Table:
    """One table of a buffer; fields are asked for by their place in the schema (0, 1, …)."""

    def __init__(self, block, at):
        self.block = block
        self.at = at
        self.slots = at - block.number(at, "<i")
        self.slots_bytes = block.number(self.slots, "<H")

    def _field(self, place):
        """Where a field lies, or 0 when it is absent."""
        slot = 4 + 2 * place
        offset = self.block.number(self.slots + slot, "<H") if slot + 2 <= self.slots_bytes else 0
        return self.at + offset if offset else 0

    def scalar(self, place, code, default=0):
        """The number in a field, by its ``struct`` code."""
        at = self._field(place)
        return self.block.number(at, code) if at else default

    def array(self, place, dtype) -> np.ndarray:
        """[N] numpy array of a vector of scalars or structs; empty when the field is absent. It
        shares the buffer's memory."""
        at = self._field(place)
        dtype = np.dtype(dtype)
        if not at:
            return np.empty(0, dtype)
        at += self.block.number(at, "<I")
        count = self.block.number(at, "<I")
        if at + 4 + count * dtype.itemsize > len(self.block.data):
            raise self.block.damaged(f"points to {count} entries outside itself")
        return np.frombuffer(self.block.data, dtype, count, at + 4)

    def tables(self, place):
        """The tables of a vector of tables."""
        at = self._field(place)
        first = at + self.block.number(at, "<I") + 4 if at else 0
        starts = self.array(place, "<u4").tolist()
        return [Table(self.block, first + 4 * k + start) for k, start in enumerate(starts)]


def damaged(path, what):
    """The error for what cannot be."""
    return FileFormatError(f"{path}: {what}; the file was cut or is damaged.")


def read_container(path, kind):
    """(root tables of the packets of the one stream of a kind, its sensor size
    (height_px, width_px) or None).

    Args:
      path: file.
      kind: four letters, "EVTS" (events) or "FRME" (frames).
    Raises: FileFormatError for another kind of file, damage, a file cut short, or not exactly one
      stream of the kind.
    """
    with open_regular(path) as file:
        data = file.read()
    if not data.startswith(MAGIC):
        raise FileFormatError(f"{path} does not start with {MAGIC!r}; it is not an AEDAT 4.0 file.")
    whole = Block(path, data)
    start = len(MAGIC) + 4 + whole.number(len(MAGIC), "<I")
    header = Block(path, data[len(MAGIC) : start]).root(b"IOHE")
    compression = header.scalar(0, "<i")
    if compression not in range(5):
        raise FileFormatError(
            f"{path}: compression {compression} is unknown; 0 (none), 1 and 2 (LZ4), 3 and 4 (ZSTD) are read."
        )
    table_at = header.scalar(1, "<q", -1)
    if table_at != -1 and not start <= table_at <= len(data):
        raise damaged(
            path, f"the table of packets is said to lie at byte {table_at} of {len(data)}"
        )
    wanted, size = _stream(path, header.array(2, "u1").tobytes(), kind)
    places = _places(path, data, start, len(data) if table_at == -1 else table_at)
    if table_at != -1:
        table = Block(path, unpacked(path, data[table_at:], compression)).root(b"FTAB").tables(0)
        listed = [(entry.scalar(0, "<q"), entry.scalar(1, "<q")) for entry in table]
        # a packet is told by its stream and size, the eight bytes ahead of it
        if listed != [(at, whole.number(at - 8, "<q")) for _, at, _ in places]:
            raise damaged(path, "the table at the end lists other packets than the file holds")
    mine = [data[at : at + count] for stream, at, count in places if stream == wanted]
    name = kind.encode("ascii")
    return [Block(path, unpacked(path, body, compression)).root(name) for body in mine], size


def unpacked(path, data, compression):
    """Decompress one block, never into more than LIMIT_RATIO times its size."""
    limit = LIMIT_RATIO * len(data) + LIMIT_EXTRA_BYTES
    if compression == NONE:
        return data
    block = f"a block of {len(data)} bytes"
    with reading(f"{path}: {block}", "the file is damaged"):
        if compression in (LZ4, LZ4_HIGH):
            unpacker = lz4_frame.LZ4FrameDecompressor()
            body = unpacker.decompress(data, max_length=limit)
        else:
            unpacker = zstandard.ZstdDecompressor(max_window_size=2**27).decompressobj()
            if zstandard.frame_content_size(data) > limit:
                raise damaged(path, f"{block} claims to hold more than {limit} bytes")
            body = unpacker.decompress(data)
    if not unpacker.eof or unpacker.unused_data:
        raise damaged(
            path, f"{block} ends early, goes on too long, or holds more than {limit} bytes"
        )
    return body


def _places(path, data, at, stop):
    """[(stream, first byte, bytes)] of the packets between two places of the file."""
    places = []
    while at < stop:
        stream, count = struct.unpack_from("<ii", data, at) if at + 8 <= stop else (0, -1)
        if count < 0 or at + 8 + count > stop:
            raise damaged(
                path, f"the packet at byte {at} claims {count} bytes, {stop - at - 8} are left"
            )
        places.append((stream, at + 8, count))
        at += 8 + count
    return places


def _stream(path, text, kind):
    """(number, (height_px, width_px) or None) of the only stream of a kind in the XML of the
    header."""
    with reading(f"{path}: the header's XML", "the file is damaged"):
        # decoded here, so that another encoding cannot hide a declaration
        plain = text.decode("utf-8")
        if "<!" in plain.replace("<!--", ""):
            raise FileFormatError(
                f"{path}: the header's XML declares a document type or entities; none is allowed."
            )
        found = ElementTree.fromstring(plain)
        streams = [
            node
            for node in found.findall("./node[@name='outInfo']/node")
            if _attribute(node, "typeIdentifier") == kind
        ]
    if len(streams) != 1:
        raise FileFormatError(
            f"{path} holds {len(streams)} streams of kind {kind}; one is needed, export a single one."
        )
    sizes = [
        _attribute(node, name)
        for node in streams[0].findall("./node[@name='info']")
        for name in ("sizeY", "sizeX")
    ]
    number = streams[0].get("name", "")
    sides = [size for size in sizes if size is not None]
    whole = STREAM_NUMBER.fullmatch(number) and all(SIDE.fullmatch(side) for side in sides)
    if not whole or len(sides) not in (0, 2):
        what = f"stream number and sensor size are given as {number!r} and {sides}"
        raise damaged(path, f"{what}; whole numbers are needed")
    return int(number), (tuple(int(side) for side in sides) or None)


def _attribute(node, key):
    found = node.find(f"./attr[@key='{key}']")
    return None if found is None else (found.text or "")


def read_aedat4(path, asked):
    """EventColumns of ``path``; the sensor size is the header's. Frames, inertial data and triggers
    are other streams (frames: see ``read_frames``).

    Raises: FileFormatError for damage, for a file cut short, without a single stream of events, or
      whose times go back (see arrival).
    """
    packets, size = read_container(path, "EVTS")
    parts = [packet.array(0, EVENT) for packet in packets]
    events = np.concatenate(parts) if parts else np.empty(0, EVENT)
    return arranged(path, asked, *(events[name] for name in ("t", "x", "y", "on")), size=size)


def write_aedat4(path, stream):
    """Write events to ``path``, LZ4-compressed with a checksum per packet, and the table of
    packets.

    Raises: FileFormatError for a sensor beyond 32768 x 32768.
    """
    t_us, x, y, p = columns(stream, "AEDAT 4.0", SIDE_PX, -(2**63), 2**63 - 1)
    events = np.zeros(len(t_us), EVENT)
    events["t"], events["x"], events["y"], events["on"] = t_us, x, y, p > 0
    info = INFO.format(height_px=stream.height_px, width_px=stream.width_px).encode("ascii")
    with open(path, "wb") as file:
        file.write(MAGIC + _header(info, 0))
        parts = [
            events[first : first + EVENTS_PER_PACKET]
            for first in range(0, len(events), EVENTS_PER_PACKET)
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
    """FlatBuffer: size, root at 20, EVTS, slots of one field at 14, table at 20 whose field points
    to the vector at 28; events lie at 32, on 8 bytes."""
    body = events.tobytes()
    return (
        struct.pack("<II4s2xHHHiII", 28 + len(body), 16, b"EVTS", 6, 8, 4, 6, 4, len(events)) + body
    )


def _header(info, table_at):
    """FlatBuffer: size, root at 28, IOHE, slots of three fields at 18, table (compression, text,
    position of the table), text with its closing zero."""
    text = info + bytes(4 - len(info) % 4)
    fields = struct.pack(
        "<II4s6xHHHHHiiIqI",
        48 + len(text),
        24,
        b"IOHE",
        10,
        20,
        4,
        12,
        8,
        10,
        LZ4,
        12,
        table_at,
        len(info),
    )
    return fields + text


def _table(entries):
    """FlatBuffer: size, root at 32, FTAB, slots of the root at 12, slots shared by all entries at
    18, root table, offsets of the entries, entries."""
    first = 44 + 4 * len(entries)
    # entries begin four bytes before a multiple of eight, where their 64-bit numbers begin
    first += (4 - first) % 8
    at = first + TABLE_ENTRY.itemsize * np.arange(len(entries))
    entries["slots"] = at - 18
    offsets = (at - (44 + 4 * np.arange(len(entries)))).astype("<u4").tobytes()
    size = first + entries.nbytes
    head = struct.pack(
        "<II4sHHHHHHHHHHiII",
        size - 4,
        28,
        b"FTAB",
        6,
        8,
        4,
        14,
        44,
        4,
        36,
        12,
        20,
        28,
        20,
        4,
        len(entries),
    )
    return head + offsets + bytes(first - len(head) - len(offsets)) + entries.tobytes()


@dataclass(frozen=True)
class RecordedFrames:
    """Grey frames of a camera, on the clock of its events.

    frames: [T, H, W] uint8. exposure_start_us, exposure_end_us: [T] int64 microseconds.
    """

    frames: Tensor
    exposure_start_us: Tensor
    exposure_end_us: Tensor


def read_frames(path: str | Path) -> RecordedFrames:
    """Read the frames of an AEDAT 4.0 file.

    Args:
      path: file ending in .aedat4.
    Returns: RecordedFrames.
    Raises: FileFormatError when the file is missing, damaged, cut short, without a single stream of
      frames, or has frames in colour or of several sizes.
    """
    path = check_regular(check_path(path))
    packets, size = read_container(path, "FRME")
    if not packets:
        raise FileFormatError(f"{path} holds no frame.")
    frames = []
    times_us = []
    for nth, table in enumerate(packets):
        sides = table.scalar(HEIGHT, "<h"), table.scalar(WIDTH, "<h")
        pixels = table.array(PIXELS, "u1")
        shown = f"{sides[1]} x {sides[0]} pixels"
        if (kind := table.scalar(FORMAT, "<b")) != GRAY:
            raise FileFormatError(
                f"{path}: frame {nth} has pixel format {kind}; 0 (8-bit grey) is read."
            )
        if min(sides) < 1 or pixels.size != sides[0] * sides[1]:
            raise damaged(path, f"frame {nth} has {pixels.size} values for {shown}")
        if sides != (size or sides) or table.scalar(LEFT, "<h") or table.scalar(TOP, "<h"):
            raise FileFormatError(
                f"{path}: frame {nth} shows {shown}, a part of the sensor; whole frames are read."
            )
        size = sides
        frames.append(pixels.reshape(size))
        times_us.append(_exposure_us(table))
        if times_us[-1][1] < times_us[-1][0]:
            raise damaged(path, f"frame {nth} ends its exposure before it starts")
    start_us, end_us = torch.tensor(times_us, dtype=torch.int64).unbind(1)
    return RecordedFrames(torch.from_numpy(np.stack(frames)), start_us, end_us)


def _exposure_us(table):
    """Start and end of exposure; recorders since dv-processing 1.2 give the start as the time of
    the frame, and a duration."""
    start_us = table.scalar(EXPOSURE_START, "<q")
    end_us = table.scalar(EXPOSURE_END, "<q")
    if start_us or end_us:
        return start_us, end_us
    return table.scalar(TIMESTAMP, "<q"), table.scalar(TIMESTAMP, "<q") + table.scalar(
        EXPOSURE, "<q"
    )


def write_aedat2(path, stream):
    """Write events to ``path``.

    Where the first event would begin with the byte of '#', which readers take for one more header
    line, an external record at the same time (bit 10 set; no event of a pixel) goes ahead of it.
    Raises: FileFormatError for other sensors than 346 x 260 and 240 x 180, and for times outside 0
      to 2^31 - 1 us.
    """
    chip = CHIPS.get((stream.height_px, stream.width_px))
    if chip is None:
        sizes = " and ".join(f"{width} x {height}" for height, width in CHIPS)
        raise FileFormatError(
            f"AEDAT 2.0 is written for DAVIS sensors of {sizes} pixels, not {stream.width_px} x "
            f"{stream.height_px}."
        )
    height_px = stream.height_px
    width_px = stream.width_px
    t_us, x, y, p = columns(stream, "AEDAT 2.0", 2**15, 0, 2**31 - 1)
    records = np.stack(
        (
            (height_px - 1 - y) << 22 | (width_px - 1 - x) << 12 | (p > 0).astype(np.int64) << 11,
            t_us,
        ),
        axis=1,
    )
    if len(records) and records[0, 0] >> 24 == ord("#"):
        records = np.concatenate(([[EXTERNAL, t_us[0]]], records))
    path.write_bytes(HEADER.format(chip).encode("ascii") + records.astype(">i4").tobytes())


def read_aedat2(path, _):
    """Refuse: addresses depend on the camera, and the header does not reliably name it."""
    raise FileFormatError(
        f"{path}: AEDAT 2.0 is written, not read; convert the recording to .aedat4 or .raw."
    )
