"""True flow by path: one closed-form field through every kind of file; flows followed through
several intervals."""

import numpy as np
import pytest
import torch
from scipy.io import savemat

from codesign.flow.files import write_flow
from codesign.flow.sources.truth import read_truth, size_of
from codesign.flow.warp import chained
from tests import refusals
from tests.numbers import close, f64
from tests.recording_case import put

SIZE = (12, 17)


def field(k=0.0):
    """Exact in float32 and in 1/128 px: [2, H, W] float64, and a mask."""
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]].astype(np.float64)
    flow = np.stack([(x - 5) / 16 + k, (3 - y) / 8 - k])
    valid = (x + y) % 5 != 0
    return np.where(valid, flow, 0.0), valid


FLOW, VALID = field()
Y, X = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
NAN = np.where(VALID, FLOW, np.nan)
SOME = np.column_stack([X[VALID], Y[VALID], FLOW[:, VALID].T])
EACH = np.column_stack([X.ravel(), Y.ravel(), FLOW.reshape(2, -1).T, VALID.ravel()])
# per event: two in every pixel, whose mean is the flow
NUMBERED = np.column_stack([np.arange(len(SOME)), SOME[:, :2], SOME[:, 0] % 2, SOME[:, 2:]])
TWICE = np.concatenate([NUMBERED + side * np.array([0, 0, 0, 0, 1, 1]) for side in (-0.25, 0.25)])


def table(head, rows):
    def save(path):
        path.write_text(
            head + "".join(" ".join(f"{value:.6f}" for value in row) + "\n" for row in rows)
        )

    return save


KINDS = {
    "flo": lambda path: write_flow(path, torch.from_numpy(FLOW), torch.from_numpy(VALID)),
    "png": lambda path: write_flow(path, torch.from_numpy(FLOW), torch.from_numpy(VALID)),
    "first.npy": lambda path: np.save(path, NAN),
    "last.npy": lambda path: np.save(path, NAN.transpose(1, 2, 0)),
    "third.npy": lambda path: np.save(path, np.dstack([*FLOW, VALID])),
    "npz": lambda path: np.savez(path, flow=FLOW, valid=VALID),
    "float.npz": lambda path: np.savez(
        path, gt_flow=FLOW.astype(np.float32), mask=VALID.astype(np.uint8)
    ),
    "pair.npz": lambda path: np.savez(path, vx=FLOW[0], vy=NAN[1]),
    "mvsec.npz": lambda path: np.savez(
        path, x_flow_dist=FLOW[:1], y_flow_dist=FLOW[1:], timestamps=np.array([1.5])
    ),
    "mat": lambda path: savemat(path, {"vxGT": FLOW[0], "vyGT": NAN[1]}),
    "txt": table("", SOME),
    "named.txt": table("y v u x\n", SOME[:, [1, 3, 2, 0]]),
    "valid.txt": table("", EACH),
    "dense.txt": table("", NAN.reshape(2, -1).T),
    "stacked.txt": table("", NAN.reshape(-1, SIZE[1])),
    "events.txt": table("", TWICE),
}


@pytest.mark.parametrize("kind", KINDS)
def test_one_field_through_every_kind_of_file(kind, tmp_path):
    path = tmp_path / f"flow.{kind}"
    KINDS[kind](path)
    (found,) = read_truth(path, SIZE)
    # MVSEC: there (0, 0) says that nothing is known
    valid = VALID & (FLOW != 0).any(0) if kind == "mvsec.npz" else VALID
    np.testing.assert_array_equal(found.valid, valid)
    np.testing.assert_allclose(
        found.flow, np.where(valid, FLOW, 0), rtol=0, atol=1e-6 * ("txt" in kind)
    )
    assert found.span_s is None
    assert size_of(path) in (SIZE, None)


@pytest.mark.parametrize(
    ("times", "spans"),
    [
        ({"t0": [1.0, 2.0, 3.0], "t1": [1.5, 2.5, 3.5]}, [(1.0, 1.5), (2.0, 2.5), (3.0, 3.5)]),
        ({"timestamps": [1.0, 2.0, 3.0, 4.0]}, [(1.0, 2.0), (2.0, 3.0), (3.0, 4.0)]),
        ({"timestamps": [1.0, 2.0, 4.0]}, [(1.0, 2.0), (2.0, 4.0), None]),
        ({"ts": [[1.0, 2.0], [2.0, 3.0], [5.0, 7.0]]}, [(1.0, 2.0), (2.0, 3.0), (5.0, 7.0)]),
        (
            {"t0": [1000000, 2000000, 4], "t1": [1500000, 2500000, 9]},
            [(1.0, 1.5), (2.0, 2.5), (4e-6, 9e-6)],
        ),
    ],
)
def test_several_flows_and_their_times(times, spans, tmp_path):
    flows = np.stack([field(k)[0] for k in range(3)])
    np.savez(
        tmp_path / "a.npz", flow=flows, **{key: np.array(value) for key, value in times.items()}
    )  # pyright: ignore[reportArgumentType]
    found = read_truth(tmp_path / "a.npz", SIZE)
    assert [flow.span_s for flow in found] == spans
    np.testing.assert_array_equal([flow.flow for flow in found], flows)


