"""Recordings cut into packets, each with its true flow."""

import zipfile

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from codesign.errors import DomainError, FileFormatError
from codesign.flow.files import write_flow
from codesign.flow.sources import PacketOptions, read_packets
from codesign.flow.sources.camera import read_calibration
from tests.recording_case import DAVIS, ETH_CALIBRATION, eth_text, made


def true(packet):
    """The true flow of a packet that must have one."""
    assert packet.truth is not None
    return packet.truth


def recording(folder, rate=(0.2, -0.3, 0.5), start_s=100.0, duration_s=0.5, count=4000):
    """A folder in the layout of the Event-Camera Dataset, turning at a fixed rate."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = made(count, start_s=start_s, duration_s=duration_s)
    (folder / "events.txt").write_text(eth_text(columns))
    t_s = start_s - 0.1 + np.arange(round((duration_s + 0.2) * 1000)) / 1000
    np.savetxt(
        folder / "imu.txt",
        np.column_stack([t_s, np.zeros((len(t_s), 3)), np.tile(rate, (len(t_s), 1))]),
        fmt="%.9f",
    )
    (folder / "calib.txt").write_text(ETH_CALIBRATION)
    return columns


def test_a_recording_is_cut_into_windows_with_the_flow_of_its_rotation(tmp_path):
    columns = recording(tmp_path / "shapes_rotation")
    packets = read_packets(
        tmp_path / "shapes_rotation", options=PacketOptions(window_s=0.02, start_s=0.1, count=3)
    )
    camera = read_calibration(tmp_path / "shapes_rotation" / "calib.txt")
    expected, valid = camera.rotation_flow(
        Rotation.from_rotvec(-np.array([0.2, -0.3, 0.5]) * 0.02).as_matrix(), *DAVIS
    )
    assert len(packets) == 3
    for k, packet in enumerate(packets):
        assert (packet.t0_us, packet.t1_us) == (
            columns[0][0] + 100_000 + 20_000 * k,
            columns[0][0] + 120_000 + 20_000 * k,
        )
        inside = (columns[0] >= packet.t0_us) & (columns[0] <= packet.t1_us)
        assert len(packet.stream) == inside.sum()
        np.testing.assert_array_equal(packet.stream.t_us.numpy(), columns[0][inside])
        assert torch.equal(true(packet).valid[0], torch.from_numpy(valid))
        np.testing.assert_allclose(
            true(packet).flow_px[0].numpy(), expected, rtol=0, atol=1e-5
        )  # float32 of some px
        assert true(packet).interval_s == pytest.approx(0.02)
        assert any("rotation alone" in note for note in packet.notes)
    spread = read_packets(tmp_path / "shapes_rotation", options=PacketOptions(window_s=0.02, count=3))
    assert [round((p.t0_us - columns[0][0]) / 20_000) for p in spread] == [0, 12, 23]
    by_number = read_packets(tmp_path / "shapes_rotation", options=PacketOptions(events=500, count=2))
    assert all(len(packet.stream) in (500, 501) for packet in by_number)


def test_without_a_truth_beside_there_is_none(tmp_path):
    recording(tmp_path / "a", duration_s=0.08)
    (tmp_path / "a" / "calib.txt").unlink()
    (packet,) = read_packets(tmp_path / "a")  # shorter than a tenth of a second: one packet
    assert packet.truth is None
    with pytest.raises(FileFormatError, match="no calib"):
        read_packets(tmp_path / "a", tmp_path / "a" / "imu.txt")


def field(k=0):
    """A flow that is a closed form of the pixel, exact in float32 and in 1/128 px."""
    y, x = torch.meshgrid(torch.arange(180.0), torch.arange(240.0), indexing="ij")
    return torch.stack([(x - 100) / 64 + k, (y - 80) / 32 - k])


@pytest.mark.parametrize(
    "layout", ["files", "subfolders", "folders", "folder of truth", "one file of truth", "zip"]
)
def test_numbered_packets_and_their_flows(layout, tmp_path):
    place = tmp_path / "data"
    truth = None
    kept = {}
    for k in (2, 10, 1):  # in order of numbers, not of letters
        columns = kept[k] = made(300, seed=k, start_s=k, duration_s=0.03)
        folder = place / {"subfolders": f"packet_{k}", "folders": "events"}.get(layout, "")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ("events.txt" if layout == "subfolders" else f"packet_{k}.txt")).write_text(
            eth_text(columns)
        )
        if layout == "folder of truth":
            truth = tmp_path / "truth"
            truth.mkdir(exist_ok=True)
            write_flow(truth / f"{k:06d}.png", field(k))
        elif layout == "folders":
            (place / "flow").mkdir(exist_ok=True)
            np.save(place / "flow" / f"{k}.npy", field(k).numpy())
        elif layout != "one file of truth":
            write_flow(folder / ("flow.flo" if layout == "subfolders" else f"packet_{k}_flow.flo"), field(k))
    if layout == "one file of truth":
        truth = tmp_path / "flow.npy"
        np.save(truth, np.stack([field(k).permute(1, 2, 0).numpy() for k in (1, 2, 10)]))
    if layout == "zip":
        with zipfile.ZipFile(tmp_path / "data.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for file in place.rglob("*.*"):
                archive.write(file, f"inside/{file.relative_to(place)}")
        place = tmp_path / "data.zip"
    packets = read_packets(place, truth)
    assert len(packets) == 3
    for k, packet in zip((1, 2, 10), packets, strict=True):
        np.testing.assert_array_equal(packet.stream.t_us.numpy(), kept[k][0])
        assert (packet.t0_us, packet.t1_us) == (kept[k][0][0], kept[k][0][-1])
        assert torch.equal(true(packet).flow_px[0], field(k))


def test_flows_without_times_follow_one_another_and_long_files_are_no_packets(tmp_path):
    columns = recording(tmp_path / "a" / "one", start_s=100.0, duration_s=2.0)
    np.save(tmp_path / "flow.npy", np.stack([field(k).numpy() for k in range(3)]))
    packets = read_packets(
        tmp_path / "a" / "one", tmp_path / "flow.npy", PacketOptions(window_s=0.02, truth_interval_s=0.02)
    )
    assert [packet.t0_us - columns[0][0] for packet in packets] == [0, 20_000, 40_000]
    assert all(torch.equal(true(packet).flow_px[0], field(k)) for k, packet in enumerate(packets))
    recording(tmp_path / "a" / "two", start_s=300.0, duration_s=2.0)
    with pytest.raises(DomainError, match="too long for one packet"):
        read_packets(tmp_path / "a")


def test_a_flow_over_another_time_is_scaled_and_says_so(tmp_path):
    recording(tmp_path / "a", start_s=100.0, duration_s=0.1)
    np.savez(tmp_path / "flow.npz", flow=field().numpy(), t0=100.01, t1=100.06)
    (packet,) = read_packets(tmp_path / "a", tmp_path / "flow.npz")
    assert (packet.t0_us, packet.t1_us) == (100_010_000, 100_060_000)  # the truth says when
    assert torch.equal(true(packet).flow_px[0], field())
    (short,) = read_packets(tmp_path / "a", tmp_path / "flow.npz", PacketOptions(window_s=0.01))
    assert (short.t0_us, short.t1_us) == (100_010_000, 100_020_000)
    torch.testing.assert_close(true(short).flow_px[0], field() / 5, rtol=1e-6, atol=0)
    assert any("scaled linearly" in note for note in short.notes)
    write_flow(tmp_path / "flow.flo", field())
    (whole,) = read_packets(tmp_path / "a", tmp_path / "flow.flo")  # no times: the flow of the whole packet
    assert torch.equal(true(whole).flow_px[0], field())
    (rate,) = read_packets(
        tmp_path / "a", tmp_path / "flow.flo", PacketOptions(window_s=0.02, start_s=0.0, truth_unit="px/s")
    )
    torch.testing.assert_close(true(rate).flow_px[0], field() * 0.02, rtol=1e-6, atol=0)
    (told,) = read_packets(
        tmp_path / "a",
        tmp_path / "flow.flo",
        PacketOptions(window_s=0.02, start_s=0.0, truth_interval_s=0.08),
    )
    torch.testing.assert_close(true(told).flow_px[0], field() / 4, rtol=1e-6, atol=0)


def test_flows_outside_the_recording_are_counted(tmp_path):
    recording(tmp_path / "a", start_s=100.0, duration_s=0.1)
    np.savez(
        tmp_path / "flow.npz",
        flow=np.stack([field(k).numpy() for k in range(3)]),
        t0=[99.9, 100.02, 100.05],
        t1=[99.95, 100.04, 100.07],
    )
    packets = read_packets(tmp_path / "a", tmp_path / "flow.npz")
    assert [packet.t0_us for packet in packets] == [100_020_000, 100_050_000]
    assert all("1 of 3 true flows lie outside" in packet.notes[0] for packet in packets)
    assert torch.equal(true(packets[1]).flow_px[0], field(2))
    np.savez(tmp_path / "flow.npz", flow=field().numpy(), t0=5.0, t1=5.1)
    with pytest.raises(FileFormatError, match="are both on one clock"):
        read_packets(tmp_path / "a", tmp_path / "flow.npz")


@pytest.mark.parametrize(
    ("options", "error", "reason"),
    [
        (PacketOptions(window_s=-1.0), DomainError, "number > 0"),
        (PacketOptions(window_s=0.1, events=3), DomainError, "one of both"),
        (PacketOptions(truth_unit="m"), DomainError, "'px/s'"),
        (PacketOptions(window_s=9.0), DomainError, "no window of 9 s"),
        (PacketOptions(events=10**6), DomainError, "windows of 1000000"),
        (PacketOptions(columns="abcd"), FileFormatError, "four letters"),
        (PacketOptions(time_unit="h"), FileFormatError, "time unit 'h'"),
    ],
)
def test_options_that_mean_nothing(options, error, reason, tmp_path):
    recording(tmp_path / "a", duration_s=0.05)
    with pytest.raises(error, match=reason):
        read_packets(tmp_path / "a", options=options)


def test_folders_without_events_and_damaged_archives(tmp_path):
    (tmp_path / "empty").mkdir()
    for path, reason in ((tmp_path / "absent", "nothing lies"), (tmp_path / "empty", "holds no events")):
        with pytest.raises(FileFormatError, match=reason):
            read_packets(path)
    (tmp_path / "a.zip").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(FileFormatError, match="no whole zip archive"):
        read_packets(tmp_path / "a.zip")
