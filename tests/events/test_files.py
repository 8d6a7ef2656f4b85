"""Event files: exact round trips, and a clear refusal of everything else."""

import io

import h5py
import numpy as np
import pytest
import torch

from codesign.errors import FileFormatError
from codesign.events import read, write
from codesign.events.formats import text
from codesign.events.stream import ordered
from codesign.flow.sources import read_recording
from tests.event_streams import FIELDS, random_stream

EVENTS = [[7, 1_400_000, 2_000_000], [3, 0, 9], [0, 5, 2], [-1, 1, 1]]  # t_us, x, y, p
T_US = np.array(EVENTS[0])
ON = np.array([0, 1, 1])


def in_arrays(**values):
    buffer = io.BytesIO()
    np.savez(buffer, **values)
    return buffer.getvalue()


def in_rows(*columns):
    buffer = io.BytesIO()
    np.save(buffer, np.stack(columns, 1))
    return buffer.getvalue()


def in_hdf5(**datasets):
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, values in datasets.items():
            file[name] = values
    return buffer.getvalue()


SAME = {
    "header.csv": b"t,x,y,p\n7,3,0,-1\n1400000,0,5,1\n2000000,9,2,1\n",
    "other_programs.csv": b"t,x,y,p\r\n7, 3,0,0\r\n\r\n1400000,0,5,1\r\n2000000,9,2,1",
    "headerless.csv": b"7,3,0,0\n1400000,0,5,1\n2000000,9,2,1\n",
    "seconds.csv": b"0.000007,3,0,0\n1.4,0,5,1\n2.0,9,2,1\n",
    "named_unit.csv": b"x,y,p,t_ns\n3,0,0,7000\n0,5,1,1400000000\n9,2,1,2000000000\n",
    "ecd.txt": b"0.000007000 3 0 0\n1.400000000 0 5 1\n2.000000000 9 2 1\n",
    "with_size.txt": b"# a comment\n10 6\n0.000007 3 0 0\n1.4 0 5 1\n2 9 2 1\n",
    "xytp.txt": b"3 0 7 -1\n0 5 1400000 1\n9 2 2000000 1\n",
    "xytp_seconds.csv": b"3,0,0.000007,0\n0,5,1.4,1\n9,2,2.0,1\n",
    "commented.csv": b"# made by hand\n#\n# p timestamp y x\n0 0.000007 0 3\n1 1.4 5 0\n1 2 2 9\n",
    "rows.npy": in_rows(T_US * 1e-6, *EVENTS[1:]),
    "xytp.npy": in_rows(*EVENTS[1:3], T_US, ON),
    "own.npz": in_arrays(t_us=T_US, x=EVENTS[1], y=EVENTS[2], p=EVENTS[3], height_px=6, width_px=10),
    "names.npz": in_arrays(ts=T_US * 1e-6, xs=EVENTS[1], ys=EVENTS[2], pol=ON > 0),
    "mvsec.hdf5": in_hdf5(
        **{
            "davis/left/events": np.stack([*EVENTS[1:3], T_US * 1e-6, EVENTS[3]], 1),
            "davis/left/image_raw": np.zeros((1, 6, 10), np.uint8),
        }
    ),
    "v2e.h5": in_hdf5(events=np.stack([T_US, *EVENTS[1:3], ON], 1).astype(np.uint32)),
    "dsec.hdf5": in_hdf5(
        **{
            f"events/{name}": values
            for name, values in zip("txyp", (T_US - 5, *EVENTS[1:3], ON), strict=True)
        },
        t_offset=5,
    ),
}


