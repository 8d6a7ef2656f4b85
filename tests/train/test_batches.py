"""Which windows are shown when, and how they are turned."""
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false

import pytest
import torch

from codesign.errors import DomainError
from codesign.train.batches import (
    Batches,
    Part,
    Started,
    pick,
    probe,
    shuffled,
    to_device,
    turned,
    without_truth,
)
from codesign.types import EventVolume, FlowField, FlowWindows
from tests.flow_training_case import SIDE, Made


@pytest.mark.parametrize("way", range(16))
def test_turned_windows_show_the_turned_motion(way):
    """A dot that moves by the flow of the pixel it starts on is still carried by that pixel's flow
    after turning; its polarity changes with bit 8 alone. A start that errs by e = (1, 2) px and
    claims the covariance e e^T still does, e turned."""
    counts = torch.zeros(1, 2, 2, 9, 12)
    flow = torch.zeros(1, 2, 9, 12)
    # from x = 3, y = 5 by (2, 1)
    counts[0, 0, 0, 5, 3] = counts[0, 0, 1, 6, 5] = 1
    flow[0, :, 5, 3] = torch.tensor([2.0, 1.0])
    valid = flow.abs().sum(1) > 0
    off = torch.tensor([1.0, 2.0])[:, None, None]
    claim = torch.tensor([1.0, 2.0, 4.0])[:, None, None].expand(1, 3, 9, 12)
    seen = turned(
        FlowWindows(
            EventVolume(counts, torch.tensor([0.0, 1.0]), torch.tensor([0.5, 0.5])),
            FlowField(flow, valid, 1.0),
            counts.sum(1),
            FlowField(flow + off, valid, 1.0, flow[:, 0], claim),
        ),
        way,
    )
    polarity, when, y, x = seen.volume.counts[0].nonzero().T
    assert polarity.tolist() == [way >> 3] * 2
    assert when.tolist() == [0, 1]
    assert seen.truth.valid[0].nonzero().tolist() == [[int(y[0]), int(x[0])]]
    assert seen.truth.flow_px[0, :, y[0], x[0]].tolist() == [float(x[1] - x[0]), float(y[1] - y[0])]
    assert torch.equal(seen.frames[0], seen.volume.counts[0].sum(0))
    u, v = (seen.start.flow_px - seen.truth.flow_px).unbind(1)
    torch.testing.assert_close(seen.start.covariance_px2, torch.stack([u * u, u * v, v * v], 1))


def test_the_sixteen_ways_differ():
    given = Made().batch([0])
    assert len({turned(given, way).volume.counts.numpy().tobytes() for way in range(16)}) == 16


@pytest.mark.bits
def test_windows_are_shown_as_often_as_told_and_resumed_alike():
    made = []
    parts = [(1.0, Made(before=lambda indices: made.append(tuple(indices))))]
    shown = Batches(parts, 2, reuse=3, pool=4)
    seen = [shown(step).volume.counts for step in range(24)]
    assert made == [(2 * k, 2 * k + 1) for k in range(8)], "every group is made once"
    for group in range(8):
        block, place = divmod(group, 4)
        versions = [seen[12 * block + 4 * showing + place] for showing in range(3)]
        assert len({version.numpy().tobytes() for version in versions}) == 3, (
            "each time another way"
        )
        assert all(torch.allclose(version.sum(), versions[0].sum()) for version in versions)
    later = Batches(parts, 2, reuse=3, pool=4)
    assert all(torch.equal(later(step).volume.counts, seen[step]) for step in (9, 10, 17))


def test_a_mix_keeps_its_shares():
    parts = [(0.5, "a"), (0.3, "b"), (0.2, "c")]
    chosen = [pick(parts, group) for group in range(1000)]
    for share, name in parts:
        # discrepancy of the golden ratio's multiples: of order log(1000)
        assert abs(chosen.count(name) - 1000 * share) <= 3
    with pytest.raises(
        DomainError, match="a share of the mix must be a finite number >= 0, got -1"
    ):
        Batches([(-1.0, Made()), (0.5, Made())], 2)


