"""Data sets: the fast truth against the slow one, files against their definitions, and runs that
are killed at any moment."""

import hashlib
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import fields
from typing import Literal

import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.errors import DomainError
from codesign.events import SensorModel, SensorState, simulate
from codesign.flow.files import read_flow
from codesign.pose import inverse, look_at, se3_exp
from codesign.render.moving import MovingScene, at_frames
from codesign.render.projection import TOLERANCE_PX, ProjectionTable
from codesign.render.truth import flow_and_occlusion, truth_of_frames, view
from scenes import dataset_motion as motions
from scenes import worlds
from scenes.dataset_motion import Stage, make_world
from scenes.tum import read_tum
from studies.make_dataset import __main__ as study
from studies.make_dataset import store
from studies.make_dataset.segments import Segments
from tests.numbers import D, close, f64, seeded
from tests.processes import ROOT
from tests.rounding_case import RoundsByPlace
from tests.studies.browser import check_page
from tests.studies.runs import ran, stored

# frames 0.0111 s apart: no whole microseconds
SMALL = "--trajectories 2 --frames 14 --size 24 --samples 2 --chunk 4 --rate-hz 90"


def camera(name="cooke-triplet", size=24, level: Literal["traced", "thin", "pinhole"] = "traced"):
    return study.make_camera(study.Config(lens=name, size=size, samples=2, level=level))


def poses(count):
    start = look_at((0.1, -1.0, 1.1), (0.0, 0.8, 0.5))
    return start @ se3_exp(
        torch.arange(count, dtype=D)[:, None] * f64([0.03, 0.01, 0.05, 0.02, -0.03, 0.04])
    )


@pytest.mark.bits
def test_the_truth_of_many_frames_is_that_of_each():
    with torch.no_grad():
        cam = camera(size=40)
        T = poses(5)
        steps = torch.zeros(5, 6, dtype=D)
        steps[:, :2] = torch.arange(5, dtype=D)[:, None] * f64([0.05, 0.02])
        upright = se3_exp(f64([-0.2, 0.0, 0.9, 0, 0, 0]))
        tilt = se3_exp(f64([0, 0, -0.9, 1.2, 0, 0]))
        path = se3_exp(steps) @ upright @ tilt
        scene = MovingScene(worlds.room(), {"board": (worlds.smooth_plane(), path)})
        chief = cam.chief_rays(cam.film.pixels())
        table = ProjectionTable(cam)
        found = truth_of_frames(table, scene, T, 5, chief)
        slow = flow_and_occlusion(cam, scene, T)
        assert found.flow_px.shape == (4, 2, 40, 40)
        assert torch.equal(found.valid, slow.valid)
        close(found.flow_px, slow.flow_px, atol=TOLERANCE_PX)
        # a ray 1e-6 px aside may meet another surface at an edge
        assert int((found.occluded != slow.occluded).sum()) <= 2
        assert bool(found.occluded.any())
        for k in range(5):
            each = view(cam, scene, T, k)
            assert torch.equal(found.object_id[k], each.object_id)
            close(found.depth_m[k], each.depth_m, atol=1e-12)
        assert found.object_id.unique().tolist() == [0, 1]
        for processor in (nullcontext(), RoundsByPlace()):
            with processor:
                whole = truth_of_frames(table, scene, T, 5, chief)
                part = truth_of_frames(table, at_frames(scene, slice(2, 4)), T[2:4], 1, chief)
            for name in (field.name for field in fields(part)):
                assert torch.equal(getattr(part, name)[0], getattr(whole, name)[2]), name
        last = truth_of_frames(table, at_frames(scene, slice(4, 5)), T[4:], 1)
        assert last.flow_px.shape == (0, 2, 40, 40)
        assert torch.equal(last.depth_m[0], found.depth_m[4])


def test_segments_are_the_shapes_of_the_scene():
    with torch.no_grad():
        cam = camera(size=48)
        scene = worlds.room()
        T = poses(1)
        segments = Segments(scene)
        object_id = view(cam, scene, T, 0).object_id[None]
        segment_id = segments.at(cam.chief_rays(cam.film.pixels()), scene, T, object_id)
        points = view(cam, scene, T, 0).points_world_m
        assert segments.names == sorted(segments.names)
        index = {name: number for number, name in enumerate(segments.names)}
        distance = (points - f64([0.1, 0.5, 0.25])).norm(dim=2)
        on_ball = segment_id[0] == index["static/ball"]
        assert bool(on_ball.any())
        # it rests a gap of 1 mm above the ground
        assert float((distance[on_ball] - 0.25).abs().max()) < 5e-3
        on_floor = segment_id[0] == index["static/floor"]
        assert torch.equal(on_floor, points[..., 2].abs() < 1e-5)
        assert torch.equal(
            segment_id[0] == index["static/north"], (points[..., 1] - 2).abs() < 1e-5
        )


