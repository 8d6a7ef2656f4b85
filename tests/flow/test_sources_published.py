"""DSEC and MVSEC in their published layouts: windows against closed forms, damage before training."""

import shutil

import hdf5plugin
import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import CodesignError, FileFormatError
from codesign.events.stream import ordered
from codesign.flow.files import write_flow
from codesign.flow.sources import DsecWindows, MvsecWindows, open_windows
from codesign.flow.sources.dsec import splatted
from studies.make_dataset.store import h5

# DSEC


def some_events(count, size, t0_us, t1_us, seed=0):
    draw = torch.Generator().manual_seed(seed)
    t_us, x, y, on = (
        torch.randint(low, high, (count,), generator=draw)
        for low, high in ((t0_us, t1_us + 1), (0, size[1]), (0, size[0]), (0, 2))
    )
    return ordered(t_us, x, y, 2 * on - 1, *size)


def dsec_field(k):
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    return torch.stack([(x - 50) / 64 + k, (y - 30) / 32]), (x + y) % 3 > 0


def make_dsec(folder, shift=(0.0, 0.0), layout="one", blosc=False, name="thun_00_a"):
    """A sequence of 120 x 160 px in the published layout; rectification moves everything by ``shift`` (x,
    y)."""
    held, flows = (
        (folder / "train_events" / name, folder / "train_optical_flow" / name)
        if layout == "two"
        else (folder / name, folder / name)
    )
    place = held / "events" / "left"
    place.mkdir(parents=True)
    (flows / "flow" / "forward").mkdir(parents=True)
    stream = some_events(6000, (120, 160), 1_000_000, 1_450_000)
    events.write(place / "events.h5", stream)
    if blosc:  # as published
        with h5(place / "events.h5", "r+") as file:
            for key in "xypt":
                values = file[f"events/{key}"][()]
                del file[f"events/{key}"]
                file["events"].create_dataset(
                    key, data=values, chunks=(1000,), **hdf5plugin.Blosc(cname="zstd", clevel=3, shuffle=1)
                )
    y, x = np.mgrid[0:120, 0:160].astype(np.float32)
    with h5(place / "rectify_map.h5", "w") as file:
        file["rectify_map"] = np.stack([x + np.float32(shift[0]), y + np.float32(shift[1])], -1)
    spans = [(1_100_000, 1_200_000), (1_200_000, 1_300_000), (1_310_000, 1_410_000)]
    for k, number in enumerate((2, 4, 10)):
        write_flow(flows / "flow" / "forward" / f"{number:06d}.png", *dsec_field(k))
    lines = ["# from_timestamp_us, to_timestamp_us", *(f"{a}, {b}" for a, b in spans)]
    (flows / "flow" / "forward_timestamps.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize(("layout", "blosc"), [("one", False), ("two", True)])
def test_dsec_windows(layout, blosc, tmp_path):
    folder = make_dsec(tmp_path / "dsec", (3.0, -2.0), layout, blosc)
    source = DsecWindows(folder, bins=5, size_px=(120, 160))
    assert len(source) == 3
    batch = source.batch([2, 0])
    stream = some_events(6000, (120, 160), 1_000_000, 1_450_000)
    for k, (index, t0_us) in enumerate(((2, 1_310_000), (0, 1_100_000))):
        flow, valid = dsec_field(index)
        assert torch.equal(batch.truth.flow_px[k], torch.where(valid, flow, 0.0))
        assert torch.equal(batch.truth.valid[k], valid)
        plain = events.from_stream(stream, t0_us, t0_us + 100_000, 5).counts[0]
        moved = torch.zeros_like(plain)  # three to the right, two up; what leaves is gone
        moved[..., :-2, 3:] = plain[..., 2:, :-3]
        torch.testing.assert_close(batch.volume.counts[k], moved, rtol=0, atol=1e-6)
    assert batch.truth.interval_s == pytest.approx(0.1)
    assert batch.frames is None


def test_events_between_pixels_are_shared_and_none_is_lost():
    t_us = torch.tensor([100, 150, 200])
    on = torch.tensor([True, False, True])
    counts = splatted(
        t_us, torch.tensor([2.25, 3.0, -0.5]), torch.tensor([1.5, 2.0, 0.0]), on, 100, 200, 3, 4, 6
    )
    expected = torch.zeros(2, 3, 4, 6)
    expected[0, 0, 1:3, 2], expected[0, 0, 1:3, 3] = 0.375, 0.125
    expected[1, 1, 2, 3] = 1.0
    expected[0, 2, 0, 0] = 0.5  # half of it lies outside
    torch.testing.assert_close(counts, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("map", "no file lies at .*rectify_map.h5"),
        ("map shape", "rectify_map has shape"),
        ("events", "no file lies at .*events.h5"),
        ("lines", "2 lines for 3 files"),
        ("png", "is not a PNG file"),
        ("clock", "the events of"),
        ("cut", "cut or damaged"),
        ("nothing", "holds no sequence of DSEC"),
        ("left", "is missing; download the events"),
    ],
)
def test_damaged_dsec_is_refused_at_once(what, reason, tmp_path):
    folder = make_dsec(tmp_path / "dsec")
    place = folder / "thun_00_a" / "events" / "left"
    flow = folder / "thun_00_a" / "flow"
    times = flow / "forward_timestamps.txt"
    if what == "map":
        (place / "rectify_map.h5").unlink()
    elif what == "map shape":
        with h5(place / "rectify_map.h5", "w") as file:
            file["rectify_map"] = np.zeros((160, 120, 2), np.float32)
    elif what == "events":
        (place / "events.h5").unlink()
    elif what == "lines":
        times.write_text("\n".join(times.read_text().splitlines()[:-1]))
    elif what == "png":
        (flow / "forward" / "000004.png").write_bytes(b"nothing")
    elif what == "clock":
        times.write_text(times.read_text().replace("1310000, 1410000", "9310000, 9410000"))
    elif what == "cut":
        content = (place / "events.h5").read_bytes()
        (place / "events.h5").write_bytes(content[: len(content) // 2])
    elif what == "left":
        shutil.rmtree(place)
    else:
        shutil.rmtree(flow)
    with pytest.raises(FileFormatError, match=reason):
        DsecWindows(folder, size_px=(120, 160))


# MVSEC


def mvsec_stream():
    return some_events(9000, (26, 34), 10_000_000, 10_600_000, seed=3)


def make_mvsec(folder, chunks=None):
    """indoor_flying1 of 26 x 34 px: flow (8, -4) px per 50 ms, grey frames every 31.25 ms; nothing measured
    in the first columns."""
    folder.mkdir(parents=True)
    stream = mvsec_stream()
    rows = torch.stack(
        [stream.x.double(), stream.y.double(), stream.t_us.double() / 1e6, stream.p.double()], 1
    ).numpy()
    with h5(folder / "indoor_flying1_data.hdf5", "w") as file:
        group = file.create_group("davis/left")
        group.create_dataset(
            "events", data=rows, **({} if chunks is None else {"chunks": chunks, "compression": "gzip"})
        )
        group["image_raw_ts"] = 10.0 + np.arange(19) * 0.03125
        group["image_raw"] = np.zeros((19, 26, 34), np.uint8)
    x_flow = np.full((11, 26, 34), 8.0)
    y_flow = np.full((11, 26, 34), -4.0)
    x_flow[:, :, :5] = y_flow[:, :, :5] = 0.0
    save = np.savez if chunks is None else np.savez_compressed  # left on the disk, or read
    save(
        folder / "indoor_flying1_gt_flow_dist.npz",
        timestamps=10.02 + 0.05 * np.arange(11),
        x_flow_dist=x_flow,
        y_flow_dist=y_flow,
    )
    return folder


@pytest.mark.parametrize(("frames", "chunks"), [(1, None), (4, (1000, 4)), (0, (777, 1))])
def test_mvsec_windows(frames, chunks, tmp_path):
    source = MvsecWindows(make_mvsec(tmp_path / "m", chunks), frames, bins=5)
    length_s = 0.05 if frames == 0 else 0.03125 * frames
    starts = 10.02 + 0.05 * np.arange(10) if frames == 0 else 10 + 0.03125 * np.arange(19)
    starts = [
        float(t)
        for t in starts
        if t >= 10.02
        and t + length_s <= 10.52 + 1e-9
        and (frames == 0 or t + length_s <= 10 + 18 * 0.03125 + 1e-9)
    ]
    assert len(source) == len(starts)
    assert source.left_out == 0
    index = len(source) // 2
    batch = source.batch([index])
    t0_us = round(starts[index] * 1e6)
    expected = events.from_stream(mvsec_stream(), t0_us, round((starts[index] + length_s) * 1e6), 5).counts
    assert torch.equal(batch.volume.counts, expected)
    assert float(expected.sum()) > 0
    flow = batch.truth.flow_px[0]
    valid = batch.truth.valid[0]
    share = length_s / 0.05
    y, x = np.mgrid[0:26, 0:34]
    assert valid[20, 7]
    assert not valid[:, :5].any()
    torch.testing.assert_close(
        flow[:, valid],
        torch.tensor([[8.0], [-4.0]]).expand(-1, int(valid.sum())) * share,
        rtol=1e-6,
        atol=1e-5,
    )
    # followed through as many intervals as the window touches: it ends where a lookup, one interval's part
    # before the end, leaves the picture
    touched = [
        max(0, min(starts[index] + length_s, 10.07 + 0.05 * k) - max(starts[index], 10.02 + 0.05 * k)) / 0.05
        for k in range(11)
    ]
    before_last = sum(touched) - [part for part in touched if part > 1e-9][-1]
    inside = (x >= 5) & (x + 8 * before_last <= 33 + 1e-6) & (y - 4 * before_last >= -1e-6)
    np.testing.assert_array_equal(valid.numpy(), inside)
    assert batch.truth.interval_s == pytest.approx(length_s)


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("flow", "has no indoor_flying1_gt_flow_dist.npz"),
        ("npz", "use a whole .npz file"),
        ("names", "use a whole .npz file"),
        ("times", "rising times"),
        ("hdf5", "cut or damaged"),
        ("columns", r"\[9000, 3\]"),
        ("nothing", "holds no"),
        ("short", "no window"),
    ],
)
def test_damaged_mvsec_is_refused_at_once(what, reason, tmp_path):
    folder = make_mvsec(tmp_path / "m")
    data = folder / "indoor_flying1_data.hdf5"
    flow = folder / "indoor_flying1_gt_flow_dist.npz"
    span_s = None
    if what == "flow":
        flow.unlink()
    elif what == "npz":
        flow.write_bytes(flow.read_bytes()[:-300])
    elif what == "names":
        np.savez(flow, timestamps=np.arange(3.0))
    elif what == "times":
        np.savez(
            flow,
            timestamps=np.zeros(11),
            x_flow_dist=np.ones((11, 26, 34)),
            y_flow_dist=np.ones((11, 26, 34)),
        )
    elif what == "hdf5":
        data.write_bytes(data.read_bytes()[:2000])
    elif what == "columns":
        with h5(data, "r+") as file:
            rows = file["davis/left/events"][()]
            del file["davis/left/events"]
            file["davis/left/events"] = rows[:, :3]
    elif what == "nothing":
        data.unlink()
    else:
        span_s = (0.0, 0.01)
    with pytest.raises(CodesignError, match=reason):
        MvsecWindows(folder, span_s=span_s)


def test_a_folder_is_opened_as_what_it_is(tmp_path):
    with pytest.raises(
        FileFormatError, match=r"rectify_map has shape \[120, 160, 2\], \[480, 640, 2\]"
    ):  # DSEC's own size
        open_windows(make_dsec(tmp_path / "d"))
    assert isinstance(open_windows(make_mvsec(tmp_path / "m"), window_frames=1), MvsecWindows)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match=r"holds no events: no events\.txt"):
        open_windows(tmp_path / "empty")
    with pytest.raises(FileFormatError, match="nothing lies at"):
        open_windows(tmp_path / "absent")
