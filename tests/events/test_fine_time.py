"""When events come between two frames: against curves known in closed form, and the hard sensor at 10 kHz."""

import itertools
import math
from functools import cache
from types import SimpleNamespace

import pytest
import torch

from codesign import System, events
from codesign.events.level_path import finer
from codesign.system import Batch
from codesign.types import FlowField

D = torch.float64
C = 0.15
SPAN_S = 0.1
BINS = 5
PIXELS = 4000
STEP = 0.05


def times(intervals):
    return torch.linspace(0, SPAN_S, intervals + 1, dtype=D)


generator = torch.Generator().manual_seed(3)
PHASE, SECOND, OFFSET = torch.rand(3, PIXELS, generator=generator, dtype=D)
# pixels of like phase together, [4, N]: over all of them a shift in time changes nothing
GROUPS = torch.cat([torch.stack((x.sin(), x.cos())) for x in (PHASE * 2 * math.pi, SECOND * 2 * math.pi)])


def waves(intervals, amplitude=1.0, shift_s=0.0):
    """[T, 1, N] levels: two waves per pixel with phases of its own, the faster with six samples per period
    where there are eight intervals. Pixels begin anywhere in their thresholds, so a sum of many is a mean
    over beginnings."""
    turn = (times(intervals)[:, None] + shift_s) * 2 * math.pi
    level = 0.5 * torch.sin(13.3 * turn + PHASE * 2 * math.pi) + 0.7 * torch.sin(
        4.1 * turn + SECOND * 2 * math.pi
    )
    return (4 + C * OFFSET + amplitude * level)[:, None]


def grouped(volume):
    """Sums of an EventVolume over groups of pixels, [2, bins, 4]."""
    return volume.counts[0, :, :, 0] @ GROUPS.T


def hard_volume(level):
    """The stream of the hard sensor, event by event, in bins."""
    stream = events.simulate(level, times(len(level) - 1), SENSOR, log_input=True)
    return grouped(events.from_stream(stream, 0, round(SPAN_S * 1e6), BINS, dtype=D))


SENSOR = events.SensorModel(theta_on=C, theta_off=C)
MOVES = {
    "amplitude": lambda intervals, s: waves(intervals, amplitude=1 + s),
    "shift": lambda intervals, s: waves(intervals, shift_s=s * 0.02),
}


@cache
def difference(move):
    """Derivative of the stream's volume, the mean over beginnings."""
    return (hard_volume(MOVES[move](1000, STEP)) - hard_volume(MOVES[move](1000, -STEP))) / (2 * STEP)


def cosine_and_scale(found, truth):
    return float(found @ truth / (found.norm() * truth.norm())), float(found @ truth / (truth @ truth))


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("name", ["memory", "counts", "physical"])
def test_eight_intervals_steer_a_volume_as_the_stream_at_10_khz_does(name, move):
    truth = difference(move)
    level = waves(8).requires_grad_()
    volume = grouped(events.layer(name, SENSOR, log_input=True).volume(level, times(8), BINS))
    tangent = (MOVES[move](8, STEP) - MOVES[move](8, -STEP)) / (2 * STEP)
    found = torch.stack(
        [
            (torch.autograd.grad(share, level, retain_graph=True)[0] * tangent).sum()
            for share in volume.flatten()
        ]
    )
    cosine, scale = cosine_and_scale(found, truth.flatten())
    # what is asked of eight intervals
    assert cosine >= 0.97
    assert 0.9 <= scale <= 1.1


def test_events_of_one_long_interval_lie_where_the_level_crosses():
    level = torch.tensor([4.0, 4.0 + 20.5 * C], dtype=D).reshape(2, 1, 1)
    t_s = torch.tensor([0.0, SPAN_S], dtype=D)
    volume = (
        events.layer("memory", SENSOR, log_input=True).volume(level, t_s, BINS).counts[0, 0, :, 0, 0].detach()
    )
    crossing = torch.arange(1, 21, dtype=D) / 20.5 * (BINS - 1)  # in node spacings
    truth = (1 - (crossing - torch.arange(BINS, dtype=D)[:, None]).abs()).clamp(min=0).sum(1)
    assert float(volume.sum()) == 20
    # four parts from node to node: an event lies at most an eighth of that from its place, early as often as
    # late
    nodes = torch.arange(BINS, dtype=D)
    assert abs(float(nodes @ (volume - truth))) < 20 / 8 / 4
    # a node shares the events of both spacings beside it, and so does one part's worth of them at most
    assert float((volume - truth).abs().max()) < 20.5 / (4 * (BINS - 1)) / 4


