"""Prophesee's RAW and DAT files: a recording decoded by another program, and words put together by the
published bit layout."""

import numpy as np
import pytest

from codesign.errors import FileFormatError
from codesign.events import read, write
from tests.event_streams import rows, stream_of

EVT3 = b"% evt 3.0\n% format EVT3;height=720;width=1280\n% geometry 1280x720\n% end\n"
EVT2 = b"% evt 2.0\n% geometry 640x480\n% end\n"
DAT = b"% Data file containing CD events\n% Version 2\n% Width 640\n% Height 480\n\x0c\x08"


def evt3(*words):
    """Words of (type, 12 bits)."""
    return EVT3 + np.array([kind << 12 | load for kind, load in words], "<u2").tobytes()


def evt2_event(t_us, x, y, p):
    return p << 28 | (t_us & 63) << 22 | x << 11 | y


def evt2(*words):
    return EVT2 + np.array(words, "<u4").tobytes()


def dat(*events):
    return DAT + np.array([(t_us, p << 28 | y << 14 | x) for t_us, x, y, p in events], "<u4").tobytes()


def words_of(path, dtype):
    return np.frombuffer(path.read_bytes().split(b"% end\n")[1], dtype).tolist()


def test_a_recording_decodes_as_another_program_decodes_it(shared):
    events = read(shared("data/prophesee_gen3_vga/faery_evt2.raw"))
    truth = np.load(
        shared("data/prophesee_gen3_vga/faery_evt2.npz")
    )  # in file order, its first time subtracted
    order = np.lexsort((truth["p"], truth["x"], truth["y"], truth["t"]))
    assert (events.height_px, events.width_px) == (480, 640)
    for found, wanted in (
        (events.t_us - events.t_us[0], truth["t"]),
        (events.x, truth["x"]),
        (events.y, truth["y"]),
        (events.p > 0, truth["p"]),
    ):
        assert np.array_equal(found.numpy(), wanted[order])
    assert int(events.t_us[0]) == 913_716_224  # the clock of the camera stays


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
            (0xA, 0x101), (0xE, 0x14), (0xF, 1), (0x7, 2),  # trigger, counter and continuations: no events
            (0x6, 9), (0x5, 1),  # the base has moved on to 132
        )
    )  # fmt: skip
    t_us = 2 * 4096 + 5
    truth = [(t_us, x, 7, 1) for x in (30, 100, 111, 113, 124, 131)] + [
        (t_us, 31, 7, -1),
        (3 * 4096, 32, 7, -1),
        (3 * 4096 + 9, 132, 7, 1),
    ]
    events = read(path)
    assert rows(events) == sorted(truth, key=lambda row: (row[0], row[2], row[1], row[3]))
    assert (events.height_px, events.width_px) == (720, 1280)


def test_clocks_start_again_and_go_on(tmp_path):
    path = tmp_path / "e.raw"
    path.write_bytes(
        evt3(
            (0x0, 1),
            (0x8, 0xFFF),
            (0x6, 0xFFF),
            (0x2, 5),
            (0x8, 0),
            (0x6, 2),
            (0x2, 6),
            (0x8, 0xFFF),
            (0x8, 0),
            (0x2, 7),
        )
    )
    assert rows(read(path)) == [(2**24 - 1, 5, 1, -1), (2**24 + 2, 6, 1, -1), (2**25, 7, 1, -1)]
    high = 0x8 << 28
    path.write_bytes(evt2(high | 2**28 - 1, evt2_event(63, 5, 1, 0), high, evt2_event(2, 6, 1, 1)))
    assert rows(read(path)) == [(2**34 - 1, 5, 1, -1), (2**34 + 2, 6, 1, 1)]
    path = tmp_path / "e.dat"
    path.write_bytes(dat((2**32 - 1, 5, 1, 0), (2, 6, 1, 1)))
    assert rows(read(path)) == [(2**32 - 1, 5, 1, -1), (2**32 + 2, 6, 1, 1)]


def test_what_is_written_is_what_the_layout_says(tmp_path):
    stream = stream_of((4096 * 3 + 70, 9, 4, 1), (4096 * 3 + 70, 10, 4, -1))
    write(tmp_path / "e.raw", stream)
    assert words_of(tmp_path / "e.raw", "<u2") == [
        0x8000,
        0x8003,
        0x6046,
        0x0004,
        0x2809,
        0x200A,
    ]
    write(tmp_path / "e.raw", stream, evt=2)
    words = [
        0x80000000,
        0x80000000 | (4096 * 3 + 70) // 64,
        *(evt2_event(4096 * 3 + 70, x, 4, p) for x, p in ((9, 1), (10, 0))),
    ]
    assert words_of(tmp_path / "e.raw", "<u4") == words
    write(tmp_path / "e.dat", stream)
    assert (
        (tmp_path / "e.dat")
        .read_bytes()
        .endswith(dat((4096 * 3 + 70, 9, 4, 1), (4096 * 3 + 70, 10, 4, 0))[len(DAT) - 2 :])
    )


