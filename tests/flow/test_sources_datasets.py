"""Our data sets as sources of windows: against what is stored and against the renderer; damage before
training; rows of large files."""

import json
import shutil

import h5py
import hdf5plugin
import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import DomainError, FileFormatError, ShapeError
from codesign.events.formats.hdf5_rows import Rows
from codesign.events.stream import ordered
from codesign.flow.sources import DatasetWindows, RecordingWindows, open_windows
from codesign.flow.sources.windows import bin_times
from codesign.flow.warp import chained
from codesign.render import flow_and_occlusion
from scenes import worlds
from studies.frame.run import main
from studies.make_dataset import __main__ as study
from studies.make_dataset.store import h5
from tests.recording_case import eth_text, made

D = torch.float64
OPTIONS = [
    "--trajectories",
    "2",
    "--frames",
    "13",
    "--size",
    "40",
    "--samples",
    "2",
    "--chunk",
    "5",
    "--rate-hz",
    "90",
]


# ours


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    threads = torch.get_num_threads()
    folder = tmp_path_factory.mktemp("data") / "set"
    assert main(study.study, study.Config, [*OPTIONS, "--out", str(folder)]) == 0
    torch.set_num_threads(threads)
    return folder


@pytest.fixture(scope="module")
def rendered(dataset):
    """True flow and occlusion of sequence 0 from frame 3 to frame 9, by the renderer."""
    with h5(dataset / "sequence_000_orbital" / "frames.h5") as file:
        T = torch.from_numpy(file["poses"][()])
    with torch.no_grad():
        camera = study.make_camera(study.Config(size=40, samples=2))
        return flow_and_occlusion(camera, worlds.room(), T[[3, 9]])


@pytest.mark.bits
def test_windows_of_one_interval_are_what_is_stored(dataset):
    assert isinstance(open_windows(dataset, window_frames=2), DatasetWindows)
    source = DatasetWindows(dataset, bins=4)
    assert len(source) == 24
    batch = source.batch([15, 2])
    for k, (name, frame) in enumerate((("sequence_001_radial", 3), ("sequence_000_orbital", 2))):
        stream = events.read(dataset / name / "events.h5", height_px=40, width_px=40)
        with h5(dataset / name / "frames.h5") as file:
            t0_us, t1_us = (int(v) for v in file["timestamps"][frame : frame + 2])
            volume = events.from_stream(stream, t0_us, t1_us, 4)
            assert float(volume.counts.sum()) > 0
            assert torch.equal(batch.volume.counts[k], volume.counts[0])
            np.testing.assert_array_equal(batch.truth.flow_px[k].numpy(), file["flow"][frame])
            np.testing.assert_array_equal(batch.truth.valid[k].numpy(), file["valid"][frame])
            assert batch.frames is not None
            np.testing.assert_array_equal(batch.frames[k].numpy(), file["frames"][frame : frame + 2])
        torch.testing.assert_close(
            batch.volume.centroid_s, volume.centroid_s, rtol=1e-4, atol=0
        )  # frame times are whole microseconds: 11111 or 11112
        torch.testing.assert_close(batch.volume.collected_s, volume.collected_s, rtol=1e-4, atol=0)
    assert batch.truth.interval_s == pytest.approx(1 / 90, rel=1e-4)
    alone = source.batch([2])
    assert torch.equal(alone.volume.counts[0], batch.volume.counts[1])


def test_flow_over_several_frames_is_the_renderers(dataset, rendered):
    source = DatasetWindows(dataset / "sequence_000_orbital", window_frames=6, stride_frames=3)
    assert len(source) == 3
    batch = source.batch([1])
    truth = rendered.flow_px[0]
    seen = rendered.valid[0]
    assert float(truth.norm(dim=0).mean()) > 1
    both = batch.truth.valid[0] & seen
    assert (
        float((both == seen).double().mean()) > 0.99
    )  # points far outside the picture have no place in the fit
    # float32 depth to 6e-8 of some metres over a flow of some px, and the fit of the camera (1e-4 px,
    # measured with traced rays)
    assert float((batch.truth.flow_px[0].double() - truth).norm(dim=0)[both].max()) < 2e-4
    stream = events.read(dataset / "sequence_000_orbital" / "events.h5", height_px=40, width_px=40)
    with h5(dataset / "sequence_000_orbital" / "frames.h5") as file:
        t0_us = int(file["timestamps"][3])
        t1_us = int(file["timestamps"][9])
        assert batch.frames is not None
        np.testing.assert_array_equal(batch.frames[0].numpy(), file["frames"][()][[3, 9]])
    assert torch.equal(batch.volume.counts, events.from_stream(stream, t0_us, t1_us, 8).counts)


