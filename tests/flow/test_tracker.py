"""Flow along a stream: windows that hold every event once however the stream comes in, warm starts,
faults, and a motion that is known."""
# pyright: reportArgumentType=false, reportCallIssue=false

import time
from itertools import pairwise

import numpy as np
import pytest
import torch

from codesign import events, flow
from codesign.errors import DomainError
from codesign.events.stream import ordered
from codesign.flow.tracker import _carried_on
from codesign.types import FlowField
from tests.event_streams import part
from tests.numbers import close, seeded

SIZE = (12, 16)


def stream_of(t_us, seed=0):
    draw = seeded(seed)
    n = len(t_us)
    x, y = (torch.randint(side, (n,), generator=draw) for side in (SIZE[1], SIZE[0]))
    p = 2 * torch.randint(2, (n,), generator=draw) - 1
    return ordered(torch.as_tensor(t_us), x, y, p, SIZE[0], SIZE[1])


def random_times(count=600, seed=0):
    """Rising microseconds with ties and a gap of several windows."""
    draw = np.random.default_rng(seed)
    t_us = np.sort(draw.integers(0, 50_000, count))
    return np.where(t_us > 30_000, t_us + 25_000, t_us) + 7_000_000


def summed(volume):
    """An estimator whose flow tells the volume: events on the left to the right, and their mean
    time."""
    counts = volume.counts
    total = counts.sum((1, 2))
    span_s = volume.collected_s.sum()
    late = (counts * (volume.centroid_s / span_s)[:, None, None].to(counts)).sum((1, 2))
    valid = total > 0
    return FlowField(torch.stack([total, late], 1), valid, float(span_s), valid.float())


def pieces(stream, cuts):
    for first, last in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        yield part(stream, slice(first, last))


def told(windows):
    return [(window.t0_us, window.t1_us, window.events) for window in windows]


@pytest.mark.bits
@pytest.mark.parametrize("by", [{"window_s": 0.004}, {"events": 70}, {"events": 1}], ids=str)
def test_chunks_change_nothing_and_every_event_is_in_one_window(by):
    stream = stream_of(random_times(300))
    whole = list(flow.Tracker(summed, **by).track([stream]))
    assert sum(window.events for window in whole) == len(stream)
    assert sum(float(window.field.flow_px[:, 0].sum()) for window in whole) == pytest.approx(
        len(stream)
    )
    for before, after in pairwise(whole):
        assert before.t0_us < before.t1_us
        # windows tile time; events of one microsecond that are more than a window holds may share
        # it
        assert before.t1_us - 1 <= after.t0_us <= before.t1_us
    for cuts in (range(40, 300, 40), range(1, 300)):
        tracker = flow.Tracker(summed, **by)
        found = list(tracker.track(pieces(stream, cuts)))
        assert told(found) == told(whole)
        assert all(
            torch.equal(a.field.flow_px, b.field.flow_px) for a, b in zip(found, whole, strict=True)
        )
        assert (tracker.windows, tracker.events) == (len(whole), len(stream))
        assert tracker.event_s == pytest.approx(sum(w.t1_us - w.t0_us for w in whole) * 1e-6)


def test_a_chunk_whose_estimate_fails_may_come_again():
    stream = stream_of(random_times(300))
    calls = []

    def failing(volume):
        calls.append(volume)
        if len(calls) == 3:
            raise RuntimeError("out of memory")
        return summed(volume)

    tracker = flow.Tracker(failing, window_s=0.004)
    first, second = pieces(stream, [20])
    found = tracker.add(first)
    with pytest.raises(RuntimeError):
        tracker.add(second)
    found += [*tracker.add(second), *tracker.finish()]
    assert told(found) == told(flow.Tracker(summed, window_s=0.004).track([stream]))
    assert (tracker.windows, tracker.events) == (len(found), 300)


def test_windows_by_time_are_those_of_the_volume_and_empty_ones_are_handed_out():
    stream = stream_of(random_times(600))
    found = list(flow.Tracker(summed, window_s=0.004, bins=5).track([stream]))
    first = int(stream.t_us[0])
    for k, window in enumerate(found[:-1]):
        assert (window.t0_us, window.t1_us) == (first + 4000 * k, first + 4000 * (k + 1))
        inside = (stream.t_us >= window.t0_us) & (stream.t_us < window.t1_us)
        assert window.events == inside.sum()
        right = summed(events.from_stream(part(stream, inside), window.t0_us, window.t1_us, 5))
        for name in ("flow_px", "valid", "confidence"):  # all zero without events
            assert torch.equal(getattr(window.field, name), getattr(right, name))
    assert found[-1].t1_us == stream.t_us[-1]
    skipping = flow.Tracker(summed, window_s=0.004, bins=5, skip=("windows_without_events",))
    assert told(skipping.track([stream])) == [one for one in told(found) if one[2]]
    empty = sum(not window.events for window in found)
    assert skipping.left_out["windows_without_events"] == empty >= 5
    # a clock that jumps costs nothing then
    tracker = flow.Tracker(summed, window_s=0.001, skip=("windows_without_events",))
    jumped = told(tracker.track([stream_of([0, 500, 10**15])]))
    assert [(t0_us, count) for t0_us, _, count in jumped] == [(0, 2), (10**15, 1)]
    assert tracker.left_out == {"windows_without_events": 10**12 - 1}


def test_windows_by_number_last_until_the_next_event():
    found = flow.Tracker(summed, events=10).track([stream_of(torch.arange(35) * 100)])
    assert told(found) == [(0, 1000, 10), (1000, 2000, 10), (2000, 3000, 10), (3000, 3400, 5)]


