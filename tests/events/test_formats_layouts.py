"""Event files against recordings that another program decoded, and against the published layouts,
bit by bit."""

import struct
import subprocess
import sys
import zlib

import h5py
import hdf5plugin
import lz4.frame
import numpy as np
import pytest
import torch
import zstandard

from codesign.errors import FileFormatError
from codesign.events import read, write
from codesign.events.formats import hdf5
from codesign.events.formats.aedat import read_frames
from codesign.events.formats.hdf5_rows import GZIP, new_hdf5, places_of, undone
from codesign.events.stream import ordered
from tests.event_streams import (
    DAT,
    dat,
    evt2,
    evt2_event,
    evt3,
    in_hdf5,
    packed_aedat4,
    random_stream,
    rows,
    same,
    stream_of,
)

DAVIS = {"height_px": 260, "width_px": 346}
EPOCH_US = 1_643_243_628_737_093


@pytest.mark.parametrize(
    ("name", "size", "start_us"),
    [("davis346_newton_cradle/demo-01.aedat4", (260, 346), None), ("prophesee_gen3_vga/faery_evt2.raw", (480, 640), 913_716_224)],
)  # fmt: skip
def test_a_recording_decodes_as_another_program_decodes_it(shared, name, size, start_us):
    path = shared(f"data/{name}")
    events = read(path)
    truth = np.load(path.with_suffix(".npz"))  # in file order, its first time subtracted
    start_us = int(truth["t0_us"]) if start_us is None else start_us
    order = np.lexsort((truth["p"], truth["x"], truth["y"], truth["t"]))
    assert (events.height_px, events.width_px) == size
    columns = (events.t_us - start_us, events.x, events.y, events.p > 0)
    for found, wanted in zip(columns, "txyp", strict=True):
        assert np.array_equal(found.numpy(), truth[wanted][order])
    if path.suffix == ".aedat4":
        recorded = read_frames(path)
        exposure_us = torch.stack((recorded.exposure_start_us, recorded.exposure_end_us), 1)
        assert np.array_equal(recorded.frames.numpy(), truth["frames"])
        assert np.array_equal(exposure_us.numpy() - start_us, truth["exposure"])


def words_of(path, dtype):
    return np.frombuffer(path.read_bytes().split(b"% end\n")[1], dtype).tolist()


def test_evt3_singles_vectors_and_time_parts(tmp_path):
    path = tmp_path / "e.raw"
    path.write_bytes(
        evt3(
            # high 2, low 5, row 7 (slave camera's bit set), one ON event in column 30
            (0x8, 2), (0x6, 5), (0x0, 0x800 | 7), (0x2, 0x800 | 30),
            # base 100 ON: columns 100, 111; then from 112: 113; then from 124: 124, 131
            (0x3, 0x800 | 100), (0x4, 0b100000000001), (0x4, 0b10), (0x5, 0xF81),
            (0x8, 2), (0x2, 31),  # a repeated high part leaves the low one
            (0x8, 3), (0x2, 32),  # a new high part starts the low one at zero
            # trigger, counter and continuations: no events
            (0xA, 0x101), (0xE, 0x14), (0xF, 1), (0x7, 2),
            (0x6, 9), (0x5, 1),  # the base has moved on to 132
        )
    )  # fmt: skip
    t_us = 2 * 4096 + 5
    truth = [(t_us, x, 7, 1) for x in (30, 100, 111, 113, 124, 131)] + [(t_us, 31, 7, -1)]
    truth += [(3 * 4096, 32, 7, -1), (3 * 4096 + 9, 132, 7, 1)]
    events = read(path)
    assert rows(events) == sorted(truth, key=lambda row: (row[0], row[2], row[1], row[3]))
    assert (events.height_px, events.width_px) == (720, 1280)


OFF_5 = (0x2, 5)  # EVT3's word of an OFF event in column 5
FULL = (0x8, 0xFFF), (0x6, 0xFFF), OFF_5


