"""Wrong calls of the event package, as somebody makes who meets it for the first time: each gets one sentence
that names what was given."""

import math

import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import CodesignError, DomainError, ShapeError
from codesign.events import SensorModel, layer
from codesign.events.stream import check_stream, ordered
from codesign.events.views.figures import rate_figure, space_time_figure
from codesign.types import EventStream

FRAMES = torch.rand(5, 4, 6, generator=torch.Generator().manual_seed(0)) * 200 + 10
T_S = torch.arange(5) / 100
COUNTS = torch.ones(4, 2, 4, 6)
STREAM = ordered(*(torch.tensor(column) for column in ([5, 9], [1, 2], [3, 0], [1, -1])), 4, 6)
SENSOR = SensorModel()
NAN = math.nan
HALVES = torch.full((4, 2, 4, 6), 0.5)
PICTURES = torch.zeros(2, 4, 4, dtype=torch.uint8)
TAKE_FRAMES = {
    "simulate": lambda frames: events.simulate(frames, T_S, SENSOR),
    "dense_counts": lambda frames: events.dense_counts(frames, T_S, SENSOR),
    "naive": lambda frames: events.naive(frames, T_S, 0.2),
    "memory": lambda frames: events.memory(frames, 0.2, 0.2),
    "soft_counts": lambda frames: events.soft_counts(frames, 0.2, 0.2),
    "soft": lambda frames: events.soft(frames, 0.2),
    "dense": lambda frames: events.dense(frames, 0.2, 0.2),
    "expected": lambda frames: events.expected(frames, 0.2, 0.2, 0.15),
    "sensor_counts": lambda frames: events.sensor_counts(frames, T_S, SENSOR),
    "upsample": lambda frames: events.upsample(frames, T_S),
    **{name: lambda frames, name=name: layer(name)(frames, T_S) for name in events.LAYERS},
}
TAKE_THRESHOLDS = {
    "naive": lambda theta: events.naive(FRAMES, T_S, theta),
    "memory": lambda theta: events.memory(FRAMES, theta, 0.2),
    "memory, OFF": lambda theta: events.memory(FRAMES, 0.2, theta),
    "soft_counts": lambda theta: events.soft_counts(FRAMES, theta, 0.2),
    "soft": lambda theta: events.soft(FRAMES, theta),
    "dense": lambda theta: events.dense(FRAMES, 0.2, theta),
    "expected": lambda theta: events.expected(FRAMES, theta, 0.2, 0.15),
}
TAKE_TIMES = {
    "simulate": lambda t_s: events.simulate(FRAMES, t_s, SENSOR),
    "naive": lambda t_s: events.naive(FRAMES, t_s, 0.2),
    "upsample": lambda t_s: events.upsample(FRAMES, t_s),
    "layer": lambda t_s: layer("counts")(FRAMES, t_s),
    "from_counts": lambda t_s: events.from_counts(COUNTS, t_s, 2),
    "to_counts": lambda t_s: events.to_counts(STREAM, t_s),
    "decay": lambda t_s: events.decay(COUNTS, t_s, 0.1),
}
TAKE_COUNTS = {
    "from_counts": lambda counts: events.from_counts(counts, T_S, 2),
    "surface_from_counts": lambda counts: events.surface_from_counts(counts, T_S, 0.1),
    "surface_from_hard_counts": lambda counts: events.surface_from_hard_counts(counts, T_S, T_S, 0.1),
    "spikes_from_counts": events.spikes_from_counts,
}


def stream_of(t_us=(5, 9), x=(1, 2), y=(3, 0), p=(1, -1)):
    return EventStream(*(torch.tensor(column) for column in (t_us, x, y, p)), 4, 6)