def test_a_window_waits_for_the_event_that_ends_it():
    tracker = flow.Tracker(summed, window_s=0.001)
    assert tracker.add(stream_of([0, 999])) == []
    assert tracker.add(stream_of([])) == []
    assert told(tracker.add(stream_of([1000]))) == [(0, 1000, 2)]
    assert told(tracker.finish()) == [(1000, 1001, 1)]
    assert tracker.finish() == []
    assert tracker.add(stream_of([5])) == []  # another stream, with a clock of its own


def test_a_warm_start_has_the_speed_of_the_window_before():
    starts = []
    speed = torch.tensor([200.0, -100.0])[:, None, None].expand(1, 2, *SIZE)

    def steady(volume, start_px=None):
        starts.append(start_px)
        seconds = float(volume.collected_s.sum())
        return FlowField(speed * seconds, torch.ones(1, *SIZE, dtype=torch.bool), seconds)

    stream = stream_of(torch.cat([torch.arange(10) * 1000, 10_000 + torch.arange(11) * 2000]))
    found = list(flow.Tracker(steady, events=10).track([stream]))
    assert [window.warm for window in found] == [False, True, True]
    assert starts[0] is None
    # the same px per second, another duration
    for start, window in zip(starts[1:], found[1:], strict=True):
        seconds = (window.t1_us - window.t0_us) * 1e-6
        close(start, speed * seconds, rtol=1e-5)
    for estimator, options in ((steady, {"warm_start": False}), (summed, {})):
        starts.clear()
        tracker = flow.Tracker(estimator, events=10, **options)
        assert not any(window.warm for window in tracker.track([stream]))
        assert not any(start is not None for start in starts)


def test_the_flow_before_is_read_where_each_pixel_came_from():
    x = torch.arange(16.0).expand(12, 16)
    linear = torch.stack([0.1 * x + 1, torch.zeros_like(x)])[None]  # x' = 1.1 x + 1
    field = FlowField(linear, torch.ones(1, 12, 16, dtype=torch.bool), 0.01)
    carried = _carried_on(flow.TrackedWindow(0, 10_000, 5, field, False, 0.0), 10_000)
    # one step back along the own flow: x - f(x), where the exact origin is (x - 1) / 1.1
    right = 0.1 * (x - (0.1 * x + 1)) + 1
    inside = x - (0.1 * x + 1) >= 0
    close(carried[0, 0][inside], right[inside], atol=1e-5)


def test_processor_time_over_event_time():
    def slow(volume):
        end = time.process_time() + 0.02
        while time.process_time() < end:
            pass
        return summed(volume)

    tracker = flow.Tracker(slow, window_s=0.01)
    found = list(tracker.track([stream_of(torch.arange(31) * 1000)]))
    assert len(found) == 4  # the last event begins one of its own, a microsecond long
    assert tracker.processor_s == pytest.approx(sum(window.processor_s for window in found))
    assert min(window.processor_s for window in found) >= 0.02
    assert tracker.real_time_factor == pytest.approx(tracker.processor_s / 0.030001)


def test_what_waits_is_no_more_than_a_window():
    tracker = flow.Tracker(summed, events=50)
    for k in range(10):
        tracker.add(stream_of(k * 10_000 + torch.arange(997), seed=k))
        assert sum(rows.untyped_storage().nbytes() for rows in tracker._rows) <= 4 * 50 * 8


def test_arrays_are_taken_and_faults_left_out_on_request():
    t_us = np.arange(20) * 100
    x, y = np.arange(20) % 16, np.arange(20) % 12
    on = np.arange(20) % 2

    def tracker(*skip):
        return flow.Tracker(summed, window_s=0.001, size_px=SIZE, skip=skip)

    chunks = [(t_us, x, y, on), (t_us + 2000, x.astype(np.int16), y.tolist(), on > 0)]
    assert sum(window.events for window in tracker().track(chunks)) == 40
    assert sum(window.events for window in tracker().track([(t_us, x, y, 2 * on - 1)])) == 20
    x[3], y[5] = 16, -1
    t_us[10] = 150
    skip = ("events_off_sensor", "events_back_in_time")
    for some, words in (
        ((), r"event 3 of the chunk, at 300 us and \(16, 3\), lies outside .* 16 x 12 px"),
        (skip[:1], r"event 8 of the chunk, at 150 us .* lies before 900 us"),
    ):
        with pytest.raises(DomainError, match=words):
            tracker(*some).add((t_us, x, y, on))
    lenient = tracker(*skip)
    assert sum(window.events for window in lenient.track([(t_us, x, y, on)])) == 17
    assert lenient.left_out == {"events_off_sensor": 2, "events_back_in_time": 1}
    turned = stream_of(np.arange(20) * 100)
    turned.t_us[10] = 150
    assert sum(window.events for window in tracker(skip[1]).track([turned])) == 19
    again = tracker()
    again.add(stream_of(np.arange(20) * 100))
    with pytest.raises(DomainError, match="lies before 1900 us"):
        again.add(stream_of(np.arange(20) * 100))


def test_polarities_that_cannot_be_told_are_refused():
    """0 is OFF in files of 1 and 0, and nothing in those of 1, 0 and -1."""
    at = np.arange(4) * 100, np.arange(4), np.arange(4)
    tracker = flow.Tracker(summed, window_s=0.001, size_px=SIZE)
    with pytest.raises(DomainError, match="polarities hold 0 and -1"):
        tracker.add((*at, np.array([1, 0, -1, 1])))
    tracker.add((*at, np.array([1, 0, 0, 1])))
    with pytest.raises(DomainError, match="polarities hold 0 and -1"):
        tracker.add((at[0] + 400, *at[1:], np.array([1, -1, -1, 1])))
