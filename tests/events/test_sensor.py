"""The hard sensor without noise: the definition in plain numbers, closed forms, the published ESIM,
and a sensor that changes during a recording written out pixel by pixel."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign import events
from codesign.events import SensorModel, SensorState, lin_log, memory, simulate, to_counts
from codesign.events.stream import ordered
from tests.event_streams import same, stream_of
from tests.numbers import D, close, f64, rand64, randn64, seeded

DAY_S = 86_400.0


@pytest.mark.parametrize("offset_s", [0.0, 1_700_000_000.0])
def test_a_ramp_of_log_intensity_fires_at_known_microseconds(offset_s):
    # level rises by 1 per 0.1 s from 3: crossing j at 0.02 j s; falls by 0.5 in the next 0.1 s from
    # 4: reference 4, crossing j at 0.1 + 0.05 j
    level = f64([3.0, 4.0 + 1e-9, 3.5 - 1e-9])[:, None, None].expand(3, 1, 2)
    stream = simulate(level.exp(), f64([0, 0.1, 0.2]) + offset_s, SensorModel(0.2, 0.25))
    truth = torch.tensor([20_000, 40_000, 60_000, 80_000, 100_000, 150_000, 200_000])
    for column in (0, 1):
        mine = stream.x == column
        # an epoch time in float64 seconds is exact to 0.24 us
        assert (stream.t_us[mine] - int(offset_s * 1e6) - truth).abs().max() <= (offset_s > 0)
        assert stream.p[mine].tolist() == [1] * 5 + [-1] * 2


# ten thousand events of one pixel come evenly; a day between two frames loses no microsecond
@pytest.mark.parametrize(
    ("rise", "theta", "start_s", "span_s"), [(10.0005, 1e-3, 0.0, 1.0), (1.0, 0.5, 1e9, DAY_S)]
)
def test_events_of_one_interval_come_evenly(rise, theta, start_s, span_s):
    level = f64([4.0, 4.0 + rise])[:, None, None]
    stream = simulate(level, [start_s, start_s + span_s], SensorModel(theta, theta), log_input=True)
    nth = torch.arange(1, int(rise / theta) + 1, dtype=D)
    truth = round(start_s * 1e6) + (nth * theta / rise * span_s * 1e6).round().long()
    assert len(stream) == len(truth)
    assert (stream.t_us - truth).abs().max() <= 1


def level_of(value):
    return value * math.log(20) / 20 if value <= 20 else math.log(value)


def hard_total(values, theta):
    """Counts of one pixel, by the definition in plain numbers."""
    reference = level_of(values[0])
    found = [0, 0]
    for value in values[1:]:
        count = math.trunc((level_of(value) - reference) / theta)
        reference += count * theta
        found[count < 0] += abs(count)
    return found


@pytest.mark.bits
@pytest.mark.parametrize("theta", [1e-3, 0.013, 0.2, 10.0])
@pytest.mark.parametrize(
    "values",
    [
        [0.0, 255.0, 0.0, 255.0],
        [77.0] * 6,
        [1.0, 1e4, 1e4, 1.0],
        [1e-4, 1.0, 1e-4, 1.0],
        [19.9, 20.1, 19.9, 20.1, 25.0],  # around the joint of the front end
        [100.0, 100.0 + 1e-6, 100.0, 100.0 + 1e-6],
        [1e6, 1e12, 1e6],  # brighter than any film
    ],
)
def test_counts_are_those_of_the_definition(values, theta):
    frames = f64(values)[:, None, None]  # a picture of one pixel
    t_s = torch.tensor([0.0, 1e-5, 0.3, 0.30001, 7.0, 7.5])[: len(frames)]  # far from uniform
    counts, _ = memory(frames, theta, theta)
    # a level that meets a threshold to the last bit may count one frame later: at most one event
    # per frame and polarity
    on, off = (counts.sum((0, 2, 3)) - torch.tensor(hard_total(values, theta))).tolist()
    assert max(abs(on), abs(off), abs(on - off)) <= 1
    stream = simulate(frames, t_s, SensorModel(theta, theta))
    assert torch.equal(to_counts(stream, t_s, dtype=D), counts)


def test_single_precision_keeps_the_times_of_long_ramps():
    """Each event once rounded the memorised level alike: microseconds too early or late after some
    dozens."""
    speed = 5 + 5 * rand64(seeded(), 40)
    speed[1::2] *= -1
    t_s = torch.arange(31, dtype=D) / 60
    frames = (7.5 + speed * (t_s[:, None] - 0.25)).exp().float()[:, None]
    stream = simulate(frames, t_s, SensorModel(0.05, 0.05))
    levels = np.log(frames[:, 0].double().numpy())  # of the frames as they are, in double precision
    for x in range(40):
        gone = np.abs(levels[:, x] - levels[0, x])
        truth_us = np.interp(0.05 * np.arange(1, int(gone[-1] / 0.05) + 1), gone, t_s.numpy()) * 1e6
        # half a microsecond of rounding, and half a last digit of two levels below 16 at 5 per
        # second: 0.2 us
        assert np.abs(stream.t_us[stream.x == x].numpy() - truth_us).max() < 0.75


def test_a_leak_below_the_last_digit_of_a_level_still_leaks():
    # 10 thresholds of 0.001 per second, 1e-7 per frame: half of what single precision tells at a
    # level of 5.3
    t_s = torch.arange(25_001, dtype=D) / 1e5
    stream = simulate(
        torch.full((25_001, 1, 1), 200.0), t_s, SensorModel(1e-3, 1e-3, leak_rate_hz=10.0)
    )
    assert set(stream.p.tolist()) == {1}
    # a last digit of the level: 48 us
    assert stream.t_us.diff().tolist() == pytest.approx([100_000] * (len(stream) - 1), abs=20)
    assert len(stream) in (2, 3)


@pytest.mark.parametrize("seconds", [0.05, 0.15, 3.3])
@pytest.mark.parametrize(
    "sensor",
    [
        SensorModel(leak_rate_hz=3.0, leak_jitter=0.1),
        SensorModel(hot_pixel_share=0.4, hot_pixel_rate_hz=10.0),
    ],
)
def test_leaks_give_rate_times_time_however_short_the_run(sensor, seconds):
    t_s = torch.linspace(0, seconds, 9, dtype=D)
    stream = simulate(torch.full((9, 64, 64), 100.0, dtype=D), t_s, sensor)
    rate_hz = sensor.leak_rate_hz + sensor.hot_pixel_share * sensor.hot_pixel_rate_hz
    # of a pixel one event more or less; five standard deviations, hot pixels are drawn too
    spread = 5 * (4096 * (0.25 + (sensor.hot_pixel_rate_hz * seconds) ** 2 / 4)) ** 0.5
    assert len(stream) == pytest.approx(4096 * rate_hz * seconds, abs=spread)
    # each at its own time: as many microseconds as events, but for coincidences
    assert len(stream.t_us.unique()) > 0.9 * len(stream) * (1 - len(stream) / 2e6 / seconds)


EPS = float(torch.finfo(torch.float32).eps)


def slack_us(levels, t_s, t, x, y, theta):
    """How far in microseconds an event may lie from a float32 reference.

    t = t_k + dt (r + C - L_k)/(L_k+1 - L_k), so a shift of the numerator moves it by dt/|L_k+1 -
    L_k| of it; whole microseconds add half of one, and a whole one just behind a frame, where
    events are rounded up so that none falls into the interval before. With |L| <= M a unit in the
    last place is at most eps M, a rounding half of that. Each of the two has levels good to two
    units, has rounded the memorised level once per event of the pixel so far and the threshold with
    it, and rounds what it divides (four times, numbers no larger than the step and a threshold
    together).

    Args: levels [T, H, W] float64. t_s: [T]. t, x, y: [N] of the reference. An event within 2 us of
      a frame may belong to the interval on either side: the flatter one counts.
    """
    pixel = y * levels.shape[2] + x
    order = np.lexsort((t, pixel))
    nth = np.empty(len(t))
    nth[order] = np.arange(len(t)) - np.searchsorted(pixel[order], pixel[order]) + 1
    most = np.abs(levels).max() + theta
    slack = np.zeros(len(t))
    for aside_s in (-2e-6, 2e-6):
        k = np.clip(np.searchsorted(t_s, t + aside_s, side="right") - 1, 0, len(t_s) - 2)
        step = np.abs(levels[k + 1, y, x] - levels[k, y, x])
        room = 2 * EPS * (2 * most + nth * (most + theta) / 2 + 2 * (step + theta))
        slack = np.maximum(slack, 1e6 * np.diff(t_s)[k] / step * room)
    to_frame_us = 1e6 * np.abs(t[:, None] - t_s).min(1)
    return np.where(to_frame_us <= 0.5 + slack, 1.0, 0.5) + slack


@pytest.mark.bits
@pytest.mark.parametrize("sequence", ["edge", "grating"])
def test_events_equal_the_published_algorithm_as_far_as_single_precision_tells(shared, sequence):
    """The reference keeps levels and memory in single precision, so do we here."""
    file = np.load(shared(f"refs/events/seq_{sequence}.npz"))
    frames, t_s = torch.from_numpy(file["frames"]), torch.from_numpy(file["t"])
    data = np.load(shared(f"refs/events/esimpy_fixedalias_{sequence}_ideal_eps1e-3.npz"))
    # through double precision: torch's float32 logarithm has other last bits on other processors
    levels = (frames.float() / 255 + 1e-3).double().log().float()
    stream = simulate(levels, t_s, SensorModel(), log_input=True)
    mine = np.lexsort((stream.t_us, stream.p, stream.x, stream.y))
    theirs = np.lexsort((data["t"], data["p"], data["x"], data["y"]))
    x, y, p = (data[name][theirs].astype(np.int64) for name in "xyp")
    for found, truth in ((stream.x, x), (stream.y, y), (stream.p, p)):
        assert np.array_equal(found.numpy()[mine], truth)
    t = data["t"][theirs]
    slack = slack_us(levels.double().numpy(), t_s.numpy(), t, x, y, 0.2)
    assert (np.abs(stream.t_us.numpy()[mine] - 1e6 * t) <= slack).all()
    assert (slack < 0.75).mean() > 0.95  # what was allowed was little


BEGAN = SensorModel(
    theta_sigma=0.03,
    leak_rate_hz=5.0,
    rate_cov_decades=0.2,
    hot_pixel_share=0.1,
    hot_pixel_rate_hz=40.0,
)
CHANGES = [
    {"theta_on": 0.6, "theta_off": 0.5},
    {"theta_on": 0.06, "theta_off": 0.09},
    {"theta_sigma": 0.0},
    {"theta_sigma": 0.1},
    {"leak_rate_hz": 500.0},
    {"leak_rate_hz": 0.0, "hot_pixel_rate_hz": 0.0},
    {"hot_pixel_share": 0.5},
]


def written_out(memorised, levels, t_s, sensors, cut, pixel, state):
    """Events (t_us, p) of one pixel: level and leak linear in time, another sensor from frame
    ``cut`` on; what falls into the dead time is dropped, the memorised level moving on all the
    same."""
    last_s, found = -1e6, []
    deviates = [float(one.flatten()[pixel]) for one in (state.deviate_on, state.deviate_off)]
    for k in range(1, len(t_s)):
        sensor = sensors[k >= cut]
        theta_on, theta_off = (
            max(theta + sensor.theta_sigma * deviate, 0.01) if sensor.theta_sigma else theta
            for theta, deviate in zip((sensor.theta_on, sensor.theta_off), deviates, strict=True)
        )
        hot = float(state.leak_heat.flatten()[pixel]) < sensor.hot_pixel_share
        spread = 10 ** (sensor.rate_cov_decades * float(state.leak_spread.flatten()[pixel]))
        slope = (levels[k] - levels[k - 1]) / (t_s[k] - t_s[k - 1])
        slope += theta_on * (sensor.leak_rate_hz * spread + hot * sensor.hot_pixel_rate_hz)
        now_s, above = t_s[k - 1], levels[k - 1] - memorised
        while True:
            p = 1 if above >= theta_on else -1 if above <= -theta_off else 0
            if not p:
                p = 1 if slope > 0 else -1
                wait_s = ((theta_on if p > 0 else -theta_off) - above) / slope if slope else 1e9
                if now_s + wait_s > t_s[k]:
                    break
                now_s, above = now_s + wait_s, above + slope * wait_s
            above -= theta_on if p > 0 else -theta_off
            if now_s - last_s >= sensor.refractory_s:
                found.append((max(round(now_s * 1e6), round(t_s[k - 1] * 1e6) + 1), p))
                last_s = now_s
        memorised = levels[k] - (above + slope * (t_s[k] - now_s))
    return found


@pytest.mark.parametrize("refractory_s", [0.0, 0.004])
@pytest.mark.parametrize("changed", CHANGES)
def test_a_changed_sensor_goes_on_as_if_simulated_in_two_pieces(changed, refractory_s, generator):
    began = replace(BEGAN, refractory_s=refractory_s)
    sensors = began, replace(began, **changed)
    t_s = (torch.arange(16) / 200 + 0.00037).tolist()
    levels = 4 + randn64(generator, 16, 4, 5).cumsum(0) * 0.2
    cut = 9
    state, counted = SensorState(), SensorState()
    streams, counts = [], []
    for part, sensor in zip((slice(0, cut), slice(cut, None)), sensors, strict=True):
        call = (levels[part], t_s[part], sensor)
        streams.append(simulate(*call, state=state, log_input=True))
        counts.append(events.dense_counts(*call, state=counted, log_input=True))
    stream = events.concatenate(streams)
    assert torch.equal(torch.cat(counts), to_counts(stream, t_s))
    at_first = SensorState()  # as it begins: nothing happens in 1e-12 s
    simulate(levels[[0, 0]], [t_s[0], t_s[0] + 1e-12], began, state=at_first, log_input=True)
    memorised = at_first.reference.flatten().tolist()
    for pixel in range(20):
        here = stream.y * 5 + stream.x == pixel
        found = list(zip(stream.t_us[here].tolist(), stream.p[here].tolist(), strict=True))
        of_pixel = levels.flatten(1)[:, pixel].tolist()
        wanted = written_out(memorised[pixel], of_pixel, t_s, sensors, cut, pixel, state)
        assert [p for _, p in found] == [p for _, p in wanted]
        assert all(abs(a - b) <= 1 for (a, _), (b, _) in zip(found, wanted, strict=True))


def test_noise_and_bandwidth_change_from_one_frame_to_the_next():
    sensor = SensorModel(cutoff_hz=1.0, shot_rate_hz=5.0)
    frames = torch.full((21, 40, 40), 255.0)
    state = SensorState()
    for part, (shot_rate_hz, seconds) in enumerate(((5.0, 1), (500.0, 2), (50.0, 2))):
        t_s = torch.arange(21) / 20 + 2 * part
        stream = simulate(frames, t_s, replace(sensor, shot_rate_hz=shot_rate_hz), state=state)
        # a quarter at full light; five standard deviations
        wanted = shot_rate_hz / 4 * 1600 * seconds
        assert len(stream) == pytest.approx(wanted, abs=5 * wanted**0.5)
    still = replace(sensor, shot_rate_hz=0.0)
    for time_s, cutoff_hz, follows in ((9.0, 0.0, 1.0), (9.001, 1e-4, 0.0), (9.002, 1e7, 1.0)):
        bright = frames[:1] * (1.0 if time_s == 9.001 else 0.1)
        before = state.level.clone()
        simulate(bright, [time_s], replace(still, cutoff_hz=cutoff_hz), state=state)
        wanted = torch.lerp(before, lin_log(bright)[0], follows)
        close(state.level, wanted, atol=1e-4)


def test_values_and_slopes_of_the_front_end_on_both_sides_of_the_joint():
    frames = torch.tensor([0.0, 1, 10, 20, 20 + 1e-9, 100, 255, 1e4], dtype=D, requires_grad=True)
    slope = math.log(20) / 20
    truth = [level_of(value) for value in frames.tolist()]
    close(lin_log(frames), f64(truth), atol=1e-10)
    (found,) = torch.autograd.grad(lin_log(frames).sum(), frames)
    wanted = f64([slope] * 4 + [0.05, 0.01, 1 / 255, 1e-4])
    close(found, wanted, rtol=1e-9)
    assert torch.autograd.gradgradcheck(lin_log, (frames[torch.tensor([1, 2, 5])],))


def test_streams_are_sorted_as_python_sorts(generator):
    t, x, y = (torch.randint(0, 6, (500,), generator=generator) for _ in range(3))
    p = torch.randint(0, 2, (500,), generator=generator) * 2 - 1
    stream = ordered(t + 2**40, x, y, p, 6, 6)
    found = torch.stack((stream.t_us, stream.y, stream.x, stream.p), 1).tolist()
    assert found == sorted(torch.stack((t + 2**40, y, x, p), 1).tolist())


def test_counts_land_in_their_pixel_and_in_the_interval_that_ends_with_them():
    rows = (5, 0, 1, 1), (6, 2, 0, -1), (7, 2, 0, 1), (7, 2, 0, 1)
    counts = to_counts(stream_of(*rows, height_px=2, width_px=3), [0, 1e-5])
    assert counts.tolist() == [[[[0, 0, 2], [1, 0, 0]], [[0, 0, 1], [0, 0, 0]]]]
    rows = ((t_us, 0, 0, -1) for t_us in (-1, 0, 1, 1000, 1001, 2000, 2001))
    counts = to_counts(stream_of(*rows, height_px=1, width_px=1), [0, 0.001, 0.002])
    assert counts[:, :, 0, 0].tolist() == [[0, 3], [0, 2]]


def test_chunks_around_a_long_interval_are_the_whole_in_single_precision():
    t_s = f64([0.0, 0.9, 1.8, 2.7, 3.6, 6.0])
    level = torch.randn(6, 20, 20, generator=seeded()).cumsum(0)
    sensor, state = SensorModel(0.1, 0.1), events.SensorState()
    whole = simulate(level, t_s, sensor, log_input=True)
    parts = [
        simulate(level[chunk], t_s[chunk], sensor, state=state, log_input=True)
        for chunk in (slice(5), slice(5, None))
    ]
    assert same(events.concatenate(parts), whole)


def test_one_flash_in_a_long_recording_has_room():
    """A level that jumps by 9000 once fires 900,000 events of 0.01; the intervals before and after
    are too long for keys of 32 bits, so each is a group of its own."""
    level = torch.zeros(5000, 1, 1)
    level[2500:] = 9000.0
    t_s = torch.arange(5000, dtype=torch.float64) * 300
    found = simulate(level, t_s, SensorModel(theta_on=0.01, theta_off=0.01), log_input=True)
    assert len(found) == 900_000
    assert found.in_order


def test_events_of_the_largest_sensors_are_put_in_order():
    """Places alone fill 63 bits."""
    zero, one = torch.zeros(2, dtype=torch.int64), torch.ones(2, dtype=torch.int64)
    side = 2**31 - 1
    found = ordered(torch.tensor([5, 0]), zero, zero + side - 1, one, side, side)
    assert found.t_us.tolist() == [0, 5]
