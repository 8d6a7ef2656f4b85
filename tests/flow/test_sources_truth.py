"""True flow by path: one closed-form field through every kind of file; flows followed through several
intervals; the camera's fit."""

import numpy as np
import pytest
import torch
from scipy.io import savemat

from codesign.errors import FileFormatError, ShapeError
from codesign.flow.files import write_flow
from codesign.flow.sources.camera import Calibration
from codesign.flow.sources.camera_fit import CameraFit
from codesign.flow.sources.truth import read_truth, size_of
from codesign.flow.warp import chained

SIZE = (12, 17)


def field(k=0.0):
    """Exact in float32 and in 1/128 px: [2, H, W] float64, and a mask."""
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]].astype(np.float64)
    flow = np.stack([(x - 5) / 16 + k, (3 - y) / 8 - k])
    valid = (x + y) % 5 != 0
    return np.where(valid, flow, 0.0), valid


def save(path, kind):
    flow, valid = field()
    y, x = np.nonzero(valid)
    some = np.column_stack([x, y, flow[:, valid].T])
    if kind in ("flo", "png"):
        write_flow(path.with_suffix(f".{kind}"), torch.from_numpy(flow), torch.from_numpy(valid))
        return path.with_suffix(f".{kind}")
    if kind.startswith("npy"):
        nan = np.where(valid, flow, np.nan)
        np.save(
            path.with_suffix(".npy"),
            {"npy": nan, "npy last": nan.transpose(1, 2, 0), "npy third": np.dstack([*flow, valid])}[kind],
        )
        return path.with_suffix(".npy")
    if kind == "mat":
        savemat(path.with_suffix(".mat"), {"vxGT": flow[0], "vyGT": np.where(valid, flow[1], np.nan)})
        return path.with_suffix(".mat")
    if kind.startswith("npz"):
        held = {
            "npz": {"flow": flow, "valid": valid},
            "npz float": {"gt_flow": flow.astype(np.float32), "mask": valid.astype(np.uint8)},
            "npz pair": {"vx": flow[0], "vy": np.where(valid, flow[1], np.nan)},
            "npz mvsec": {"x_flow_dist": flow[:1], "y_flow_dist": flow[1:], "timestamps": np.array([1.5])},
        }
        np.savez(path.with_suffix(".npz"), **held[kind])
        return path.with_suffix(".npz")
    nan = np.where(valid, flow, np.nan)
    tables = {
        "table": ("", some),
        "table named": ("y v u x\n", some[:, [1, 3, 2, 0]]),
        "table valid": (
            "",
            np.column_stack(
                [
                    np.mgrid[0 : SIZE[0], 0 : SIZE[1]][::-1].reshape(2, -1).T,
                    flow.reshape(2, -1).T,
                    valid.ravel(),
                ]
            ),
        ),
        "table dense": ("", nan.reshape(2, -1).T),
        "table stacked": ("", nan.reshape(-1, SIZE[1])),
        # per event: two in every pixel, whose mean is the flow
        "table events": (
            "",
            np.concatenate(
                [
                    np.column_stack([np.arange(len(x)), x, y, x % 2, flow[:, valid].T + side])
                    for side in (-0.25, 0.25)
                ]
            ),
        ),
    }
    head, rows = tables[kind]
    path.with_suffix(".txt").write_text(
        head + "".join(" ".join(f"{value:.6f}" for value in row) + "\n" for row in rows)
    )
    return path.with_suffix(".txt")


@pytest.mark.parametrize(
    "kind",
    [
        "flo",
        "png",
        "npy",
        "npy last",
        "npy third",
        "npz",
        "npz float",
        "npz pair",
        "npz mvsec",
        "mat",
        "table",
        "table named",
        "table valid",
        "table dense",
        "table stacked",
        "table events",
    ],
)
def test_one_field_through_every_kind_of_file(kind, tmp_path):
    path = save(tmp_path / "flow", kind)
    (found,) = read_truth(path, SIZE)
    flow, valid = field()
    if kind == "npz mvsec":  # there (0, 0) says that nothing is known
        valid = valid & (flow != 0).any(0)
    np.testing.assert_array_equal(found.valid, valid)
    np.testing.assert_allclose(
        found.flow, np.where(valid, flow, 0), rtol=0, atol=1e-6 if "table" in kind else 0
    )
    assert found.span_s is None
    assert size_of(path) in (SIZE, None)


