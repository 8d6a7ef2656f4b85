"""Wrong calls of the event package, as somebody makes who meets it for the first time: each gets one sentence that
names what was given."""

import math

import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import CodesignError, DomainError, FileFormatError, ShapeError
from codesign.events import SensorModel, layer
from codesign.events.stream import check_stream, ordered
from codesign.types import EventStream

FRAMES = torch.rand(5, 4, 6, generator=torch.Generator().manual_seed(0)) * 200 + 10
T_S = torch.arange(5) / 100
COUNTS = torch.ones(4, 2, 4, 6)
STREAM = ordered(*(torch.tensor(column) for column in ([5, 9], [1, 2], [3, 0], [1, -1])), 4, 6)
TAKE_FRAMES = {
    "simulate": lambda frames: events.simulate(frames, T_S, SensorModel()),
    "dense_counts": lambda frames: events.dense_counts(frames, T_S, SensorModel()),
    "memory": lambda frames: events.memory(frames, 0.2, 0.2),
    "soft": lambda frames: events.soft(frames, 0.2),
    "dense": lambda frames: events.dense(frames, 0.2, 0.2),
    "expected": lambda frames: events.expected(frames, 0.2, 0.2, 0.15),
    "sensor_counts": lambda frames: events.sensor_counts(frames, T_S, SensorModel()),
    "layer": lambda frames: layer("memory")(frames, T_S),
    "HardSensor": lambda frames: events.HardSensor(SensorModel(), 3)(frames, T_S),
    "low_pass": lambda frames: events.low_pass(frames, frames, T_S.diff(), 30.0),
    "upsample": lambda frames: events.upsample(frames, T_S),
}
TAKE_TIMES = {
    "simulate": lambda t_s: events.simulate(FRAMES, t_s, SensorModel()),
    "layer": lambda t_s: layer("counts")(FRAMES, t_s),
    "from_counts": lambda t_s: events.from_counts(COUNTS, t_s, 2),
    "to_counts": lambda t_s: events.to_counts(STREAM, t_s),
    "decay": lambda t_s: events.decay(COUNTS, t_s, 0.1),
}
TAKE_COUNTS = {
    "from_counts": lambda counts: events.from_counts(counts, T_S, 2),
    "surface_from_counts": lambda counts: events.surface_from_counts(counts, T_S, 0.1),
    "spikes_from_counts": events.spikes_from_counts,
}


def designed(**design):
    return events.sensor_counts(FRAMES, T_S, SensorModel(), **design)


def stream_of(t_us=(5, 9), x=(1, 2), y=(3, 0), p=(1, -1)):
    return EventStream(*(torch.tensor(column) for column in (t_us, x, y, p)), 4, 6)


@pytest.mark.parametrize("call", TAKE_FRAMES.values(), ids=TAKE_FRAMES)
@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([1.0, 2.0], "list"),
        (None, "NoneType"),
        (FRAMES.int(), "int32"),
        (FRAMES.half(), "float16"),
        (FRAMES.to(torch.complex64), "complex64"),
        (FRAMES.to_sparse(), "sparse"),
        (FRAMES.to("meta"), "without values"),
        (FRAMES[:0], "at least|shape"),
    ],
)
def test_frames_of_another_kind(call, frames, words):
    with pytest.raises(CodesignError, match=words):
        call(frames)


@pytest.mark.parametrize("call", TAKE_TIMES.values(), ids=TAKE_TIMES)
@pytest.mark.parametrize(
    ("t_s", "words"),
    [
        (None, "NoneType"),
        ("0, 1", "real numbers"),
        (["0", "1", "2", "3", "4"], "real numbers"),
        (T_S.to(torch.complex64), "real numbers"),
        (T_S.clone().requires_grad_(), "none to frame times"),
        (torch.tensor(0.1), "one time per frame"),
        (T_S.flip(0), "increase strictly"),
    ],
)
def test_times_of_another_kind(call, t_s, words):
    with pytest.raises(CodesignError, match=words):
        call(t_s)


