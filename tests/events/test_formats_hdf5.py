"""DSEC's and v2e's HDF5 layouts, put together with h5py alone; and the index of milliseconds against its
definition."""

import h5py
import hdf5plugin
import numpy as np
import pytest
import torch

from codesign.errors import FileFormatError
from codesign.events import read, write
from codesign.events.formats import hdf5
from codesign.events.stream import ordered
from tests.event_streams import same

EPOCH_US = 1_643_243_628_737_093


def example():
    """t, x, y, p (1 or 0) of 3000 events within 40 ms, sorted."""
    dice = np.random.default_rng(0)
    columns = (
        np.sort(dice.integers(0, 40_000, 3000)),
        dice.integers(0, 640, 3000),
        dice.integers(0, 480, 3000),
        dice.integers(0, 2, 3000),
    )
    return columns


def stream_of(t_us, x, y, p, height_px=480, width_px=640):
    t_us, x, y, p = (torch.tensor(np.asarray(values), dtype=torch.int64) for values in (t_us, x, y, p))
    return ordered(t_us, x, y, 2 * p - 1, height_px, width_px)


def dsec(path, change=None, **packing):
    """A file as DSEC publishes them; ``change`` replaces datasets (None removes one)."""
    t, x, y, p = example()
    arrays = {
        "events/t": t.astype(np.uint32),
        "events/x": x.astype(np.uint16),
        "events/y": y.astype(np.uint16),
        "events/p": p.astype(np.uint8),
        "t_offset": np.int64(EPOCH_US),
        "ms_to_idx": np.array([np.count_nonzero(t < 1000 * k) for k in range(41)], np.uint64),
    } | (change or {})
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            if values is not None:
                file.create_dataset(name, data=values, **(packing if np.ndim(values) else {}))
    return path


@pytest.mark.parametrize(
    "packing",
    [
        dict(hdf5plugin.Blosc(cname="zstd", clevel=1)),
        {"compression": "gzip", "shuffle": True, "fletcher32": True},
        {"chunks": True},
        {},
    ],
)
def test_published_files_are_read(tmp_path, packing):
    events = read(dsec(tmp_path / "e.h5", **packing), height_px=480, width_px=640)
    truth = stream_of(example()[0] + EPOCH_US, *example()[1:])
    assert same(events, truth)


def test_what_is_written_follows_the_layout(tmp_path):
    t, x, y, p = example()
    write(tmp_path / "e.h5", stream_of(t + EPOCH_US, x, y, p))
    with h5py.File(tmp_path / "e.h5") as file:
        names = ("events/t", "events/x", "events/y", "events/p", "t_offset", "ms_to_idx")
        since_us, columns, rows, on, offset_us, index = (np.asarray(file[name]) for name in names)
    assert [values.dtype for values in (since_us, columns, rows, on, offset_us, index)] == [
        np.uint32,
        np.uint16,
        np.uint16,
        np.uint8,
        np.int64,
        np.uint64,
    ]
    assert int(offset_us) == EPOCH_US + t[0]
    assert np.array_equal(since_us, t - t[0])
    assert index.tolist() == [np.count_nonzero(since_us < 1000 * k) for k in range(len(index))]
    assert index[-1] == len(t)  # the last millisecond is closed
    assert set(on.tolist()) == {0, 1}
    back = read(tmp_path / "e.h5")
    assert (back.height_px, back.width_px) == (480, 640)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"events/p": None}, "events/p is absent"),
        ({"t_offset": None}, "t_offset is absent"),
        ({"t_offset": np.int64(2**62)}, "61 bits"),
        ({"t_offset": np.zeros(2, int)}, "one whole number"),
        ({"events/x": np.zeros(5, np.uint16)}, r"\[5\], \[3000\] is needed"),
        ({"events/x": np.zeros(3000)}, "whole numbers"),
        ({"events/p": np.full(3000, 2, np.uint8)}, "event 0: its polarity is 2"),
        ({"events/t": example()[0][::-1].astype(np.uint32), "ms_to_idx": None}, "before an earlier"),
        ({"ms_to_idx": np.arange(41)}, "first event of each millisecond"),
        ({"ms_to_idx": np.array([0, 2**40])}, "no index of its 3000 events"),
    ],
)
def test_malformed_files_are_refused(tmp_path, change, words):
    with pytest.raises(FileFormatError, match=words):
        read(dsec(tmp_path / "e.h5", change))


def test_files_that_point_elsewhere_are_refused(tmp_path):
    dsec(tmp_path / "other.h5")
    with h5py.File(tmp_path / "e.h5", "w") as file:
        file["events"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "events")
    with pytest.raises(FileFormatError, match="link to another"):
        read(tmp_path / "e.h5")
    dsec(tmp_path / "e.h5", {"events/x": None})
    with h5py.File(tmp_path / "e.h5", "a") as file:
        layout = h5py.VirtualLayout((3000,), np.uint16)
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "events/x", (3000,))
        file.create_virtual_dataset("events/x", layout)
    with pytest.raises(FileFormatError, match="other files"):
        read(tmp_path / "e.h5")
    with pytest.raises(FileFormatError, match="filters"):
        read(dsec(tmp_path / "e.h5", compression="lzf"))
    (tmp_path / "e.h5").write_bytes(b"not HDF5")
    with pytest.raises(FileFormatError, match="no HDF5 file"):
        read(tmp_path / "e.h5")


def test_streams_longer_than_32_bits_of_microseconds_are_refused(tmp_path):
    with pytest.raises(FileFormatError, match="32 bits"):
        write(tmp_path / "e.h5", stream_of([0, 2**32], [1, 1], [1, 1], [1, 1]))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("indexed", [True, False])
def test_a_window_is_the_events_between_two_times(tmp_path, monkeypatch, indexed):
    monkeypatch.setattr(hdf5, "FINE", 16)  # so that bisection has to find its way
    t, x, y, p = example()
    late = t.copy()
    late[1::7] -= 400  # a little disorder, which an index of milliseconds cannot hold
    times = t if indexed else np.maximum(late, 0)
    change = {} if indexed else {"events/t": times.astype(np.uint32), "ms_to_idx": None}
    events = hdf5.Hdf5Events(dsec(tmp_path / "e.h5", change))
    for t0_us, t1_us in ((0, 0), (11_999, 12_000), (7_300, 21_450), (39_000, 60_000), (-50, 40_000)):
        inside = (times >= t0_us) & (times <= t1_us)
        truth = stream_of(times[inside] + EPOCH_US, x[inside], y[inside], p[inside])
        found = events.window(t0_us + EPOCH_US, t1_us + EPOCH_US, (480, 640))
        assert same(found, truth)