def test_several_flows_and_their_times(tmp_path):
    flows = np.stack([field(k)[0] for k in range(3)])
    for name, times, spans in (
        ("ends.npz", {"t0": [1.0, 2.0, 3.0], "t1": [1.5, 2.5, 3.5]}, [(1.0, 1.5), (2.0, 2.5), (3.0, 3.5)]),
        ("edges.npz", {"timestamps": [1.0, 2.0, 3.0, 4.0]}, [(1.0, 2.0), (2.0, 3.0), (3.0, 4.0)]),
        ("starts.npz", {"timestamps": [1.0, 2.0, 4.0]}, [(1.0, 2.0), (2.0, 4.0), None]),
        ("pairs.npz", {"ts": [[1.0, 2.0], [2.0, 3.0], [5.0, 7.0]]}, [(1.0, 2.0), (2.0, 3.0), (5.0, 7.0)]),
        (
            "us.npz",
            {"t0": [1000000, 2000000, 3000000], "t1": [1500000, 2500000, 3500000]},
            [(1.0, 1.5), (2.0, 2.5), (3.0, 3.5)],
        ),
    ):
        np.savez(tmp_path / name, flow=flows, **{key: np.array(value) for key, value in times.items()})  # pyright: ignore[reportArgumentType]
        found = read_truth(tmp_path / name, SIZE)
        assert [flow.span_s for flow in found] == spans, name
        for k, flow in enumerate(found):
            np.testing.assert_array_equal(flow.flow, field(k)[0])
    folder = tmp_path / "dsec" / "flow"
    (folder / "forward").mkdir(parents=True)
    for k, number in enumerate((2, 4, 11)):
        write_flow(
            folder / "forward" / f"{number:06d}.png",
            torch.from_numpy(field(k)[0]),
            torch.from_numpy(field()[1]),
        )
    (folder / "forward_timestamps.txt").write_text(
        "# from_timestamp_us, to_timestamp_us\n1000000, 1100000\n1100000, 1200000\n1500000, 1600000\n"
    )
    for place in (tmp_path / "dsec", folder, folder / "forward"):
        found = read_truth(place, SIZE)
        assert [flow.span_s for flow in found] == [(1.0, 1.1), (1.1, 1.2), (1.5, 1.6)]
        np.testing.assert_array_equal(found[2].flow, field(2)[0] * field()[1])


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.npy", np.zeros((3, 4)), r"\[2, H, W\]"),
        ("a.npy", np.zeros((5, 4, 4)), r"\[2, H, W\]"),
        ("a.npy", np.zeros((2, 4, 5)), "5 x 4 pixels, the recording 17 x 12"),
        ("a.npz", {"other": np.zeros((2, 4, 5))}, "holds other"),
        ("a.npz", {"flow": np.zeros((2, *SIZE)), "valid": np.zeros((3, 3))}, "mask has shape"),
        (
            "a.npz",
            {"flow": np.zeros((2, *SIZE)), "t0": np.array([2.0]), "t1": np.array([1.0])},
            "a later time",
        ),
        ("a.npz", {"u": np.zeros(SIZE), "v": np.zeros((2, 2))}, "two alike"),
        ("a.txt", "1 2 3\n", "'x y u v'"),
        ("a.txt", "90 2 3 4\n", "none of a sensor of 17 x 12"),
        ("a.txt", "x y z\n1 2 3\n", "'x y u v'"),
        ("a.txt", "1 2\n3 4\n", "one for all pixels or 204"),
        ("a.txt", "a, b\nc d", "no table"),
        ("a.bmp", "", "ends in '.bmp'"),
        ("a.npy", "text", "use a whole .npy file"),
        ("a.mat", "text", "no MATLAB file"),
        ("a.flo", "text", "not a .flo"),
    ],
)
def test_truths_that_are_none(name, content, reason, tmp_path):
    path = tmp_path / name
    if isinstance(content, np.ndarray):
        np.save(path, content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    else:
        path.write_text(content)
    with pytest.raises(FileFormatError, match=reason):
        read_truth(path, SIZE)
    with pytest.raises(FileFormatError, match="no ground truth lies"):
        read_truth(tmp_path / "absent.flo", SIZE)
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match="holds no flow files"):
        read_truth(tmp_path / "empty", SIZE)


def test_a_line_for_all_pixels(tmp_path):
    (tmp_path / "flow.txt").write_text("1.5 -2\n")
    (found,) = read_truth(tmp_path / "flow.txt", SIZE)
    np.testing.assert_array_equal(
        found.flow, np.broadcast_to(np.array([1.5, -2.0])[:, None, None], (2, *SIZE))
    )


# flows one after the other


