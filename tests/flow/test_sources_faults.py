"""Recordings with faulty events and gaps: named, left out only where that was asked for, and
counted."""

from dataclasses import replace

import numpy as np
import pytest

from codesign.errors import FileFormatError
from codesign.flow.sources import PacketOptions, read_packets, read_recording
from codesign.flow.sources.packet import across, gaps
from tests.recording_case import DAVIS, eth_text, made, recording

SKIP = ("events_off_sensor", "events_back_in_time")


@pytest.mark.parametrize("kind", ["txt", "npy"])
def test_events_off_the_sensor_or_back_in_time(kind, tmp_path):
    t_us, x, y, on = made(400, start_s=100.0, duration_s=0.05)
    x[50] = 240  # one beyond the last column
    y[60] = -1
    t_us[200] -= 20_000
    path = tmp_path / f"e.{kind}"

    def save():
        if kind == "txt":
            path.write_text(eth_text((t_us, x, y, on)))
        else:
            np.save(path, np.column_stack([t_us * 1e-6, x, y, on]))

    save()
    place = "line 61|line 201" if kind == "txt" else "event 60|event 200"
    with pytest.raises(FileFormatError, match=place):
        read_packets(path, options=PacketOptions(size_px=DAVIS))
    (packet,) = read_packets(path, options=PacketOptions(size_px=DAVIS, skip=SKIP))
    assert packet.left_out == {"events_off_sensor": 2, "events_back_in_time": 1}
    # one that is off the sensor and a minute ahead makes no other late
    t_us[50] += 60_000_000
    save()
    (again,) = read_packets(path, options=PacketOptions(size_px=DAVIS, skip=SKIP))
    assert (again.left_out, len(again.stream)) == (packet.left_out, len(packet.stream))
    kept = np.delete(np.arange(400), [50, 60, 200])
    for found, column in ((packet.stream.t_us, t_us), (packet.stream.x, x)):
        assert sorted(found.tolist()) == sorted(column[kept].tolist())
    if kind == "txt":
        path.write_text(eth_text((t_us, x + 250, y, on)))
        with pytest.raises(FileFormatError, match="no event that is on the sensor"):
            read_recording(path, PacketOptions(size_px=DAVIS, skip=SKIP))


def test_gaps_and_empty_windows(tmp_path):
    t_us, x, y, on = made(4000, start_s=100.0, duration_s=0.2)
    late = t_us > t_us[0] + 100_000
    t_us[late] += 85_000
    recording(tmp_path / "a", (t_us, x, y, on))
    assert gaps(t_us).tolist() == [[t_us[~late].max(), t_us[late].min()]]
    options = PacketOptions(window_s=0.02, start_s=0.0, size_px=DAVIS, count=14)
    whole = read_packets(tmp_path / "a", options=options)
    assert [packet.across_gap for packet in whole] == [5 <= k < 9 for k in range(14)]
    assert sum(not len(packet.stream) for packet in whole) == 4
    assert all(any("1 gap(s)" in note for note in packet.notes) for packet in whole)
    empty, gap = "windows_without_events", "windows_across_gaps"
    for skip, counted in (((empty,), [4]), ((gap,), [4]), ((empty, gap), [4, 0])):
        some = read_packets(tmp_path / "a", options=replace(options, skip=skip))
        assert [packet.name for packet in some] == [
            packet.name for packet in whole if len(packet.stream)
        ]
        assert some[0].left_out == dict(zip(skip, counted, strict=True))
    assert across([(0, 10), (4, 8)], np.array([[0, 5]])).tolist() == [True, False]
    assert len(gaps(np.arange(0, 10**6, 50))) == 0
