"""Event files of every format: exact round trips, one file through both doors, damage and limits
that end in a sentence. Bit layouts: test_formats_layouts.py; mutants of whole files:
tests/hostile."""

import io
import zipfile
import zlib

import h5py
import hdf5plugin
import lz4.frame
import numpy as np
import pytest
import zstandard

from codesign.errors import FileFormatError
from codesign.events import read, write
from codesign.events.formats import text
from codesign.events.formats.aedat import read_frames
from codesign.flow.sources import read_recording
from tests.event_streams import (
    FIELDS,
    dat,
    evt2,
    evt3,
    in_hdf5,
    packed_aedat4,
    random_stream,
    same,
    stream_of,
)

EPOCH_US = 1_643_243_628_737_093  # a clock that counts from 1970
DAVIS = {"height_px": 260, "width_px": 346}


@pytest.mark.parametrize(
    ("name", "first_us", "span_us", "options"),
    [
        ("e.h5", EPOCH_US, 2**32, {}),
        ("e.aedat4", EPOCH_US, 10_000_000, {}),
        ("e.aedat4", 2**32 - 1000, 2**34, {}),
        ("e.raw", EPOCH_US, 10_000_000, {"evt": 3, "t0_us": EPOCH_US - 5}),
        ("e.raw", 2**32 - 1000, 2**34, {"evt": 3}),
        ("e.raw", EPOCH_US, 2**34, {"evt": 2, "t0_us": EPOCH_US}),
        ("e.raw", 2**32 - 1000, 2**33, {"evt": 2}),
        ("e.dat", EPOCH_US, 2**32, {"t0_us": EPOCH_US}),
        ("e.dat", 5000, 2**31, {}),
        ("e.npz", 5000, 2**50, {}),
        ("e.CSV", 5000, 2**50, {}),
    ],
)
def test_events_come_back_exactly_with_the_size_of_the_sensor(
    tmp_path, name, first_us, span_us, options
):
    # which text has no place for
    told = {"height_px": 480, "width_px": 640} if name == "e.CSV" else {}
    for count in (30_000, 1, 0):
        stream = random_stream(count, 480, 640, span_us - 1, first_us)
        write(tmp_path / name, stream, **options)
        back = read(tmp_path / name, **told)
        assert same(stream, back)
        assert (back.height_px, back.width_px) == (480, 640)


EVENTS = [[7, 1_400_000, 2_000_000], [3, 0, 9], [0, 5, 2], [-1, 1, 1]]  # t_us, x, y, p
T_US = np.array(EVENTS[0])
ON = np.array([0, 1, 1])
NPZ = {"t_us": T_US, "x": EVENTS[1], "y": EVENTS[2], "p": EVENTS[3], "height_px": 6, "width_px": 10}
DSEC = {"events/t": T_US - 5, "events/x": EVENTS[1], "events/y": EVENTS[2], "events/p": ON}
DSEC["t_offset"] = 5


def in_arrays(**values):
    buffer = io.BytesIO()
    np.savez(buffer, **values)
    return buffer.getvalue()


def in_rows(*columns):
    buffer = io.BytesIO()
    np.save(buffer, np.stack(columns, 1))
    return buffer.getvalue()


SAME = {
    "header.csv": b"t,x,y,p\n7,3,0,-1\n1400000,0,5,1\n2000000,9,2,1\n",
    "other_programs.csv": b"t,x,y,p\r\n7, 3,0,0\r\n\r\n1400000,0,5,1\r\n2000000,9,2,1",
    "marked.csv": b"\xef\xbb\xbft,x,y,p\n7,3,0,-1\n1400000,0,5,1\n2000000,9,2,1\n",
    "marked_headerless.csv": b"\xef\xbb\xbf7,3,0,0\n1400000,0,5,1\n2000000,9,2,1\n",
    "headerless.csv": b"7,3,0,0\n1400000,0,5,1\n2000000,9,2,1\n",
    "seconds.csv": b"0.000007,3,0,0\n1.4,0,5,1\n2.0,9,2,1\n",
    "named_unit.csv": b"x,y,p,t_ns\n3,0,0,7000\n0,5,1,1400000000\n9,2,1,2000000000\n",
    "with_size.txt": b"# a comment\n10 6\n0.000007 3 0 0\n1.4 0 5 1\n2 9 2 1\n",
    "xytp.txt": b"3 0 7 -1\n0 5 1400000 1\n9 2 2000000 1\n",
    "xytp_seconds.csv": b"3,0,0.000007,0\n0,5,1.4,1\n9,2,2.0,1\n",
    "commented.csv": b"# made by hand\n#\n# p timestamp y x\n0 0.000007 0 3\n1 1.4 5 0\n1 2 2 9\n",
    "rows.npy": in_rows(T_US * 1e-6, *EVENTS[1:]),
    "xytp.npy": in_rows(*EVENTS[1:3], T_US, ON),
    "own.npz": in_arrays(**NPZ),
    "names.npz": in_arrays(ts=T_US * 1e-6, xs=EVENTS[1], ys=EVENTS[2], pol=ON > 0),
    "mvsec.hdf5": in_hdf5(
        {
            "davis/left/events": np.stack([*EVENTS[1:3], T_US * 1e-6, EVENTS[3]], 1),
            "davis/left/image_raw": np.zeros((1, 6, 10), np.uint8),
        }
    ),
    "v2e.h5": in_hdf5({"events": np.stack([T_US, *EVENTS[1:3], ON], 1).astype(np.uint32)}),
    "dsec.hdf5": in_hdf5(DSEC),
    "plain.h5": in_hdf5(DSEC | {"events/t": T_US, "t_offset": None}),
}