def affine(matrix, shift, size=(40, 50)):
    """Flow (matrix - 1)(x - c) + shift, which bilinear lookups read exactly."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size), indexing="ij")
    at = torch.stack([x - (size[1] - 1) / 2, y - (size[0] - 1) / 2], -1)
    return (at @ (matrix - torch.eye(2, dtype=torch.float64)).T + shift).permute(2, 0, 1), at


def test_affine_flows_are_followed_exactly():
    matrix = torch.tensor([[1.01, -0.02], [0.02, 0.99]], dtype=torch.float64)
    shift = torch.tensor([0.7, -0.4], dtype=torch.float64)
    step, at = affine(matrix, shift)
    power = torch.eye(2, dtype=torch.float64)
    moved = torch.zeros(2, dtype=torch.float64)
    places = []
    for _ in range(4):
        power = matrix @ power
        moved = matrix @ moved + shift
        places.append(at @ power.T + moved)
    flow, valid = chained(step.expand(4, -1, -1, -1), torch.ones(4, 40, 50, dtype=torch.bool))
    half = torch.tensor([24.5, 19.5], dtype=torch.float64)
    inside = torch.stack([(place.abs() <= half).all(-1) for place in places[:3]]).all(
        0
    )  # the last place may lie outside
    assert torch.equal(valid, inside)
    assert 0.5 < float(inside.double().mean()) < 1
    torch.testing.assert_close(
        flow[:, inside], (places[3] - at).permute(2, 0, 1)[:, inside], rtol=0, atol=1e-12
    )


def test_what_is_hidden_invalid_or_between_surfaces_is_not_followed():
    still = torch.zeros(3, 2, 8, 9, dtype=torch.float64)
    ok = torch.ones(3, 8, 9, dtype=torch.bool)
    still[:, 0] = 1.0
    holes = ok.clone()
    holes[1, 4, 5] = False  # read between the first and the second part
    assert sorted(map(tuple, (~chained(still, holes)[1][:, :7]).nonzero().tolist())) == [
        (4, 4)
    ]  # the last two columns leave
    hidden = ~ok
    hidden[0, 2, 2] = hidden[1, 3, 5] = hidden[2, 6, 3] = (
        # hidden after the first part; after the second (from 3, 4); at the end, where nothing is read any
        # more
        True
    )
    assert sorted(map(tuple, (~chained(still, ok, hidden)[1][:, :7]).nonzero().tolist())) == [(2, 2), (3, 4)]
    edge = torch.zeros(2, 2, 8, 9, dtype=torch.float64)
    edge[0, 0], edge[1, 0, :, 5:] = 0.5, 3.0  # half a pixel on, the columns 4 and 5 are read together
    assert chained(edge, ok[:2])[1].all(0).tolist() == [
        True,
        True,
        True,
        True,
        False,
        True,
        True,
        True,
        False,
    ]
    with pytest.raises(ShapeError, match=r"valid must be \(2, 8, 9\)"):
        chained(edge, ok)
    with pytest.raises(ShapeError, match=r"\[K, 2, H, W\]"):
        chained(edge[:, 0], ok)


def test_the_camera_fit_projects_as_the_camera():
    lens = Calibration((30.0, 31.0), (20.2, 14.7), (-0.2, 0.06, 1e-3, -5e-4, 0.0))
    rays = lens.directions(30, 40)
    y, x = np.mgrid[0:30, 0:40]
    pupil = np.stack(
        [0 * x, 0 * x, 1e-3 * rays[..., 0] ** 2], -1
    )  # the pupil moves along the axis with the field
    fit = CameraFit(rays, pupil)
    assert fit.error_px < 1e-3
    inner = rays[3:-3:2, 4:-4:2] * 0.97 * np.array([1, 1, 1 / 0.97])  # between pixels
    start = np.stack([0 * inner[..., 0], 0 * inner[..., 0], 1e-3 * inner[..., 0] ** 2], -1)
    for depth in (0.1, 2.0):
        np.testing.assert_allclose(
            fit.project((start + depth * inner).reshape(-1, 3)),
            lens.project(inner).reshape(-1, 2),
            rtol=0,
            atol=1e-3,
        )
    assert np.isnan(fit.project(np.array([[0.0, 0.0, -1.0]]))).all()
    with pytest.raises(FileFormatError, match="finite and forward"):
        CameraFit(-rays, pupil)
    with pytest.raises(FileFormatError, match="fitted to"):
        CameraFit(rays + np.array([1, 0, 0]) * ((x + y) % 2)[..., None] * 0.01, pupil)