TAKE_STREAMS = (
    check_stream,
    lambda stream: events.to_counts(stream, T_S),
    lambda stream: events.from_stream(stream, 0, 10, 2),
    lambda stream: events.surface_from_stream(stream, [10], 0.1),
    lambda stream: events.spikes_from_stream(stream, 0, 5, 2),
    lambda stream: events.write("e.npz", stream),
    lambda stream: events.write("e.raw", stream),
)
# takers, what they are given, words of the sentence
KINDS = [
    (TAKE_FRAMES, FRAMES.half(), "float16"),
    (TAKE_FRAMES, FRAMES.to_sparse(), "sparse"),
    (TAKE_FRAMES, FRAMES.to("meta"), "without values"),
    (TAKE_FRAMES, FRAMES[:1], "at least 2|one time per frame"),
    (TAKE_FRAMES, FRAMES[:, :0], "no pixel"),
    (TAKE_FRAMES, torch.tensor(1.0), "no time axis|tensor .*needed"),
    (TAKE_FRAMES, FRAMES.index_fill(0, torch.tensor([1]), NAN), "NaN"),
    (TAKE_FRAMES, FRAMES.index_fill(0, torch.tensor([1]), math.inf), "infinite"),
    (TAKE_FRAMES, FRAMES.index_fill(0, torch.tensor([2]), -1e-3), r"index \[2, 0, 0\]|frame 2|negative"),
    (TAKE_THRESHOLDS, 0.0, "> 0"),
    (TAKE_THRESHOLDS, -0.2, "> 0"),
    (TAKE_THRESHOLDS, NAN, "> 0"),
    (TAKE_THRESHOLDS, True, "True"),
    (TAKE_THRESHOLDS, "0.2", "'0.2'"),
    (TAKE_THRESHOLDS, torch.tensor(0.2 + 0j), "complex"),
    (TAKE_THRESHOLDS, torch.full((6, 4), 0.2), r"\[4, 6\]"),
    (TAKE_THRESHOLDS, torch.ones((), device="meta"), "on meta"),
    (TAKE_THRESHOLDS, 10**400, "= 1000"),
    (TAKE_TIMES, ["0", "1", "2", "3", "4"], "real numbers"),
    (TAKE_TIMES, T_S.to(torch.complex64), "real numbers"),
    (TAKE_TIMES, T_S.clone().requires_grad_(), "none to frame times"),
    (TAKE_TIMES, torch.tensor(0.1), "one time per frame"),
    (TAKE_TIMES, T_S.flip(0), "increase strictly"),
    (TAKE_TIMES, T_S * NAN, "t_s"),
    (TAKE_COUNTS, COUNTS.int(), "int32"),  # shares of an event would all round to zero
    (TAKE_COUNTS, COUNTS[0], "have shape"),
    (TAKE_COUNTS, COUNTS[:, :1], "ON first"),
    (TAKE_COUNTS, COUNTS * NAN, "NaN"),
]


@pytest.mark.parametrize(
    ("take", "given", "words"),
    [(take, given, words) for takers, given, words in KINDS for take in takers.values()],
)
def test_what_is_of_another_kind(take, given, words):
    with pytest.raises(CodesignError, match=words):
        take(given)


@pytest.mark.parametrize(
    ("stream", "words"),
    [
        ([(5, 1, 3, 1)], "(are|is) a list"),
        (stream_of(t_us=(9, 5)), "go back"),
        (stream_of(t_us=(5.0, 9.5)), "float32"),
        (stream_of(x=(1, 6)), "x spans 1 to 6; the sensor has 6"),
        (stream_of(y=(-1, 0)), "y spans -1 to 0"),
        (stream_of(p=(1, 0)), "polarity 0"),
        (stream_of(p=(1,)), "equal length"),
    ],
)
def test_streams_that_are_none(tmp_path, monkeypatch, stream, words):
    monkeypatch.chdir(tmp_path)
    for take in TAKE_STREAMS:
        with pytest.raises(CodesignError, match=words):
            take(stream)
    assert not list(tmp_path.iterdir())


def events_at(t_us, x, y, p):
    return ordered(*(torch.tensor([value]) for value in (t_us, x, y, p)), 4, 6)


def designed(**design):
    return events.sensor_counts(FRAMES, T_S, SENSOR, **design)


