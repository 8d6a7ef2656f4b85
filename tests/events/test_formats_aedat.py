"""AEDAT 4.0 against a published recording, byte for byte where both write the same; AEDAT 2.0 against its bit
layout."""

import struct

import lz4.frame
import numpy as np
import pytest
import torch
import zstandard

from codesign.errors import FileFormatError
from codesign.events import read, write
from codesign.events.formats.aedat4 import read_frames
from codesign.events.stream import ordered
from tests.event_streams import same, stream_of

RECORDING = "data/davis346_newton_cradle/demo-01.aedat4"
DAVIS = {"height_px": 260, "width_px": 346}
MAGIC = b"#!AER-DAT4.0\r\n"


def blocks(data):
    """(header, [(stream, place, packet)], table) of a file, by the published layout; nothing is
    decompressed."""
    start = 18 + struct.unpack_from("<I", data, 14)[0]
    table_at = struct.unpack_from("<q", data, 14 + 40)[0]
    at = start
    packets = []
    while at < table_at:
        stream, size = struct.unpack_from("<ii", data, at)
        packets.append((stream, at + 8, data[at + 8 : at + 8 + size]))
        at += 8 + size
    return data[14:start], packets, data[table_at:]


def test_a_recording_decodes_as_another_program_decodes_it(shared):
    events = read(shared(RECORDING))
    truth = np.load(shared("data/davis346_newton_cradle/demo-01.npz"))
    order = np.lexsort((truth["p"], truth["x"], truth["y"], truth["t"]))
    assert (events.height_px, events.width_px) == (260, 346)
    for found, wanted in (
        (events.t_us - int(truth["t0_us"]), truth["t"]),
        (events.x, truth["x"]),
        (events.y, truth["y"]),
        (events.p > 0, truth["p"]),
    ):
        assert np.array_equal(found.numpy(), wanted[order])
    recorded = read_frames(shared(RECORDING))
    assert np.array_equal(recorded.frames.numpy(), truth["frames"])
    for found, wanted in (
        (recorded.exposure_start_us, truth["exposure"][:, 0]),
        (recorded.exposure_end_us, truth["exposure"][:, 1]),
    ):
        assert np.array_equal(found.numpy() - int(truth["t0_us"]), wanted)


def test_packets_and_header_are_laid_out_as_in_the_recording(shared, tmp_path):
    header, packets, _ = blocks(shared(RECORDING).read_bytes())
    first = next(lz4.frame.decompress(packet) for stream, _, packet in packets if stream == 0)
    events = np.frombuffer(
        first,
        np.dtype(
            {
                "names": list("txyp"),
                "formats": ["<i8", "<i2", "<i2", "?"],
                "offsets": [0, 8, 10, 12],
                "itemsize": 16,
            }
        ),
        offset=32,
    )
    ties = events[np.lexsort((events["p"], events["x"], events["y"], events["t"]))]
    t_us, x, y, p = (torch.from_numpy(ties[name].astype(np.int64)) for name in "txyp")
    write(tmp_path / "e.aedat4", ordered(t_us, x, y, 2 * p - 1, 260, 346))
    written_header, written, table = blocks((tmp_path / "e.aedat4").read_bytes())
    assert len(written) == 1
    assert lz4.frame.decompress(written[0][2]) == first[:32] + ties.tobytes()
    # size prefix, place of the table and length of the text differ; offsets, identifier, slots and
    # compression do not
    assert written_header[4:40] == header[4:40]
    assert b'<attr key="sizeX" type="int">346</attr>' in written_header
    # the table at the end, walked by hand: root 28, its vector at 40, one entry, whose shared slots begin at
    # 18
    table = lz4.frame.decompress(table)
    assert struct.unpack_from("<II4s", table) == (len(table) - 4, 28, b"FTAB")
    assert struct.unpack_from("<II", table, 40)[0] == 1
    entry = 44 + struct.unpack_from("<I", table, 44)[0]
    slots = entry - struct.unpack_from("<i", table, entry)[0]
    at = [entry + offset for offset in struct.unpack_from("<5H", table, slots + 4)]
    assert struct.unpack_from("<q", table, at[0])[0] == written[0][1]
    assert struct.unpack_from("<ii", table, at[1]) == (0, len(written[0][2]))
    assert [struct.unpack_from("<q", table, place)[0] for place in at[2:]] == [
        len(ties),
        int(t_us[0]),
        int(t_us[-1]),
    ]
    assert all(place % 8 == 0 for place in (at[0], *at[2:]))


def test_every_compression_and_a_missing_table_are_read(tmp_path):
    path = tmp_path / "e.aedat4"
    stream = stream_of((5, 1, 2, 1), (9, 3, 4, -1), **DAVIS)
    write(path, stream)
    header, packets, _ = blocks(path.read_bytes())
    body = lz4.frame.decompress(packets[0][2])
    for code, pack in enumerate(
        (bytes, lz4.frame.compress, lz4.frame.compress, zstandard.compress, zstandard.compress)
    ):
        packet = pack(body)
        changed = bytearray(MAGIC + header + struct.pack("<ii", 0, len(packet)) + packet)
        struct.pack_into("<i", changed, 14 + 32, code)
        struct.pack_into("<q", changed, 14 + 40, -1)  # recording was interrupted
        path.write_bytes(changed)
        back = read(path)
        assert same(stream, back)


