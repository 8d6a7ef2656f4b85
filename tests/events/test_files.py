"""Event files: exact round trips, and a clear refusal of everything else."""

import random

import numpy as np
import pytest
import torch

from codesign.errors import FileFormatError
from codesign.events import read, write
from codesign.events.stream import ordered

FIELDS = ("t_us", "x", "y", "p")


def random_events(count=20_000, seed=0):
    generator = torch.Generator().manual_seed(seed)
    t_us = torch.randint(0, 2**50, (count,), generator=generator)  # beyond 2^32
    x, y, p = (torch.randint(0, high, (count,), generator=generator) for high in (346, 260, 2))
    return ordered(t_us, x, y, 2 * p - 1, 260, 346)


@pytest.mark.parametrize("extension", [".csv", ".npz", ".CSV", ".aedat4"])
@pytest.mark.parametrize("count", [20_000, 1, 0])
def test_round_trip_is_exact(tmp_path, extension, count):
    stream = random_events(count)
    path = tmp_path / f"events{extension}"
    write(path, stream)
    back = read(path, height_px=260, width_px=346)
    assert all(torch.equal(getattr(stream, name), getattr(back, name)) for name in FIELDS)
    assert (back.height_px, back.width_px) == (260, 346)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_csv_is_the_text_it_says(tmp_path):
    path = tmp_path / "e.csv"
    t_us, x, y, p = (torch.tensor(column) for column in ([7, 2**40], [3, 0], [0, 5], [-1, 1]))
    write(path, ordered(t_us, x, y, p, 9, 9))
    assert path.read_text() == f"t,x,y,p\n7,3,0,-1\n{2**40},0,5,1\n"
    assert (read(path).height_px, read(path).width_px) == (6, 4)  # the smallest sensor that holds them
    path.write_text(
        "t,x,y,p\r\n1, 2,3,0\r\n1,1,3,1"
    )  # other programs: CRLF, spaces, 0 for OFF, no last newline, ties in any order
    back = read(path)
    assert [getattr(back, name).tolist() for name in FIELDS] == [[1, 1], [1, 2], [3, 3], [1, -1]]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("", "line 1"),
        ("t,x,y\n1,2,3\n", "header"),
        ("1,2,3,1\n", "header"),
        ("t,x,y,p\n1,2,3,1\n2,2,3\n", "line 3"),
        ("t,x,y,p\n1,2,3,1,4\n2,2,3\n", "line 2"),
        ("t,x,y,p\n1,2,3,1\n\n2,2,3,1\n", "line 3"),
        ("t,x,y,p\n1.5,2,3,1\n", "line 2"),
        ("t,x,y,p\n1,2,nan,1\n", "line 2"),
        ("t,x,y,p\n1_0,2,3,1\n", "line 2"),
        ("t,x,y,p\n1,2,3,1\n9999999999999999999,2,3,1\n", "line 3.*64-bit"),
        ("t,x,y,p\n5,2,3,1\n4,2,3,1\n", "line 3.*time"),
        ("t,x,y,p\n5,-2,3,1\n", "line 2.*pixel"),
        ("t,x,y,p\n5,2,3,2\n", "line 2.*polarity"),
        ("t,x,y,p\n5,2,3,-1\n5,2,3,0\n", "line 3.*polarity"),
        ("t,x,y,p\n", "no event"),
        ("t,x,y,p\n1,2,3,1\x00\n", "line 2"),
        ("t,x,y,p\nµ,2,3,1\n", "not a text file"),
    ],
)
def test_malformed_csv_is_refused_with_its_line(tmp_path, body, words):
    path = tmp_path / "e.csv"
    path.write_bytes(body.encode())
    with pytest.raises(FileFormatError, match=words):
        read(path)


def test_csv_events_outside_a_given_sensor_are_refused(tmp_path):
    path = tmp_path / "e.csv"
    path.write_text("t,x,y,p\n1,2,3,1\n2,9,3,1\n")
    with pytest.raises(FileFormatError, match=r"line 3.*width, 9"):
        read(path, width_px=9)
    with pytest.raises(FileFormatError, match=r"line 2.*height, 3"):
        read(path, height_px=3)


def test_mutated_npz_never_gives_a_wrong_stream(tmp_path):
    path = tmp_path / "e.npz"
    stream = random_events(200)
    write(path, stream)
    whole = path.read_bytes()
    dice = random.Random(0)
    for trial in range(300):
        data = bytearray(whole)
        if trial % 3 == 0:
            data = data[: dice.randrange(len(data))]
        else:
            for _ in range(dice.randint(1, 4)):
                data[dice.randrange(len(data))] = dice.randrange(256)
        path.write_bytes(data)
        try:
            back = read(path)
        except FileFormatError:
            continue
        # what still reads passed the checksums: only bytes without meaning had changed
        assert all(torch.equal(getattr(stream, name), getattr(back, name)) for name in FIELDS)


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
        ({"t_us": np.arange(3.0)}, "whole numbers"),
        ({"t_us": np.arange(3)[::-1]}, "go back"),
        ({"t_us": np.full(3, 2**63 + 5, np.uint64)}, "64-bit"),
        ({"x": np.zeros(2, int)}, "equal length"),
        ({"x": np.full(3, 2)}, "x spans"),
        ({"p": np.zeros(3, int)}, "polarity"),
        ({"t_us": np.array([None] * 3)}, "t_us holds object"),
        ({"height_px": np.array([2])}, "height_px"),
    ]:
        np.savez(path, **{name: values for name, values in (good | change).items() if values is not None})
        with pytest.raises(FileFormatError, match=words):
            read(path)
    np.savez(path, **good)
    with pytest.raises(FileFormatError, match="width_px 2, but 3"):
        read(path, width_px=3)


def test_unknown_extensions_and_missing_places_are_refused(tmp_path):
    stream = random_events(3)
    for name in ("e.txt", "e"):
        with pytest.raises(FileFormatError, match=r"\.csv, \.dat, \.h5, \.npz, \.raw"):
            read(tmp_path / name)
        with pytest.raises(FileFormatError, match=r"\.csv, \.dat, \.h5, \.npz, \.raw"):
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
