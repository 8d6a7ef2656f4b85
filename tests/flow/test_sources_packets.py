"""Recordings cut into packets, each with its true flow, whichever way that is stored."""
# pyright: reportOptionalMemberAccess=false

import itertools
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from codesign.errors import CodesignError, DomainError
from codesign.flow.files import write_flow
from codesign.flow.sources import PacketOptions, read_packets
from codesign.flow.sources.camera import read_calibration
from tests import refusals
from tests.numbers import close
from tests.recording_case import DAVIS, eth_text, gyroscope, made, poses, recording

RATE = (0.2, -0.3, 0.5)


@pytest.fixture
def place(tmp_path):
    """Events of half a second in a folder."""
    recording(tmp_path / "a", made(4000, start_s=100.0, duration_s=0.5))
    return tmp_path / "a"


def field(k=0):
    """A flow that is a closed form of the pixel, exact in float32 and in 1/128 px."""
    y, x = torch.meshgrid(torch.arange(180.0), torch.arange(240.0), indexing="ij")
    return torch.stack([(x - 100) / 64 + k, (y - 80) / 32 - k])


def starts_ms(packets, t_us):
    return [round((packet.t0_us - t_us[0]) / 1000) for packet in packets]


def test_a_recording_is_cut_into_windows_with_the_flow_of_its_rotation(place):
    (t_us, *_) = made(4000, start_s=100.0, duration_s=0.5)
    gyroscope(place, 99.9, 100.7, RATE)
    packets = read_packets(place, options=PacketOptions(window_s=0.02, start_s=0.1, count=3))
    turn = Rotation.from_rotvec(-0.02 * np.array(RATE)).as_matrix()
    expected, valid = read_calibration(place / "calib.txt").rotation_flow(turn, *DAVIS)
    assert starts_ms(packets, t_us) == [100, 120, 140]
    for packet in packets:
        assert packet.t1_us == packet.t0_us + 20_000
        inside = (t_us >= packet.t0_us) & (t_us <= packet.t1_us)
        np.testing.assert_array_equal(packet.stream.t_us.numpy(), t_us[inside])
        np.testing.assert_array_equal(packet.truth.valid[0].numpy(), valid)
        # float32 of some px
        np.testing.assert_allclose(packet.truth.flow_px[0].numpy(), expected, rtol=0, atol=1e-5)
        assert packet.truth.interval_s == pytest.approx(0.02)
        assert any("rotation alone" in note for note in packet.notes)
    spread = read_packets(place, options=PacketOptions(window_s=0.02, count=3))
    assert starts_ms(spread, t_us) == [0, 240, 460]
    by_number = read_packets(place, options=PacketOptions(events=500, count=2))
    assert all(len(packet.stream) in (500, 501) for packet in by_number)


