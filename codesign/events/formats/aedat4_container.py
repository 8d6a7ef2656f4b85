"""The container of AEDAT 4.0: header, streams, packets, and the table of packets at the end.

Layout: the line ``#!AER-DAT4.0``, an IOHeader (FlatBuffer: compression, position of the table, XML that names
  the streams), packets of (stream, size) and a compressed FlatBuffer each, and a compressed FileDataTable
  that lists the packets once more.
Source: iniVation documentation, "AEDAT file formats", AEDAT 4.0; FlatBuffers schemas of dv-processing.
"""

import re
import struct
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

from codesign.errors import FileFormatError
from codesign.events.formats import flatbuffer
from codesign.optional import optional
from codesign.reading import open_regular, reading

lz4_frame = optional("lz4.frame", "event-files", "reading and writing .aedat4")
zstandard = optional("zstandard", "event-files", "reading .aedat4 packed by Zstandard")

MAGIC = b"#!AER-DAT4.0\r\n"
NONE, LZ4, LZ4_HIGH, ZSTD, ZSTD_HIGH = range(5)
STREAM_NUMBER = re.compile(r"[0-9]{1,5}")
SIDE = re.compile(r"[1-9][0-9]{0,4}")
# LZ4 packs at most 255 to 1; what claims to unpack to more than this is refused, not unpacked
LIMIT_RATIO = 1024
LIMIT_EXTRA_BYTES = 4096


@dataclass(frozen=True)
class Packet:
    """One packet: stream number, where its bytes begin in the file, how many they are, and its unpacked
    FlatBuffer."""

    stream: int
    at: int
    size: int
    body: bytes


def read_container(path, kind):
    """(packets of the one stream of a kind, its sensor size (height_px, width_px) or None, rows of the table
    or None).

    Args: path: file. kind: four letters, "EVTS" (events) or "FRME" (frames).
    Raises: FileFormatError for another kind of file, damage, a file cut short, or not exactly one stream of
      the kind.
    """
    with open_regular(path) as file:
        data = file.read()
    if not data.startswith(MAGIC):
        raise FileFormatError(f"{path} does not start with {MAGIC!r}; it is not an AEDAT 4.0 file.")
    start = len(MAGIC) + 4 + flatbuffer.number(path, data, len(MAGIC), "<I")
    header = flatbuffer.root(path, data[len(MAGIC) : start], b"IOHE")
    compression = header.scalar(0, "<i")
    if compression not in range(5):
        raise FileFormatError(
            f"{path}: compression {compression} is unknown; 0 (none), 1 and 2 (LZ4), 3 and 4 (ZSTD) are read."
        )
    table_at = header.scalar(1, "<q", -1)
    if table_at != -1 and not start <= table_at <= len(data):
        raise FileFormatError(
            f"{path}: the table of packets is said to lie at byte {table_at} of {len(data)}; the file was "
            "cut or is damaged."
        )
    wanted, size = _stream(path, header.array(2, "u1").tobytes(), kind)
    places = _places(path, data, start, len(data) if table_at == -1 else table_at)
    packets = [
        Packet(stream, at, count, unpacked(path, data[at : at + count], compression))
        for stream, at, count in places
        if stream == wanted
    ]
    rows = None
    if table_at != -1:
        rows = _table(path, unpacked(path, data[table_at:], compression), len(places))
        if [row[:3] for row in rows] != places:
            raise FileFormatError(
                f"{path}: the table at the end lists other packets than the file holds; the file is damaged."
            )
        rows = [row for row in rows if row[0] == wanted]
    return packets, size, rows


def unpacked(path, data, compression):
    """Decompress one block, never into more than LIMIT_RATIO times its size."""
    limit = LIMIT_RATIO * len(data) + LIMIT_EXTRA_BYTES
    if compression == NONE:
        return data
    with reading(f"{path}: a block of {len(data)} bytes", "the file is damaged"):
        if compression in (LZ4, LZ4_HIGH):
            unpacker = lz4_frame.LZ4FrameDecompressor()
            body = unpacker.decompress(data, max_length=limit)
        else:
            unpacker = zstandard.ZstdDecompressor(max_window_size=2**27).decompressobj()
            if zstandard.frame_content_size(data) > limit:
                raise FileFormatError(
                    f"{path}: a block of {len(data)} bytes claims to hold more than {limit} bytes; the file is damaged."
                )
            body = unpacker.decompress(data)
    if not unpacker.eof or unpacker.unused_data:
        raise FileFormatError(
            f"{path}: a block of {len(data)} bytes ends early, goes on too long, or holds more than {limit} "
            "bytes; the file is damaged."
        )
    return body


def _places(path, data, at, stop):
    """[(stream, first byte, bytes)] of the packets between two places of the file."""
    places = []
    while at < stop:
        if at + 8 > stop:
            raise FileFormatError(
                f"{path} ends amid a packet's header, at byte {at}; it was cut, copy it again."
            )
        stream, count = struct.unpack_from("<ii", data, at)
        if count < 0 or at + 8 + count > stop:
            raise FileFormatError(
                f"{path}: the packet at byte {at} claims {count} bytes, {stop - at - 8} are left; the file "
                "was cut or is damaged."
            )
        places.append((stream, at + 8, count))
        at += 8 + count
    return places


def _table(path, body, count):
    """[(stream, first byte, bytes, elements, first time, last time)] of the table at the end."""
    rows = []
    for entry in flatbuffer.root(path, body, b"FTAB").tables(0, count):
        stream, count = entry.pair(1)
        rows.append(
            (
                stream,
                entry.scalar(0, "<q"),
                count,
                entry.scalar(2, "<q"),
                entry.scalar(3, "<q"),
                entry.scalar(4, "<q"),
            )
        )
    return rows


def _stream(path, text, kind):
    """(number, (height_px, width_px) or None) of the only stream of a kind in the XML of the header."""
    with reading(f"{path}: the header's XML", "the file is damaged"):
        plain = text.decode("utf-8")  # decoded here, so that another encoding cannot hide a declaration
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
    if (
        not STREAM_NUMBER.fullmatch(number)
        or not all(SIDE.fullmatch(side) for side in sides)
        or len(sides) not in (0, 2)
    ):
        raise FileFormatError(
            f"{path}: stream number and sensor size are given as {number!r} and {sides}; whole numbers are "
            "needed, the file is damaged."
        )
    return int(number), (tuple(int(side) for side in sides) or None)


def _attribute(node, key):
    found = node.find(f"./attr[@key='{key}']")
    return None if found is None else (found.text or "")
