"""When events come between two frames, against curves known in closed form and the hard sensor at
10 kHz; a sensor that ran before its window, against the closed form of a ramp."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import torch

from codesign import System, events
from codesign.events.level_path import finer
from codesign.system import Batch
from codesign.types import FlowField
from tests.events.slopes import cosine_and_scale
from tests.numbers import D, f64, rand64, seeded

C = 0.15
SPAN_S = 0.1
BINS = 5
STEP = 0.05
SENSOR = events.SensorModel(theta_on=C, theta_off=C)


def times(intervals):
    return torch.linspace(0, SPAN_S, intervals + 1, dtype=D)


PHASE, SECOND, OFFSET = rand64(seeded(3), 3, 4000)
# pixels of like phase together, [4, N]: over all of them a shift in time changes nothing
GROUPS = torch.cat(
    [torch.stack((x.sin(), x.cos())) for x in (PHASE * 2 * math.pi, SECOND * 2 * math.pi)]
)


def waves(intervals, amplitude=0.0, shift=0.0):
    """[T, 1, N] levels: two waves per pixel with phases of its own, the faster with six samples per
    period where there are eight intervals. Pixels begin anywhere in their thresholds, so a sum of
    many is a mean over beginnings."""
    turn = (times(intervals)[:, None] + 0.02 * shift) * 2 * math.pi
    level = (
        0.5 * (13.3 * turn + PHASE * 2 * math.pi).sin()
        + 0.7 * (4.1 * turn + SECOND * 2 * math.pi).sin()
    )
    return (4 + C * OFFSET + (1 + amplitude) * level)[:, None]


MOVES = ["amplitude", "shift"]


def way(move, intervals):
    return (waves(intervals, **{move: STEP}) - waves(intervals, **{move: -STEP})) / (2 * STEP)


def steered(found, level, move):
    """Derivatives of numbers by a move of the level that they come from."""
    tangent = way(move, len(level) - 1)
    slopes = [
        (torch.autograd.grad(x, level, retain_graph=True)[0] * tangent).sum()
        for x in found.flatten()
    ]
    return torch.stack(slopes)


@cache
def difference(move):
    """Derivative of the stream's volume, event by event, the mean over beginnings."""
    ends = []
    for sign in (1, -1):
        level = waves(1000, **{move: sign * STEP})
        stream = events.simulate(level, times(1000), SENSOR, log_input=True)
        found = events.from_stream(stream, 0, round(SPAN_S * 1e6), BINS, dtype=D).counts[0, :, :, 0]
        ends.append((found @ GROUPS.T).flatten())
    return (ends[0] - ends[1]) / (2 * STEP)


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("name", ["memory", "counts", "physical"])
def test_eight_intervals_steer_a_volume_as_the_stream_at_10_khz_does(name, move):
    level = waves(8).requires_grad_()
    layer = events.layer(name, SENSOR, log_input=True)
    volume = layer.volume(level, times(8), BINS).counts[0, :, :, 0]
    cosine, scale = cosine_and_scale(steered(volume @ GROUPS.T, level, move), difference(move))
    # what is asked of eight intervals
    assert cosine >= 0.97
    assert 0.9 <= scale <= 1.1


def test_events_of_one_long_interval_lie_where_the_level_crosses():
    level = f64([4.0, 4.0 + 20.5 * C]).reshape(2, 1, 1)
    t_s = f64([0.0, SPAN_S])
    layer = events.layer("memory", SENSOR, log_input=True)
    volume = layer.volume(level, t_s, BINS).counts[0, 0, :, 0, 0].detach()
    crossing = torch.arange(1, 21, dtype=D) / 20.5 * (BINS - 1)  # in node spacings
    nodes = torch.arange(BINS, dtype=D)
    truth = (1 - (crossing - nodes[:, None]).abs()).clamp(min=0).sum(1)
    assert volume.sum() == 20
    # four parts from node to node: an event lies at most an eighth of that from its place, early as
    # often as late
    assert abs(nodes @ (volume - truth)) < 20 / 8 / 4
    # a node shares the events of both spacings beside it, and so does one part's worth of them at
    # most
    assert (volume - truth).abs().max() < 20.5 / (4 * (BINS - 1)) / 4