def test_flow_followed_from_frame_to_frame_is_near_the_renderers(dataset, rendered):
    sequence = DatasetWindows(dataset / "sequence_000_orbital", window_frames=6).sequences[0]
    flows, valid, occluded = (
        torch.from_numpy(sequence.rows[name].read(3, 9)) for name in ("flow", "valid", "occluded")
    )
    flow, seen = chained(flows.double(), valid, occluded)
    seen = seen & rendered.valid[0]
    assert float(seen.double().mean()) > 0.5
    error = (flow - rendered.flow_px[0]).norm(dim=0)[seen]
    # bilinear lookups smooth the flow by its curvature; across edges of depth that differ by less than the
    # threshold it is wrong by a part of that
    assert float(error.median()) < 0.01
    assert float(error.quantile(0.95)) < 0.3


@pytest.mark.bits
def test_pieces_depend_on_seed_and_number_alone(dataset):
    whole = DatasetWindows(dataset)
    source = DatasetWindows(dataset, crop_px=(16, 24), seed=5)
    one = source.batch([7, 3])
    other = source.batch([3])
    assert one.volume.counts.shape == (2, 2, 8, 16, 24)
    assert one.frames is not None
    assert one.frames.shape == (2, 2, 16, 24)
    assert torch.equal(one.volume.counts[1], other.volume.counts[0])
    full = whole.batch([3])
    found = [
        (top, left)
        for top in range(25)
        for left in range(17)
        if torch.equal(full.truth.flow_px[0, :, top : top + 16, left : left + 24], other.truth.flow_px[0])
        and torch.equal(full.volume.counts[0, ..., top : top + 16, left : left + 24], other.volume.counts[0])
    ]
    assert len(found) == 1
    moved = [
        not torch.equal(
            DatasetWindows(dataset, crop_px=(16, 24), seed=seed).batch([3]).truth.flow_px, other.truth.flow_px
        )
        for seed in range(5)
    ]
    assert any(moved)
    with pytest.raises(ShapeError, match="the pictures have 40 x 40"):
        DatasetWindows(dataset, crop_px=(16, 41))


