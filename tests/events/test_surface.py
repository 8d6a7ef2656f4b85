"""Time surfaces and fading traces: definitions worked out event by event, and certified gradients."""

import math

import pytest
import torch

from codesign.events.stream import ordered
from codesign.events.volumes.surface import surface_from_counts, surface_from_stream, surface_from_times
from codesign.events.volumes.traces import decay, decay_from_stream
from codesign.types import EventStream
from tests.event_streams import random_stream

D = torch.float64
EPOCH_US = 1_700_000_000_000_000
TAU_S = 0.013


def by_hand(stream, at_us, last_only):
    """The definitions, in Python integers and floats: fading of the last event, or the sum over all."""
    found = torch.zeros(len(at_us), 2, stream.height_px, stream.width_px, dtype=D)
    for k, time_us in enumerate(at_us):
        for t, x, y, p in zip(
            *(column.tolist() for column in (stream.t_us, stream.x, stream.y, stream.p)), strict=True
        ):
            if t <= time_us:
                faded = math.exp(-(time_us - t) / (1e6 * TAU_S))
                found[k, int(p < 0), y, x] = faded if last_only else found[k, int(p < 0), y, x] + faded
    return found


@pytest.mark.parametrize("offset_us", [0, EPOCH_US])
def test_streams_give_surface_and_trace_as_defined_at_any_time(offset_us):
    stream = random_stream(400, 3, 4, 100_000, offset_us)
    at_us = [
        offset_us + time_us
        for time_us in (-5, 17_000, 17_001, int(stream.t_us[200]) - offset_us, 100_000, 130_000)
    ]
    # one rounding of an exponential, and a sum of at most 30 of them
    torch.testing.assert_close(
        surface_from_stream(stream, at_us, TAU_S, dtype=D), by_hand(stream, at_us, True), rtol=1e-14, atol=0
    )
    torch.testing.assert_close(
        decay_from_stream(stream, at_us, TAU_S, dtype=D),
        by_hand(stream, at_us, False),
        rtol=1e-12,
        atol=1e-14,
    )
    assert not surface_from_stream(stream, at_us, TAU_S)[0].any()  # before the first event


def test_a_trace_goes_on_where_an_earlier_chunk_ended():
    stream = random_stream(400, 3, 4, 100_000)
    cut_us = 41_000
    early, late = (
        EventStream(stream.t_us[part], stream.x[part], stream.y[part], stream.p[part], 3, 4)
        for part in (stream.t_us <= cut_us, stream.t_us > cut_us)
    )
    first = decay_from_stream(early, [cut_us], TAU_S, dtype=D)[0]
    second = decay_from_stream(late, [60_000, 90_000], TAU_S, start=(first, cut_us), dtype=D)
    torch.testing.assert_close(second, by_hand(stream, [60_000, 90_000], False), rtol=1e-12, atol=1e-14)


def test_real_times_give_the_surface_of_the_same_whole_microseconds():
    stream = random_stream(400, 3, 4, 100_000)
    shuffled = torch.randperm(400, generator=torch.Generator().manual_seed(1))
    at_us = [17_000, 100_000]
    t_s, x, y, p = (column[shuffled] for column in (stream.t_us.to(D) * 1e-6, stream.x, stream.y, stream.p))
    found = surface_from_times(t_s, x, y, p, 3, 4, [1e-6 * time_us for time_us in at_us], TAU_S)
    # seconds are rounded to 1e-17, of tau 1e-15
    torch.testing.assert_close(found, by_hand(stream, at_us, True), rtol=1e-13, atol=0)


def test_gradient_to_times_is_that_of_the_last_event():
    t_s = torch.tensor([0.001, 0.004, 0.002, 0.0055, 0.009], dtype=D, requires_grad=True)
    x = torch.tensor([0, 0, 1, 1, 0])
    y = torch.zeros(5, dtype=torch.int64)
    p = torch.tensor([1, 1, -1, 1, 1])

    def surface(times_s):
        return surface_from_times(times_s, x, y, p, 1, 2, [0.005, 0.006], TAU_S)

    assert torch.autograd.gradcheck(surface, (t_s,))
    gradient = torch.autograd.grad(surface(t_s)[1].sum(), t_s)[0]
    truth = [
        0,
        math.exp(-0.002 / TAU_S) / TAU_S,
        math.exp(-0.004 / TAU_S) / TAU_S,
        math.exp(-0.0005 / TAU_S) / TAU_S,
        0,
    ]
    torch.testing.assert_close(gradient, torch.tensor(truth, dtype=D), rtol=1e-12, atol=0)


def test_whole_counts_give_the_surface_of_events_at_the_middles_of_their_intervals():
    generator = torch.Generator().manual_seed(3)
    counts = torch.randint(0, 3, (12, 2, 3, 4), generator=generator) * (
        torch.rand(12, 2, 3, 4, generator=generator) < 0.4
    )
    times_us = torch.cat(
        (
            torch.zeros(1, dtype=torch.int64),
            (torch.randint(1, 9, (12,), generator=generator) * 2000).cumsum(0),
        )
    )
    k, polarity, y, x = counts.nonzero(as_tuple=True)
    stream = ordered((times_us[k] + times_us[k + 1]) // 2, x, y, 1 - 2 * polarity, 3, 4)
    # twelve products and roots of float64
    torch.testing.assert_close(
        surface_from_counts(counts.to(D), times_us.to(D) * 1e-6, TAU_S),
        by_hand(stream, times_us[1:].tolist(), True),
        rtol=1e-12,
        atol=0,
    )


def test_a_share_of_an_event_mixes_the_surfaces_with_and_without_it():
    counts = torch.tensor([1.0, 0.3, 0.0], dtype=D)[:, None, None, None].repeat(1, 2, 1, 1)
    surface = surface_from_counts(counts, [0.0, 0.01, 0.02, 0.03], 0.01)[2, 0, 0, 0]
    assert float(surface) == pytest.approx(0.7 * math.exp(-2.5) + 0.3 * math.exp(-1.5), rel=1e-14)


@pytest.mark.parametrize("function", [surface_from_counts, decay])
def test_gradients_to_soft_counts(function):
    counts = (
        torch.tensor([0.2, 0.9, 0.4, 1.6, 0.7], dtype=D)[:, None, None, None]
        * torch.rand(5, 2, 2, 3, dtype=D, generator=torch.Generator().manual_seed(0))
        + 0.01
    )
    counts = counts.clone().requires_grad_()
    assert int((counts > 1).sum())  # on both sides of the bend at 1
    assert float((counts.detach() - 1).abs().min()) > 1e-4  # and nowhere on it
    assert torch.autograd.gradcheck(
        lambda c: function(c, [0.0, 0.01, 0.015, 0.03, 0.031, 0.04], TAU_S), (counts,)
    )