def test_a_finite_source_is_shown_whole_and_in_another_order_each_time():
    first = shuffled(range(10), 10)
    second = shuffled(range(10, 20), 10)
    assert sorted(first) == sorted(second) == list(range(10))
    assert first != second


def test_a_finite_source_is_looked_at_from_end_to_end():
    class Short(Made):
        def __len__(self):
            return 19

    made = []
    probe(Made(before=made.append))
    probe(Short(before=made.append))
    assert made == [[0], [0, 9, 18]]


def test_everything_in_a_batch_moves_to_the_device():
    moved = to_device({"a": [Made().batch([0]), (torch.ones(2), "kept")]}, torch.device("meta"))
    found, (ones, kept) = moved["a"]
    tensors = (found.frames, found.volume.counts, found.volume.centroid_s, found.truth.flow_px)
    assert all(tensor.is_meta for tensor in (*tensors, found.truth.valid, ones))
    assert (found.truth.interval_s, kept) == (1.0, "kept")


def test_windows_without_any_true_flow_are_counted():
    windows = Made().batch([0, 1, 2])
    windows.truth.valid[1] = False
    windows.truth.valid[2, 1:] = False
    assert without_truth(windows) == 1
    assert without_truth((torch.zeros(3), torch.zeros(3))) == 0


def doubled(volume):
    """An estimate that may be told: twice the events of either bin, and no covariance."""
    flow = 2 * volume.counts.sum(1)
    return FlowField(flow, flow[:, 0] > 0, 1.0, None, torch.zeros(len(flow), 3, SIDE, SIDE))


def test_a_start_is_estimated_once_for_all_showings():
    asked = []

    def estimate(volume):
        asked.append(len(volume.counts))
        return doubled(volume)

    shown = Batches([(1.0, Started(Made(), estimate))], 2, reuse=4, pool=3)
    for step in range(12):
        windows = shown(step)
        right = 2 * windows.volume.counts.sum(1).norm(dim=1)
        torch.testing.assert_close(windows.start.flow_px.norm(dim=1), right)
    assert asked == [2, 2, 2]


def test_some_begin_elsewhere():
    """A fifth of the samples, the same ones in any batch: 0.5 to 1.2 of the start, claimed to a
    pixel."""
    source = Started(Made(), doubled, foreign=0.2)
    windows = source.batch(range(200))
    elsewhere = windows.start.covariance_px2[:, 0, 0, 0] == 1
    assert 25 <= int(elsewhere.sum()) <= 55  # 40, five deviations of 5.7 off at the most
    factor = windows.start.flow_px.sum((1, 2, 3)) / doubled(windows.volume).flow_px.sum((1, 2, 3))
    torch.testing.assert_close(factor[~elsewhere], torch.ones(int((~elsewhere).sum())))
    assert 0.5 <= float(factor[elsewhere].min()) < 0.6
    assert 1.1 < float(factor[elsewhere].max()) <= 1.2
    alone = source.batch([int(elsewhere.nonzero()[0])])
    assert torch.equal(alone.start.flow_px[0], windows.start.flow_px[elsewhere][0])


class Ten:
    """A source with an end that gives its numbers."""

    def __len__(self):
        return 10

    def batch(self, indices):
        return list(indices)


def test_a_part_has_no_windows_beyond_itself():
    part = Part(Ten(), 4, 7)
    assert part.batch([0, 2]) == [4, 6]
    for beyond in (-1, 3):
        with pytest.raises(DomainError, match=f"window {beyond} of 3; give 0 to 2"):
            part.batch([0, beyond])


def test_what_begins_somewhere_ends_where_its_source_does():
    assert len(Started(Ten(), lambda volume: None)) == 10
    assert not hasattr(Started(Made(), lambda volume: None), "__len__")