def damaged(dataset, tmp_path, what):
    folder = tmp_path / "set"
    shutil.copytree(dataset, folder)
    place = folder / "sequence_001_radial"
    if what == "missing":
        (place / "events.h5").unlink()
    elif what == "cut":
        content = (place / "frames.h5").read_bytes()
        (place / "frames.h5").write_bytes(content[: len(content) // 2])
    elif what == "cut, no manifest":
        content = (place / "frames.h5").read_bytes()
        (place / "frames.h5").write_bytes(content[: len(content) // 2])
        return place
    elif what == "manifest":
        (folder / "manifest.json").unlink()
    elif what == "format":
        manifest = json.loads((folder / "manifest.json").read_text())
        (folder / "manifest.json").write_text(json.dumps({**manifest, "format": "codesign-dataset/9"}))
    elif what in ("shape", "times", "index"):
        with h5(place / ("events.h5" if what == "index" else "frames.h5"), "r+") as file:
            if what == "shape":
                del file["flow"]
                file["flow"] = np.zeros((12, 2, 40, 39), np.float32)
            elif what == "times":
                file["timestamps"][4] = 0
            else:
                file["ms_to_idx"][5] = 10**9
        return place
    return folder


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("missing", "lacks events.h5"),
        ("cut", "by the manifest; it was cut"),
        ("cut, no manifest", "cut or damaged"),
        ("manifest", "has no manifest.json"),
        ("format", "format 'codesign-dataset/9'"),
        ("shape", r"flow has shape \[12, 2, 40, 39\], \[12, 2, 40, 40\] is needed"),
        ("times", "do not rise"),
        ("index", "no index"),
    ],
)
def test_damaged_data_sets_are_refused_at_once(what, reason, dataset, tmp_path):
    with pytest.raises(FileFormatError, match=reason):
        DatasetWindows(damaged(dataset, tmp_path, what))


def test_numbers_that_mean_nothing(dataset):
    source = DatasetWindows(dataset)
    for call, reason in (
        (lambda: source.batch([24]), "the source has 24"),
        (lambda: source.batch([-1]), "the source has 24"),
        (lambda: source.batch([]), "no samples"),
        (lambda: DatasetWindows(dataset, window_frames=13), "no sequence"),
        (lambda: DatasetWindows(dataset, window_frames=0), "whole numbers from 1"),
    ):
        with pytest.raises(DomainError, match=reason):
            call()
    with pytest.raises(FileFormatError, match="has no sequence 'x'"):
        DatasetWindows(dataset, sequences=["x"])


# rows of files


@pytest.mark.parametrize(
    "packing",
    [
        {},
        {"chunks": (7, 2, 3)},
        {"chunks": (7, 2, 3), "compression": "gzip", "shuffle": True, "fletcher32": True},
        {"chunks": (16, 4, 5), **hdf5plugin.Blosc()},
    ],
)
def test_rows_are_those_of_the_library(packing, tmp_path):
    values = np.random.default_rng(0).normal(size=(50, 4, 5))
    with h5(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=values, **packing)
    rows = Rows(tmp_path / "a.h5", "a", (4, 5), 50)
    for first, last in ((0, 50), (6, 8), (7, 14), (49, 50), (20, 20)):
        np.testing.assert_array_equal(rows.read(first, last), values[first:last])
    np.testing.assert_array_equal(rows[33], values[33])
    with pytest.raises(FileFormatError, match="rows 40 to 51"):
        rows.read(40, 51)


def test_rows_refuse_what_the_library_would_end_the_process_on(tmp_path):
    path = tmp_path / "a.h5"
    with h5(path, "w") as file:
        data = file.create_dataset("a", (40,), np.int32, chunks=(10,), compression="gzip")
        data[:] = np.arange(40)
        data.id.write_direct_chunk((20,), b"\x78\x9c\x03\x00\x00\x00\x00\x01")  # unpacks to nothing
        file.create_dataset("b", data=np.arange(40), chunks=(10,), compression="lzf")
        file["c"] = h5py.SoftLink("/a")
        file["d"] = np.array([b"text"])
    rows = Rows(path, "a")
    np.testing.assert_array_equal(rows.read(0, 20), np.arange(20))
    with pytest.raises(FileFormatError, match="does not unpack"):
        rows.read(0, 40)
    for name, reason in (
        ("b", "went through the filters"),
        ("c", "absent or a link"),
        ("d", "no list of numbers"),
        ("e", "absent or a link"),
    ):
        with pytest.raises(FileFormatError, match=reason):
            Rows(path, name)


def test_times_of_the_bins_are_those_of_from_stream():
    one = torch.tensor([1])
    stream = ordered(one, one, one, one, 3, 3)
    for bins in (1, 2, 5):
        volume = events.from_stream(stream, 0, 1000, bins)
        for found, expected in zip(
            bin_times(bins, 1e-3), (volume.centroid_s, volume.collected_s), strict=True
        ):
            torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)


def test_a_recording_is_a_source_of_windows(tmp_path):
    """Events of a text file, all of them, in windows of the length asked for; no flow is known."""
    columns = made(2000, duration_s=0.101)
    place = tmp_path / "set" / "walk"
    place.mkdir(parents=True)
    (place / "events.txt").write_text(eth_text(columns))
    source = open_windows(place, bins=4, window_s=0.025)
    assert isinstance(source, RecordingWindows)
    windows = source.batch(range(len(source)))
    assert windows.volume.counts.shape == (4, 2, 4, 180, 240)
    first_us = columns[0][0]
    inside = (columns[0] - first_us <= 100_000).sum()
    # an event on the border of two windows is in both
    borders = sum(int((columns[0] - first_us == k * 25_000).sum()) for k in (1, 2, 3))
    assert float(windows.volume.counts.sum()) == pytest.approx(inside + borders)
    assert not bool(windows.truth.valid.any())
