"""video_to_events: closed forms for lossless frames, the sensor itself for decoded ones, runs that
stop, and sentences for what cannot be."""

import dataclasses
import itertools
import math
from typing import Any

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import DomainError, FileFormatError
from codesign.events.stream import ordered
from codesign.types import EventStream
from studies.frame.run import Run
from studies.video_to_events import __main__ as study
from studies.video_to_events.input import Light, read_times
from studies.video_to_events.options import chosen_sensor
from studies.video_to_events.state import RECORD, EventLog, Progress
from tests import refusals
from tests.numbers import D, close, seeded
from tests.studies.browser import check_page
from tests.studies.runs import numbers, page, ran

FIELDS = ("t_us", "x", "y", "p")
IDEAL = "--preset ideal --events e.npz"


@pytest.fixture
def plain(monkeypatch):
    """No figures and videos: they are looked at by a test of their own."""
    monkeypatch.setattr(study.pages, "pictures", lambda view: None)
    monkeypatch.setattr(Run, "figure", lambda *arguments: None)


def write_folder(folder, stack):
    folder.mkdir()
    for index, frame in enumerate(stack):
        iio.imwrite(folder / f"{index}.png", frame)
    return folder


def waves(count=30, height=12, width=16):
    """Gray frames [T, H, W] uint8 whose pixels swing smoothly and far."""
    phase = 6 * np.random.default_rng(0).random((height, width))
    return (120 + 100 * np.sin(0.4 * np.arange(count)[:, None, None] + phase)).astype(np.uint8)


def crossings(values, fps, theta):
    """(microsecond, polarity) of the events of one pixel, by hand: values are gray levels > 20 at
    an even rate."""
    level = [math.log(value) for value in values]
    found = []
    reference = level[0]
    for k, (before, after) in enumerate(itertools.pairwise(level)):
        sign = 1 if after > before else -1
        while sign * (after - reference) >= theta:
            reference += sign * theta
            found.append((1e6 * (k + (reference - before) / (after - before)) / fps, sign))
    return found


def test_a_ramp_of_gray_values_fires_at_known_microseconds(tmp_path, plain, capsys):
    # no step ends on a threshold: ln of whole numbers is no multiple of 0.2 away
    pixels = [
        [40, 52, 66, 90, 130, 250],
        [250, 200, 100, 99, 60, 30],
        [100, 150, 100, 150, 60, 180],
        [77] * 6,
        [30, 31, 33, 36, 39, 42],
    ]
    folder = write_folder(tmp_path / "in", np.array(pixels, np.uint8).T[:, None, :])
    out = tmp_path / "run"
    assert ran(study, f"--fps 200 {IDEAL} e.csv --out", out, "--input", folder) == 0
    for name in ("e.npz", "e.csv"):
        stream = events.read(out / name)
        for x, values in enumerate(pixels):
            truth = crossings(values, 200, 0.2)
            mine = stream.x == x
            assert stream.p[mine].tolist() == [sign for _, sign in truth]
            # rounded to a microsecond; levels are float32 (5e-7 of a step of at least 0.03 in 5000
            # us)
            np.testing.assert_allclose(
                stream.t_us[mine].numpy(), [t for t, _ in truth], atol=0.5 + 5000 * 5e-7 / 0.03
            )
    metrics = numbers(out)
    every = [sign for values in pixels for _, sign in crossings(values, 200, 0.2)]
    found = [metrics[name] for name in ("frames", "events_on", "events_off")]
    assert found == [6, every.count(1), every.count(-1)]
    assert metrics["rate_on_hz"] == pytest.approx(every.count(1) / 0.025)
    assert "too slow" in capsys.readouterr().out
    assert not (out / study.LOG).exists()


