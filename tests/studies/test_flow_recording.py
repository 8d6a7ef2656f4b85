"""The study of event flow on a recording: its made-up recording against its homographies, its
figures against known cases, its errors."""

from dataclasses import replace

import imageio_ffmpeg
import numpy as np
import pytest
import torch

from codesign import events, flow
from codesign.flow.sources import PacketOptions, read_packets, read_recording
from codesign.types import FlowField
from studies.flow_recording import __main__ as study
from studies.flow_recording import made, video
from tests import refusals
from tests.recording_case import poses
from tests.studies.browser import check_page
from tests.studies.runs import numbers, page, ran

SIZE = (45, 60)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording") / "made"
    return folder, made.make(folder, 0.05, SIZE)


def test_the_made_recording_says_what_its_homographies_say(recording):
    folder, whole = recording
    for truth in (None, folder / "groundtruth.txt"):
        (packet,) = read_packets(
            folder, truth, PacketOptions(window_s=0.04, start_s=0.0, count=1, size_px=SIZE)
        )
        there = whole.truth(
            *(t_us - round(made.START_S * 1e6) for t_us in (packet.t0_us, packet.t1_us))
        )
        assert float(there.flow_px.norm(dim=1).mean()) > 2
        # float32 places of 60 px; rates between samples 1 ms apart
        assert float((true(packet).flow_px - there.flow_px).norm(dim=1).max()) < 2e-4
        assert bool(true(packet).valid.all())


def true(packet):
    """The true flow of a packet that must have one."""
    assert packet.truth is not None
    return packet.truth


def run(folder, recording, options=""):
    """Exit code, and what was measured."""
    given = f"--estimator lk --width-px 60 --height-px 45 {options} --out"
    code = ran(study, given, folder, "--recording", recording)
    return code, numbers(folder) if (folder / "metrics.json").is_file() else {}


def test_figures_of_a_run(recording, tmp_path):
    threads = torch.get_num_threads()
    code, metrics = run(
        tmp_path / "run", recording[0], "--window-ms 20 --start-s 0.005 --packets 2"
    )
    torch.set_num_threads(threads)
    assert code == 0
    options = PacketOptions(window_s=0.02, start_s=0.005, count=2, size_px=SIZE)
    packets = read_packets(recording[0], options=options)
    errors = []
    zero = []
    for packet in packets:
        volume = events.from_stream(packet.stream, packet.t0_us, packet.t1_us, 8)
        field, _ = study.measured(packet, study.load("lk")["lk"][0], 8)
        seen = (volume.counts.sum((1, 2)) > 0)[0]
        errors.append(float((field.flow_px - true(packet).flow_px)[0].norm(dim=0)[seen].mean()))
        zero.append(float(true(packet).flow_px[0].norm(dim=0)[seen].mean()))
    assert metrics["lk_aee_px"] == metrics["aee_px"] == pytest.approx(np.mean(errors), rel=1e-5)
    assert metrics["lk_zero_aee_px"] == pytest.approx(np.mean(zero), rel=1e-5)
    assert metrics["packets"] == 2
    assert metrics["events"] == sum(len(packet.stream) for packet in packets)
    shown = page(tmp_path / "run")
    assert "rotation alone" in shown
    assert "The recording is synthetic" not in shown
    check_page("flow_recording", tmp_path / "run")
    assert (tmp_path / "run" / "packet_01.png").is_file()