# clocks start again and go on; a little disorder is sorted; a header alone is an empty stream
@pytest.mark.parametrize(
    ("name", "content", "truth"),
    [
        (
            "e.raw",
            evt3((0x0, 1), *FULL, (0x8, 0), (0x6, 2), OFF_5, (0x8, 0xFFF), (0x8, 0), OFF_5),
            [(2**24 - 1, 5, 1, -1), (2**24 + 2, 5, 1, -1), (2**25, 5, 1, -1)],
        ),
        (
            "e.raw",
            evt2(0x8FFFFFFF, evt2_event(63, 5, 1, 0), 0x80000000, evt2_event(2, 6, 1, 1)),
            [(2**34 - 1, 5, 1, -1), (2**34 + 2, 6, 1, 1)],
        ),
        (
            "e.dat",
            dat((2**32 - 1, 5, 1, 0), (2, 6, 1, 1)),
            [(2**32 - 1, 5, 1, -1), (2**32 + 2, 6, 1, 1)],
        ),
        (
            "e.dat",
            dat((5000, 1, 1, 1), (4000, 2, 1, 1), (5000, 0, 1, 1)),
            [(4000, 2, 1, 1), (5000, 0, 1, 1), (5000, 1, 1, 1)],
        ),
        ("e.dat", DAT[:-2], []),
        ("e.dat", DAT, []),
    ],
)
def test_clocks_order_and_empty_files(tmp_path, name, content, truth):
    (tmp_path / name).write_bytes(content)
    assert rows(read(tmp_path / name)) == truth


def test_what_is_written_is_what_the_layout_says(tmp_path):
    stream = stream_of((4096 * 3 + 70, 9, 4, 1), (4096 * 3 + 70, 10, 4, -1))
    write(tmp_path / "e.raw", stream)
    assert words_of(tmp_path / "e.raw", "<u2") == [0x8000, 0x8003, 0x6046, 0x0004, 0x2809, 0x200A]
    write(tmp_path / "e.raw", stream, evt=2)
    pair = [evt2_event(4096 * 3 + 70, x, 4, p) for x, p in ((9, 1), (10, 0))]
    high = 0x80000000
    assert words_of(tmp_path / "e.raw", "<u4") == [high, high | (4096 * 3 + 70) // 64, *pair]
    # a start time stands where faery looks for it
    late = stream_of((2**50 + 7, 5, 1, -1))
    write(tmp_path / "e.dat", late, t0_us=2**50)
    header = DAT[:-2] + b"% T0 1125899906842624\n\x0c\x08"
    assert (tmp_path / "e.dat").read_bytes() == header + dat((7, 5, 1, 0)).removeprefix(DAT)
    write(tmp_path / "e.raw", late, t0_us=2**50)
    assert b"% t0 1125899906842624\n% end\n" in (tmp_path / "e.raw").read_bytes()
    assert words_of(tmp_path / "e.raw", "<u2") == [0x8000, 0x6007, 0x0001, 0x2005]


@pytest.mark.parametrize(
    "times_us", [[0, 2**24 - 1, 2**24], [4094 * 4096, 2**26 + 5], [2**32 + 9], [2**23, 2**36]]
)
def test_every_way_of_counting_loops_of_evt3_gives_the_written_times(tmp_path, times_us):
    """The strictest reader, faery, counts a loop only from 4095 to 0 and passes over jumps of 4094
    or more; Prophesee's takes the first time-high word, less one, off all times."""
    write(tmp_path / "e.raw", stream_of(*((t_us, 1, 1, 1) for t_us in times_us)))
    high, low, loops, found = 0, 0, 0, []
    words = words_of(tmp_path / "e.raw", "<u2")
    assert words[0] == 0x8000
    for word in words:
        kind, load = word >> 12, word & 0xFFF
        if kind == 0x8:
            assert load >= high or (high, load) == (4095, 0)
            assert load - high < 4094
            loops += load < high
            low = low if load == high else 0
            high = load
        elif kind == 0x6:
            low = load
        elif kind == 0x2:
            found.append(loops << 24 | high << 12 | low)
    assert found == times_us


@pytest.mark.parametrize(
    "line", [b"% t0 5000000000\n", b"% T0 5000000000\n", b"% codesign_t_offset_us 5000000000\n"]
)
def test_the_start_time_of_the_header_is_added(tmp_path, line):
    for name, content in (
        ("e.dat", dat((7, 5, 1, 0))),
        ("e.raw", evt2(0x80000000, evt2_event(7, 5, 1, 0))),
        ("e.raw", evt3((0x8, 0), (0x6, 7), (0x0, 1), (0x2, 5))),
    ):
        (tmp_path / name).write_bytes(line + content)
        assert rows(read(tmp_path / name)) == [(5_000_000_007, 5, 1, -1)]


def test_events_that_come_before_their_time_or_row_are_left_out_with_a_warning(tmp_path):
    path = tmp_path / "e.raw"
    for content, count, left in (
        # one event without a time, two without a column base
        (evt3((0x0, 1), (0x2, 4), (0x5, 0b11), (0x8, 0), (0x2, 5)), 3, (0, 5, 1, -1)),
        (evt2(evt2_event(1, 2, 3, 1), 0x80000000, evt2_event(1, 2, 3, 1)), 1, (1, 2, 3, 1)),
    ):
        path.write_bytes(content)
        with pytest.warns(UserWarning, match=f"{count} events before"):
            assert rows(read(path)) == [left]


def test_sizes_come_from_the_header_the_caller_or_the_events(tmp_path):
    path = tmp_path / "e.raw"
    content = evt2(0x80000000, evt2_event(1, 9, 5, 1))
    path.write_bytes(content.replace(b"% geometry 640x480\n", b""))
    for told, size in (({}, (6, 10)), ({"height_px": 480, "width_px": 640}, (480, 640))):
        events = read(path, **told)
        assert (events.height_px, events.width_px) == size
    with pytest.raises(FileFormatError, match=r"x = 9.*9 pixels"):
        read(path, width_px=9)
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="width_px 640 by the file, but 641"):
        read(path, width_px=641)


