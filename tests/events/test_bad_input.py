"""Wrong calls of the event package, as somebody makes who meets it for the first time: each gets
one sentence that names what was given. Plain types and signs of single arguments are the doors'
(``tests/test_doors.py``)."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import events
from codesign.errors import DomainError, ShapeError
from codesign.events import SensorModel, layer
from codesign.events.stream import check_stream, ordered
from codesign.events.views import figures
from codesign.types import EventStream
from tests import refusals
from tests.numbers import seeded

FRAMES = torch.rand(5, 4, 6, generator=seeded()) * 200 + 10
T_S = torch.arange(5) / 100
COUNTS = torch.ones(4, 2, 4, 6)
STREAM = ordered(*(torch.tensor(column) for column in ([5, 9], [1, 2], [3, 0], [1, -1])), 4, 6)
SENSOR = SensorModel()
NAN = math.nan
PICTURES = torch.zeros(2, 4, 4, dtype=torch.uint8)
TAKE_FRAMES = (
    lambda frames: events.simulate(frames, T_S, SENSOR),
    lambda frames: events.dense_counts(frames, T_S, SENSOR),
    lambda frames: events.naive(frames, T_S, 0.2),
    lambda frames: events.memory(frames, 0.2, 0.2),
    lambda frames: events.soft_counts(frames, 0.2, 0.2),
    lambda frames: events.soft(frames, 0.2),
    lambda frames: events.dense(frames, 0.2, 0.2),
    lambda frames: events.expected(frames, 0.2, 0.2, 0.15),
    lambda frames: events.sensor_counts(frames, T_S, SENSOR),
    lambda frames: events.upsample(frames, T_S),
    lambda frames: events.SpikeEsim()(frames, T_S),
    *(lambda frames, name=name: layer(name)(frames, T_S) for name in events.LAYERS),
)
TAKE_THRESHOLDS = (
    lambda theta: events.naive(FRAMES, T_S, theta),
    lambda theta: events.memory(FRAMES, theta, 0.2),
    lambda theta: events.memory(FRAMES, 0.2, theta),
    lambda theta: events.soft_counts(FRAMES, theta, 0.2),
    lambda theta: events.soft(FRAMES, theta),
    lambda theta: events.dense(FRAMES, 0.2, theta),
    lambda theta: events.expected(FRAMES, theta, 0.2, 0.15),
)
TAKE_TIMES = (
    lambda t_s: events.simulate(FRAMES, t_s, SENSOR),
    lambda t_s: events.naive(FRAMES, t_s, 0.2),
    lambda t_s: events.upsample(FRAMES, t_s),
    lambda t_s: layer("counts")(FRAMES, t_s),
    lambda t_s: events.from_counts(COUNTS, t_s, 2),
    lambda t_s: events.to_counts(STREAM, t_s),
    lambda t_s: events.decay(COUNTS, t_s, 0.1),
)
TAKE_COUNTS = (
    lambda counts: events.from_counts(counts, T_S, 2),
    lambda counts: events.surface_from_counts(counts, T_S, 0.1),
)
TAKE_STREAMS = (
    check_stream,
    lambda stream: events.to_counts(stream, T_S),
    lambda stream: events.from_stream(stream, 0, 10, 2),
    lambda stream: events.surface_from_stream(stream, [10], 0.1),
    lambda stream: events.spikes_from_stream(stream, 0, 5, 2),
    lambda stream: events.write("e.npz", stream),
    lambda stream: events.write("e.raw", stream),
)


def stream_of(t_us=(5, 9), x=(1, 2), y=(3, 0), p=(1, -1)):
    return EventStream(*(torch.tensor(column) for column in (t_us, x, y, p)), 4, 6)


def with_frame(value, index=1):
    return FRAMES.index_fill(0, torch.tensor([index]), value)


KINDS = {
    "what takes frames": TAKE_FRAMES,
    "what takes thresholds": TAKE_THRESHOLDS,
    "what takes times": TAKE_TIMES,
    "what takes counts": TAKE_COUNTS,
    "what takes counts that were seen": TAKE_COUNTS[1:],
    "what takes streams": TAKE_STREAMS,
}
ROWS = [(takers, row) for name, takers in KINDS.items() for row in refusals.rows(__file__, name)]


@pytest.mark.parametrize(("takers", "row"), ROWS)
def test_what_is_of_another_kind(takers, row, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for take in takers:
        row.holds(globals() | {"take": take})
    assert not list(tmp_path.iterdir())


DRIVE = torch.zeros(3, 2, 1)
NO_RESPONSE = torch.zeros(0, 2, 1, dtype=torch.float64)
MEAN = {"kernel": "exp", "response": "alpha", "tau_s": 2.4, "tau_r": 1.2, "gradient": "mean"}


def going_on(**changed):
    """A layer's second chunk."""
    made = layer("memory", SensorModel(theta_sigma=0.03))
    given = {"frames": FRAMES, "t_s": T_S + 1, "state": made.advance(FRAMES, T_S)[1]} | changed
    return made.advance(**given)