# imageio leaves FFmpeg's pipes open
@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning"
)
def test_a_video_gives_the_events_of_its_frames_as_imageio_decodes_them(tmp_path, plain):
    path = tmp_path / "clip.mp4"
    writer = imageio_ffmpeg.write_frames(
        str(path), (32, 24), fps=25, codec="libx264", macro_block_size=2
    )
    writer.send(None)
    for frame in waves(40, 24, 32):
        writer.send(np.ascontiguousarray(np.stack([frame, frame[::-1], frame[:, ::-1]], -1)))
    writer.close()
    clock = "--slow-motion 10 --start-s 0.02 --stop-s 0.1"
    options = f"{clock} --preset clean --seed 3 --events e.npz --out"
    assert ran(study, options, tmp_path / "run", "--input", path) == 0
    decoded = iio.imread(path, plugin="FFMPEG").astype(np.float64) @ [0.2126, 0.7152, 0.0722]
    t_s = np.arange(40) / 250
    used = (t_s >= 0.02) & (t_s <= 0.1 + 1e-9)
    sensor = events.SensorModel(theta_sigma=0.02)
    frames = torch.from_numpy(decoded[used]).float()
    truth = events.simulate(frames, t_s[used], sensor, seeded(3))
    found = events.read(tmp_path / "run" / "e.npz")
    assert len(truth) > 1000
    order = [
        torch.argsort((stream.y * 32 + stream.x) * 2**40 + stream.t_us, stable=True)
        for stream in (truth, found)
    ]
    for name in ("x", "y", "p"):
        assert torch.equal(getattr(truth, name)[order[0]], getattr(found, name)[order[1]])
    # luminance in single precision moves a crossing by 1e-6 log units of the 0.01 or more that a
    # frame of 4 ms changes
    assert (truth.t_us[order[0]] - found.t_us[order[1]]).abs().max() <= 1


@pytest.mark.parametrize("how", ["killed", "killed at the end"])
def test_an_interrupted_run_goes_on_with_the_same_events(tmp_path, monkeypatch, plain, capsys, how):
    monkeypatch.setattr(study, "PIXELS_PER_CHUNK", 4 * 12 * 16)
    monkeypatch.setattr(study, "SECONDS_BETWEEN_SAVES", 0.0 if how == "killed" else 1e9)
    folder = write_folder(tmp_path / "in", waves())
    options = "--fps 300 --preset noisy --events e.npz --seed 7 --out"
    assert ran(study, options, tmp_path / "whole", "--input", folder) == 0
    real = events.simulate
    calls = []

    def stop(*arguments):
        raise KeyboardInterrupt

    def stops(*arguments, **options):
        found = real(*arguments, **options)
        calls.append(len(found))
        if len(calls) == 4 and how == "killed":
            stop()
        return found

    monkeypatch.setattr(study.events, "simulate", stops)
    with monkeypatch.context() as patched:
        if how == "killed at the end":
            patched.setattr(study, "write_outputs", stop)
        assert ran(study, options, tmp_path / "cut", "--input", folder) == 130
    assert "--resume" in capsys.readouterr().err
    # what a killed run wrote after its state was stored does not count
    with (tmp_path / "cut" / study.LOG).open("ab") as file:
        file.write(b"rubbish")
    assert ran(study, "--resume", tmp_path / "cut") == 0
    # of eight chunks the killed run made one again
    assert len(calls) == (9 if how == "killed" else 8)
    assert (tmp_path / "whole" / "e.npz").read_bytes() == (tmp_path / "cut" / "e.npz").read_bytes()
    assert ran(study, "--resume", tmp_path / "cut") == 0
    assert "complete" in capsys.readouterr().out


def test_everything_is_drawn_and_shown(tmp_path):
    looks = "--fps 1000 --preview-slowdown 100 --sensor-size 20 10 --linear --out"
    out = tmp_path / "run"
    assert ran(study, looks, out, "--input", write_folder(tmp_path / "in", waves(12))) == 0
    stream = events.read(out / "events.h5")
    assert (stream.width_px, stream.height_px) == (20, 10)
    shown = page(out)
    assert shown.count("data:image/png") == 3
    assert shown.count("data:video/mp4") == 2
    assert "sRGB gamma is undone" in shown
    assert "stretched to 20 x 10" in shown
    check_page("video_to_events", out)
    # 11 ms at 100 times slower and 30 pictures a second
    assert imageio_ffmpeg.count_frames_and_secs(str(out / "events.mp4"))[0] == 33
    metrics = numbers(out)
    assert metrics["events_on"] + metrics["events_off"] == len(stream)
    assert metrics["mpixel_per_s"] == pytest.approx(12 * 200 / metrics["seconds"] / 1e6)


def test_epoch_times_of_a_file_stay_exact_to_the_microsecond(tmp_path):
    times_us = [1_700_000_000_123_457 + step for step in (0, 1000, 1700, 5000)]
    path = tmp_path / "times.txt"
    path.write_text("# microseconds\n" + "\n".join(map(str, times_us)) + "\n")
    assert read_times(path, "us", 4).mul(1e6).round().long().tolist() == times_us