def surface_of_times(**changed):
    zero = torch.zeros(2, dtype=torch.int64)
    given = {"t_s": torch.zeros(2), "x": zero, "y": zero, "p": zero + 1} | changed
    return events.surface_from_times(**given, height_px=3, width_px=4, at_s=[1.0], tau_s=1.0)


def going_on(**changed):
    """A layer's second chunk."""
    made = layer("memory", SensorModel(theta_sigma=0.03))
    given = {"frames": FRAMES, "t_s": T_S + 1, "state": made.advance(FRAMES, T_S)[1]} | changed
    return made.advance(**given)


def settled(lead_s):
    return events.Settled(layer("memory"), lead_s).volume(FRAMES, T_S, 2)


def upsampled(**options):
    frames = FRAMES.roll((3, 5), (1, 2)) if "max_steps" in options else FRAMES
    return events.upsample(frames, T_S, **options)


def streamed(frames, t_s):
    return list(events.upsample_stream(frames, t_s))


GENERATOR = torch.Generator()
UNSTABLE = {"cutoff_hz": 300.0, "shot_rate_hz": 5.0, "photoreceptor_noise": True, "timing": "v2e"}
WRONG = [
    (lambda: events_at(0.5, 1, 1, 1), "t_us holds 0.5"),
    (lambda: events_at(1, 6, 1, 1), "x spans 6 to 6"),
    (lambda: events_at(1, 1, 1, 2), "polarity 2"),
    (lambda: ordered(STREAM.t_us, STREAM.x[:1], STREAM.y, STREAM.p, 4, 6), "equal length"),
    (lambda: events.concatenate([]), "at least one"),
    (lambda: events.concatenate([STREAM, ordered(*[torch.zeros(0)] * 4, 5, 6)]), "one sensor"),
    (lambda: events.to_counts(STREAM, [0.0, 1e-7]), "microsecond"),
    # files
    (lambda: events.write("e.raw", STREAM, evt=[2]), r"evt=\[2\]"),
    (lambda: events.write("e.npz", STREAM, t0_us=5), r"t0_us=5 .* \.dat and \.raw"),
    # volumes, surfaces, spikes
    (lambda: events.HardSensor(SENSOR, 0), "bins is 0"),
    (lambda: events.HardSensor(SENSOR, 5, -1.0), "lead_s is -1"),
    (lambda: events.HardSensor(SENSOR, 5)(FRAMES, T_S), r"\[N, T, H, W\]"),
    (lambda: events.from_counts(COUNTS, T_S, 2.0), "bins"),
    (lambda: events.from_counts(COUNTS, T_S, 20), "fewer bins"),
    (lambda: events.from_counts(COUNTS, T_S, 2**40), "bins is"),
    (lambda: events.from_stream(STREAM, NAN, 10, 2), "t0_us is nan"),
    (lambda: events.from_stream(STREAM, 5, 2, 2), "t1 > t0"),
    (lambda: events.from_stream(STREAM, 0, 10, -1), "bins"),
    (lambda: events.spikes_from_stream(STREAM, 0.5, 1, 1), "t0_us"),
    (lambda: events.spikes_from_stream(STREAM, 0, 1, True), "steps"),
    (lambda: events.stream_from_spikes(torch.zeros(2, 3, 3), 0, 1), "W, H, T"),
    (lambda: events.stream_from_spikes(torch.full((2, 1, 1, 1), 0.5), 0, 1), "other than 0 and 1"),
    (lambda: events.spikes_from_counts(-COUNTS), "0 or more"),
    (lambda: events.surface_from_counts(-COUNTS, T_S, 0.1), "0 or more"),
    (lambda: events.surface_from_hard_counts(HALVES, T_S, T_S, 0.1), r"counts hold 0\.5; whole numbers"),
    (lambda: events.surface_from_stream(STREAM, [5], -1.0), "tau_s"),
    (lambda: events.surface_from_stream(STREAM, [5, 5], 1.0), "whole microseconds"),
    (lambda: events.surface_from_stream(STREAM, [0.5], 1.0), "whole microseconds"),
    (lambda: surface_of_times(x=torch.zeros(1, dtype=torch.int64)), "equal length"),
    (lambda: surface_of_times(x=torch.tensor([0, 4])), "below 4"),
    (lambda: surface_of_times(p=torch.tensor([0, 1])), "polarity"),
    (lambda: surface_of_times(t_s=torch.tensor([0, 1])), "floating-point"),
    (lambda: events.decay(COUNTS, T_S, math.inf), "tau_s"),
    (lambda: events.decay(COUNTS, T_S, 1e-200), "tau_s is 1e-200"),
    (lambda: events.decay_from_stream(STREAM, [10], 0.1, start=(COUNTS[0], 2**40)), "the trace is of"),
    (lambda: events.decay_from_stream(STREAM, [10], 0.1, start=(torch.zeros(2, 6, 4), 0)), "the sensor's"),
    # pictures
    (lambda: events.picture(COUNTS[:, 0]), "ON first"),
    (lambda: events.picture(COUNTS, full_scale=0), "full_scale"),
    (lambda: events.write_video("e.gif", PICTURES, 0), "fps"),
    (lambda: events.write_video("e.avi", PICTURES, 10), r"\.mp4 or \.gif"),
    (lambda: events.write_video("none/e.gif", PICTURES, 10), "folder"),
    (lambda: events.write_video("e.gif", PICTURES.float(), 10), "uint8"),
    (lambda: events.write_video("e.gif", iter(()), 10), "at least one"),
    (lambda: events.write_video("e.gif", iter([PICTURES[0], PICTURES[0, :2]]), 10), "one size"),
    (lambda: rate_figure(torch.zeros(3), torch.zeros(2, 2)), r"\[K, 2\]"),
    (lambda: space_time_figure(STREAM, points=0), "points"),
    (lambda: space_time_figure(ordered(*[torch.zeros(0)] * 4, 3, 3)), "no event"),
    # sensors
    (lambda: events.simulate(FRAMES[:, 0], T_S, SENSOR), "H, W"),
    (lambda: events.simulate(FRAMES, T_S, "noisy"), "events.PRESETS"),
    (lambda: events.simulate(FRAMES, T_S, SENSOR, 3), "the generator is 3"),
    (lambda: events.simulate(FRAMES, T_S, SENSOR, state={}), "the state is a dict"),
    (lambda: events.simulate(FRAMES, T_S, SENSOR, log_input="no"), "log_input is 'no'"),
    (lambda: events.simulate(FRAMES, T_S, SENSOR, log_eps=0.0), "log_eps"),
    (lambda: events.simulate(FRAMES, T_S, SENSOR, log_eps=1.0, log_input=True), "log_input"),
    (lambda: SensorModel(theta_on=np.float32(0.2)), r"\(float32\); a finite Python number"),
    (lambda: SensorModel(theta_on=torch.tensor(0.2)), "events.sensor_counts"),
    (lambda: SensorModel(theta_on=10**400), "theta_on is 1000"),
    (lambda: SensorModel(theta_off=0), "theta_off"),
    (lambda: SensorModel(theta_sigma=-1.0), "theta_sigma"),
    (lambda: SensorModel(shot_rate_hz=NAN), "shot_rate_hz"),
    (lambda: SensorModel(timing="exact"), "timing"),
    (lambda: SensorModel(photoreceptor_noise=True), "needs cutoff_hz and shot_rate_hz"),
    (lambda: events.simulate(FRAMES, T_S, SensorModel(**UNSTABLE)), "unstable"),
    (lambda: SensorModel(hot_pixel_share=2.0), "0 to 1"),
    (lambda: events.draw_thresholds(SENSOR, (2, 2), GENERATOR, device="x"), "device is 'x'"),
    (lambda: events.draw_shot_counts(SENSOR, (2, 2), [0.1, 0.0], GENERATOR), "interval_s"),
    (lambda: events.draw_shot_counts(SENSOR, (2, 2), torch.tensor(0.1), GENERATOR), "interval_s"),
    (lambda: designed(leak_rate_hz=torch.tensor(0.1)), "'leak_rate_hz' cannot carry"),
    (lambda: designed(theta_on=torch.tensor(-1.0)), "theta_on"),
    (lambda: designed(theta_on=torch.full((4, 6), 0.2)), r"theta_on is .* \[4, 6\]; one"),
    (lambda: designed(refractory_s=torch.tensor(0.0, requires_grad=True)), "0, which switches it off"),
    # functions of frames
    (lambda: events.naive(FRAMES[:, 0], T_S, 0.2), "H, W"),
    (lambda: events.dense(FRAMES, 0.2, 0.2, sharpness=-1), "sharpness is -1"),
    (lambda: events.soft(FRAMES, 0.2, sharpness=math.inf), "sharpness"),
    (lambda: events.expected(FRAMES, 0.2, 0.2, 0.0), "spread"),
    (lambda: events.dense(FRAMES, 0.2, 0.2, state=torch.zeros(6)), r"state is .* \[6\]"),
    (lambda: events.expected(FRAMES, 0.2, 0.2, 0.1, state=FRAMES[0] * NAN), "state"),
    (lambda: events.memory(FRAMES, 0.2, 0.2, state=FRAMES[:2] * NAN), "state: "),
    (lambda: events.memory(FRAMES, 0.2, 0.2, state=FRAMES[0].double()), "same sensor"),
    (lambda: events.memory(FRAMES, 0.2, 0.2, gradient="mean"), "'exact', 'play'"),
    (lambda: events.annealed(1, 10, NAN), "first is nan"),
    (lambda: events.lin_log(-FRAMES), "index"),
    (lambda: events.low_pass(FRAMES, FRAMES, T_S.diff(), 0.0), "cutoff_hz is 0.0"),
    (lambda: events.low_pass(FRAMES, FRAMES, T_S, 1.0), "do not fit"),
    (lambda: events.one_pole(FRAMES, torch.ones(3, 1, 1)), "one per interval"),
    (lambda: events.one_pole(FRAMES[:, 0, 0], torch.ones(4, 1, 1)), "at most 1 axes"),
    (lambda: events.one_pole(FRAMES * NAN, torch.ones(4, 1, 1)), "levels: "),
    (lambda: events.one_pole(FRAMES, torch.ones(4, 1, 1), torch.zeros(6)), r"\[6\], one frame is"),
    (lambda: upsampled(max_displacement_px=0.0), "max_displacement_px is 0.0"),
    (lambda: upsampled(max_log_change=NAN), "max_log_change is nan"),
    (lambda: upsampled(max_steps=0), "max_steps is 0"),
    (lambda: upsampled(max_steps=1, max_displacement_px=0.01), "max_steps = 1: record faster"),
    (lambda: streamed(FRAMES, [0.0]), "there is no time 1"),
    (lambda: streamed([FRAMES[0], FRAMES[1, 1:]], T_S[:2]), "frame 1"),
    (lambda: streamed(FRAMES, [0.1, 0.0, 0.2, 0.3, 0.4]), r"frame 1 is at 0\.0 s"),
    # layers
    (lambda: layer("memroy"), "no event layer 'memroy', did you mean 'memory'"),
    (lambda: layer("x"), r"'x'; event layers are 'sigmoid'"),
    (lambda: layer("memory", "noisy"), "events.PRESETS"),
    (lambda: layer("memory", spread=0.1), "no option 'spread'; its options are learn, log_input"),
    (lambda: layer("memory", learn="theta_on"), "learn is 'theta_on'"),
    (lambda: layer("memory", learn=("refractory_s",)), "cannot learn 'refractory_s'.*the layer 'physical'"),
    (lambda: layer("physical", learn=("leak_rate_hz",)), "'leak_rate_hz', which has no"),
    (lambda: layer("physical", learn=("cutoff_hz",)), "switched off"),
    (
        lambda: layer("expected", SensorModel(theta_sigma=0.03), learn=("theta_sigma",)),
        "no gradient in the comp",
    ),
    (lambda: layer("memory")(FRAMES[0], T_S), r"\[4, 6\]; a tensor"),
    (lambda: layer("memory")(FRAMES, T_S, 3), "the generator is 3"),
    (lambda: layer("memory")(FRAMES.expand(2, 5, 4, 6), T_S, [GENERATOR]), "batch of 2"),
    (lambda: layer("memory").finely(FRAMES, T_S, 1e-12), r"1e-12 s would hold .* of one call"),
    (lambda: layer("memory").finely(FRAMES, T_S, 0.0), "a length > 0 s is needed"),
    (lambda: layer("memory").surface(FRAMES, T_S, 0), "tau_s is 0"),
    (lambda: going_on(generator=GENERATOR), "leave the generator out"),
    (lambda: going_on(t_s=T_S), "go on increasing"),
    (lambda: events.PositiveValues({"tau": -1.0}), "tau is -1.0"),
    (lambda: events.Settled(None, 0.1), "the layer is a NoneType"),
    (lambda: settled(0.007), r"no frame stands 0\.007 s after the first"),
    (lambda: settled(0.04), "no frame stands"),
    # spikes
    (lambda: events.count_loss(COUNTS, COUNTS, side_px=1.5), "side_px is 1.5"),
    (lambda: events.Laplace.unit(0), "width is 0"),
    (lambda: events.srm(FRAMES, theta=1.0, tau_r=1e-12), "tau_r is 1e-12 .* steps"),
    (lambda: events.srm(FRAMES, theta=1.0, kernel=["step"]), "kernel is"),
    (lambda: events.srm(FRAMES, theta=1.0, tau_r=1.0, coupled="no"), "coupled is 'no'"),
    (lambda: events.TwoBranchSpikes(1)(FRAMES, 3), "is a int"),
    (lambda: events.TwoBranchSpikes(1, theta=NAN), "theta is nan"),
    (lambda: events.SpikeEsim()(FRAMES, T_S, state=3), "the state is a int"),
    (lambda: events.SpikeEsim(width=2**40), "width is"),
]