def blocks(data):
    """(header, packets as (place, bytes), table) of an AEDAT 4.0 file, by the published layout;
    nothing is decompressed."""
    at = start = 18 + struct.unpack_from("<I", data, 14)[0]
    table_at = struct.unpack_from("<q", data, 14 + 40)[0]
    packets = []
    while at < table_at:
        stream, size = struct.unpack_from("<ii", data, at)
        packets += [(at + 8, data[at + 8 : at + 8 + size])] * (stream == 0)
        at += 8 + size
    return data[14:start], packets, data[table_at:]


def test_packets_and_header_are_laid_out_as_in_the_recording(shared, tmp_path):
    header, packets, _ = blocks(shared("data/davis346_newton_cradle/demo-01.aedat4").read_bytes())
    first = lz4.frame.decompress(packets[0][1])
    event = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "?"), ("", "V3")])
    events = np.frombuffer(first, event, offset=32)
    ties = events[np.lexsort((events["p"], events["x"], events["y"], events["t"]))]
    t_us, x, y, p = (torch.from_numpy(ties[name].astype(np.int64)) for name in "txyp")
    write(tmp_path / "e.aedat4", ordered(t_us, x, y, 2 * p - 1, 260, 346))
    written_header, [(place, packet)], table = blocks((tmp_path / "e.aedat4").read_bytes())
    assert lz4.frame.decompress(packet) == first[:32] + ties.tobytes()
    # size prefix, place of the table and length of the text differ; offsets, identifier, slots and
    # compression do not
    assert written_header[4:40] == header[4:40]
    assert b'<attr key="sizeX" type="int">346</attr>' in written_header
    # the table at the end, walked by hand: root 28, its vector at 40, one entry, whose shared slots
    # begin at 18
    table = lz4.frame.decompress(table)
    assert struct.unpack_from("<II4s", table) == (len(table) - 4, 28, b"FTAB")
    assert struct.unpack_from("<II", table, 40)[0] == 1
    entry = 44 + struct.unpack_from("<I", table, 44)[0]
    slots = entry - struct.unpack_from("<i", table, entry)[0]
    at = [entry + offset for offset in struct.unpack_from("<5H", table, slots + 4)]
    assert struct.unpack_from("<ii", table, at.pop(1)) == (0, len(packet))
    found = [struct.unpack_from("<q", table, place)[0] for place in at]
    assert found == [place, len(ties), int(t_us[0]), int(t_us[-1])]
    assert all(place % 8 == 0 for place in at)