def test_light_follows_the_published_curves():
    gray = np.arange(256, dtype=np.uint8)[None]
    assert torch.equal(Light(255, False)([gray], 0)[0, 0], torch.arange(256.0))
    linear = Light(255, True)([gray], 0)[0, 0] / 255
    # IEC 61966-2-1: digital values and their linear light to six decimals
    published = {0: 0.0, 10: 0.003035, 11: 0.003347, 128: 0.215861, 188: 0.502886, 255: 1.0}
    for value, light in published.items():
        assert float(linear[value]) == pytest.approx(light, abs=5e-7)
    primaries = np.eye(3, dtype=np.uint8)[None] * 255
    seen = Light(255, False)([primaries], 0)
    close(seen[0, 0] / 255, torch.tensor([0.2126, 0.7152, 0.0722]), rtol=1e-6)
    assert float(Light(4095, False)([np.full((1, 1), 4095, np.uint16)], 0)) == 255
    assert float(Light(255, False)([np.full((1, 1), 300.5)], 0)) == 300.5


def test_a_new_size_keeps_what_is_linear():
    y, x = np.mgrid[:48, :64].astype(np.float64)
    small = Light(255, False, (16, 12))([50 + 2 * x + y], 0)[0]
    # the pixel centres of a quarter of the size lie at 4 k + 1.5; away from the edges, where the
    # window is cut
    truth = 50 + 2 * (4 * np.arange(16) + 1.5) + (4 * np.arange(12)[:, None] + 1.5)
    np.testing.assert_allclose(small.numpy()[1:-1, 1:-1], truth[1:-1, 1:-1], rtol=1e-6)


def test_the_share_of_large_steps_is_counted():
    level = torch.full((3, 10, 10), 5.0)  # far above the linear part
    level[1:, :3] += 0.2 * 1.5  # 30 pixels by 1.5 thresholds
    level[1:, 3:5] += 0.2 * 10.5  # 20 pixels by 10.5
    level[2, 9] -= 0.4 * 4.5  # 10 pixels darker, OFF threshold 0.4
    none = torch.zeros(0, dtype=torch.int64)
    steps = Progress(0, {}, events.SensorState())
    for chunk in (slice(0, 2), slice(2, 3)):
        steps.add(level.exp()[chunk], EventStream(none, none, none, none, 10, 10), (0.2, 0.4))
    expected = {0: 140, 1: 30, 4: 10, 10: 20}
    assert [expected.get(k, 0) for k in range(len(steps.histogram))] == steps.histogram.tolist()
    assert steps.large_share == pytest.approx(30 / 60)
    # nine in ten move by up to 11 thresholds, 3 are wanted
    assert steps.remedy == pytest.approx(11 / 3)


OFF = {"cutoff_hz": 0, "leak_rate_hz": 0, "shot_rate_hz": 0, "refractory_s": 0}
V2E = {
    "clean": {"theta_sigma": 0.02, **OFF},
    "noisy": OFF | {"theta_sigma": 0.05, "cutoff_hz": 30, "leak_rate_hz": 0.1, "shot_rate_hz": 5},
    "default": {"theta_sigma": 0.03, "cutoff_hz": 300, "leak_rate_hz": 0.01}
    | {"shot_rate_hz": 0.001, "refractory_s": 5e-4},
}


def test_presets_are_those_of_v2e_and_every_parameter_is_an_option():
    for name, values in V2E.items():
        sensor = chosen_sensor(study.Config(preset=name))
        assert {field: getattr(sensor, field) for field in values} == values
        assert (sensor.theta_on, sensor.theta_off) == (0.2, 0.2)
    given: dict[str, Any] = dataclasses.asdict(events.SensorModel())
    given |= {"theta_off": 0.35, "timing": "v2e"}
    assert chosen_sensor(study.Config(preset="noisy", **given)) == events.SensorModel(**given)
    with pytest.raises(DomainError, match="ideal, clean, noisy, default"):
        chosen_sensor(study.Config(preset="best"))


