"""Windows of our data sets and of recordings: against what is stored and the renderer; damage
before training."""
# pyright: reportCallIssue=false, reportOptionalSubscript=false

import shutil

import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import CodesignError, ShapeError
from codesign.events.stream import ordered
from codesign.flow.export import evenly_timed
from codesign.flow.sources import DatasetWindows, PacketOptions, RecordingWindows, open_windows
from codesign.flow.sources.windows import bin_times
from codesign.render import flow_and_occlusion
from scenes import worlds
from studies.frame.run import main
from studies.make_dataset import __main__ as study
from studies.make_dataset.store import h5
from tests import recording_case, refusals
from tests.numbers import close
from tests.recording_case import eth_text, made


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    threads = torch.get_num_threads()
    folder = tmp_path_factory.mktemp("data") / "set"
    options = "--trajectories 2 --frames 13 --size 40 --samples 2 --chunk 5 --rate-hz 90 --out"
    assert main(study.study, study.Config, [*options.split(), str(folder)]) == 0
    torch.set_num_threads(threads)
    return folder


def stored(dataset, name):
    """Stream, and all that is stored with the frames, of a sequence."""
    stream = events.read(dataset / name / "events.h5", height_px=40, width_px=40)
    with h5(dataset / name / "frames.h5") as file:
        return stream, {key: file[key][()] for key in file}


@pytest.mark.bits
def test_windows_of_one_interval_are_what_is_stored(dataset):
    assert isinstance(open_windows(dataset, window_frames=2), DatasetWindows)
    source = DatasetWindows(dataset, bins=4)
    assert len(source) == 24
    batch = source.batch([15, 2])
    for k, (name, frame) in enumerate((("sequence_001_radial", 3), ("sequence_000_orbital", 2))):
        stream, file = stored(dataset, name)
        volume = events.from_stream(
            stream, *(int(t) for t in file["timestamps"][frame : frame + 2]), 4
        )
        assert volume.counts.sum() > 0
        assert torch.equal(batch.volume.counts[k], volume.counts[0])
        for found, right in (
            (batch.truth.flow_px, file["flow"][frame]),
            (batch.truth.valid, file["valid"][frame]),
            (batch.frames, file["frames"][frame : frame + 2]),
        ):
            np.testing.assert_array_equal(found[k].numpy(), right)
        # frame times are whole microseconds: 11111 or 11112
        close(batch.volume.centroid_s, volume.centroid_s, rtol=1e-4)
        close(batch.volume.collected_s, volume.collected_s, rtol=1e-4)
    assert batch.truth.interval_s == pytest.approx(1 / 90, rel=1e-4)


def test_flow_over_several_frames_is_the_renderers(dataset):
    stream, file = stored(dataset, "sequence_000_orbital")
    camera = study.make_camera(study.Config(size=40, samples=2))
    with torch.no_grad():
        rendered = flow_and_occlusion(
            camera, worlds.room(), torch.from_numpy(file["poses"])[[6, 12]]
        )
    truth, seen = rendered.flow_px[0], rendered.valid[0]
    assert truth.norm(dim=0).mean() > 1
    source = DatasetWindows(dataset / "sequence_000_orbital", window_frames=6)
    assert len(source) == 2
    batch = source.batch([1])
    both = batch.truth.valid[0] & seen
    # points far outside the picture have no place in the fit
    assert (both == seen).double().mean() > 0.99
    # float32 depth to 6e-8 of some metres over a flow of some px, and the fit of the camera (1e-4
    # px, measured with traced rays)
    assert (batch.truth.flow_px[0].double() - truth).norm(dim=0)[both].max() < 2e-4
    np.testing.assert_array_equal(batch.frames[0].numpy(), file["frames"][[6, 12]])
    ends = (int(file["timestamps"][k]) for k in (6, 12))
    assert torch.equal(batch.volume.counts, events.from_stream(stream, *ends, 8).counts)


@pytest.mark.bits
def test_pieces_depend_on_seed_and_number_alone(dataset):
    source = DatasetWindows(dataset, crop_px=(16, 24), seed=5)
    one, other = source.batch([7, 3]), source.batch([3])
    assert torch.equal(one.volume.counts[1], other.volume.counts[0])
    full = DatasetWindows(dataset).batch([3])
    pieces = [
        (slice(top, top + 16), slice(left, left + 24)) for top in range(25) for left in range(17)
    ]
    found = [
        torch.equal(full.truth.flow_px[(0, ..., *piece)], other.truth.flow_px[0])
        and torch.equal(full.volume.counts[(0, ..., *piece)], other.volume.counts[0])
        and torch.equal(full.frames[(0, ..., *piece)], other.frames[0])
        for piece in pieces
    ]
    assert sum(found) == 1
    again = [DatasetWindows(dataset, crop_px=(16, 24), seed=seed).batch([3]) for seed in range(3)]
    assert not all(torch.equal(batch.truth.flow_px, other.truth.flow_px) for batch in again)
    with pytest.raises(ShapeError, match="the pictures have 40 x 40"):
        DatasetWindows(dataset, crop_px=(16, 41))


@refusals.table(__file__, "numbers of windows")
def test_numbers_that_mean_nothing(row, dataset):
    row.holds({"DatasetWindows": DatasetWindows, "folder": dataset})


def test_times_of_the_bins_are_those_of_from_stream():
    one = torch.tensor([1])
    for bins in (1, 2, 5):
        volume = events.from_stream(ordered(one, one, one, one, 3, 3), 0, 1_000_000, bins)
        right = volume.centroid_s, volume.collected_s
        close(bin_times(bins, 1.0), right, rtol=1e-12)
        ours = evenly_timed(volume.counts) if bins > 1 else volume
        close((ours.centroid_s, ours.collected_s), right, rtol=1e-12)


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
    t_us = columns[0] - columns[0][0]
    assert float(windows.volume.counts.sum()) == pytest.approx((t_us < 100_000).sum())
    assert not bool(windows.truth.valid.any())
    first, middle, last = columns[0][0] + np.array([10_000, 30_000, 80_000])
    np.savez(
        place / "flow.npz", flow=np.ones((2, 2, 180, 240)), t0=[first, middle], t1=[middle, last]
    )
    with pytest.raises(CodesignError, match="must last alike"):
        RecordingWindows(place, options=PacketOptions())


@refusals.table(__file__, "damaged data sets")
def test_damage_is_refused_at_once(row, dataset, tmp_path):
    def spoiled(of, path, damage, *given):
        """The set or one sequence, after what happens to one of its files."""
        shutil.copytree(dataset / of, tmp_path / "set")
        damage(tmp_path / "set" / path, *given)
        return DatasetWindows(tmp_path / "set")

    row.holds(vars(recording_case) | {"spoiled": spoiled})