@pytest.mark.parametrize("count", [39, 40, 41, 42])
def test_packets_by_number_hold_that_number(tmp_path, count):
    t_us = 3 * np.arange(count)
    np.savetxt(tmp_path / "e.txt", np.stack([t_us, 0 * t_us, 0 * t_us, 0 * t_us + 1], 1), "%d")
    packets = read_packets(
        tmp_path / "e.txt", options=PacketOptions(events=10, columns="txyp", count=9)
    )
    assert [len(packet.stream) for packet in packets] == [10] * (count // 10)
    firsts = [int(packet.stream.t_us[0]) for packet in packets]
    assert firsts == t_us[: count // 10 * 10 : 10].tolist()


def test_motion_that_covers_a_part_of_the_windows_tells_of_that_part(place):
    gyroscope(place, 100.018, 101)
    options = PacketOptions(window_s=0.02, start_s=0.0, count=4)
    packets = read_packets(place, options=options)
    assert [packet.truth is not None for packet in packets] == [False, True, True, True]
    gyroscope(place, 200, 201)
    with pytest.raises(CodesignError, match="one clock"):
        read_packets(place, options=options)


@pytest.mark.parametrize("layout", ["subfolders", "folders", "one file of truth", "zip"])
def test_numbered_packets_and_their_flows(layout, tmp_path):
    place = tmp_path / "data"
    truth = tmp_path / "flow.npy" if layout == "one file of truth" else None
    kept = {}
    for k in (2, 10, 1):  # in order of numbers, not of letters
        kept[k] = made(300, seed=k, start_s=k, duration_s=0.03)
        folder = place / {"subfolders": f"packet_{k}", "folders": "events"}.get(layout, "")
        folder.mkdir(parents=True, exist_ok=True)
        name = "events" if layout == "subfolders" else f"packet_{k}"
        (folder / f"{name}.txt").write_text(eth_text(kept[k]))
        if layout == "folders":
            (place / "flow").mkdir(exist_ok=True)
            np.save(place / "flow" / f"{k}.npy", field(k).numpy())
        elif truth is None:
            write_flow(
                folder / ("flow.flo" if layout == "subfolders" else f"{name}_flow.flo"), field(k)
            )
    if truth is not None:
        np.save(truth, np.stack([field(k).permute(1, 2, 0).numpy() for k in (1, 2, 10)]))
    if layout == "zip":
        with zipfile.ZipFile(tmp_path / "data.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for file in place.rglob("*.*"):
                archive.write(file, f"inside/{file.relative_to(place)}")
        place = tmp_path / "data.zip"
    for k, packet in zip((1, 2, 10), read_packets(place, truth), strict=True):
        np.testing.assert_array_equal(packet.stream.t_us.numpy(), kept[k][0])
        assert (packet.t0_us, packet.t1_us) == (kept[k][0][0], kept[k][0][-1])
        assert torch.equal(packet.truth.flow_px[0], field(k))


def test_flows_without_times_follow_one_another_but_for_windows_left_out(tmp_path):
    t_us, *rest = made(4000, start_s=100.0, duration_s=0.1)
    t_us = np.where(t_us > t_us[0] + 20_000, t_us + 20_000, t_us)
    recording(tmp_path / "a", (t_us, *rest))
    np.save(tmp_path / "flow.npy", np.stack([field(k).numpy() for k in range(3)]))
    options = PacketOptions(window_s=0.02, truth_interval_s=0.02, start_s=0.0)
    packets = read_packets(tmp_path / "a", tmp_path / "flow.npy", options)
    assert starts_ms(packets, t_us) == [0, 20, 40]
    assert all(torch.equal(packet.truth.flow_px[0], field(k)) for k, packet in enumerate(packets))
    skipping = replace(options, skip=("windows_without_events",))
    some = read_packets(tmp_path / "a", tmp_path / "flow.npy", skipping)
    assert [float(packet.truth.flow_px[0, 0, 80, 100]) for packet in some] == [0.0, 2.0]
    assert some[0].left_out == {"windows_without_events": 1}


@pytest.mark.parametrize(
    ("times", "options", "span_us", "factor"),
    [
        # the truth says when
        ({"t0": 100.01, "t1": 100.06}, {}, (10_000, 60_000), 1.0),
        ({"t0": 100.01, "t1": 100.06}, {"window_s": 0.01}, (10_000, 20_000), 0.2),
        # no times: the flow of the whole packet, of a second, of a time that is told
        ({}, {"window_s": 0.02, "start_s": 0.0, "truth_unit": "px/s"}, (0, 20_000), 0.02),
        ({}, {"window_s": 0.02, "start_s": 0.0, "truth_interval_s": 0.08}, (0, 20_000), 0.25),
    ],
)
def test_a_flow_over_another_time_is_scaled(times, options, span_us, factor, place):
    (t_us, *_) = made(4000, start_s=100.0, duration_s=0.5)
    np.savez(place.parent / "flow.npz", flow=field().numpy(), **times)
    (packet, *_) = read_packets(place, place.parent / "flow.npz", PacketOptions(**options))
    first = 100_000_000 if times else t_us[0]
    assert (packet.t0_us - first, packet.t1_us - first) == span_us
    close(packet.truth.flow_px[0], field() * factor, rtol=1e-6)
    assert any("scaled linearly" in note for note in packet.notes) == (
        factor == 0.2 or factor == 0.25
    )


def test_flows_outside_the_recording_are_counted(place):
    truth = place.parent / "flow.npz"
    flows = np.stack([field(k).numpy() for k in range(3)])
    np.savez(truth, flow=flows, t0=[99.9, 100.02, 100.05], t1=[99.95, 100.04, 100.07])
    packets = read_packets(place, truth)
    assert [packet.t0_us for packet in packets] == [100_020_000, 100_050_000]
    assert all("1 of 3 true flows lie outside" in packet.notes[0] for packet in packets)
    assert torch.equal(packets[1].truth.flow_px[0], field(2))
    np.savez(truth, flow=field().numpy(), t0=5.0, t1=5.1)
    with pytest.raises(CodesignError, match="are both on one clock"):
        read_packets(place, truth)


@pytest.mark.parametrize("by", ["poses", "gyroscope"])
def test_the_flow_of_rotation_is_no_truth_of_a_slider(by, place):
    poses(place, (0.25, 0.0, 0.0), (0.0, 0.0, 0.0))
    if by == "gyroscope":
        gyroscope(place, 99.9, 101, (0.0, 0.0, 0.0))
    (packet, *_) = read_packets(place, options=PacketOptions(window_s=0.02, start_s=0.0))
    assert packet.rotation_only
    assert packet.translates
    # 5 mm in 20 ms, at 1 m: f x / z
    assert packet.neglected_px == pytest.approx(
        (199.092366542 + 198.82882047) / 2 * 0.005, rel=1e-4
    )
    # 0.08 px of a scene 1 m away beside 4 px
    poses(place, (0.02, 0.0, 0.0), (0.0, 1.0, 0.0))
    (place / "imu.txt").unlink(missing_ok=True)
    (packet, *_) = read_packets(place, options=PacketOptions(window_s=0.02, start_s=0.0))
    assert packet.rotation_only
    assert not packet.translates


def test_a_recording_in_two_forms_is_one(place):
    (t_us, *_) = made(4000, start_s=100.0, duration_s=0.5)
    np.save(place / "events.npy", np.zeros((3, 4)))  # somebody's array: no events at all
    (packet, *_) = read_packets(place, options=PacketOptions(window_s=0.02, start_s=0.0))
    assert len(packet.stream) == (t_us <= t_us[0] + 20_000).sum()
    assert any(
        "events from events.txt; events.npy beside it not read" in note for note in packet.notes
    )


def test_without_a_truth_beside_there_is_none(tmp_path):
    recording(tmp_path / "a", made(400, duration_s=0.08))
    (tmp_path / "a" / "calib.txt").unlink()
    (packet,) = read_packets(tmp_path / "a")  # shorter than a tenth of a second: one packet
    assert packet.truth is None
    gyroscope(tmp_path / "a", 0, 1)
    with pytest.raises(CodesignError, match="no calib"):
        read_packets(tmp_path / "a", tmp_path / "a" / "imu.txt")


def test_a_truth_without_a_time_is_not_taken_for_that_of_a_window(tmp_path):
    recording(tmp_path / "a", made(400, duration_s=0.08))
    np.savetxt(tmp_path / "truth.txt", [[3.0, -1.5]])
    given = tmp_path / "a", tmp_path / "truth.txt"
    for cut in (PacketOptions(window_s=0.02), PacketOptions(events=100)):
        with pytest.raises(DomainError, match=r"a window of .* ms is cut from .* ms: give"):
            read_packets(*given, cut)
    (packet, *_) = read_packets(*given, PacketOptions(window_s=0.02, truth_interval_s=0.04))
    assert packet.truth.flow_px[0, :, 0, 0].tolist() == pytest.approx([1.5, -0.75])


@refusals.table(__file__, "options of packets")
def test_options_that_mean_nothing(row, place):
    row.holds({"read": lambda **options: read_packets(place, options=PacketOptions(**options))})


def test_folders_without_events_and_damaged_archives(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.zip").write_bytes(b"PK\x03\x04 cut off")
    for k in (1, 2):
        recording(tmp_path / "long" / str(k), made(100, start_s=k, duration_s=2.0))
    for name, reason in (
        ("absent", "nothing lies"),
        ("empty", "holds no events"),
        ("a.zip", "no whole zip archive"),
        ("long", "too long for one packet"),
    ):
        with pytest.raises(CodesignError, match=reason):
            read_packets(tmp_path / name)


def test_flows_without_times_share_the_recording_whatever_the_window(place, tmp_path):
    """Windows of 20 ms begin where the fifths of half a second do, which the flows are of."""
    (t_us, *_) = made(4000, start_s=100.0, duration_s=0.5)
    np.save(tmp_path / "flow.npy", np.stack([field(k).numpy() for k in range(5)]))
    packets = read_packets(place, tmp_path / "flow.npy", PacketOptions(window_s=0.02))
    assert starts_ms(packets, t_us) == [0, 100, 200, 300, 400]
    for k, packet in enumerate(packets):
        share = 20_000 / ((t_us[-1] - t_us[0]) / 5)
        close(packet.truth.flow_px[0], field(k) * share, rtol=1e-4)
    later = PacketOptions(window_s=0.02, start_s=0.15)
    assert starts_ms(read_packets(place, tmp_path / "flow.npy", later), t_us)[0] == 150
    with pytest.raises(CodesignError, match="say nothing of windows of 500 events"):
        read_packets(place, tmp_path / "flow.npy", PacketOptions(events=500))
    long = read_packets(place, tmp_path / "flow.npy", PacketOptions(window_s=0.3))
    assert starts_ms(long, t_us) == [0, 100, 200]  # those behind run past the end
    for options in (PacketOptions(window_s=1.0), PacketOptions(window_s=0.02, start_s=10.0)):
        with pytest.raises(CodesignError, match="fits behind the start"):
            read_packets(place, tmp_path / "flow.npy", options)


@pytest.mark.parametrize("options", [{"window_s": 0.02, "count": 100}, {"events": 500}])
def test_windows_that_follow_one_another_share_no_event(options, place):
    held = made(4000, start_s=100.0, duration_s=0.5)[0]
    packets = read_packets(place, None, PacketOptions(start_s=0.0, **options))
    assert all(one.t1_us == other.t0_us for one, other in itertools.pairwise(packets))
    read = torch.cat([packet.stream.t_us for packet in packets])
    assert read.tolist() == held[: len(read)].tolist()
    assert len(read) == len(held) or "window_s" in options
