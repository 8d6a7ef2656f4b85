"""DSEC and MVSEC in their published layouts: windows against closed forms, damage before
training."""
# pyright: reportArgumentType=false

import hdf5plugin
import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import CodesignError
from codesign.flow.files import write_flow
from codesign.flow.sources import DsecWindows, MvsecWindows, open_windows
from codesign.flow.sources.dsec import splatted
from studies.make_dataset.store import h5
from tests import recording_case, refusals
from tests.event_streams import random_stream
from tests.numbers import close
from tests.recording_case import stores

# DSEC


DSEC = random_stream(6000, 120, 160, 450_000, 1_000_000)


def dsec_field(k):
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    return torch.stack([(x - 50) / 64 + k, (y - 30) / 32]), (x + y) % 3 > 0


def make_dsec(folder, shift=(0.0, 0.0), two=False):
    """A sequence of 120 x 160 px in the published layout, events packed by Blosc; rectification
    moves everything by ``shift`` (x, y). two: events and flow lie apart."""
    held = folder / "train_events" / "thun_00_a" if two else folder / "thun_00_a"
    flows = folder / "train_optical_flow" / "thun_00_a" if two else held
    place = held / "events" / "left"
    place.mkdir(parents=True)
    (flows / "flow" / "forward").mkdir(parents=True)
    events.write(place / "events.h5", DSEC)
    with h5(place / "events.h5", "r+") as file:
        for key in "xypt":
            values = file[f"events/{key}"][()]
            del file[f"events/{key}"]
            packing = hdf5plugin.Blosc(cname="zstd")
            file["events"].create_dataset(key, data=values, chunks=(1000,), **packing)
    y, x = np.mgrid[0:120, 0:160].astype(np.float32)
    with h5(place / "rectify_map.h5", "w") as file:
        file["rectify_map"] = np.stack([x + np.float32(shift[0]), y + np.float32(shift[1])], -1)
    for k, number in enumerate((2, 4, 10)):
        write_flow(flows / "flow" / "forward" / f"{number:06d}.png", *dsec_field(k))
    (flows / "flow" / "forward_timestamps.txt").write_text(
        "# from_timestamp_us, to_timestamp_us\n1100000, 1200000\n1200000, 1300000\n1310000, 1410000\n"
    )
    return folder


@pytest.mark.parametrize("two", [False, True])
def test_dsec_windows(two, tmp_path):
    source = DsecWindows(make_dsec(tmp_path / "dsec", (3.0, -2.0), two), bins=5, size_px=(120, 160))
    assert len(source) == 3
    batch = source.batch([2, 0])
    for k, (index, t0_us) in enumerate(((2, 1_310_000), (0, 1_100_000))):
        flow, valid = dsec_field(index)
        assert torch.equal(batch.truth.flow_px[k], torch.where(valid, flow, 0.0))
        assert torch.equal(batch.truth.valid[k], valid)
        plain = events.from_stream(DSEC, t0_us, t0_us + 100_000, 5).counts[0]
        moved = torch.zeros_like(plain)  # three to the right, two up; what leaves is gone
        moved[..., :-2, 3:] = plain[..., 2:, :-3]
        close(batch.volume.counts[k], moved, atol=1e-6)
    assert batch.truth.interval_s == pytest.approx(0.1)
    assert batch.frames is None


def test_events_between_pixels_are_shared_and_none_is_lost():
    t_us = torch.tensor([100, 150, 200])
    x, y = torch.tensor([2.25, 3.0, -0.5]), torch.tensor([1.5, 2.0, 0.0])
    counts = splatted(t_us, x, y, torch.tensor([True, False, True]), 100, 200, 3, 4, 6)
    expected = torch.zeros(2, 3, 4, 6)
    expected[0, 0, 1:3, 2], expected[0, 0, 1:3, 3] = 0.375, 0.125
    expected[1, 1, 2, 3] = 1.0
    expected[0, 2, 0, 0] = 0.5  # half of it lies outside
    close(counts, expected, atol=1e-7)


# MVSEC


MVSEC = random_stream(9000, 26, 34, 600_000, 10_000_000, seed=3)
ROWS = np.stack([MVSEC.x, MVSEC.y, MVSEC.t_us.double() / 1e6, MVSEC.p], 1, dtype=np.float64)


def make_mvsec(folder, chunks=None):
    """indoor_flying1 of 26 x 34 px: flow (8, -4) px per 50 ms, grey frames every 31.25 ms; nothing
    measured in the first columns."""
    folder.mkdir(parents=True)
    packing = {} if chunks is None else {"chunks": chunks, "compression": "gzip"}
    with h5(folder / GREY, "w") as file:
        group = file.create_group("davis/left")
        group.create_dataset("events", data=ROWS, **packing)
        group["image_raw_ts"] = 10.0 + np.arange(19) * 0.03125
        group["image_raw"] = np.zeros((19, 26, 34), np.uint8)
    seen = np.arange(34) >= 5
    flow = {f"{k}_flow_dist": np.full((11, 26, 34), v) * seen for k, v in (("x", 8.0), ("y", -4.0))}
    save = np.savez if chunks is None else np.savez_compressed  # left on the disk, or read
    save(folder / GT, timestamps=10.02 + 0.05 * np.arange(11), **flow)
    return folder