@pytest.mark.parametrize("world", list(worlds.WORLDS))
def test_every_world_has_a_clear_path_of_every_family(world):
    with torch.no_grad():
        scene, stage = make_world(world)
        cam = camera(size=16)
        for family in motions.FAMILIES:
            one, two = (motions.motion(family, stage, scene, cam, 1.5, seeded(3)) for _ in range(2))
            t = motions.LEAD_S + torch.linspace(0, 1.5, 7, dtype=D)
            assert torch.equal(one(t), two(t))
            for k in (0, 3, 6):
                seen = view(cam, scene, one(t), k)
                assert float(seen.valid.double().mean()) > motions.SEEN - 0.1
                assert float(seen.depth_m[seen.valid].min()) > 0.8 * motions.CLEAR_M


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    threads = torch.get_num_threads()
    folder = tmp_path_factory.mktemp("data") / "set"
    assert ran(study, f"{SMALL} --flo --out", folder) == 0
    torch.set_num_threads(threads)
    return folder


def names(folder):
    return stored(folder, "manifest")["sequences"]


def test_the_manifest_holds_the_hash_of_every_file(dataset):
    check_page("make_dataset", dataset)
    manifest = stored(dataset, "manifest")
    assert manifest["sequences"] == ["sequence_000_orbital", "sequence_001_radial"]
    own = {"camera.h5", "events.h5", "frames.h5", "lens.json", "poses.txt", "sequence.json"}
    own |= {f"flow/forward/{k:06d}.{kind}" for k in range(13) for kind in ("png", "flo")}
    own.add("flow/forward_timestamps.txt")
    for name in manifest["sequences"]:
        files = [path for path in (dataset / name).rglob("*") if path.is_file()]
        assert {path.relative_to(dataset / name).as_posix() for path in files} == own
    every = {f"{name}/{file}" for name in manifest["sequences"] for file in own}
    assert set(manifest["files"]) == every
    for name, entry in manifest["files"].items():
        content = (dataset / name).read_bytes()
        assert entry == {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}


@pytest.mark.bits
def test_events_are_those_of_the_stored_frames_whatever_the_chunks(dataset):
    for index, name in enumerate(names(dataset)):
        with (
            store.h5(dataset / name / "frames.h5") as frames,
            store.h5(dataset / name / "events.h5") as events,
        ):
            t_s = torch.from_numpy(frames["t_s"][()])
            close(t_s, torch.arange(14, dtype=D) / 90, atol=1e-15)
            np.testing.assert_array_equal(
                frames["timestamps"][()], np.rint(np.arange(14) / 90 * 1e6)
            )
            whole = simulate(
                torch.from_numpy(frames["frames"][()]),
                t_s,
                SensorModel(0.2, 0.2, 0.02, shot_rate_hz=0.1),
                state=SensorState(generator=seeded(2 * index + 1)),
            )
            assert len(whole) > 200
            kinds = ("uint16", "uint16", "uint8", "uint32")
            columns = (whole.x, whole.y, (whole.p > 0).long(), whole.t_us)
            for key, kind, values in zip("xypt", kinds, columns, strict=True):
                np.testing.assert_array_equal(events[f"events/{key}"][()], values.numpy())
                assert events[f"events/{key}"].dtype.name == kind
            t = events["events/t"][()].astype(np.int64)
            index_of = events["ms_to_idx"][()].astype(np.int64)
            assert int(events["t_offset"][()]) == 0
            assert len(index_of) * 1000 > t[-1]
            for ms, first in enumerate(index_of):  # the definition in the format's documentation
                assert first == len(t) or t[first] >= ms * 1000
                assert first == 0 or t[first - 1] < ms * 1000


def test_flow_files_hold_the_flow_and_the_truth_is_the_renderers(dataset):
    scene, _ = make_world("room")
    cam = camera()
    for name in names(dataset):
        with store.h5(dataset / name / "frames.h5") as frames:
            T, flow, valid = (
                torch.from_numpy(frames[key][()]) for key in ("poses", "flow", "valid")
            )
            with torch.no_grad():
                slow = flow_and_occlusion(cam, scene, T)
                images = render.frames(cam, scene, T)
            assert torch.equal(valid, slow.valid)
            # the chart's, and float32
            close(flow.double(), slow.flow_px, atol=2e-6)
            close(torch.from_numpy(frames["frames"][()]), images, atol=1e-4)
            close(
                torch.from_numpy(frames["depth"][3]).double(),
                view(cam, scene, T, 3).depth_m,
                rtol=1e-6,
            )
            step = inverse(T[:-1]) @ T[1:]
            velocity = torch.from_numpy(frames["velocity"][()])
            middle = se3_exp((velocity[:-1] + velocity[1:]) / 180)
            # trapezium rule over 1/90 s: dt^3/12 of the jerk, which for a swing of 0.3 m at 0.7 Hz
            # is 26 m/s^3
            close(step, middle, atol=3e-6)
        for k in range(13):
            for kind, tolerance in (("png", 1 / 256), ("flo", 0)):
                stored, seen = read_flow(dataset / name / "flow" / "forward" / f"{k:06d}.{kind}")
                assert torch.equal(seen, valid[k])
                assert float((stored - flow[k]).abs().max()) <= tolerance
        t_s, T_text = read_tum(dataset / name / "poses.txt")
        close(T_text, T, atol=1e-12)
        lines = (dataset / name / "flow" / "forward_timestamps.txt").read_text().splitlines()
        assert lines[1:3] == ["0, 11111", "11111, 22222"]
        assert len(lines) == 14