@pytest.mark.parametrize("name", SAME)
def test_one_file_gives_the_same_numbers_through_both_doors(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(SAME[name])
    stream, held = read(path), read_recording(path)
    assert [getattr(stream, field).tolist() for field in FIELDS] == EVENTS
    columns = held.t_us, held.x, held.y, 2 * held.on - 1
    assert [column.tolist() for column in columns] == EVENTS
    assert (stream.height_px, stream.width_px) == (6, 10)  # told, or the smallest that holds them
    told = name in ("with_size.txt", "own.npz", "mvsec.hdf5")
    assert (held.height_px, held.width_px) == ((6, 10) if told else (180, 240))
    window = held.window(1_400_000, 2_000_000)
    assert [getattr(window, field).tolist() for field in FIELDS] == [
        column[1:] for column in EVENTS
    ]


@pytest.mark.parametrize(
    ("text", "options", "times_us"),
    [
        ("1 2 3 1\n", {"columns": "xytp"}, [3]),
        ("1 2 3 1\n2 3 4 1\n", {"columns": "xytp", "time_unit": "ms"}, [3000, 4000]),
        ("2 9 3 1\n5 9 1 1\n", {}, [2, 5]),
        ("2.000 9 3 1\n5.000 9 1 1\n", {}, [2_000_000, 5_000_000]),
        # 256 ns from one number of double precision to the next
        (
            "1700000000000000499 1 1 1\n1700000000000001501 1 1 1\n",
            {"time_unit": "ns"},
            [1_700_000_000_000_000, 1_700_000_000_000_002],
        ),
        ("2 9 3 1\n1 9 3 1\n", {}, [3, 3]),
        ("1 1 5 2\n", {"columns": "pxty"}, [5]),
        # a little late
        ("0.1 1 1 1\n0.1005 2 2 1\n0.1002 3 3 0\n", {}, [100_000, 100_200, 100_500]),
    ],
)
def test_columns_are_told_or_evident_and_events_put_in_order(text, options, times_us, tmp_path):
    path = tmp_path / "e.txt"
    path.write_text(text)
    assert read(path, **options).t_us.tolist() == times_us


def test_csv_is_written_as_the_text_it_says(tmp_path):
    path = tmp_path / "e.csv"
    write(path, stream_of((7, 3, 0, -1), (2**60 + 1, 0, 5, 1)))
    assert path.read_text() == f"t,x,y,p\n7,3,0,-1\n{2**60 + 1},0,5,1\n"
    assert read(path).t_us.tolist() == [7, 2**60 + 1]  # whole numbers stay exact


def dsec(**change):
    """Bytes of a DSEC file with some datasets changed, None: left out."""
    changed = {f"events/{k}" if k in "txyp" else k: v for k, v in change.items()}
    return in_hdf5(DSEC | changed)


def npz(**change):
    return in_arrays(**{k: v for k, v in (NPZ | change).items() if v is not None})


def short_blocks(packing, shorten):
    """DSEC of blocks that unpack to too little: both end the process when HDF5 unpacks them, since
    the missing bytes lie beyond its buffer."""

    def fill(file):
        for name in "txyp":
            zeros = np.zeros(2**18, np.uint32)
            block = file.create_dataset(f"events/{name}", data=zeros, chunks=(2**18,), **packing)
            block.id.write_direct_chunk((0,), shorten(block.id.read_direct_chunk((0,))[1]))
        file["t_offset"] = 0

    return in_hdf5({}, fill)


def five_bytes(block):
    return zlib.compress(b"short")


def claims_64_bytes(block):
    return block[:4] + b"\x40\0\0\0" + block[8:]


def never_written(file):  # 4 TB
    for name in "txyp":
        whole = {"shape": (2**40,), "chunks": (2**20,), "dtype": "u1", "compression": "gzip"}
        file.create_dataset(f"events/{name}", **whole)
    file["t_offset"] = 0


def linked(file):
    file["events"] = h5py.ExternalLink("other.h5", "events")


def virtual(file):
    layout = h5py.VirtualLayout((3,), np.uint16)
    layout[:] = h5py.VirtualSource("other.h5", "events/x", (3,))
    file.create_virtual_dataset("events/x", layout)


def claimed_npz():
    buffer = io.BytesIO()
    header = b"{'descr': '<i8', 'fortran_order': False, 'shape': (1099511627776,), }"
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("t_us.npy", b"\x93NUMPY\x01\x00\x76\x00" + header.ljust(117) + b"\n")
    return buffer.getvalue()


LINES = "".join(f"0.2{k:03d} 1 2 1\n" for k in range(299))
TEXTS = [
    ("t,x,y,p\n", "holds no event"),
    ("a b c\n", "line 1"),
    ("t,x,y\n1,2,3\n", "line 1.*header"),
    ("1,2,3,1\n2,5,6,1\n", "give columns='txyp' or"),
    ("5,2,3,1\n4,2,1,1\n", "give columns='txyp' or"),
    ("t,x,y,p\n1,2,3,1\n2,2,3\n", "line 3"),
    ("t,x,y,p\n1,2,nan,1\n", "line 2"),
    ("t,x,y,p\n1_0,2,3,1\n", "line 2"),
    ("t,x,y,p\n1,2,3,1x\n", "line 2.*four finite"),
    ("t,x,y,p\n1,2,3,1\n9999999999999999999,2,3,1\n", "line 3.*61 bits"),
    ("t,x,y,p\n5000,2,3,1\n3999,2,3,1\n", "line 3.*1001 us before an earlier"),
    ("t,x,y,p\n5,-2,3,1\n", "line 2.*x = -2"),
    ("t,x,y,p\n5,2,3,2\n", "line 2.*polarity is 2"),
    ("t,x,y,p\n5,2,3,-1\n5,2,3,0\n", "line 3.*polarity is 0; 1 for ON, -1, as"),
    (bytes(range(256)).decode("latin-1") * 90, "line"),
    (LINES + "0.3 1 2 1 9\n0.3 1 2 1\n", "line 300.*four"),
    (LINES + "0.3 1 two 1\n", "line 300.*four"),
    (LINES + "0.1 1 2 1\n", "line 300.*before an earlier"),
    (LINES + "\n0.3 1.5 2 1\n", "line 301.*whole numbers"),  # empty lines count as lines
    (LINES + "0.3 1 2 7\n", "line 300.*polarity"),
]
EVT3 = evt3()
DAMAGED = {
    "e.csv": [(body.encode(), words) for body, words in TEXTS],
    "e.npz": [
        (npz(t_us=None), "t_us"),
        (npz(t_us=T_US[::-1]), "event 1: .* us before"),
        (npz(t_us=np.full(3, 2**63 + 5, np.uint64)), "61 bits"),
        (in_arrays(**NPZ | {"t": np.float32([1e9, 1e9, 2e9])}), "not told apart in float32"),
        (npz(x=np.zeros(2, int)), "equal length"),
        (npz(x=np.full(3, 10)), "x = 10; the sensor has 10"),
        (npz(t_us=np.array([None] * 3)), "t_us holds object"),
        (npz(height_px=np.array([2])), "height_px"),
        (claimed_npz(), "t_us claims"),
    ],
    "e.h5": [
        (b"not HDF5", "no HDF5 file"),
        (dsec(p=None), "events/p is absent"),
        (dsec(t_offset=np.int64(2**62)), "61 bits"),
        (dsec(t_offset=np.zeros(2, int)), "one whole number"),
        (dsec(x=np.zeros(5, np.uint16)), r"\[5\], \[3\] is needed"),
        (dsec(x=np.zeros(3)), "whole numbers"),
        (dsec(p=np.full(3, 2, np.uint8)), "event 0: its polarity is 2"),
        (dsec(t=T_US[::-1]), "before an earlier"),
        (dsec(ms_to_idx=np.zeros(41, int)), "first event of each millisecond"),
        (dsec(ms_to_idx=np.array([0, 2**40])), "no index of its 3 events"),
        (in_hdf5({}, linked), "link to another"),
        (in_hdf5(DSEC | {"events/x": None}, virtual), "other files"),
        (in_hdf5(DSEC, compression="lzf"), "filters"),
        (short_blocks({"compression": "gzip"}, five_bytes), "does not unpack"),
        (short_blocks(dict(hdf5plugin.Blosc()), claims_64_bytes), "does not unpack"),
        (in_hdf5({}, never_written), "out of proportion"),
    ],
    "e.raw": [
        (b"", "encoding nowhere"),
        (b"% evt 2.1\n% end\n", "2.1"),
        (b"% evt 3.0\n% format EVT2\n% end\n", r"2\.0.*3\.0"),
        (b"% evt 3.0\n% endianness big\n% end\n", "big"),
        (b"% evt 3.0\n% geometry 640\n% end\n", "WIDTHxHEIGHT"),
        (b"% evt 3.0\n% format EVT3;height=4;width=5\n% geometry 4x5\n% end\n", "two sensor sizes"),
        (b"% evt 3.0\n% geometry 9000x5\n% end\n", "from 1 to 2048"),
        (b"% evt 3.0\n% evt 2.0\n% end\n", "twice"),
        (b"% evt \xff\n% end\n", "ASCII"),
        (b"% evt 3.0", "does not end"),
        (b"% evt 3.0\n% end\n", "no event"),
        (b"% t0 1e6\n" + EVT3, r"start time \(t0\) as '1e6'"),
        (b"% t0 5\n% T0 6\n" + EVT3, "5 and as 6"),
        (EVT3 + b"\x00", "amid a word"),
        (evt3((0x8, 0), (0x9, 0)), "word 1 has type 0x9"),
        (evt2(0x80000000, 0x30000000), "word 1 has type 0x3"),
        (evt3((0x8, 0), (0x0, 720), (0x2, 5)), "y = 720.*720 pixels"),
        (evt3((0x8, 0), (0x0, 1), (0x3, 2047), (0x5, 2), geometry=False), "column 2048"),
        # one wrong bit is no new loop
        (evt3((0x8, 2048), (0x0, 1), (0x2, 5), (0x8, 0), (0x2, 5)), "before an earlier"),
    ],
    "e.dat": [
        (b"", "version 'none'"),
        (dat().replace(b"Version 2", b"Version 1"), "version '1'"),
        (dat()[:-2] + b"\x0e\x08", "0e 08"),
        (dat()[:-1], "type and size are 0c"),
        (dat() + b"1234567", "amid an event"),
        (dat((1, 2, 3, 2)), "polarity is 2"),
        (dat((1, 640, 3, 1)), "x = 640"),
        (dat((5000, 1, 1, 1), (3999, 2, 1, 1)), "event 1: it lies 1001 us before"),
        (dat().replace(b"Width 640", b"Width -6"), "Width as '-6'"),
    ],
    "e.aedat4": [
        (lambda data: data[1:] + b"x", "does not start with"),
        (lambda data: data.replace(b'<dv version="2.0">', b"<!DOCTYPE dv     >"), "document type"),
        (lambda data: data.replace(b"</dv>", b"</dw>"), "XML cannot be read"),
        (lambda data: data.replace(b"EVTS</attr>", b"FRME</attr>"), "0 streams of kind EVTS"),
        (lambda data: data.replace(b">346<", b">-46<"), "whole numbers"),
        (lambda data: data[:-20], "damaged"),
        (lambda data: data[: 14 + 32] + b"\x09" + data[14 + 33 :], "compression 9"),
        (lambda data: data[: 14 + 45] + b"\x01" + data[14 + 46 :], "was cut"),
        # blocks that unpack without end; ZSTD packs zeros 20000 to 1
        (lambda data: packed_aedat4(data, 1, lz4.frame.compress(bytes(2**26))), "damaged"),
        (lambda data: packed_aedat4(data, 3, zstandard.compress(bytes(2**26))), "damaged"),
    ],
    "e.aedat2": [(b"#!AER-DAT2.0\r\n", "written, not read")],
    "e.log": [(b"", r"\.csv, \.dat, \.h5, \.hdf5, \.npy, \.npz, \.raw, \.txt")],
}
DAMAGES = [(name, *row) for name, rows in DAMAGED.items() for row in rows]


@pytest.mark.parametrize(("name", "content", "words"), DAMAGES)
def test_damaged_files_end_in_a_sentence(tmp_path, monkeypatch, name, content, words):
    path = tmp_path / name
    if callable(content):
        write(path, stream_of((5, 1, 2, 1), (9, 3, 4, -1), **DAVIS))
        content = content(path.read_bytes())
    path.write_bytes(content)
    for chunk in (2**23, 640):
        monkeypatch.setattr(text, "CHUNK_BYTES", chunk)
        with pytest.raises(FileFormatError, match=words):
            read(path)


ONE, LATE = stream_of((0, 1, 1, 1)), stream_of((2**32, 1, 1, 1))


@pytest.mark.parametrize(
    ("name", "stream", "options", "words"),
    [
        ("e.log", ONE, {}, r"\.csv, \.dat, \.h5, \.hdf5, \.npz, \.raw"),
        ("none/e.csv", ONE, {}, "folder"),
        ("e.csv", stream_of((2**61, 1, 1, 1)), {}, "CSV holds"),
        ("e.h5", stream_of((0, 1, 1, 1), (2**32, 1, 1, 1)), {}, "32 bits"),
        ("e.raw", stream_of((0, 1, 1, 1), width_px=2049), {}, "at most 2048 x 2048"),
        ("e.raw", stream_of((-1, 1, 1, 1)), {"evt": 2}, "times span -1"),
        ("e.raw", stream_of((2**44, 1, 1, 1)), {}, "0 to 17592186044415; pass .* t0_us"),
        ("e.raw", stream_of((2**34, 1, 1, 1)), {"evt": 2}, "0 to 17179869183; pass .* t0_us"),
        ("e.raw", ONE, {"evt": 4}, "evt=4"),
        ("e.raw", ONE, {"t0_us": 1}, "times less t0_us 1 span -1"),
        ("e.dat", ONE, {"evt": 3}, "evt=3"),
        ("e.dat", LATE, {}, "times span 4294967296.*0 to 4294967295; pass .* t0_us"),
        ("e.dat", stream_of((0, 1, 1, 1), width_px=2**14 + 1), {}, "16384 x 16384"),
        ("e.dat", ONE, {"t0_us": 1.0}, "t0_us is 1.0"),
        ("e.dat", ONE, {"t0_us": 2**63}, "t0_us is 9223372036854775808"),
        ("e.npz", ONE, {"t0_us": 5}, r"t0_us=5 was given .* \.dat and \.raw files alone"),
        ("e.aedat2", ONE, {}, "346 x 260 and 240 x 180 pixels, not 640 x 480"),
        ("e.aedat2", stream_of((2**31, 1, 1, 1), **DAVIS), {}, "holds 0 to 2147483647"),
    ],
)
def test_streams_a_format_cannot_hold_leave_the_earlier_file(
    tmp_path, name, stream, options, words
):
    path = tmp_path / name
    if path.parent.exists():
        path.write_bytes(b"earlier")
    with pytest.raises(FileFormatError, match=words):
        write(path, stream, **options)
    assert [one.read_bytes() for one in tmp_path.iterdir()] == [b"earlier"] * path.parent.exists()


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        (
            "seconds.csv",
            {"width_px": 9},
            "line 3.*x = 9; the sensor has 9 pixels there by the options",
        ),
        ("seconds.csv", {"height_px": 5}, "line 2.*y = 5"),
        ("own.npz", {"width_px": 3}, "width_px 10 by the file, but 3"),
        ("mvsec.hdf5", {"width_px": 11}, "width_px 10 by its frames, but 11"),
        ("seconds.csv", {"columns": "abcd"}, "four letters"),
        ("seconds.csv", {"time_unit": "h"}, "time unit 'h'"),
        ("e.raw", {"columns": "xytp"}, "has these by its format"),
        ("dsec.hdf5", {"time_unit": "ns"}, "has these by its format"),
        ("own.npz", {"columns": "yxtp"}, "leave columns away"),
        ("none.csv", {}, "no file lies at"),
    ],
)
def test_options_and_places_that_do_not_fit_are_refused(name, options, words, tmp_path):
    if name != "none.csv":
        (tmp_path / name).write_bytes(SAME.get(name, b""))
    with pytest.raises(FileFormatError, match=words):
        read(tmp_path / name, **options)


def test_a_file_of_events_has_no_frames(tmp_path):
    write(tmp_path / "e.aedat4", stream_of((5, 1, 2, 1), **DAVIS))
    for name, words in (("e", "0 streams of kind FRME"), ("none", "no file lies")):
        with pytest.raises(FileFormatError, match=words):
            read_frames(tmp_path / f"{name}.aedat4")
