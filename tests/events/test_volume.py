"""Event volumes, time surfaces, fading traces and spikes against their definitions event by event:
conservation, centroids, agreement of the builders, and gradients."""

import math

import pytest
import torch

from codesign.errors import DomainError
from codesign.events import decay, from_counts, from_stream, surface_from_counts, to_counts
from codesign.events.stream import concatenate, ordered
from codesign.events.volumes.surface import decay_from_stream, surface_from_stream
from codesign.events.volumes.volume import spikes_from_stream
from tests.event_streams import part, random_stream, rows, stream_of
from tests.numbers import D, close, f64, rand64

EPOCH_US = 1_700_000_000_000_000
TAU_S = 0.013


def at_one_pixel(*t_us):
    return stream_of(*((time_us, 0, 0, 1) for time_us in t_us), height_px=1, width_px=1)


@pytest.mark.parametrize("bins", [1, 2, 5])
@pytest.mark.parametrize("batch", [(), (2, 2)])
def test_counts_are_conserved_and_centroids_are_mean_times_also_of_uneven_frames(
    bins, batch, generator
):
    steps_s = 0.005 + 0.01 * rand64(generator, 19)
    edges_s = 7 + torch.cat((torch.zeros(1, dtype=D), steps_s.cumsum(0)))
    counts = torch.randint(0, 4, (19, 2, *batch, 4, 6), generator=generator).double()
    flat = counts.reshape(19, 2, -1, 4, 6)
    volume = from_counts(counts, edges_s, bins)
    assert volume.counts.shape == (flat.shape[2], 2, bins, 4, 6)
    close(volume.counts.sum(2), flat.sum(0).transpose(0, 1), rtol=1e-13, atol=1e-13)
    # shares of each interval's middle between the two nearest nodes
    middle_s = (edges_s[1:] + edges_s[:-1]) / 2 - 7
    place = middle_s / (edges_s[-1] - 7) * (bins - 1)
    share = (1 - (place - torch.arange(bins)[:, None]).abs()).clamp(min=0)  # [bins, T]
    torch.testing.assert_close(volume.counts, torch.einsum("kt,tpnyx->npkyx", share, flat))
    # even rate: each interval holds events in proportion to its length
    mass = share * steps_s
    close(volume.centroid_s, (mass @ middle_s) / mass.sum(1), rtol=1e-12)


@pytest.mark.parametrize("bins", [1, 2, 5])
@pytest.mark.parametrize("offset_us", [0, EPOCH_US])
def test_stream_events_are_conserved_and_shared_by_time(bins, offset_us):
    stream = random_stream(500, 3, 4, 100_000, first_us=offset_us)
    volume = from_stream(stream, offset_us, offset_us + 100_000, bins, dtype=D)
    truth = torch.zeros(2, bins, 3, 4, dtype=D)
    for t_us, x, y, p in rows(stream):
        place = (t_us - offset_us) / 100_000 * (bins - 1)
        for node in range(bins):
            truth[int(p < 0), node, y, x] += max(1 - abs(place - node), 0)
    close(volume.counts[0], truth, rtol=1e-12, atol=1e-12)
    assert abs(volume.counts.sum() - 500) < 1e-9


def test_the_window_of_a_stream_holds_both_ends_and_its_centroids_are_those_of_an_even_rate():
    volume = from_stream(at_one_pixel(9, 10, 15, 20, 21), 10, 20, 2)
    assert volume.counts[0, 0, :, 0, 0].tolist() == [1.5, 1.5]
    volume = from_stream(at_one_pixel(0), 0, 120_000, 4, dtype=D)
    truth = f64([0.04 / 3, 0.04, 0.08, 0.12 - 0.04 / 3])
    close(volume.centroid_s, truth, rtol=1e-14)