@pytest.mark.parametrize("log_input", [True, False])
def test_smooth_curves_between_frames_are_met_to_the_third_order(log_input):
    """h^3 |L'''| / 62 between inner frames, the term that central slopes leave."""

    def curve(t_s):
        # 7 to 150 of 255: dark part and logarithm
        return 3.5 + 1.5 * torch.sin(2 * math.pi * 10 * t_s)

    errors = []
    for intervals in (20, 40):
        level = curve(times(intervals)).reshape(-1, 1, 1)
        light = torch.where(level <= math.log(20), level * 20 / math.log(20), level.exp())
        frames = level if log_input else light
        found, times_s = finer(frames, times(intervals), SPAN_S / 320, log_input=log_input)
        found = found if log_input else events.lin_log(found)
        inner = (times_s > SPAN_S / intervals) & (times_s < SPAN_S * (1 - 1 / intervals))
        errors.append(float((found.flatten() - curve(times_s))[inner].abs().max()))
        assert errors[-1] < 1.1 * (SPAN_S / intervals) ** 3 * 1.5 * (2 * math.pi * 10) ** 3 / 62
    assert errors[0] / errors[1] > 7


def test_a_step_rings_by_seven_percent_of_it_beside_and_nowhere_else_and_has_its_gradient(
    generator,
):
    level = f64([1.0, 1.0, 1.0, 3.0, 3.0, 3.0]).reshape(-1, 1)
    found, times_s = finer(level, torch.arange(6.0), 1 / 96, log_input=True)
    assert (found[times_s <= 1] == 1).all()
    assert (found[times_s >= 4] == 3).all()
    # half a step per interval of slope at the end of a cubic: s^2 (1 - s) is at most 4/27
    assert float(found.min()) == pytest.approx(1 - 4 / 27, abs=1e-4)
    assert float(found.max()) == pytest.approx(3 + 4 / 27, abs=1e-4)
    t_s = f64([0.0, 0.1, 0.25, 0.3, 0.5])
    frames = (rand64(generator, 5, 2, 2) * 60).requires_grad_()
    assert torch.autograd.gradcheck(lambda frames: finer(frames, t_s, 0.04)[0], (frames,))


@pytest.mark.parametrize(
    "t_s",
    [
        torch.linspace(0, 0.1, 17),
        10 + torch.arange(17) / 100,
        1.7e9 + torch.arange(17, dtype=D) / 1000,
    ],
)
def test_rounded_times_make_no_part_more(t_s, generator):
    # 17 frames are four intervals from one node of five bins to the next, in exact times
    frames = 30 + 99 * torch.rand(17, 2, 2, generator=generator)
    layer = events.layer()
    longest_s = float(t_s.to(D)[-1] - t_s.to(D)[0]) / 16
    assert torch.equal(layer.finely(frames, t_s, longest_s)[0], layer(frames, t_s))
    assert layer.finely(frames, t_s, longest_s / 2)[0].shape[0] == 32


@pytest.mark.parametrize("name", events.LAYERS)
def test_every_layer_gives_volumes_from_few_frames(name):
    level = waves(8)[..., :40].expand(2, 9, 1, 40)
    layer = events.layer(name, SENSOR, log_input=True)
    counts, times_s = layer.finely(level, times(8), SPAN_S / 16)
    torch.testing.assert_close(times_s, times(16))
    volume = layer.volume(level, times(8), BINS)
    assert volume.counts.shape == (2, 2, BINS, 1, 40)
    torch.testing.assert_close(volume.counts.sum((0, 2)), counts.sum((0, 1)))
    if not layer.refines:  # events of an interval come evenly
        halves = counts.unflatten(1, (8, 2))
        each = layer(level, times(8)) / 2
        torch.testing.assert_close(halves, each[:, :, None].expand_as(halves))


