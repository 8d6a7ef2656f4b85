"""Event volumes: conservation, centroids, shares, and agreement of the two builders."""

import pytest
import torch

from codesign.events import from_counts, from_stream
from codesign.events.volumes.volume import spikes_from_counts, spikes_from_stream, stream_from_spikes
from codesign.types import EventStream
from tests.event_streams import random_stream


@pytest.mark.parametrize("bins", [1, 2, 5, 9])
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_counts_are_conserved_per_pixel_and_polarity(bins, batch):
    counts = torch.randint(0, 4, (19, 2, *batch, 4, 6), generator=torch.Generator().manual_seed(0)).double()
    volume = from_counts(counts, torch.linspace(3.0, 3.2, 20, dtype=torch.float64), bins)
    flat = counts.reshape(19, 2, -1, 4, 6)
    assert volume.counts.shape == (flat.shape[2], 2, bins, 4, 6)
    torch.testing.assert_close(volume.counts.sum(2), flat.sum(0).transpose(0, 1), rtol=1e-13, atol=1e-13)


def test_one_event_is_shared_between_the_two_nearest_nodes():
    counts = torch.zeros(8, 2, 1, 2)
    counts[2, 1, 0, 1] = 3.0  # middle of interval 2 of 8: 2.5/8 of the way, 1.25 nodes of 4 spacings
    volume = from_counts(counts, torch.arange(9) / 100, 5)
    expected = torch.zeros(1, 2, 5, 1, 2)
    expected[0, 1, 1, 0, 1], expected[0, 1, 2, 0, 1] = 3 * 0.75, 3 * 0.25
    torch.testing.assert_close(volume.counts, expected)