def test_the_calibration_is_the_cameras(dataset):
    folder = dataset / names(dataset)[0]
    cam = camera()
    with store.h5(folder / "camera.h5") as file:
        rays = cam.chief_rays(cam.film.pixels())
        for name, values in (("direction", rays.direction), ("origin_m", rays.origin_m)):
            stored = file[name][()].reshape(-1, 3)
            np.testing.assert_allclose(stored, values.detach().numpy(), rtol=0, atol=1e-15)
        # near the axis the lens is the pinhole of K; at 0.7 px its distortion, some percent at the
        # border 17 px away, is 0.002 of that
        seen = file["K"][()] @ (file["direction"][12, 12] / file["direction"][12, 12, 2])
        np.testing.assert_allclose(seen, [12, 12, 1], rtol=0, atol=1e-4)
        # the film stands off the focal plane by a little
        np.testing.assert_allclose(file["K"][0, 0], 8.0 / file.attrs["pixel_pitch_mm"], rtol=1e-2)
    back = lens.load(folder / "lens.json")
    assert float(back.first_order().efl_mm.detach()) == pytest.approx(8.0, rel=1e-12)


def kill_when(folder, appears, *options):
    """Start the study and end it with SIGKILL as soon as a file matching ``appears`` is there;
    False when it ended first."""
    command = [sys.executable, "-m", "studies.make_dataset", *options]
    silent = subprocess.DEVNULL
    process = subprocess.Popen(command, cwd=ROOT, stdout=silent, stderr=silent)
    deadline = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < deadline:
        if any(folder.glob(appears)):
            os.kill(process.pid, signal.SIGKILL)
            break
        time.sleep(1e-3)
    return process.wait() == -signal.SIGKILL


@pytest.mark.slow
def test_a_run_killed_many_times_ends_with_the_same_bytes(dataset, tmp_path):
    folder = tmp_path / "set"
    resume = ("--resume", str(folder))
    begin = (*SMALL.split(), "--flo", "--out", str(folder))
    assert kill_when(folder, "sequence_000_orbital/flow/forward/000002.png", *begin)
    assert not (folder / "manifest.json").exists()
    for appears in ("*/events.h5", "sequence_001*/parts/000002.h5"):
        assert kill_when(folder, appears, *resume)
    # a finished one is finished
    for again in ("--processes 2 --resume", "--resume"):
        assert ran(study, again, folder) == 0
        assert (folder / "manifest.json").read_bytes() == (dataset / "manifest.json").read_bytes()
    for name in stored(folder, "manifest")["files"]:
        assert (folder / name).read_bytes() == (dataset / name).read_bytes()
    assert not [
        path for path in folder.rglob("*") if path.name.startswith(".") or path.name == store.PARTS
    ]


def test_folders_with_other_things_and_damaged_parts_are_refused_in_one_sentence(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert ran(study, f"{SMALL} --out", tmp_path) == 2
    assert "holds other things (notes.txt)" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    part = store.part_path(tmp_path, 0)
    part.parent.mkdir()
    part.write_bytes(b"not HDF5")
    with pytest.raises(ValueError, match="go on again with --resume"):
        store.read_state(part)


def test_paths_that_cannot_keep_clear_are_refused():
    # at the wall
    stage = Stage(low_m=(0.0, 1.99, 1.0), high_m=(0.0, 1.995, 1.0), target_m=(0.0, 3.0, 1.0))
    with pytest.raises(DomainError, match="none of 200 radial paths"):
        motions.motion("radial", stage, worlds.room(), camera(size=16), 1.0, seeded())


def test_the_example_of_the_documentation_runs(dataset):
    text = (ROOT / "docs" / "datasets.md").read_text()
    code = re.search(r"```python\n(.*?)```", text, re.S)
    assert code is not None
    text = code.group(1).replace("runs/mine", str(dataset))
    names_there: dict = {}
    exec(text.replace("sequence_003_driving", "sequence_000_orbital"), names_there)
    assert names_there["frames"].shape == (14, 24, 24)
    assert len(names_there["x"]) == len(names_there["t"]) > 0