@pytest.mark.parametrize("name", SAME)
def test_one_file_gives_the_same_numbers_through_both_doors(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(SAME[name])
    stream = read(path)
    held = read_recording(path)
    assert [getattr(stream, field).tolist() for field in FIELDS] == EVENTS
    assert [held.t_us.tolist(), held.x.tolist(), held.y.tolist(), (2 * held.on - 1).tolist()] == EVENTS
    assert (stream.height_px, stream.width_px) == (6, 10)  # told, or the smallest that holds them
    told = name in ("with_size.txt", "own.npz", "mvsec.hdf5")
    assert (held.height_px, held.width_px) == ((6, 10) if told else (180, 240))
    window = held.window(1_400_000, 2_000_000)
    assert [getattr(window, field).tolist() for field in FIELDS] == [column[1:] for column in EVENTS]


def test_csv_is_written_as_the_text_it_says(tmp_path):
    path = tmp_path / "e.csv"
    t_us, x, y, p = (torch.tensor(column) for column in ([7, 2**60 + 1], [3, 0], [0, 5], [-1, 1]))
    write(path, ordered(t_us, x, y, p, 9, 9))
    assert path.read_text() == f"t,x,y,p\n7,3,0,-1\n{2**60 + 1},0,5,1\n"
    assert read(path).t_us.tolist() == [7, 2**60 + 1]  # whole numbers stay exact
    with pytest.raises(FileFormatError, match="CSV holds"):
        write(path, ordered(t_us + 2**61, x, y, p, 9, 9))


def test_events_a_little_late_are_put_in_order(tmp_path):
    path = tmp_path / "e.txt"
    path.write_text("0.100000 1 1 1\n0.100500 2 2 1\n0.100200 3 3 0\n0.101000 4 4 0\n")
    assert read(path).x.tolist() == [1, 3, 2, 4]


@pytest.mark.parametrize(
    ("text", "options", "times_us"),
    [
        ("1 2 3 1\n", {"columns": "txyp"}, [1]),
        ("1 2 3 1\n", {"columns": "xytp"}, [3]),
        ("1 2 3 1\n2 3 4 1\n", {"columns": "xytp", "time_unit": "ms"}, [3000, 4000]),
        ("2 9 3 1\n5 9 1 1\n", {}, [2, 5]),
        ("2 9 3 1\n1 9 3 1\n", {}, [3, 3]),
        ("1 1 5 2\n", {"columns": "pxty"}, [5]),
    ],
)
def test_the_order_of_columns_is_told_or_evident(text, options, times_us, tmp_path):
    path = tmp_path / "e.txt"
    path.write_text(text)
    assert read(path, **options).t_us.tolist() == times_us


LINES = "".join(f"0.2{k:03d} 1 2 1\n" for k in range(299))


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("", "holds no event"),
        ("# nothing\n", "holds no event"),
        ("t,x,y,p\n", "holds no event"),
        ("a b c\n", "line 1"),
        ("t,x,y\n1,2,3\n", "line 1.*header"),
        ("µ,2,3,1\n" * 9, "line 1"),
        ("1,2,3,1\n", "give columns='txyp' or"),
        ("1,2,3,1\n2,5,6,1\n", "give columns='txyp' or"),
        ("5,2,3,1\n4,2,1,1\n", "give columns='txyp' or"),
        ("t,x,y,p\n1,2,3,1\n2,2,3\n", "line 3"),
        ("t,x,y,p\n1,2,3,1,4\n2,2,3\n", "line 2"),
        ("t,x,y,p\n1,2,nan,1\n", "line 2"),
        ("t,x,y,p\n1_0,2,3,1\n", "line 2"),
        ("t,x,y,p\n1,2,3,1x\n", "line 2.*four finite"),
        ("t,x,y,p\n1,2,3,0.5\n", "line 2.*polarity"),
        ("t,x,y,p\n1,2,3,1\n9999999999999999999,2,3,1\n", "line 3.*61 bits"),
        ("t,x,y,p\n5000,2,3,1\n3999,2,3,1\n", "line 3.*1001 us before an earlier"),
        ("t,x,y,p\n5,-2,3,1\n", "line 2.*x = -2"),
        ("t,x,y,p\n5,2,3,2\n", "line 2.*polarity is 2"),
        ("t,x,y,p\n5,2,3,-1\n5,2,3,0\n", "line 3.*polarity is 0; 1 for ON, -1, as"),
        ("t,x,y,p\n1,2,3,1\x00\n", "line 2"),
        (bytes(range(256)).decode("latin-1") * 90, "line"),
        (LINES + "0.3 1 2\n", "line 300.*four"),
        (LINES + "0.3 1 2 1 9\n0.3 1 2 1\n", "line 300.*four"),
        (LINES + "0.3 1 two 1\n", "line 300.*four"),
        (LINES + "nan 1 2 1\n", "line 300.*four"),
        (LINES + "0.1 1 2 1\n", "line 300.*before an earlier"),
        (LINES + "\n0.3 1.5 2 1\n", "line 301.*whole numbers"),  # empty lines count as lines
        (LINES + "0.3 1 2 7\n", "line 300.*polarity"),
        (LINES + "1e40 1 2 1\n", "line 300.*61 bits"),
    ],
)
def test_malformed_text_is_refused_with_its_line(tmp_path, monkeypatch, body, words):
    path = tmp_path / "e.csv"
    path.write_bytes(body.encode())
    for chunk in (2**23, 640):
        monkeypatch.setattr(text, "CHUNK_BYTES", chunk)
        with pytest.raises(FileFormatError, match=words):
            read(path)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("ecd.txt", {"width_px": 9}, "line 3.*x = 9; the sensor has 9 pixels there by the options"),
        ("ecd.txt", {"height_px": 5}, "line 2.*y = 5"),
        ("mvsec.hdf5", {"width_px": 11}, "width_px 10 by its frames, but 11"),
        ("ecd.txt", {"columns": "abcd"}, "four letters"),
        ("ecd.txt", {"columns": 4}, "four letters"),
        ("ecd.txt", {"time_unit": "h"}, "time unit 'h'"),
        ("e.raw", {"columns": "xytp"}, "one order of columns"),
    ],
)
def test_options_that_do_not_fit_are_refused(name, options, words, tmp_path):
    (tmp_path / name).write_bytes(SAME.get(name, b""))
    with pytest.raises(FileFormatError, match=words):
        read(tmp_path / name, **options)