@pytest.mark.parametrize(
    ("frames", "chunks", "length_s", "grid"),
    [
        (1, None, 0.03125, 10 + 0.03125 * np.arange(18)),
        (4, (1000, 4), 0.125, 10 + 0.03125 * np.arange(15)),
        (0, (777, 1), 0.05, 10.02 + 0.05 * np.arange(10)),
    ],
)
def test_mvsec_windows(frames, chunks, length_s, grid, tmp_path):
    source = MvsecWindows(make_mvsec(tmp_path / "m", chunks), frames, bins=5)
    starts = grid[(grid >= 10.02) & (grid + length_s <= 10.52 + 1e-9)]
    assert (len(source), source.left_out) == (len(starts), 0)
    index = len(source) // 2
    t0_s, t1_s = starts[index], starts[index] + length_s
    batch = source.batch([index])
    expected = events.from_stream(MVSEC, round(t0_s * 1e6), round(t1_s * 1e6), 5).counts
    assert torch.equal(batch.volume.counts, expected)
    flow, valid = batch.truth.flow_px[0], batch.truth.valid[0]
    truth = torch.tensor([[8.0], [-4.0]]).expand(2, int(valid.sum())) * (length_s / 0.05)
    close(flow[:, valid], truth, rtol=1e-6, atol=1e-5)
    # followed through as many intervals as the window touches: it ends where a lookup, one
    # interval's part before the end, leaves the picture
    edges = 10.02 + 0.05 * np.arange(12)
    parts = np.clip(np.minimum(t1_s, edges[1:]) - np.maximum(t0_s, edges[:-1]), 0, None) / 0.05
    before_last = parts.sum() - parts[parts > 1e-9][-1]
    y, x = np.mgrid[0:26, 0:34]
    inside = (x >= 5) & (x + 8 * before_last <= 33 + 1e-6) & (y - 4 * before_last >= -1e-6)
    np.testing.assert_array_equal(valid.numpy(), inside)
    assert batch.truth.interval_s == pytest.approx(length_s)


def test_windows_end_with_the_events(tmp_path):
    make_mvsec(tmp_path / "m")
    stores(tmp_path / "m" / GREY, "davis/left/events", ROWS[MVSEC.t_us < 10_300_000])
    # flows begin at 10.02 s, 50 ms apart
    assert len(MvsecWindows(tmp_path / "m", frames=0)) == 5


@pytest.mark.parametrize("layout", ["dsec", "mvsec"])
def test_an_event_between_two_windows_is_in_the_second_alone(layout, tmp_path):
    """Five events on every border: each is counted once, those at the last end of all too where the
    recording ends with it."""
    folder = tmp_path / "set"
    if layout == "dsec":
        make_dsec(folder)
        borders = [1_100_000, 1_200_000, 1_300_000]
        t = np.repeat(borders, 5) - 1_000_000  # since t_offset
        path = folder / LEFT / "events.h5"
        for key, values in (("t", t), ("x", 0 * t), ("y", 0 * t), ("p", 0 * t + 1)):
            stores(path, f"events/{key}", values.astype(np.uint32))
        stores(path, "t_offset", np.array(1_000_000))
        stores(path, "ms_to_idx", np.searchsorted(t, 1000 * np.arange(301)))
        (folder / TIMES).write_text("1100000, 1200000\n1200000, 1300000\n")
        (folder / FLOW / "forward" / "000010.png").unlink()
        source = DsecWindows(folder, bins=1, size_px=(120, 160))
        expected = [5, 10]  # the recording ends with the second
    else:
        make_mvsec(folder)
        t = np.repeat(10.02 + 0.05 * np.arange(12), 5)
        rows = np.stack([0 * t, 0 * t, t, 0 * t + 1], 1)
        stores(folder / GREY, "davis/left/events", rows)
        source = MvsecWindows(folder, frames=0, bins=1)
        expected = [5] * 10
    counts = source.batch(range(len(source))).volume.counts
    assert counts.sum((1, 2, 3, 4)).tolist() == expected


# damage


def dsec(folder):
    make_dsec(folder)
    return lambda folder: DsecWindows(folder, size_px=(120, 160))


def mvsec(folder):
    make_mvsec(folder)
    return MvsecWindows


LEFT = "thun_00_a/events/left"
FLOW = "thun_00_a/flow"
TIMES = f"{FLOW}/forward_timestamps.txt"
GREY = "indoor_flying1_data.hdf5"
GT = "indoor_flying1_gt_flow_dist.npz"


@refusals.table(__file__, "damaged published sets")
def test_damage_is_refused_at_once(row, tmp_path):
    def spoiled(source, path, damage, *given):
        opened = source(tmp_path / "set")
        damage(tmp_path / "set" / path, *given)
        return opened(tmp_path / "set")

    row.holds(vars(recording_case) | globals() | {"spoiled": spoiled})


def test_a_folder_is_opened_as_what_it_is(tmp_path):
    # DSEC's own size
    with pytest.raises(
        CodesignError, match=r"rectify_map has shape \[120, 160, 2\], \[480, 640, 2\]"
    ):
        open_windows(make_dsec(tmp_path / "d"))
    assert isinstance(open_windows(make_mvsec(tmp_path / "m"), window_frames=1), MvsecWindows)
    with pytest.raises(CodesignError, match="no window"):
        MvsecWindows(tmp_path / "m", span_s=(0.0, 0.01))
    (tmp_path / "empty").mkdir()
    with pytest.raises(CodesignError, match=r"holds no events: no events\.txt"):
        open_windows(tmp_path / "empty")
    with pytest.raises(CodesignError, match="nothing lies at"):
        open_windows(tmp_path / "absent")