@pytest.mark.parametrize("log_input", [True, False])
def test_smooth_curves_between_frames_are_met_to_the_third_order(log_input):
    """h^3 |L'''| / 62 between inner frames, the term that central slopes leave."""

    def curve(t_s):
        return 3.5 + 1.5 * torch.sin(2 * math.pi * 10 * t_s)  # 7 to 150 of 255: dark part and logarithm

    errors = []
    for intervals in (20, 40):
        level = curve(times(intervals)).reshape(-1, 1, 1)
        dark = level * 20 / math.log(20)
        frames = level if log_input else torch.where(level <= math.log(20), dark, level.exp())
        found, times_s = finer(frames, times(intervals), SPAN_S / 320, log_input=log_input)
        found = found if log_input else events.lin_log(found)
        inner = (times_s > SPAN_S / intervals) & (times_s < SPAN_S * (1 - 1 / intervals))
        errors.append(float((found.flatten() - curve(times_s))[inner].abs().max()))
        slope = 1.5 * (2 * math.pi * 10) ** 3
        assert errors[-1] < 1.1 * (SPAN_S / intervals) ** 3 * slope / 62
    assert errors[0] / errors[1] > 7


def test_a_step_rings_by_seven_percent_of_it_beside_and_nowhere_else():
    level = torch.tensor([1.0, 1.0, 1.0, 3.0, 3.0, 3.0], dtype=D).reshape(-1, 1)
    found, times_s = finer(level, torch.arange(6.0), 1 / 96, log_input=True)
    assert bool((found[times_s <= 1] == 1).all())
    assert bool((found[times_s >= 4] == 3).all())
    # half a step per interval of slope at the end of a cubic: s^2 (1 - s) is at most 4/27
    assert float(found.min()) == pytest.approx(1 - 4 / 27, abs=1e-4)
    assert float(found.max()) == pytest.approx(3 + 4 / 27, abs=1e-4)


@pytest.mark.parametrize(
    "t_s",
    [torch.linspace(0, 0.1, 17), 10 + torch.arange(17) / 100, 1.7e9 + torch.arange(17, dtype=D) / 1000],
    ids=["float32", "float32 of ten seconds", "seconds since 1970"],
)
def test_rounded_times_make_no_part_more(t_s):
    # 17 frames are four intervals from one node of five bins to the next, in exact times
    frames = 30 + 99 * torch.rand(17, 2, 2, generator=torch.Generator().manual_seed(0))
    layer = events.layer()
    counts = layer(frames, t_s)
    longest_s = float(t_s.to(D)[-1] - t_s.to(D)[0]) / 16
    assert torch.equal(layer.finely(frames, t_s, longest_s)[0], counts)
    assert layer.finely(frames, t_s, longest_s / 2)[0].shape[0] == 32


def test_the_way_between_frames_has_its_gradient():
    generator = torch.Generator().manual_seed(1)
    t_s = torch.tensor([0.0, 0.1, 0.25, 0.3, 0.5], dtype=D)
    frames = (torch.rand(5, 2, 2, generator=generator, dtype=D) * 60).requires_grad_()
    assert torch.autograd.gradcheck(lambda frames: finer(frames, t_s, 0.04)[0], (frames,))


@pytest.mark.parametrize("name", events.LAYERS)
def test_every_layer_gives_volumes_and_surfaces_from_few_frames(name):
    level = waves(8)[..., :40].expand(2, 9, 1, 40)
    layer = events.layer(name, SENSOR, log_input=True)
    counts, times_s = layer.finely(level, times(8), SPAN_S / 16)
    volume = layer.volume(level, times(8), BINS)
    assert counts.shape == (2, 16, 2, 1, 40)
    torch.testing.assert_close(times_s, times(16))
    assert volume.counts.shape == (2, 2, BINS, 1, 40)
    torch.testing.assert_close(volume.counts.sum((0, 2)), counts.sum((0, 1)))
    surface = layer.surface(level, times(8), 0.02)
    assert surface.shape == (2, 8, 2, 1, 40)
    assert 0 <= float(surface.detach().min()) <= float(surface.detach().max()) <= 1
    if not layer.refines:  # events of an interval come evenly
        halves = counts.unflatten(1, (8, 2))
        torch.testing.assert_close(halves[:, :, 0], halves[:, :, 1])
        torch.testing.assert_close(halves.sum(2), layer(level, times(8)))