def responding(drive=DRIVE, **changed):
    return events.srm(drive, **{"theta": 1.0, "tau_r": 1.0} | changed)


def potential(drive):
    return responding(drive)[1].sum()


def level(rise, seconds, **sensor):
    """A pixel whose log level rises by so much, instead of counting for ever."""
    levels = torch.tensor([0.0, rise])[:, None, None]
    return events.simulate(levels, [0.0, seconds], SensorModel(**sensor), log_input=True)


def streamed(frames, t_s):
    return list(events.upsample_stream(frames, t_s))


def begun_simpler(**more):
    """Goes on with a state that an ideal sensor began, which is left as it was."""
    state = events.SensorState()
    events.simulate(FRAMES, T_S, SENSOR, state=state)
    try:
        events.simulate(FRAMES, T_S + 1, SensorModel(**more), state=state)
    finally:
        assert state.time_s == pytest.approx(0.04)


GENERATOR = torch.Generator()
OURS = events.SpikeEsim()
STATE = OURS(FRAMES, T_S)[1]
NETWORK = events.TwoBranchSpikes(1)
UNSTABLE = {"cutoff_hz": 300.0, "shot_rate_hz": 5.0, "photoreceptor_noise": True, "timing": "v2e"}


@refusals.table(
    __file__,
    *("streams, volumes, surfaces, spikes", "pictures", "sensors", "functions of frames", "layers"),
    *("spike response layer", "spikes", "a state that a simpler sensor began"),
)
def test_one_wrong_value(row, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    row.holds(vars(figures) | globals())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", events.LAYERS)
def test_states_of_other_frames_or_layers(name):
    made = layer(name)
    _, state = made.advance(FRAMES, T_S)
    for frames in (FRAMES[:, :2], FRAMES.double(), FRAMES[None].expand(2, -1, -1, -1)):
        with pytest.raises(ShapeError):
            made.advance(frames, T_S + 1, state)
    for other in set(events.LAYERS) - {name}:
        with pytest.raises(DomainError, match=r"pass what (this layer|the call before) returned"):
            layer(other).advance(FRAMES, T_S + 1, state)


@pytest.mark.parametrize("take", TAKE_FRAMES)
def test_frames_on_0_to_1_are_warned_of(take):
    """They make no event: on 0 to 255 all light up to 1 is within ln(20)/20 = 0.15 of black, less
    than a threshold. Black frames, frames of a chain that begins black, and all others are taken in
    silence."""
    flat = torch.linspace(0, 1, 320).reshape(5, 8, 8)
    with pytest.warns(UserWarning, match="scale 0 to 255"):
        take(flat)
    for frames in (0 * flat, 255 * flat, torch.cat((0 * flat[:3], 255 * flat[:2]))):
        take(frames)


def test_frames_on_0_to_1_make_no_event():
    flat = torch.rand(5, 8, 8, generator=seeded())
    with pytest.warns(UserWarning, match="multiply by 255"):
        assert not len(events.simulate(flat, T_S, SensorModel(theta_on=0.2, theta_off=0.2)))
    assert len(events.simulate(255 * flat, T_S, SensorModel(theta_on=0.2, theta_off=0.2))) > 100
    # levels of a logarithm may be as small
    events.simulate(flat, T_S, SENSOR, log_input=True)


@pytest.mark.parametrize("name", [name for name in events.LAYERS if name != "physical"])
def test_what_a_layer_leaves_out_of_its_sensor_is_named(name):
    with pytest.warns(
        UserWarning, match="knows no leak_rate_hz, refractory_s: the sensor is taken without"
    ):
        layer(name, events.PRESETS["default"])
    # warns of nothing: warnings are errors here
    layer(name, SensorModel(theta_sigma=0.03, shot_rate_hz=1.0))


def test_a_changed_noise_rate_is_drawn_anew():
    noisy = layer("memory", SensorModel(theta_on=9.0, theta_off=9.0, shot_rate_hz=20.0))
    few = noisy(FRAMES, T_S).sum()
    noisy.sensor = replace(noisy.sensor, shot_rate_hz=2000.0)
    assert noisy(FRAMES, T_S).sum() > 20 * few > 0


def test_a_sensor_with_other_values_of_what_is_learnt_is_refused():
    learning = layer("memory", SensorModel(0.2, 0.2))
    with pytest.raises(DomainError, match="theta_on is learnt here"):
        learning.sensor = SensorModel(0.1, 0.2)
    assert learning.fitted() == learning.sensor == SensorModel(0.2, 0.2)
    fixed = layer("memory", SensorModel(0.2, 0.2), learn=())
    fixed.sensor = SensorModel(0.1, 0.1, cutoff_hz=60.0)
    again = layer("memory", SensorModel(0.1, 0.1, cutoff_hz=60.0), learn=())
    assert torch.equal(fixed(FRAMES, T_S), again(FRAMES, T_S))