@pytest.mark.parametrize(("call", "words"), WRONG)
def test_one_wrong_value(call, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CodesignError, match=words):
        call()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", events.LAYERS)
def test_states_of_other_frames_or_layers(name):
    made = layer(name)
    _, state = made.advance(FRAMES, T_S)
    for frames in (FRAMES[:, :2], FRAMES.double(), FRAMES[None].expand(2, -1, -1, -1)):
        with pytest.raises(ShapeError):
            made.advance(frames, T_S + 1, state)
    for other in events.LAYERS:
        if other != name:
            with pytest.raises(DomainError, match="pass what this layer returned"):
                layer(other).advance(FRAMES, T_S + 1, state)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"leak_rate_hz": 1.0, "rate_cov_decades": 0.1}, "a spread of leaks"),
        ({"leak_rate_hz": 1.0, "leak_jitter": 0.1}, "a leak that jitters"),
        ({"hot_pixel_share": 0.1, "hot_pixel_rate_hz": 1.0}, "hot pixels"),
        ({"theta_sigma": 0.03}, "a mismatch of thresholds"),
        ({"refractory_s": 0.1}, "a dead time"),
        ({"cutoff_hz": 30.0}, "a bandwidth"),
        ({"shot_rate_hz": 3.0}, "noise events"),
        ({"timing": "v2e"}, "timing='v2e'"),
    ],
)
def test_a_state_that_a_simpler_sensor_began(more, words):
    state = events.SensorState()
    events.simulate(FRAMES, T_S, SENSOR, state=state)
    with pytest.raises(DomainError, match=f"has {words}, the one that began"):
        events.simulate(FRAMES, T_S + 1, SensorModel(**more), state=state)
    assert state.time_s == pytest.approx(0.04)


@pytest.mark.parametrize("name", [name for name in events.LAYERS if name != "physical"])
def test_what_a_layer_leaves_out_of_its_sensor_is_named(name):
    with pytest.warns(UserWarning, match="knows no leak_rate_hz, refractory_s: the sensor is taken without"):
        layer(name, events.PRESETS["default"])
    layer(name, SensorModel(theta_sigma=0.03, shot_rate_hz=1.0))  # warns of nothing: warnings are errors here