def with_text(path, change):
    """The file with its XML changed to another of the same length."""
    data = path.read_bytes()
    changed = change(data)
    assert len(changed) == len(data)
    path.write_bytes(changed)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[1:] + b"x", "does not start with"),
        (lambda data: data.replace(b'<dv version="2.0">', b"<!DOCTYPE dv     >"), "document type"),
        (lambda data: data.replace(b"</dv>", b"</dw>"), "XML cannot be read"),
        (lambda data: data.replace(b"EVTS</attr>", b"FRME</attr>"), "0 streams of kind EVTS"),
        (lambda data: data.replace(b">346<", b">-46<"), "whole numbers"),
        (lambda data: data[:-5] + bytes(5), "damaged"),
        (lambda data: data[: 14 + 32] + b"\x09" + data[14 + 33 :], "compression 9"),
        (lambda data: data[: 14 + 40] + struct.pack("<q", 2**40) + data[14 + 48 :], "was cut"),
    ],
)
def test_malformed_files_are_refused(tmp_path, change, words):
    path = tmp_path / "e.aedat4"
    write(path, stream_of((5, 1, 2, 1), (9, 3, 4, -1), **DAVIS))
    with_text(path, change)
    with pytest.raises(FileFormatError, match=words):
        read(path)


def test_a_cut_file_and_missing_frames_are_refused(tmp_path):
    path = tmp_path / "e.aedat4"
    write(path, stream_of((5, 1, 2, 1), (9, 3, 4, -1), **DAVIS))
    with pytest.raises(FileFormatError, match="0 streams of kind FRME"):
        read_frames(path)
    with pytest.raises(FileFormatError, match="no file lies"):
        read_frames(tmp_path / "none.aedat4")
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(FileFormatError, match="damaged"):
        read(path)


def test_a_block_that_unpacks_without_end_is_refused(tmp_path):
    path = tmp_path / "e.aedat4"
    write(path, stream_of((5, 1, 2, 1), **DAVIS))
    header, _, _ = blocks(path.read_bytes())
    for code, bomb in (
        (1, lz4.frame.compress(bytes(2**26))),
        (3, zstandard.compress(bytes(2**26))),
    ):  # ZSTD packs zeros 20000 to 1
        changed = bytearray(MAGIC + header + struct.pack("<ii", 0, len(bomb)) + bomb)
        struct.pack_into("<i", changed, 14 + 32, code)
        struct.pack_into("<q", changed, 14 + 40, -1)
        path.write_bytes(changed)
        with pytest.raises(FileFormatError, match="damaged"):
            read(path)


@pytest.mark.parametrize(
    ("extension", "height_px", "width_px", "chip"),
    [(".aedat2", 260, 346, b"DAVIS346"), (".aedat", 180, 240, b"DAVIS240C")],
)
def test_aedat2_holds_mirrored_addresses_and_big_endian_times(tmp_path, extension, height_px, width_px, chip):
    path = tmp_path / f"e{extension}"
    generator = torch.Generator().manual_seed(0)
    t_us = torch.randint(0, 2**31, (1000,), generator=generator)
    x, y, p = (torch.randint(0, high, (1000,), generator=generator) for high in (width_px, height_px, 2))
    stream = ordered(t_us, x, y, 2 * p - 1, height_px, width_px)
    write(path, stream)
    header, data = path.read_bytes().split(b"#End Of ASCII Header\r\n", 1)
    assert header.startswith(b"#!AER-DAT2.0\r\n")
    assert chip in header
    records = np.frombuffer(data, ">u4").reshape(-1, 2).astype(np.int64)
    records = records[(records[:, 0] >> 10 & 1) == 0]
    assert np.array_equal(records[:, 1], stream.t_us.numpy())
    # jAER: x = width - 1 - column bits, y counts from the bottom
    assert np.array_equal(width_px - 1 - (records[:, 0] >> 12 & 0x3FF), stream.x.numpy())
    assert np.array_equal(height_px - 1 - (records[:, 0] >> 22 & 0x1FF), stream.y.numpy())
    assert np.array_equal(records[:, 0] >> 11 & 1, (stream.p > 0).numpy())
    assert not (records[:, 0] >> 31).any()


def test_aedat2_never_lets_an_event_pass_for_a_header_line(tmp_path):
    # row 140 from the bottom: its address begins with '#'
    path = tmp_path / "e.aedat2"
    stream = stream_of((7, 1, 259 - 140, 1), **DAVIS)
    write(path, stream)
    data = path.read_bytes().split(b"#End Of ASCII Header\r\n", 1)[1]
    assert data[:1] != b"#"
    assert np.frombuffer(data, ">i4").tolist() == [1 << 10, 7, 140 << 22 | 344 << 12 | 1 << 11, 7]


@pytest.mark.parametrize(
    ("stream", "words"),
    [
        (
            stream_of((0, 1, 1, 1), height_px=480, width_px=640),
            "346 x 260 and 240 x 180 pixels, not 640 x 480",
        ),
        (stream_of((2**31, 1, 1, 1), **DAVIS), "holds 0 to 2147483647"),
        (stream_of((-1, 1, 1, 1), **DAVIS), "times span -1"),
    ],
)
def test_aedat2_refuses_what_it_cannot_hold(tmp_path, stream, words):
    with pytest.raises(FileFormatError, match=words):
        write(tmp_path / "e.aedat2", stream)
    (tmp_path / "e.aedat2").write_bytes(b"#!AER-DAT2.0\r\n")
    with pytest.raises(FileFormatError, match="written, not read"):
        read(tmp_path / "e.aedat2")