def test_spikes_are_events_per_step():
    stream = random_stream(3000, 3, 4, 99_999, first_us=EPOCH_US)
    spikes = spikes_from_stream(stream, EPOCH_US, 1000, 100)
    truth = torch.zeros(2, 4, 3, 100)
    for t_us, x, y, p in rows(stream):
        truth[int(p < 0), x, y, (t_us - EPOCH_US) // 1000] = 1
    assert torch.equal(spikes, truth)
    # outside the steps; from 11 on one microsecond is too early
    few = at_one_pixel(9, 10, 29, 30)
    for first_us, steps, found in ((10, 2, [1, 1]), (20, 3, [1, 1, 0]), (11, 1, [0])):
        assert spikes_from_stream(few, first_us, 10, steps)[0, 0, 0].tolist() == found


def by_hand(stream, at_us, last_only):
    """Fading of the last event, or the sum over all, in Python integers and floats."""
    found = torch.zeros(len(at_us), 2, stream.height_px, stream.width_px, dtype=D)
    for k, time_us in enumerate(at_us):
        for t_us, x, y, p in rows(stream):
            if t_us <= time_us:
                faded = math.exp(-(time_us - t_us) / (1e6 * TAU_S))
                found[k, int(p < 0), y, x] *= not last_only
                found[k, int(p < 0), y, x] += faded
    return found


@pytest.mark.parametrize("offset_us", [0, EPOCH_US])
def test_streams_give_surface_and_trace_as_defined_at_any_time(offset_us):
    stream = random_stream(400, 3, 4, 100_000, offset_us)
    cut_us = offset_us + 17_001
    at_us = [offset_us - 5, offset_us + 17_000, cut_us, int(stream.t_us[200]), offset_us + 130_000]
    surface, trace = by_hand(stream, at_us, True), by_hand(stream, at_us, False)
    # one rounding of an exponential, and a sum of at most 30 of them
    found = surface_from_stream(stream, at_us, TAU_S, dtype=D)
    close(found, surface, rtol=1e-14)
    found = decay_from_stream(stream, at_us, TAU_S, dtype=D)
    close(found, trace, rtol=1e-12, atol=1e-14)
    # a trace goes on where an earlier chunk ended
    first = decay_from_stream(part(stream, stream.t_us <= cut_us), [cut_us], TAU_S, dtype=D)[0]
    late = part(stream, stream.t_us > cut_us)
    found = decay_from_stream(late, at_us[3:], TAU_S, start=(first, cut_us), dtype=D)
    close(found, trace[3:], rtol=1e-12, atol=1e-14)


def test_whole_counts_give_the_surface_of_events_at_the_middles_of_their_intervals(generator):
    counts = torch.randint(0, 3, (12, 2, 3, 4), generator=generator)
    counts = counts * (torch.rand(counts.shape, generator=generator) < 0.4)
    steps_us = torch.randint(1, 9, (12,), generator=generator) * 2000
    times_us = torch.cat((steps_us[:1] * 0, steps_us.cumsum(0)))
    k, polarity, y, x = counts.nonzero(as_tuple=True)
    stream = ordered((times_us[k] + times_us[k + 1]) // 2, x, y, 1 - 2 * polarity, 3, 4)
    truth = by_hand(stream, times_us[1:].tolist(), True)
    t_s = times_us.to(D) * 1e-6
    # twelve products and roots of float64
    close(surface_from_counts(counts.to(D), t_s, TAU_S), truth, rtol=1e-12)


def test_a_share_of_an_event_mixes_the_surfaces_with_and_without_it():
    counts = f64([1.0, 0.3, 0.0])[:, None, None, None].repeat(1, 2, 1, 1)
    surface = surface_from_counts(counts, [0.0, 0.01, 0.02, 0.03], 0.01)[2, 0, 0, 0]
    assert float(surface) == pytest.approx(0.7 * math.exp(-2.5) + 0.3 * math.exp(-1.5), rel=1e-14)


@pytest.mark.parametrize(
    "function",
    [
        lambda counts, t_s: surface_from_counts(counts, t_s, TAU_S),
        lambda counts, t_s: decay(counts, t_s, TAU_S),
        lambda counts, t_s: from_counts(counts, t_s, 3).counts,
    ],
)
def test_gradients_to_soft_counts(function, generator):
    # on both sides of the bend at 1
    counts = f64([0.2, 0.9, 0.4, 1.6, 0.7])[:, None, None, None]
    counts = counts * rand64(generator, 5, 2, 2, 3) + 0.01
    assert int((counts > 1).sum())
    t_s = [0.0, 0.01, 0.015, 0.03, 0.031, 0.04]
    assert torch.autograd.gradcheck(lambda c: function(c, t_s), (counts.requires_grad_(),))


def test_traces_of_counts_fade_exponentially():
    counts = torch.zeros(4, 2, 1, 1, dtype=D)
    counts[0, 0], counts[2, 0], counts[1, 1] = 3, 1, 2
    traces = decay(counts, [0.0, 0.01, 0.03, 0.04, 0.09], tau_s=0.02)[:, :, 0, 0]
    on = [3, 3 * math.exp(-1), 3 * math.exp(-1.5) + 1, (3 * math.exp(-1.5) + 1) * math.exp(-2.5)]
    off = [0, 2, 2 * math.exp(-0.5), 2 * math.exp(-3)]
    torch.testing.assert_close(traces, f64([on, off]).T)


def test_counts_that_a_type_does_not_hold_are_refused():
    many = 40_000
    zero = torch.zeros(many, dtype=torch.int64)
    stream = ordered(torch.arange(many), zero, zero, zero + 1, 1, 1)
    assert to_counts(stream, [0.0, 1.0], dtype=torch.int32).sum() == many
    for kind in (torch.int16, torch.float16, torch.bfloat16):
        with pytest.raises(DomainError, match=f"40000 events .*, more than {kind} holds exactly"):
            to_counts(stream, [0.0, 1.0], dtype=kind)
    twice = ordered(*(torch.cat([v, v]) for v in (stream.t_us, zero, zero, zero + 1)), 1, 1)
    with pytest.raises(DomainError, match=r"8e\+04 events, more than torch.float16 can"):
        from_stream(twice, 0, many, 1, dtype=torch.float16)
    with pytest.raises(DomainError, match=r"1.7e\+18 us is too long for 8 bins"):
        from_stream(stream, 0, 17 * 10**17, 8)


def test_streams_out_of_order_are_joined_in_order_and_refused_though_they_were_in_order_before():
    stream = at_one_pixel(10, 20, 30)
    assert float(from_stream(stream, 0, 40, 2).counts.sum()) == 3
    stream.t_us[0] = 35
    with pytest.raises(DomainError, match="go back"):
        from_stream(stream, 0, 40, 2)
    assert concatenate([stream]).t_us.tolist() == [20, 30, 35]