def test_the_true_flow_is_sharper_than_none_and_without_error(recording):
    (packet,) = read_packets(
        recording[0], options=PacketOptions(window_s=0.04, start_s=0.0, count=1, size_px=SIZE)
    )
    _, right = study.measured(packet, lambda _: packet.truth, 8)
    _, none = study.measured(
        packet,
        lambda _: FlowField(torch.zeros_like(true(packet).flow_px), true(packet).valid, 0.04),
        8,
    )
    assert right["aee_px"] == right["aee_dense_px"] == right["outlier_percent"] == 0
    assert right["angular_error_deg"] < 0.05  # of float32
    assert right["fwl"] > 1.2
    assert right["rsat"] < 1
    assert none["fwl"] == 1  # by definition
    # truth that is known on the left half is as sharp there as the same estimate
    known = torch.zeros(1, *SIZE, dtype=torch.bool)
    known[..., : SIZE[1] // 2] = True
    _, half = study.measured(
        replace(packet, truth=replace(true(packet), valid=known)), lambda _: packet.truth, 8
    )
    assert half["truth_fwl"] == half["fwl_where_known"] > 1.2


def test_a_recording_without_truth_has_its_sharpness_only(tmp_path):
    (tmp_path / "events.txt").write_text(
        "".join(f"{0.1 + k * 1e-4:.6f} {(k * 7) % 60} {(k * 3) % 45} {k % 2}\n" for k in range(400))
    )
    code, metrics = run(tmp_path / "run", tmp_path / "events.txt")
    assert code == 0
    # shorter than 0.1 s: one packet
    assert metrics["packets_without_truth"] == metrics["packets"] == 1
    assert "lk_aee_px" not in metrics
    assert metrics["lk_fwl"] > 0


def test_sharpness_that_is_not_defined_is_left_out(recording):
    options = PacketOptions(window_s=0.02, start_s=0.0, count=1, size_px=SIZE)
    (packet,) = read_packets(recording[0], options=options)
    early = replace(
        packet.stream, **{name: getattr(packet.stream, name)[:3] for name in ("x", "y", "p")}
    )
    early = replace(early, t_us=torch.full_like(early.x, packet.t0_us, dtype=torch.int64))
    field = FlowField(torch.zeros(1, 2, *SIZE), torch.ones(1, *SIZE, dtype=torch.bool), 0.02)
    _, found = study.measured(replace(packet, stream=early, truth=None), lambda _: field, 8)
    assert found == {"fwl": 1.0}  # mean times of 0 on every pixel have no ratio


def test_bins_are_those_asked_for(recording, tmp_path, monkeypatch):
    seen = []

    def estimate(volume):
        seen.append(volume.counts.shape[2])
        return flow.estimate_lk(volume)

    monkeypatch.setattr(study, "load", lambda name: {"lk": (estimate, None)})
    assert run(tmp_path / "run", recording[0], "--window-ms 20 --packets 1 --bins 3")[0] == 0
    assert set(seen) == {3}


def test_a_video_of_all_windows(recording, tmp_path):
    code, metrics = run(
        tmp_path / "run", recording[0], "--window-ms 5 --packets 1 --video --video-windows 99"
    )
    assert code == 0
    held = read_recording(recording[0], PacketOptions(size_px=SIZE))
    assert metrics["video_events"] == len(held)
    assert metrics["video_event_s"] == pytest.approx(
        (held.t_us[-1] - held.t_us[0]) * 1e-6, abs=2e-6
    )
    assert metrics["video_real_time_factor"] == pytest.approx(
        metrics["video_processor_s"] / metrics["video_event_s"]
    )
    frames = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "run" / "flow.mp4"))[0]
    assert frames == metrics["video_windows"] == -(-(held.t_us[-1] - held.t_us[0]) // 5000)
    assert "real-time factor" in page(tmp_path / "run")


def test_arrows_are_the_flow_per_second_where_events_are(recording):
    held = read_recording(recording[0], PacketOptions(size_px=SIZE))
    t0_us = int(held.t_us[0])
    y, x = torch.meshgrid(torch.arange(45.0), torch.arange(60.0), indexing="ij")
    linear = torch.stack([x / 10, 3 + 0 * y])[None]
    field = FlowField(
        linear, torch.ones(1, *SIZE, dtype=torch.bool), 0.01, torch.full((1, *SIZE), 0.5)
    )
    found = video.arrows(held, flow.TrackedWindow(t0_us, t0_us + 10_000, 9, field, False, 0.0), 1)
    part = held.window(t0_us, t0_us + 10_000)
    places = {(float(a), float(b)) for a, b in zip(part.x.tolist(), part.y.tolist(), strict=True)}
    assert {(float(a), float(b)) for a, b in zip(found.x_px, found.y_px, strict=True)} == places
    np.testing.assert_allclose(found.u, found.x_px / 10 / 0.01, rtol=1e-5)
    np.testing.assert_allclose(found.v, 300, rtol=1e-5)
    np.testing.assert_allclose(found.sure, 0.5, rtol=1e-5)


def test_a_slider_has_no_error_against_its_rotation(tmp_path):
    folder = tmp_path / "slider"
    folder.mkdir()
    lines = [f"{1 + k * 1e-4:.6f} {(k * 7) % 60} {(k * 3) % 45} {k % 2}" for k in range(600)]
    (folder / "events.txt").write_text("\n".join([*lines, "1.070000 99 3 1"]) + "\n")
    (folder / "calib.txt").write_text("60 60 30 22 0 0 0 0 0\n")
    poses(folder, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), start_s=0.9)
    assert run(tmp_path / "refused", folder, "--window-ms 20")[0] == 2  # an event off the sensor
    code, metrics = run(tmp_path / "run", folder, "--window-ms 20 --skip events_off_sensor")
    assert code == 0
    assert metrics["packets_translating"] == metrics["packets"] == 2
    assert metrics["left_out_events_off_sensor"] == 1
    assert not [name for name in metrics if name.endswith("aee_px")]
    assert metrics["lk_rotation_difference_px"] >= 0
    shown = page(tmp_path / "run")
    assert "The camera translates" in shown
    assert "1 events off sensor" in shown
    assert "AEE where events are, lk" not in shown  # no card


@refusals.table(__file__, "flow_recording")
def test_bad_input_is_one_sentence_and_exit_code_2(row, refuses, recording, tmp_path):
    (tmp_path / "made").symlink_to(recording[0])
    refuses(study, row)


def test_packets_of_events_of_the_made_recording_have_no_length_in_time():
    assert study.options(study.Config(events=500)).window_s is None
    assert study.options(study.Config()).window_s == 0.02