def test_a_folder_of_flows_and_its_list_of_times(tmp_path):
    folder = tmp_path / "dsec" / "flow"
    (folder / "forward").mkdir(parents=True)
    for k, number in enumerate((2, 4, 11)):
        path = folder / "forward" / f"{number:06d}.png"
        write_flow(path, *(torch.from_numpy(values) for values in field(k)))
    (folder / "forward_timestamps.txt").write_text(
        "# from_timestamp_us, to_timestamp_us\n1000000, 1100000\n1100000, 1200000\n1500000, 1600000\n"
    )
    for place in (tmp_path / "dsec", folder, folder / "forward"):
        found = read_truth(place, SIZE)
        assert [flow.span_s for flow in found] == [(1.0, 1.1), (1.1, 1.2), (1.5, 1.6)]
        np.testing.assert_array_equal(found[2].flow, field(2)[0] * VALID)


@refusals.table(__file__, "files of true flow")
def test_truths_that_are_none(row, tmp_path):
    def read(name, content):
        put(tmp_path / name, content)
        return read_truth(tmp_path / name, SIZE)

    row.holds(globals() | {"read": read, "folder": tmp_path})


def test_a_line_is_the_flow_of_all_pixels(tmp_path):
    (tmp_path / "flow.txt").write_text("1.5 -2\n")
    (found,) = read_truth(tmp_path / "flow.txt", SIZE)
    np.testing.assert_array_equal(found.flow, np.full((*SIZE, 2), (1.5, -2.0)).transpose(2, 0, 1))


# flows one after the other


def test_affine_flows_are_followed_exactly():
    """Flow (matrix - 1)(x - c) + shift, which bilinear lookups read exactly."""
    matrix = f64([[1.01, -0.02], [0.02, 0.99]])
    shift = f64([0.7, -0.4])
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (40, 50)), indexing="ij")
    place = at = torch.stack([x - 24.5, y - 19.5], -1)
    inside = torch.ones(40, 50, dtype=torch.bool)
    for _ in range(4):
        # the last place may lie outside
        inside &= (place.abs() <= torch.tensor([24.5, 19.5])).all(-1)
        place = place @ matrix.T + shift
    step = (at @ matrix.T + shift - at).permute(2, 0, 1)
    flow, valid = chained(step.expand(4, -1, -1, -1), torch.ones(4, 40, 50, dtype=torch.bool))
    assert torch.equal(valid, inside)
    assert 0.5 < inside.double().mean() < 1
    truth = (place - at).permute(2, 0, 1)
    close(flow[:, inside], truth[:, inside], atol=1e-12)


def test_what_is_hidden_invalid_or_between_surfaces_is_not_followed():
    moved = torch.zeros(3, 2, 8, 9, dtype=torch.float64)
    moved[:, 0] = 1.0
    ok = torch.ones(3, 8, 9, dtype=torch.bool)

    def lost(holes, hidden):
        """Rows and columns that are not followed; the last two columns leave."""
        return (~chained(moved, holes, hidden)[1][:, :7]).nonzero().tolist()

    holes = ok.clone()
    holes[1, 4, 5] = False  # read between the first and the second part
    assert lost(holes, None) == [[4, 4]]
    hidden = ~ok
    # hidden after the first part; after the second (from 3, 4); at the end, where nothing is read
    # any more
    hidden[0, 2, 2] = hidden[1, 3, 5] = hidden[2, 6, 3] = True
    assert lost(ok, hidden) == [[2, 2], [3, 4]]
    edge = torch.zeros(2, 2, 8, 9, dtype=torch.float64)
    # half a pixel on, the columns 4 and 5 are read together
    edge[0, 0], edge[1, 0, :, 5:] = 0.5, 3.0
    assert chained(edge, ok[:2])[1].all(0).tolist() == [k not in (4, 8) for k in range(9)]


def test_flow_that_is_nan_where_it_is_unknown_stays_there():
    still, known = torch.zeros(2, 2, 4, 4), torch.ones(2, 4, 4, dtype=torch.bool)
    still[1, :, 1, 1], known[1, 1, 1] = float("nan"), False
    flow, valid = chained(still, known)
    assert torch.equal(valid, known[1])
    assert torch.equal(flow, torch.zeros(2, 4, 4))