def test_a_system_asks_a_layer_for_its_volume_and_sets_plain_counts_at_middles():
    frames = waves(8)[None, ..., :32].reshape(1, 9, 4, 8)
    layer = events.layer("memory", SENSOR, log_input=True)
    system = System(
        camera=lambda: SimpleNamespace(film=SimpleNamespace(shape=(4, 8)), seed=0),
        events=layer,
        flow=lambda volume: FlowField(volume.counts[:, :, 0], volume.counts[:, 0, 0] > 0, SPAN_S),
        objectives={"zero": lambda field: field.flow_px.sum()},
    )
    plain = system.replaced(events=lambda frames, t_s: layer(frames, t_s))
    batch = Batch(None, times(8))
    found = [one.begin(batch, {"frames": frames})["volume"].counts for one in (system, plain)]
    counts = layer(frames, times(8)).movedim(0, 2)
    assert torch.equal(found[0], layer.volume(frames, times(8), 5).counts)
    assert torch.equal(found[1], events.from_counts(counts, times(8), 5).counts)
    assert not torch.equal(*found)


RATE = 25.0  # of the log level, per second
WINDOW_S = 0.02
START_S = 3.0  # of the window, on the clock of the frames
IDEAL = events.SensorModel(theta_on=0.2, theta_off=0.2)
STEADY = RATE * WINDOW_S / 0.2


def ramps(lead_s, slope=1.0):
    """Frames [1, T, 1, 200] and times: log levels that rise by RATE, up to one event's time after
    the first frame, so that all phases of the threshold are alike often; without a lead all begin
    with the window."""
    t_s = START_S + torch.linspace(-lead_s, WINDOW_S, 61, dtype=D)
    delay_s = torch.linspace(0, 0.2 / RATE, 201, dtype=D)[:-1] * (lead_s > 0)
    since_s = (t_s[:, None] - START_S + lead_s - delay_s).clamp(min=0)
    return (4.0 + slope * RATE * since_s).exp()[None, :, None], t_s, 5


@pytest.mark.parametrize("hard", [False, True])
def test_the_steady_rate_of_a_ramp_is_read_after_the_lead(hard):
    """Events of a window are its rise over the threshold; a sensor that begins with the window
    counts whole ones."""

    def volume(sensor, lead_s):
        made = events.Settled(events.layer("memory", sensor), lead_s)
        with torch.no_grad():
            if hard:
                return events.HardSensor(sensor, 5, lead_s)(*ramps(lead_s)[:2])
            return made.volume(*ramps(lead_s))

    found = volume(IDEAL, 0.02)
    assert float(found.collected_s.sum()) == pytest.approx(WINDOW_S)
    assert float(found.counts.sum()) / 200 == pytest.approx(STEADY, abs=0.03)
    rates = found.counts[0, 0].mean((1, 2)) / found.collected_s
    assert rates.tolist() == pytest.approx([RATE / 0.2] * 5, rel=0.12)
    assert float(volume(IDEAL, 0.0).counts.sum()) / 200 == pytest.approx(math.floor(STEADY))
    # behind a low pass the first events come later still; after the lead what is left is that its
    # time constant, which goes as one over the light, is shorter at the end of the ramp than at its
    # beginning
    slow = replace(IDEAL, cutoff_hz=100.0)
    assert volume(slow, 0.0).counts.sum() / 200 <= STEADY - 0.5
    assert STEADY < volume(slow, 0.02).counts.sum() / 200 < STEADY + 0.2


def test_the_gradient_of_a_settled_sensor_is_that_of_the_steady_count():
    slope = torch.tensor(1.0, dtype=D, requires_grad=True)
    volume = events.Settled(events.layer("memory", IDEAL), 0.02).volume(*ramps(0.02, slope))
    (found,) = torch.autograd.grad(volume.counts[:, 0].sum() / 200, slope)
    assert float(found) == pytest.approx(STEADY, rel=0.03)