def test_every_compression_and_a_missing_table_are_read(tmp_path):
    path = tmp_path / "e.aedat4"
    stream = stream_of((5, 1, 2, 1), (9, 3, 4, -1), **DAVIS)
    write(path, stream)
    data = path.read_bytes()
    body = lz4.frame.decompress(blocks(data)[1][0][1])
    packers = (bytes, *[lz4.frame.compress] * 2, *[zstandard.compress] * 2)
    for code, pack in enumerate(packers):
        path.write_bytes(packed_aedat4(data, code, pack(body)))
        assert same(stream, read(path))


@pytest.mark.parametrize(
    ("extension", "height_px", "width_px", "chip"),
    [(".aedat2", 260, 346, b"DAVIS346"), (".aedat", 180, 240, b"DAVIS240C")],
)
def test_aedat2_holds_mirrored_addresses_and_big_endian_times(
    tmp_path, extension, height_px, width_px, chip
):
    path = tmp_path / f"e{extension}"
    stream = random_stream(1000, height_px, width_px, 2**31 - 1)
    write(path, stream)
    header, data = path.read_bytes().split(b"#End Of ASCII Header\r\n", 1)
    assert header.startswith(b"#!AER-DAT2.0\r\n")
    assert chip in header
    address, t_us = np.frombuffer(data, ">u4").reshape(-1, 2).astype(np.int64).T
    t_us, address = t_us[(address >> 10 & 1) == 0], address[(address >> 10 & 1) == 0]
    # jAER: x = width - 1 - column bits, y counts from the bottom
    x, y = width_px - 1 - (address >> 12 & 0x3FF), height_px - 1 - (address >> 22 & 0x1FF)
    np.testing.assert_array_equal([t_us, x, y], [stream.t_us, stream.x, stream.y])
    assert np.array_equal(address >> 11 & 1, stream.p > 0)
    assert not (address >> 31).any()


def test_aedat2_never_lets_an_event_pass_for_a_header_line(tmp_path):
    # row 140 from the bottom: its address begins with '#'
    path = tmp_path / "e.aedat2"
    write(path, stream_of((7, 1, 259 - 140, 1), **DAVIS))
    data = path.read_bytes().split(b"#End Of ASCII Header\r\n", 1)[1]
    assert np.frombuffer(data, ">i4").tolist() == [1 << 10, 7, 140 << 22 | 344 << 12 | 1 << 11, 7]


STREAM = random_stream(3000, 480, 640, 39_999, EPOCH_US)


def dsec(path, since_us, indexed=True, **packing):
    """A file as DSEC publishes them, of the events of STREAM at other times."""
    index = np.array([np.count_nonzero(since_us < 1000 * k) for k in range(41)], np.uint64)
    arrays = {
        "events/t": since_us.astype(np.uint32),
        "events/x": STREAM.x.numpy().astype(np.uint16),
        "events/y": STREAM.y.numpy().astype(np.uint16),
        "events/p": (STREAM.p > 0).numpy().astype(np.uint8),
        "t_offset": np.int64(EPOCH_US),
        "ms_to_idx": index[: indexed if indexed > 1 else None] if indexed else None,
    }
    path.write_bytes(in_hdf5(arrays, **packing))
    return path


SINCE_US = (STREAM.t_us - EPOCH_US).numpy()


@pytest.mark.parametrize(
    "packing",
    [
        dict(hdf5plugin.Blosc(cname="zstd", clevel=1)),
        {"compression": "gzip", "shuffle": True, "fletcher32": True},
        {"chunks": True},
        {"chunks": True, "userblock": 512},
        {},
    ],
)
def test_published_hdf5_files_are_read(tmp_path, packing):
    path = dsec(tmp_path / "e.h5", SINCE_US, **packing)
    assert same(read(path, height_px=480, width_px=640), STREAM)