@pytest.mark.parametrize("bins", [1, 2, 4, 7])
def test_centroid_is_the_mean_time_of_what_a_bin_collects_even_for_uneven_frames(bins):
    # even rate: each interval holds events in proportion to its length; the weighted mean of their times, by
    # a plain loop
    steps_s = 0.005 + 0.01 * torch.rand(40, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    edges_s = torch.cat((torch.tensor([7.0], dtype=torch.float64), 7 + steps_s.cumsum(0)))
    mass = [0.0] * bins
    moment = [0.0] * bins
    for k in range(40):
        counts = torch.zeros(40, 2, 1, 1, dtype=torch.float64)
        counts[k, 0] = steps_s[k]
        shared = from_counts(counts, edges_s, bins).counts[0, 0, :, 0, 0]
        middle_s = float(edges_s[k] + edges_s[k + 1]) / 2 - 7
        for b in range(bins):
            mass[b] += float(shared[b])
            moment[b] += float(shared[b]) * middle_s
    found = from_counts(torch.zeros(40, 2, 1, 1), edges_s, bins).centroid_s
    torch.testing.assert_close(
        found,
        torch.tensor([m / w for m, w in zip(moment, mass, strict=True)], dtype=torch.float64),
        rtol=1e-12,
        atol=0,
    )


def test_gradient_of_a_volume_is_its_share():
    counts = torch.rand(6, 2, 2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: from_counts(x, torch.arange(7), 3).counts, (counts,))


@pytest.mark.parametrize("bins", [1, 2, 5])
@pytest.mark.parametrize("offset_us", [0, 1_700_000_000_000_000])
def test_stream_events_are_conserved_and_shared_by_time(bins, offset_us):
    stream = random_stream(5000, 3, 4, 100_000, first_us=offset_us)
    volume = from_stream(stream, offset_us, offset_us + 100_000, bins, dtype=torch.float64)
    truth = torch.zeros(2, bins, 3, 4, dtype=torch.float64)
    for t, x, y, p in zip(
        (stream.t_us - offset_us).tolist(),
        stream.x.tolist(),
        stream.y.tolist(),
        stream.p.tolist(),
        strict=True,
    ):
        place = t / 100_000 * (bins - 1)
        low = min(int(place), max(bins - 2, 0))
        truth[int(p < 0), low, y, x] += 1 - (place - low)
        if bins > 1:
            truth[int(p < 0), low + 1, y, x] += place - low
    torch.testing.assert_close(volume.counts[0], truth, rtol=1e-12, atol=1e-12)
    assert abs(float(volume.counts.sum()) - 5000) < 1e-8


def test_stream_centroids_are_those_of_an_even_rate_and_of_many_short_intervals():
    every_us = torch.arange(0, 120_001)
    zero = torch.zeros_like(every_us)
    stream = EventStream(every_us, zero, zero, zero + 1, 1, 1)
    volume = from_stream(stream, 0, 120_000, 4, dtype=torch.float64)
    torch.testing.assert_close(
        volume.centroid_s,
        torch.tensor([0.04 / 3, 0.04, 0.08, 0.12 - 0.04 / 3], dtype=torch.float64),
        rtol=1e-14,
        atol=0,
    )
    fine = from_counts(torch.zeros(1200, 2, 1, 1), torch.linspace(0, 0.12, 1201, dtype=torch.float64), 4)
    # midpoint rule with 400 intervals per node spacing: relative error of the moments about (1/400)^2
    torch.testing.assert_close(fine.centroid_s, volume.centroid_s, rtol=2e-5, atol=0)
    # an event per microsecond: the weighted mean itself, one microsecond in 40000 at the cut ends
    shares = (1 - (every_us / 40_000 - torch.arange(4)[:, None]).abs()).clamp(min=0).double()
    alone = ((shares * every_us * 1e-6).sum(1) / shares.sum(1)).tolist()
    torch.testing.assert_close(volume.centroid_s, torch.tensor(alone, dtype=torch.float64), rtol=1e-4, atol=0)


def test_the_window_holds_both_ends_and_nothing_else():
    zero = torch.zeros(5, dtype=torch.int64)
    stream = EventStream(torch.tensor([9, 10, 15, 20, 21]), zero, zero, zero + 1, 1, 1)
    assert from_stream(stream, 10, 20, 2).counts[0, 0, :, 0, 0].tolist() == [1.5, 1.5]


def test_spikes_are_events_per_step_and_go_back_exactly():
    offset_us = 1_700_000_000_000_000
    stream = random_stream(3000, 3, 4, 99_999, first_us=offset_us)
    spikes = spikes_from_stream(stream, offset_us, 1000, 100)
    truth = torch.zeros(2, 4, 3, 100)
    for t, x, y, p in zip(
        (stream.t_us - offset_us).tolist(),
        stream.x.tolist(),
        stream.y.tolist(),
        stream.p.tolist(),
        strict=True,
    ):
        truth[int(p < 0), x, y, t // 1000] = 1
    assert torch.equal(spikes, truth)
    back = stream_from_spikes(spikes, offset_us, 1000)
    assert len(back) == int(spikes.sum())
    assert set(((back.t_us - offset_us) % 1000).tolist()) == {0}
    assert torch.equal(spikes_from_stream(back, offset_us, 1000, 100), spikes)
    # at a microsecond per step nothing merges but events that are the same
    few = random_stream(50, 3, 4, 999, seed=1)
    again = stream_from_spikes(spikes_from_stream(few, 0, 1, 1000), 0, 1)
    found, events = (
        set(zip(*(getattr(each, name).tolist() for name in ("t_us", "x", "y", "p")), strict=True))
        for each in (again, few)
    )
    assert len(again) == len(events)
    assert found == events


def test_spikes_outside_the_steps_are_not_asked_for():
    zero = torch.zeros(4, dtype=torch.int64)
    stream = EventStream(torch.tensor([9, 10, 29, 30]), zero, zero, zero + 1, 1, 1)
    assert spikes_from_stream(stream, 10, 10, 2)[0, 0, 0].tolist() == [1, 1]
    assert spikes_from_stream(stream, 20, 10, 3)[0, 0, 0].tolist() == [1, 1, 0]
    assert spikes_from_stream(stream, 11, 10, 1)[0, 0, 0].tolist() == [0]  # one microsecond early


def test_spikes_of_counts_are_binary_for_whole_and_shares_for_soft_ones():
    counts = torch.tensor([[0.0, 1.0], [3.0, 0.25]])[:, None, :, None].expand(
        2, 2, 2, 1
    )  # [T, 2, H = 2, W = 1]
    spikes = spikes_from_counts(counts)
    assert spikes.shape == (2, 1, 2, 2)
    assert spikes[1, 0].tolist() == [[0, 1], [1, 0.25]]
    soft = (
        0.05 + 0.9 * torch.rand(3, 2, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ).requires_grad_()
    assert torch.autograd.gradcheck(spikes_from_counts, (soft,))
    assert not torch.autograd.grad(spikes_from_counts(soft + 1).sum(), soft)[0].any()