@pytest.mark.parametrize(
    "times_us", [[0, 2**24 - 1, 2**24], [4094 * 4096, 2**26 + 5], [2**32 + 9], [2**23, 2**36]]
)
def test_every_way_of_counting_loops_of_evt3_gives_the_written_times(tmp_path, times_us):
    """The strictest reader, faery, counts a loop only from 4095 to 0 and passes over jumps of 4094 or more;
    Prophesee's takes the first time-high word, less one, off all times."""
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
    "line",
    [b"% t0 1643243628737093\n", b"% T0 1643243628737093\n", b"% codesign_t_offset_us 1643243628737093\n"],
)
def test_the_start_time_of_the_header_is_added(tmp_path, line):
    start_us = 1_643_243_628_737_093
    for name, header, content in (
        ("e.dat", DAT[:-2], dat((7, 5, 1, 0))),
        ("e.raw", EVT2.removesuffix(b"% end\n"), evt2(0x80000000, evt2_event(7, 5, 1, 0))),
        ("e.raw", EVT3.removesuffix(b"% end\n"), evt3((0x8, 0), (0x6, 7), (0x0, 1), (0x2, 5))),
    ):
        (tmp_path / name).write_bytes(header + line + content.removeprefix(header))
        assert rows(read(tmp_path / name)) == [(start_us + 7, 5, 1, -1)]


def test_a_start_time_is_written_where_faery_looks_for_it(tmp_path):
    stream = stream_of((2**50 + 7, 5, 1, -1))
    write(tmp_path / "e.dat", stream, t0_us=2**50)
    assert (tmp_path / "e.dat").read_bytes() == DAT[:-2] + b"% T0 1125899906842624\n\x0c\x08" + dat(
        (7, 5, 1, 0)
    )[len(DAT) :]
    write(tmp_path / "e.raw", stream, t0_us=2**50)
    assert b"% t0 1125899906842624\n% end\n" in (tmp_path / "e.raw").read_bytes()
    assert words_of(tmp_path / "e.raw", "<u2") == [0x8000, 0x6007, 0x0001, 0x2005]
    write(tmp_path / "e.raw", stream_of((7, 5, 1, -1)))
    assert b"t0" not in (tmp_path / "e.raw").read_bytes()


def test_a_dat_header_with_nothing_behind_it_is_an_empty_stream(tmp_path):
    path = tmp_path / "e.dat"
    for content in (DAT[:-2], DAT, b"% Version 2\n% Width 640\n% Height 480\n"):
        path.write_bytes(content)
        events = read(path)
        assert (rows(events), events.height_px, events.width_px) == ([], 480, 640)


def test_events_that_come_before_their_time_or_row_are_left_out_with_a_warning(tmp_path):
    path = tmp_path / "e.raw"
    path.write_bytes(
        evt3((0x0, 1), (0x2, 4), (0x5, 0b11), (0x8, 0), (0x2, 5))
    )  # one event without a time, two without a column base
    with pytest.warns(UserWarning, match="3 events before"):
        assert rows(read(path)) == [(0, 5, 1, -1)]
    path.write_bytes(evt2(evt2_event(1, 2, 3, 1), 0x80000000, evt2_event(1, 2, 3, 1)))
    with pytest.warns(UserWarning, match="1 events before"):
        assert rows(read(path)) == [(1, 2, 3, 1)]