def test_recordings_of_cameras_are_the_same_through_both_doors(shared):
    for name in ("data/davis346_newton_cradle/demo-01.npz", "data/prophesee_gen3_vga/faery_evt2.npz"):
        with np.load(shared(name)) as file:
            t_us, x, y, p = (file[key].astype(np.int64) for key in "txyp")
        stream, held = read(shared(name)), read_recording(shared(name))
        for found, true in zip((held.t_us, held.x, held.y, held.on), (t_us, x, y, p > 0), strict=True):
            assert np.array_equal(found, true)
        assert np.array_equal(stream.t_us.numpy(), t_us)
        assert int((stream.x * stream.p).sum()) == int((x * (2 * (p > 0) - 1)).sum())


def test_npz_of_something_else_is_refused(tmp_path):
    path = tmp_path / "e.npz"
    good = {
        "t_us": np.arange(3),
        "x": np.zeros(3, int),
        "y": np.zeros(3, int),
        "p": np.ones(3, int),
        "height_px": np.array(2),
        "width_px": np.array(2),
    }
    for change, words in [
        ({"t_us": None}, "t_us"),
        ({"t_us": np.arange(3)[::-1] * 1001}, "event 1: .*1001 us before"),
        ({"t_us": np.full(3, 2**63 + 5, np.uint64)}, "61 bits"),
        ({"x": np.zeros(2, int)}, "equal length"),
        ({"x": np.full(3, 2)}, "x = 2; the sensor has 2"),
        ({"p": np.full(3, 2)}, "polarity"),
        ({"t_us": np.array([None] * 3)}, "t_us holds object"),
        ({"height_px": np.array([2])}, "height_px"),
    ]:
        np.savez(path, **{name: values for name, values in (good | change).items() if values is not None})
        with pytest.raises(FileFormatError, match=words):
            read(path)
    np.savez(path, **good)
    with pytest.raises(FileFormatError, match="width_px 2 by the file, but 3"):
        read(path, width_px=3)


def test_unknown_extensions_and_missing_places_are_refused(tmp_path):
    stream = random_stream(3, 260, 346, 100)
    for name in ("e.log", "e"):
        with pytest.raises(FileFormatError, match=r"\.csv, \.dat, \.h5, \.hdf5, \.npy, \.npz, \.raw, \.txt"):
            read(tmp_path / name)
        with pytest.raises(FileFormatError, match=r"\.csv, \.dat, \.h5, \.hdf5, \.npz, \.raw"):
            write(tmp_path / name, stream)
    with pytest.raises(FileFormatError, match="no file lies at"):
        read(tmp_path / "none.csv")
    with pytest.raises(FileFormatError, match="folder"):
        write(tmp_path / "none" / "e.csv", stream)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_earlier_file(tmp_path):
    path = tmp_path / "e.dat"
    event = [torch.tensor([value]) for value in (7, 0, 0, 1)]
    write(path, ordered(*event, 260, 346))
    before = path.read_bytes()
    with pytest.raises(FileFormatError, match="times span 4294967296"):
        write(path, ordered(event[0] + 2**32 - 7, *event[1:], 260, 346))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
