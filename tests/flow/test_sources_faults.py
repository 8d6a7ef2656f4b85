"""Recordings with faults: each is named, left out only where that was asked for, and counted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from codesign.errors import DomainError, FileFormatError
from codesign.flow.files import write_flow
from codesign.flow.sources import SKIPPABLE, PacketOptions, read_packets, read_text_events
from codesign.flow.sources.camera import Calibration, read_calibration
from codesign.flow.sources.packet import across, gaps
from tests.recording_case import DAVIS, ETH_CALIBRATION, eth_text, made

WINDOWS = PacketOptions(window_s=0.02, start_s=0.0, size_px=DAVIS)


def recording(folder, columns=None, calibration=ETH_CALIBRATION):
    folder.mkdir(parents=True, exist_ok=True)
    columns = made(4000, start_s=100.0, duration_s=0.2) if columns is None else columns
    (folder / "events.txt").write_text(eth_text(columns))
    (folder / "calib.txt").write_text(calibration)
    return columns


def gyroscope(folder, first_s, last_s, rate=(0.2, -0.3, 0.5)):
    t_s = np.arange(round(first_s * 1000), round(last_s * 1000) + 1) / 1000
    rows = np.column_stack([t_s, np.zeros((len(t_s), 3)), np.tile(rate, (len(t_s), 1))])
    np.savetxt(folder / "imu.txt", rows, fmt="%.9f")


def poses(folder, speed_m_s, rate_rad_s):
    t_s = 99.9 + np.arange(81) / 200
    turns = Rotation.from_rotvec(np.outer(t_s - t_s[0], rate_rad_s)).as_quat()
    rows = np.column_stack([t_s, np.outer(t_s, speed_m_s), turns])
    np.savetxt(folder / "groundtruth.txt", rows, fmt="%.9f")


def test_text_is_read_before_arrays_of_the_same_name_and_that_is_said(tmp_path):
    columns = recording(tmp_path / "a")
    np.save(tmp_path / "a" / "events.npy", np.zeros((3, 4)))  # somebody's array: no events at all
    (packet, *_) = read_packets(tmp_path / "a", options=WINDOWS)
    assert len(packet.stream) == int((columns[0] <= columns[0][0] + 20_000).sum())
    assert any("events from events.txt; events.npy beside it not read" in note for note in packet.notes)


def test_a_recording_in_two_forms_is_one(tmp_path):
    columns = recording(tmp_path / "a")
    (tmp_path / "a" / "events.txt").rename(tmp_path / "a" / "walk-01.txt")
    np.save(tmp_path / "a" / "walk-01.npy", np.zeros((3, 4)))
    packets = read_packets(tmp_path / "a", options=WINDOWS)
    assert {packet.name.split()[0] for packet in packets} == {"walk-01.txt"}
    assert len(packets[0].stream) == int((columns[0] <= columns[0][0] + 20_000).sum())
    assert any("walk-01.npy beside it not read" in note for note in packets[0].notes)


def test_motion_recorded_later_than_the_events_tells_of_the_windows_it_covers(tmp_path):
    columns = recording(tmp_path / "a")
    start_s = columns[0][0] * 1e-6
    gyroscope(tmp_path / "a", start_s + 0.018, start_s + 1)
    packets = read_packets(tmp_path / "a", options=replace(WINDOWS, count=4))
    assert [packet.truth is not None for packet in packets] == [False, True, True, True]
    assert any("covers 100.018" in note and "not the window" in note for note in packets[0].notes)
    gyroscope(tmp_path / "a", start_s + 5, start_s + 6)
    with pytest.raises(FileFormatError, match=r"covers 105\..*are both on one clock"):
        read_packets(tmp_path / "a", options=WINDOWS)


@pytest.mark.parametrize("by", ["poses", "gyroscope"])
def test_the_flow_of_rotation_is_no_truth_of_a_slider(by, tmp_path):
    columns = recording(tmp_path / "a")
    poses(tmp_path / "a", (0.25, 0.0, 0.0), (0.0, 0.0, 0.0))
    if by == "gyroscope":
        gyroscope(tmp_path / "a", columns[0][0] * 1e-6 - 0.1, columns[0][0] * 1e-6 + 1, (0.0, 0.0, 0.0))
    (packet, *_) = read_packets(tmp_path / "a", options=WINDOWS)
    assert packet.rotation_only
    assert packet.translates
    # 5 mm in 20 ms, at 1 m: f x / z
    assert packet.neglected_px == pytest.approx((199.092366542 + 198.82882047) / 2 * 0.005, rel=1e-4)
    assert any("0.99 px of flow for a scene 1 m away" in note or "1.00 px" in note for note in packet.notes)


def test_a_camera_that_turns_and_hardly_moves_has_a_truth(tmp_path):
    recording(tmp_path / "a")
    poses(tmp_path / "a", (0.02, 0.0, 0.0), (0.0, 1.0, 0.0))  # 0.08 px of a scene 1 m away beside 4 px
    (packet, *_) = read_packets(tmp_path / "a", options=WINDOWS)
    assert packet.rotation_only
    assert not packet.translates


def test_flow_of_undistorted_pixels_is_carried_to_raw_ones(tmp_path):
    (tmp_path / "calib.txt").write_text(ETH_CALIBRATION)
    lens = read_calibration(tmp_path / "calib.txt")
    turn = Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix()
    pinhole = Calibration(lens.focal_px, lens.centre_px)
    raw, known = lens.raw_flow(*pinhole.rotation_flow(turn, *DAVIS))
    right, valid = lens.rotation_flow(turn, *DAVIS)
    both = known & valid
    assert (
        both.mean() > 0.75
    )  # barrel distortion: the corners of the raw picture lie beside the undistorted one
    # read between pixels, linearly: an eighth of the field's second derivative, (0.06 rad / 200 px)
    np.testing.assert_allclose(raw[:, both], right[:, both], rtol=0, atol=2e-4)
    recording(tmp_path / "a")
    write_flow(tmp_path / "flow.flo", torch.from_numpy(pinhole.rotation_flow(turn, *DAVIS)[0]))
    options = replace(WINDOWS, count=1, truth_interval_s=0.02)
    (doubted,) = read_packets(tmp_path / "a", tmp_path / "flow.flo", options)
    off = np.hypot(*(right - pinhole.rotation_flow(turn, *DAVIS)[0]))[both].mean()
    assert doubted.undistorted_px == pytest.approx(off, rel=1e-3)
    assert any("the camera has distortion" in note for note in doubted.notes)
    (carried,) = read_packets(
        tmp_path / "a", tmp_path / "flow.flo", replace(options, truth_pixels="undistorted")
    )
    assert carried.truth is not None
    np.testing.assert_allclose(carried.truth.flow_px[0].numpy()[:, both], right[:, both], rtol=0, atol=3e-4)
    assert carried.undistorted_px == 0


@pytest.mark.parametrize("kind", ["txt", "npy"])
def test_events_off_the_sensor_or_back_in_time(kind, tmp_path):
    t_us, x, y, on = (column.copy() for column in made(400, start_s=100.0, duration_s=0.05))
    x[50] = 240  # one beyond the last column
    y[60] = -1
    t_us[200] -= 20_000

    def write(columns):
        path = tmp_path / f"e.{kind}"
        if kind == "txt":
            path.write_text(eth_text(columns))
        else:
            np.save(path, np.column_stack([columns[0] * 1e-6, *columns[1:]]))
        return path

    path = write((t_us, x, y, on))
    place = "line 61|line 201" if kind == "txt" else "event 60|event 200"
    with pytest.raises(FileFormatError, match=place):
        read_packets(path, options=PacketOptions(size_px=DAVIS))
    skip = ("events_off_sensor", "events_back_in_time")
    (packet,) = read_packets(path, options=PacketOptions(size_px=DAVIS, skip=skip))
    assert packet.left_out == {"events_off_sensor": 2, "events_back_in_time": 1}
    kept = np.delete(np.arange(400), [50, 60, 200])
    assert sorted(packet.stream.t_us.tolist()) == t_us[kept].tolist()
    assert sorted(packet.stream.x.tolist()) == sorted(x[kept].tolist())
    with pytest.raises(
        FileFormatError, match=r"x = 240; the sensor has 240 pixels there .* leave such events out"
    ):
        read_packets(write((np.sort(t_us), x, np.abs(y), on)), options=PacketOptions(size_px=DAVIS))
    if kind == "txt":
        with pytest.raises(FileFormatError, match="no event that is on the sensor"):
            read_text_events(write((t_us, x + 250, y, on)), DAVIS, skip=skip)


def test_gaps_and_empty_windows(tmp_path):
    t_us, x, y, on = made(4000, start_s=100.0, duration_s=0.2)
    late = t_us > t_us[0] + 100_000
    t_us[late] += 85_000
    recording(tmp_path / "a", (t_us, x, y, on))
    ends = gaps(t_us)
    last = t_us[~late].max()
    assert ends.tolist() == [[last, t_us[late].min()]]
    whole = read_packets(tmp_path / "a", options=replace(WINDOWS, count=14))
    assert [packet.across_gap for packet in whole] == [5 <= k < 9 for k in range(14)]
    assert sum(not len(packet.stream) for packet in whole) == 4
    assert all(any("1 gap(s)" in note for note in packet.notes) for packet in whole)
    for fault in ("windows_without_events", "windows_across_gaps"):
        some = read_packets(tmp_path / "a", options=replace(WINDOWS, count=14, skip=(fault,)))
        assert [packet.name for packet in some] == [packet.name for packet in whole if len(packet.stream)]
        assert some[0].left_out == {fault: 4}
    assert across([(0, 10), (4, 8)], np.array([[0, 5]])).tolist() == [True, False]
    assert len(gaps(np.arange(0, 10**6, 50))) == 0


def test_windows_that_are_left_out_keep_the_flows_of_the_others(tmp_path):
    t_us, x, y, on = made(4000, start_s=100.0, duration_s=0.06)
    t_us = np.where(t_us > t_us[0] + 20_000, t_us + 20_000, t_us)
    recording(tmp_path / "a", (t_us, x, y, on))
    flows = [torch.full((2, *DAVIS), float(k)) for k in range(4)]
    np.save(tmp_path / "flow.npy", torch.stack(flows).numpy())
    options = replace(WINDOWS, truth_interval_s=0.02, skip=("windows_without_events",))
    packets = read_packets(tmp_path / "a", tmp_path / "flow.npy", options)
    found = [float(packet.truth.flow_px.mean()) for packet in packets if packet.truth is not None]
    assert found == [0.0, 2.0]  # the window from 20 to 40 ms holds no event; the last is not whole
    assert packets[0].left_out == {"windows_without_events": 1}


def test_faults_that_do_not_exist(tmp_path):
    recording(tmp_path / "a")
    for skip in (("all",), "windows_without_events", ["windows_without_events"], None):
        with pytest.raises(DomainError, match=SKIPPABLE[0]):
            read_packets(tmp_path / "a", options=replace(WINDOWS, skip=skip))
    with pytest.raises(DomainError, match="'raw' or 'undistorted'"):
        read_packets(tmp_path / "a", options=replace(WINDOWS, truth_pixels="ideal"))
    (tmp_path / "a" / "calib.txt").unlink()
    write_flow(tmp_path / "flow.flo", torch.zeros(2, *DAVIS))
    with pytest.raises(FileFormatError, match=r"undistorted pixels, and no calib\.txt"):
        read_packets(tmp_path / "a", tmp_path / "flow.flo", replace(WINDOWS, truth_pixels="undistorted"))