def test_hdf5_that_is_written_follows_the_layout(tmp_path):
    write(tmp_path / "e.h5", STREAM)
    with h5py.File(tmp_path / "e.h5") as file:
        names = ("events/t", "events/x", "events/y", "events/p", "t_offset", "ms_to_idx")
        found = [np.asarray(file[name]) for name in names]
    assert [one.dtype.str for one in found] == ["<u4", "<u2", "<u2", "|u1", "<i8", "<u8"]
    since_us, x, y, on, offset_us, index = found
    assert offset_us == STREAM.t_us[0]
    wanted = (SINCE_US - SINCE_US[0], STREAM.x, STREAM.y, STREAM.p > 0)
    assert all(np.array_equal(a, b) for a, b in zip((since_us, x, y, on), wanted, strict=True))
    assert index.tolist() == [np.count_nonzero(since_us < 1000 * k) for k in range(len(index))]
    assert index[-1] == len(since_us)  # the last millisecond is closed


@pytest.mark.parametrize("indexed", [True, False, 20])
def test_a_window_is_the_events_between_two_times(tmp_path, monkeypatch, indexed):
    monkeypatch.setattr(hdf5, "FINE", 16)  # so that bisection has to find its way
    times = SINCE_US.copy()
    if (
        not indexed
    ):  # a little disorder, which an index of milliseconds cannot hold; 20: it ends early
        times[1::7] = np.maximum(times[1::7] - 400, 0)
    events = hdf5.Hdf5Events(dsec(tmp_path / "e.h5", times, indexed))
    windows_us = (0, 0), (11_999, 12_000), (7_300, 21_450), (39_000, 60_000), (-50, 40_000)
    for t0_us, t1_us in windows_us:
        inside = (times >= t0_us) & (times <= t1_us)
        columns = (STREAM.x[inside], STREAM.y[inside], STREAM.p[inside])
        truth = ordered(torch.from_numpy(times[inside] + EPOCH_US), *columns, 480, 640)
        assert same(events.window(t0_us + EPOCH_US, t1_us + EPOCH_US, (480, 640)), truth)


def test_a_block_lies_inside_the_file_to_its_last_byte(tmp_path):
    (tmp_path / "e.h5").write_bytes(in_hdf5({"a": np.arange(40)}, chunks=True))
    with h5py.File(tmp_path / "e.h5") as file:
        (block,) = (file["a"].id.get_chunk_info(k) for k in range(file["a"].id.get_num_chunks()))
        end = block.byte_offset + block.size
        assert len(places_of("e.h5", file["a"], "a", end)) == 1
        with pytest.raises(FileFormatError, match="needs 1 blocks and lacks some"):
            places_of("e.h5", file["a"], "a", end - 1)


@pytest.mark.parametrize("change", [lambda packed: packed + b"x", lambda packed: packed[:-1]])
def test_a_gzip_block_ends_where_its_stream_ends(change):
    data = bytes(range(200))
    packed = zlib.compress(data)
    assert undone("e.h5", "a", GZIP, (), packed, len(data)) == data
    with pytest.raises(FileFormatError, match=r"e\.h5: a block of a \(gzip\) does not unpack"):
        undone("e.h5", "a", GZIP, (), change(packed), len(data))


PROGRAM = """
import resource, signal, sys
import numpy as np
from codesign.events.formats.hdf5_rows import new_hdf5
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
dice = np.random.default_rng(0)
told = 0
for most in range(0, 60_000, 3000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
    try:
        with new_hdf5(sys.argv[1]) as file:
            grown = file.create_dataset("a", (0,), "i8", maxshape=(None,), chunks=(512,), compression="gzip")
            for part in range(20):
                grown.resize((part + 1) * 500, 0)
                grown[part * 500 :] = dice.integers(0, 2**40, 500)
                if part % 4 == 0:
                    file.flush()
    except OSError as error:
        told += error.errno == 27
print(told)
"""


def test_a_full_disk_is_an_error_and_never_the_end_of_the_process(tmp_path):
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "a.h5")]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert (ended.returncode, ended.stdout) == (0, "20\n"), ended.stderr[-500:]
    values = np.random.default_rng(1).integers(0, 1000, 5000)
    for name, opened in (("ours", new_hdf5), ("theirs", lambda path: h5py.File(path, "w"))):
        with opened(tmp_path / name) as file:
            options = {"chunks": (512,), "compression": "gzip", "track_times": False}
            file.create_dataset("a", data=values, **options)
    assert (tmp_path / "ours").read_bytes() == (tmp_path / "theirs").read_bytes()