def test_small_disorder_is_sorted_and_more_is_refused(tmp_path):
    path = tmp_path / "e.dat"
    path.write_bytes(dat((5000, 1, 1, 1), (4000, 2, 1, 1), (5000, 0, 1, 1)))
    assert rows(read(path)) == [(4000, 2, 1, 1), (5000, 0, 1, 1), (5000, 1, 1, 1)]
    path.write_bytes(dat((5000, 1, 1, 1), (3999, 2, 1, 1)))
    with pytest.raises(FileFormatError, match="event 1: it lies 1001 us before"):
        read(path)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("e.raw", b"", "encoding nowhere"),
        ("e.raw", b"% evt 2.1\n% end\n", "2.1"),
        ("e.raw", b"% evt 3.0\n% format EVT2\n% end\n", r"2\.0.*3\.0"),
        ("e.raw", b"% evt 3.0\n% endianness big\n% end\n", "big"),
        ("e.raw", b"% evt 3.0\n% geometry 640\n% end\n", "WIDTHxHEIGHT"),
        ("e.raw", b"% evt 3.0\n% format EVT3;height=4;width=5\n% geometry 4x5\n% end\n", "two sensor sizes"),
        ("e.raw", b"% evt 3.0\n% geometry 9000x5\n% end\n", "from 1 to 2048"),
        ("e.raw", b"% evt 3.0\n% evt 2.0\n% end\n", "twice"),
        ("e.raw", b"% evt \xff\n% end\n", "ASCII"),
        ("e.raw", b"% evt 3.0", "does not end"),
        ("e.raw", b"% evt 3.0\n% end\n", "no event"),
        ("e.raw", EVT3 + b"\x00", "amid a word"),
        ("e.raw", evt3((0x8, 0), (0x9, 0)), "word 1 has type 0x9"),
        ("e.raw", evt2(0x80000000, 0x30000000), "word 1 has type 0x3"),
        ("e.raw", evt3((0x8, 0), (0x0, 720), (0x2, 5)), "y = 720.*720 pixels"),
        (
            "e.raw",
            b"% evt 3.0\n% end\n" + evt3((0x8, 0), (0x0, 1), (0x3, 2047), (0x5, 2))[len(EVT3) :],
            "column 2048",
        ),
        (
            "e.raw",
            evt3((0x8, 2048), (0x0, 1), (0x2, 5), (0x8, 0), (0x2, 5)),
            "before an earlier",
        ),  # one wrong bit is no new loop
        ("e.dat", DAT.replace(b"Version 2", b"Version 1"), "version '1'"),
        ("e.dat", DAT[:-2] + b"\x0e\x08", "0e 08"),
        ("e.dat", DAT[:-1], "type and size are 0c"),
        ("e.dat", b"", "version 'none'"),
        ("e.dat", b"% t0 -5\n" + DAT, r"start time \(t0\) as '-5'"),
        ("e.raw", b"% t0 1e6\n" + EVT3, r"start time \(t0\) as '1e6'"),
        ("e.raw", b"% t0 5\n% T0 6\n" + EVT3, "5 and as 6"),
        ("e.dat", DAT + b"1234567", "amid an event"),
        ("e.dat", dat((1, 2, 3, 2)), "polarity is 2"),
        ("e.dat", dat((1, 640, 3, 1)), "x = 640"),
        ("e.dat", DAT.replace(b"Width 640", b"Width -6"), "Width as '-6'"),
    ],
)
def test_malformed_files_are_refused(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=words):
        read(path)


def test_sizes_come_from_the_header_the_caller_or_the_events(tmp_path):
    path = tmp_path / "e.raw"
    path.write_bytes(b"% evt 2.0\n% end\n" + evt2(0x80000000, evt2_event(1, 9, 5, 1))[len(EVT2) :])
    assert (read(path).height_px, read(path).width_px) == (6, 10)
    events = read(path, height_px=480, width_px=640)
    assert (events.height_px, events.width_px) == (480, 640)
    with pytest.raises(FileFormatError, match=r"x = 9.*9 pixels"):
        read(path, width_px=9)
    path.write_bytes(evt2(0x80000000, evt2_event(1, 9, 5, 1)))
    with pytest.raises(FileFormatError, match="width_px 640 by the file, but 641"):
        read(path, width_px=641)


@pytest.mark.parametrize(
    ("name", "stream", "evt", "words"),
    [
        ("e.raw", stream_of((0, 1, 1, 1), width_px=2049), 3, "at most 2048 x 2048"),
        ("e.raw", stream_of((-1, 1, 1, 1)), 2, "times span -1"),
        ("e.raw", stream_of((0, 1, 1, 1), (2**44, 1, 1, 1)), 3, "0 to 17592186044415; pass .* t0_us"),
        ("e.raw", stream_of((2**34, 1, 1, 1)), 2, "0 to 17179869183; pass .* t0_us"),
        ("e.raw", stream_of((0, 1, 1, 1)), 4, "evt=4"),
        ("e.dat", stream_of((0, 1, 1, 1)), 3, "evt=3"),
        ("e.dat", stream_of((0, 1, 1, 1), (2**32, 1, 1, 1)), None, "0 to 4294967295; pass .* t0_us"),
        ("e.dat", stream_of((0, 1, 1, 1), width_px=2**14 + 1), None, "16384 x 16384"),
    ],
)
def test_streams_a_format_cannot_hold_are_refused(tmp_path, name, stream, evt, words):
    with pytest.raises(FileFormatError, match=words):
        write(tmp_path / name, stream, evt=evt)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "t0_us", "words"),
    [
        ("e.raw", 2**40 + 1, "times less t0_us 1099511627777 span -1 to 0"),
        ("e.dat", -1, "t0_us is -1"),
        ("e.dat", 1.0, "t0_us is 1.0"),
        ("e.dat", 2**63, "t0_us is 9223372036854775808"),
        ("e.npz", 5, r"t0_us=5 was given .* \.dat and \.raw files alone"),
    ],
)
def test_start_times_that_do_not_fit_are_refused(tmp_path, name, t0_us, words):
    with pytest.raises(FileFormatError, match=words):
        write(tmp_path / name, stream_of((2**40, 1, 1, 1), (2**40 + 1, 1, 1, 1)), t0_us=t0_us)
    assert not list(tmp_path.iterdir())
