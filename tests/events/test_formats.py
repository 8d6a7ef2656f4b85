"""Event files of every format: exact round trips, one file through both doors, damage and limits
that end in a sentence. Bit layouts: test_formats_layouts.py; mutants of whole files:
tests/hostile."""
# ruff: noqa: F401 (names of the calls)

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
from tests import refusals
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
from tests.recording_case import put

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
EVT3 = evt3()


@refusals.table(__file__, "damaged files of events")
def test_damaged_files_end_in_a_sentence(row, tmp_path, monkeypatch):
    write(tmp_path / "e.aedat4", stream_of((5, 1, 2, 1), (9, 3, 4, -1), **DAVIS))

    def damaged(name, content):
        put(tmp_path / name, content)
        return read(tmp_path / name)

    names = globals() | {"damaged": damaged, "data": (tmp_path / "e.aedat4").read_bytes()}
    for chunk in (2**23, 640):
        monkeypatch.setattr(text, "CHUNK_BYTES", chunk)
        row.holds(names)


ONE, LATE = stream_of((0, 1, 1, 1)), stream_of((2**32, 1, 1, 1))


@refusals.table(__file__, "streams that a format cannot hold")
def test_streams_a_format_cannot_hold_leave_the_earlier_file(row, tmp_path):
    def write_to(name, stream, **options):
        path = tmp_path / name
        if path.parent.exists():
            path.write_bytes(b"earlier")
        write(path, stream, **options)

    row.holds(globals() | {"write_to": write_to})
    kept = [one.read_bytes() for one in tmp_path.iterdir()]
    assert kept == [b"earlier"] * ("none/" not in row.call)


@refusals.table(__file__, "options and places")
def test_options_and_places_that_do_not_fit_are_refused(row, tmp_path):
    def read_as(name, **options):
        if name != "none.csv":
            (tmp_path / name).write_bytes(SAME.get(name, b""))
        return read(tmp_path / name, **options)

    row.holds({"read_as": read_as})


def test_a_file_of_events_has_no_frames(tmp_path):
    write(tmp_path / "e.aedat4", stream_of((5, 1, 2, 1), **DAVIS))
    for name, words in (("e", "0 streams of kind FRME"), ("none", "no file lies")):
        with pytest.raises(FileFormatError, match=words):
            read_frames(tmp_path / f"{name}.aedat4")