def test_a_system_asks_a_layer_for_its_volume_and_sets_plain_counts_at_middles():
    frames = waves(8)[None, ..., :32].reshape(1, 9, 4, 8)
    layer = events.layer("memory", SENSOR, log_input=True)
    system = System(
        camera=lambda: SimpleNamespace(film=SimpleNamespace(shape=(4, 8)), seed=0),
        events=layer,
        flow=lambda volume: FlowField(volume.counts[:, :, 0], volume.counts[:, 0, 0] > 0, SPAN_S),
        objectives={"zero": lambda field: field.flow_px.sum()},
    )
    batch = Batch(None, times(8))
    fine = system.begin(batch, {"frames": frames})["volume"]
    assert torch.equal(fine.counts, layer.volume(frames, times(8), 5).counts)
    plain = system.replaced(events=lambda frames, t_s: layer(frames, t_s)).begin(batch, {"frames": frames})[
        "volume"
    ]
    counts = layer(frames, times(8)).movedim(0, 2)
    assert torch.equal(plain.counts, events.from_counts(counts, times(8), 5).counts)
    assert not torch.equal(plain.counts, fine.counts)


def test_a_surface_of_hard_counts_is_that_of_the_stream():
    generator = torch.Generator().manual_seed(2)
    counts = (torch.rand(30, 2, 3, 4, 5, generator=generator, dtype=D) * 1.3).floor()
    t_s = torch.linspace(0, 0.3, 31, dtype=D)
    found = events.surface_from_hard_counts(counts, t_s, t_s[[10, 11, 30]], 0.05)
    torch.testing.assert_close(found, events.surface_from_counts(counts, t_s, 0.05)[[9, 10, 29]])


@pytest.mark.parametrize("move", MOVES)
def test_a_surface_steers_as_the_mean_over_beginnings(move):
    """Against the stream of single events, from forty intervals: what the gradient of the surface itself is
    worth."""
    tau_s = 0.03

    def surface(level):
        stream = events.simulate(level, times(1000), SENSOR, log_input=True)
        found = events.surface_from_stream(stream, [50_000, 100_000], tau_s, dtype=D)
        return found[:, :, 0] @ GROUPS.T

    step = 0.2  # wide: a surface is the last event alone, so pixels are few for its noise
    truth = (surface(MOVES[move](1000, step)) - surface(MOVES[move](1000, -step))) / (2 * step)
    level = waves(40).requires_grad_()
    found = events.layer("memory", SENSOR, log_input=True).surface(level, times(40), tau_s)[[19, 39]]
    tangent = (MOVES[move](40, step) - MOVES[move](40, -step)) / (2 * step)
    slopes = [
        (torch.autograd.grad(one, level, retain_graph=True)[0] * tangent).sum()
        for one in (found[:, :, 0] @ GROUPS.T).flatten()
    ]
    cosine, scale = cosine_and_scale(torch.stack(slopes), truth.flatten())
    assert cosine >= 0.9
    assert 0.8 <= scale <= 1.25


def test_the_gradient_of_a_surface_is_that_of_the_two_windows_behind_its_events():
    generator = torch.Generator().manual_seed(4)
    intervals = 25
    t_s = (0.05 + torch.rand(intervals + 1, generator=generator, dtype=D)).cumsum(0)
    counts = (torch.rand(intervals, 2, 1, 3, generator=generator, dtype=D) * 1.7).square().floor()
    # before the first interval ends, two in one interval, at an end, and behind all
    at_s = [
        float(t_s[0]) + 0.01,
        *torch.lerp(t_s[6], t_s[7], torch.tensor([0.2, 0.7], dtype=D)),
        t_s[18],
        t_s[-1] + 1,
    ]
    weight = torch.randn(len(at_s), 2, 1, 3, generator=generator, dtype=D)
    tau_s = 2.0
    middle_s = (t_s[1:] + t_s[:-1]) / 2
    wanted = torch.zeros_like(counts)
    for number, time_s in enumerate(at_s):
        for cell in itertools.product(*map(range, counts.shape[1:])):
            seen = [k for k in range(intervals) if t_s[k + 1] <= time_s]
            fired = [k for k in seen for _ in range(int(counts[(k, *cell)]))]
            for begun in [[-1, *fired][-1], [-1, -1, *fired][-2]]:
                base = math.exp((middle_s[begun] - time_s) / tau_s) if begun >= 0 else 0
                for k in range(begun + 1, len(seen)):
                    shown = math.exp((middle_s[k] - time_s) / tau_s)
                    wanted[(k, *cell)] += weight[(number, *cell)] * (shown - base) / 2
    counts.requires_grad_()
    surface = events.surface_from_hard_counts(counts, t_s, at_s, tau_s)
    torch.testing.assert_close(torch.autograd.grad(surface, counts, weight)[0], wanted)