def test_the_log_finds_events_by_time_and_forgets_what_does_not_count(tmp_path):
    generator = seeded()
    t_us, x, y, p = (torch.randint(0, high, (500,), generator=generator) for high in (300, 9, 7, 2))
    stream = ordered(t_us + 1_700_000_000_000_000, x, y, 2 * p - 1, 7, 9)
    log = EventLog(tmp_path / "log", 0, 7, 9)
    for part in (slice(0, 200), slice(200, 500)):
        log.append(
            EventStream(*(getattr(stream, name)[part] for name in FIELDS), height_px=7, width_px=9)
        )
    times = [1_700_000_000_000_000 + k for k in (-1, 0, 57, 299, 400)]
    found = np.searchsorted(stream.t_us.numpy(), times, side="right")
    assert log.positions(times) == found.tolist()
    picked = [3, 77, 499]
    for read, part in (
        (log.read(123, 321), slice(123, 321)),
        (log.pick(torch.tensor(picked)), picked),
    ):
        assert all(torch.equal(getattr(read, name), getattr(stream, name)[part]) for name in FIELDS)
    EventLog(tmp_path / "log", 450, 7, 9)
    assert (tmp_path / "log").stat().st_size == 450 * RECORD.itemsize
    with pytest.raises(FileFormatError, match="450 of the 451"):
        EventLog(tmp_path / "log", 451, 7, 9)


def grating(count, height=24, width=56):
    """[T, H, W] float32 whose log is a sinusoid of 14 px that moves to the right by 3 px a
    frame."""
    x = np.arange(width) - 3 * np.arange(count)[:, None, None]
    light = np.exp(4.5 + 0.55 * np.sin(2 * math.pi * x / 14))
    return np.broadcast_to(light, (count, height, width)).astype(np.float32)


def test_an_upsampled_grating_fires_when_its_closed_form_crosses_in_any_chunks(
    tmp_path, monkeypatch, plain
):
    np.save(tmp_path / "in.npy", grating(9))

    def run(name, options=""):
        given = f"--fps 100 {IDEAL} {options} --out"
        return ran(study, given, tmp_path / name, "--input", tmp_path / "in.npy")

    assert run("up", "--upsample 0.5") == 0
    assert run("kept") == 0
    found, kept = (events.read(tmp_path / name / "e.npz") for name in ("up", "kept"))
    monkeypatch.setattr(study, "PIXELS_PER_CHUNK", 2 * 24 * 56)
    assert run("chunks", "--upsample 0.5") == 0
    assert (tmp_path / "chunks" / "e.npz").read_bytes() == (tmp_path / "up" / "e.npz").read_bytes()

    # the truth: 2000 steps per second of the same grating; pixels whose light of the last frame was
    # always inside the picture
    t_s = torch.arange(0, 161, dtype=D) / 2000
    x = torch.arange(56) - 300 * t_s[:, None, None]
    level = 4.5 + 0.55 * torch.sin(2 * math.pi * x / 14)
    truth = events.simulate(level.exp().expand(-1, 24, -1).contiguous(), t_s, events.SensorModel())
    totals = [
        events.to_counts(each, [0.0, 0.08])[0][..., 28:-4].sum() for each in (truth, found, kept)
    ]
    # cut by 1 - cos(pi 0.5 / 14) = 0.6 % of 1.1 log units, an event of 0.2 more or less per half
    # period of 5 events at worst in one pixel of 30
    assert abs(float(totals[1] / totals[0]) - 1) < 0.05
    # straight lines over 3 of 14 px cut 1 - cos(3 pi / 14) = 22 % off half of the peaks
    assert float(totals[2] / totals[0]) < 0.95
    metrics = numbers(tmp_path / "up")
    assert metrics["frames"] == 9
    assert metrics["simulated_frames"] >= 1 + 8 * 6  # 3 px in steps of half a pixel


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Pictures, a stack with NaN, and tables of times that do not fit."""
    folder = tmp_path_factory.mktemp("inputs")
    write_folder(folder / "in", waves(4))
    stack = waves(4).astype(np.float32)
    stack[2, 3, 4] = np.nan
    np.save(folder / "nan.npy", stack)
    lines = {"back": "0\n0.1\n0.05\n0.2", "few": "0\n0.1", "word": "0\n0.1\nnoon\n0.2"}
    for name, text in {**lines, "close": "0\n0.1\n0.1000001\n0.2"}.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


@refusals.table(__file__, "video_to_events")
def test_what_cannot_be_is_one_sentence_and_exit_code_2(row, refuses, inputs, monkeypatch):
    monkeypatch.chdir(inputs)
    refuses(study, row)