@pytest.mark.parametrize("call", TAKE_COUNTS.values(), ids=TAKE_COUNTS)
@pytest.mark.parametrize(
    ("counts", "words"),
    [
        (None, "NoneType"),
        (COUNTS.int(), "int32"),  # shares of an event would all round to zero
        (COUNTS[0], "have shape"),
        (COUNTS[:, :1], "ON first"),
        (COUNTS * math.nan, "NaN"),
    ],
)
def test_counts_of_another_kind(call, counts, words):
    with pytest.raises(CodesignError, match=words):
        call(counts)


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
def test_streams_that_are_none(tmp_path, stream, words):
    for call in (
        check_stream,
        lambda stream: events.to_counts(stream, T_S),
        lambda stream: events.from_stream(stream, 0, 10, 2),
        lambda stream: events.surface_from_stream(stream, [10], 0.1),
        lambda stream: events.spikes_from_stream(stream, 0, 5, 2),
        *(
            lambda stream, name=name: events.write(tmp_path / name, stream)
            for name in ("e.csv", "e.npz", "e.raw")
        ),
    ):
        with pytest.raises(CodesignError, match=words):
            call(stream)
    assert not list(tmp_path.iterdir())


WRONG = {
    "fractions as times": (lambda: ordered(torch.full((1,), 0.5), *STREAM_INTS, 4, 6), "t_us holds 0.5"),
    "no streams": (lambda: events.concatenate(None), "None"),
    "path": (lambda: events.read(3), "the path is 3"),
    "height": (lambda: events.read("e.npz", height_px="4"), "height_px"),
    "bins": (lambda: events.HardSensor(SensorModel(), 0), "bins is 0"),
    "start of a volume": (lambda: events.from_stream(STREAM, math.nan, 10, 2), "t0_us is nan"),
    "step": (lambda: events.spikes_from_stream(STREAM, 0, "5", 2), "step_us"),
    "tau": (lambda: events.decay(COUNTS, T_S, "1"), "tau_s"),
    "tau of each pixel": (lambda: events.decay(COUNTS, T_S, torch.ones(3)), "tau_s"),
    "reference times": (lambda: events.decay_from_stream(STREAM, None, 0.1), "at_us is None"),
    "distance to nothing": (lambda: events.van_rossum(COUNTS, None, tau_s=0.1), "NoneType"),
    "side": (lambda: events.count_loss(COUNTS, COUNTS, side_px=1.5), "side_px is 1.5"),
    "sensor by name": (lambda: events.simulate(FRAMES, T_S, "noisy"), "events.PRESETS"),
    "layer's sensor by name": (lambda: layer("memory", "noisy"), "events.PRESETS"),
    "seed for a generator": (lambda: events.simulate(FRAMES, T_S, SensorModel(), 3), "the generator is 3"),
    "seed for a layer's": (lambda: layer("memory")(FRAMES, T_S, 3), "the generator is 3"),
    "state": (lambda: events.simulate(FRAMES, T_S, SensorModel(), state={}), "the state is a dict"),
    "log_input": (lambda: events.simulate(FRAMES, T_S, SensorModel(), log_input="no"), "log_input is 'no'"),
    "log_eps": (lambda: events.simulate(FRAMES, T_S, SensorModel(), log_eps="a"), "log_eps"),
    "threshold as bool": (lambda: events.memory(FRAMES, True, 0.2), "theta_on is True"),
    "complex threshold": (lambda: events.soft(FRAMES, torch.tensor(0.2 + 0j)), "complex"),
    "numpy's single": (lambda: SensorModel(theta_on=np.float32(0.2)), r"\(float32\); a finite Python number"),
    "a tensor in a sensor": (lambda: SensorModel(theta_on=torch.tensor(0.2)), "events.sensor_counts"),
    "sharpness": (lambda: events.dense(FRAMES, 0.2, 0.2, sharpness=-1), "sharpness is -1"),
    "sharpness as text": (lambda: events.soft(FRAMES, 0.2, sharpness="x"), "sharpness"),
    "spread": (lambda: events.expected(FRAMES, 0.2, 0.2, None), "spread"),
    "state of one row": (lambda: events.dense(FRAMES, 0.2, 0.2, state=torch.zeros(6)), r"state is .* \[6\]"),
    "state without value": (
        lambda: events.expected(FRAMES, 0.2, 0.2, 0.1, state=torch.full((4, 6), math.nan)),
        "state",
    ),
    "bandwidth": (lambda: events.low_pass(FRAMES, FRAMES, T_S.diff(), 0.0), "cutoff_hz is 0.0"),
    "too many intervals": (lambda: events.low_pass(FRAMES, FRAMES, T_S, 1.0), "do not fit"),
    "paces": (lambda: events.one_pole(FRAMES, torch.ones(3, 1, 1)), "one per interval"),
    "learnt value": (lambda: events.PositiveValues({"tau": -1.0}), "tau is -1.0"),
    "option": (lambda: layer("memory", spread=0.1), "no option 'spread'; its options are learn, log_input"),
    "learn as text": (lambda: layer("memory", learn="theta_on"), "learn is 'theta_on'"),
    "learn nothing": (lambda: layer("memory", learn=None), "learn is None"),
    "leak has no gradient": (
        lambda: layer("physical", learn=("leak_rate_hz",)),
        "'leak_rate_hz', which has no",
    ),
    "dead time of a comparator": (lambda: layer("memory", learn=("refractory_s",)), "the layer 'physical'"),
    "spread of nominal thresholds": (
        lambda: layer("expected", SensorModel(theta_sigma=0.03), learn=("theta_sigma",)),
        "theta_sigma has no gradient in the comparator Expected",
    ),
    "pictures of counts": (lambda: events.picture([1]), "counts are list"),
    "full scale": (lambda: events.picture(COUNTS, full_scale="x"), "full_scale"),
    "pictures per second": (lambda: events.write_video("e.gif", [], "x"), "fps"),
    "frames of nothing": (lambda: events.open_frames(None), "the path is None"),
    "pixels": (
        lambda: events.draw_thresholds(SensorModel(theta_sigma=0.1), 4, torch.Generator()),
        "pixels is 4",
    ),
    "intervals": (
        lambda: events.draw_shot_counts(SensorModel(), (2, 2), "x", torch.Generator()),
        "interval_s is 'x'",
    ),
    "axes of a pace": (lambda: events.one_pole(FRAMES[:, 0, 0], torch.ones(4, 1, 1)), "at most 1 axes"),
    "state of Spike-ESIM": (lambda: events.SpikeEsim()(FRAMES, T_S, state=3), "the state is a int"),
    "design of a leak": (lambda: designed(leak_rate_hz=torch.tensor(0.1)), "'leak_rate_hz' cannot carry"),
    "design of each pixel": (
        lambda: designed(theta_on=torch.full((4, 6), 0.2)),
        r"theta_on is .* \[4, 6\]; one",
    ),
    "design of text": (lambda: designed(cutoff_hz="x"), "cutoff_hz"),
    **{
        f"{name} that is switched off": (
            lambda name=name: designed(**{name: torch.tensor(0.0, requires_grad=True)}),
            f"{name} is 0, which switches it off",
        )
        for name in ("theta_sigma", "cutoff_hz", "refractory_s")
    },
    "comparator": (lambda: events.ComparatorLayer(None), "the comparator is None"),
    "parts without end": (
        lambda: layer("memory").finely(FRAMES, T_S, 1e-12),
        r"1e-12 s would hold .* of one call",
    ),
    "bins without end": (lambda: events.from_counts(COUNTS, T_S, 2**40), "bins is"),
    "width of a surrogate": (lambda: events.Laplace.unit(0), "width is 0"),
    "width as text": (lambda: events.Triangular.unit("x"), "width = 'x' is no number"),
    "tau below double precision": (
        lambda: events.srm(DRIVE, theta=1.0, tau_r=1.0, tau_s=1e-155, response="alpha"),
        "tau_s spans|tau_s is",
    ),
    "tau far below a step": (lambda: events.srm(DRIVE, theta=1.0, tau_r=1e-12), "tau_r is 1e-12 .* steps"),
    "kernel that no set can hold": (lambda: events.srm(DRIVE, theta=1.0, kernel=["step"]), "kernel is"),
    "coupled as text": (lambda: events.srm(DRIVE, theta=1.0, tau_r=1.0, coupled="no"), "coupled is 'no'"),
    "threshold without values": (
        lambda: events.memory(FRAMES, torch.ones((), device="meta"), 0.2),
        "on meta",
    ),
    "threshold beyond floats": (lambda: events.memory(FRAMES, 10**400, 0.2), "theta_on = 1000"),
    "sensor beyond floats": (lambda: SensorModel(theta_on=10**400), "theta_on is 1000"),
    "state of memory with NaN": (
        lambda: events.memory(FRAMES, 0.2, 0.2, state=torch.full((2, 4, 6), math.nan)),
        "state: ",
    ),
    "state of sensor_counts": (lambda: events.sensor_counts(FRAMES, T_S, SensorModel(), state=3), "is a int"),
    "state of the thesis network": (lambda: events.TwoBranchSpikes(1)(FRAMES, 3), "is a int"),
    "threshold of the thesis network": (lambda: events.TwoBranchSpikes(1, theta=math.nan), "theta is nan"),
    "width of Spike-ESIM": (lambda: events.SpikeEsim(width=2**40), "width is"),
    "path of Spike-ESIM": (lambda: events.SpikeEsim.load(None), "the path is None"),
    "annealed": (lambda: events.annealed(1, 10, math.nan), "first is nan"),
    "levels of NaN": (lambda: events.one_pole(FRAMES * math.nan, torch.ones(4, 1, 1)), "levels: "),
    "start of a filter": (
        lambda: events.one_pole(FRAMES, torch.ones(4, 1, 1), torch.zeros(6)),
        r"\[6\], one frame is",
    ),
    "dtype": (lambda: events.to_counts(STREAM, T_S, dtype="float"), "dtype is 'float'"),
    "device": (
        lambda: events.draw_thresholds(SensorModel(), (2, 2), torch.Generator(), device="x"),
        "device is 'x'",
    ),
    "layer to settle": (lambda: events.Settled(None, 0.1), "the layer is a NoneType"),
    "fading within nothing": (lambda: events.decay(COUNTS, T_S, 1e-200), "tau_s is 1e-200"),
    "trace of the future": (
        lambda: events.decay_from_stream(STREAM, [10], 0.1, start=(COUNTS[0], 2**40)),
        "the trace is of",
    ),
    "frames without times": (lambda: list(events.upsample_stream(FRAMES, [0.0])), "there is no time 1"),
    "spikes of a list": (lambda: events.stream_from_spikes([1], 0, 5), "spikes are list"),
    "encoding": (lambda: events.write("e.raw", STREAM, evt=[2]), r"evt=\[2\]"),
}
DRIVE = torch.rand(5, 2, 4)
STREAM_INTS = (STREAM.x[:1], STREAM.y[:1], STREAM.p[:1])


@pytest.mark.parametrize(("call", "words"), WRONG.values(), ids=WRONG)
def test_one_wrong_value(call, words):
    with pytest.raises(CodesignError, match=words):
        call()


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
    events.simulate(FRAMES, T_S, SensorModel(), state=state)
    with pytest.raises(DomainError, match=f"has {words}, the one that began"):
        events.simulate(FRAMES, T_S + 1, SensorModel(**more), state=state)
    assert state.time_s == pytest.approx(0.04)


@pytest.mark.parametrize("name", [name for name in events.LAYERS if name != "physical"])
def test_what_a_layer_leaves_out_of_its_sensor_is_named(name):
    with pytest.warns(UserWarning, match="knows no leak_rate_hz, refractory_s: the sensor is taken without"):
        layer(name, events.PRESETS["default"])
    layer(name, SensorModel(theta_sigma=0.03, shot_rate_hz=1.0))  # warns of nothing: warnings are errors here


def test_paths_and_options_of_files(tmp_path):
    with pytest.raises(FileFormatError, match="the path is None"):
        events.write(None, STREAM)
    with pytest.raises(FileFormatError, match=r"t0_us=5 .* \.dat and \.raw"):
        events.write(tmp_path / "e.npz", STREAM, t0_us=5)
