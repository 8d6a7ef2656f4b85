"""Spike-ESIM against the hard sensor, the network of the thesis against an independent case, closed forms of
their parts and losses, chunks against the whole."""

import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import DomainError, FileFormatError, ShapeError
from codesign.events import SensorModel, lin_log, spiking
from codesign.events.spiking.losses import count_loss, van_rossum
from codesign.events.spiking.spike_esim import SpikeEsim
from codesign.events.spiking.srm import srm
from codesign.events.spiking.surrogate import Laplace
from codesign.events.spiking.thesis_network import TwoBranchSpikes
from tests.rounding_case import RoundsByPlace

D = torch.float64


def clip(frames=40, side=12, seed=0, dtype=D):
    """Smooth random pictures that change by about a threshold every few frames."""
    draw = torch.randn(frames, side, side, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    return (3.5 + (0.15 * draw).cumsum(0)).clamp(0.1, 5.5).exp(), torch.arange(frames, dtype=D) / 500


def levels(frames):
    """Log levels, picture by picture as the generators take them: a logarithm may round by its place."""
    return torch.stack([lin_log(picture[None])[0] for picture in frames])


def disturbed(seed=1, **options):
    """A generator all of whose parameters have moved from where they start."""
    model = SpikeEsim(0.2, 0.25, **options)
    draw = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=draw, dtype=parameter.dtype))
        model.bandwidth.gate.fill_(0.6)
    return model


@pytest.mark.bits
@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_untrained_it_is_the_ideal_sensor(dtype):
    frames, t_s = clip(dtype=dtype)
    counts, _ = SpikeEsim(0.2, 0.25)(frames, t_s)
    truth = events.dense_counts(levels(frames), t_s, SensorModel(0.2, 0.25), log_input=True)
    assert truth.sum() > 1000
    assert torch.equal(counts, truth)


@pytest.mark.bits
def test_untrained_with_dead_time_it_is_the_sensor_with_that_dead_time():
    frames, t_s = clip()
    counts, _ = SpikeEsim(0.1, 0.1, refractory_s=1e-3)(frames, t_s)
    truth = events.dense_counts(levels(frames), t_s, SensorModel(0.1, 0.1, refractory_s=1e-3), log_input=True)
    assert torch.equal(counts, truth)


@pytest.mark.bits
def test_spiking_comparator_is_the_ideal_sensor_where_no_step_holds_two_events():
    # levels that move by at most 0.2 per step against a threshold of 0.25: at most one event per step and
    # none left over
    draw = torch.rand(60, 6, 6, generator=torch.Generator().manual_seed(3), dtype=D)
    frames = (4 + (0.4 * draw - 0.2).cumsum(0)).clamp(3.1, 5.4).exp()
    t_s = torch.arange(60, dtype=D) / 500
    counts, _ = SpikeEsim(0.25, 0.25, comparator="srm")(frames, t_s)
    truth = events.dense_counts(levels(frames), t_s, SensorModel(0.25, 0.25), log_input=True)
    assert truth.sum() > 100
    assert torch.equal(counts, truth)


@pytest.mark.bits
@pytest.mark.parametrize("processor", [nullcontext, RoundsByPlace])
@pytest.mark.parametrize("options", [{}, {"refractory_s": 1e-3}, {"comparator": "srm"}])
def test_chunks_equal_the_whole_bit_for_bit(options, processor):
    frames, t_s = clip(side=11, dtype=torch.float32)
    model = disturbed(**options)
    with processor():
        whole, end = model(frames, t_s)
        parts = []
        state = None
        for first, last in ((0, 3), (3, 4), (4, 21), (21, 40)):
            counts, state = model(frames[first:last], t_s[first:last], state)
            parts.append(counts)
    assert torch.equal(torch.cat(parts), whole)
    assert state is not None
    for name in ("level", "filtered", "slow", "frame"):
        assert torch.equal(getattr(state, name), getattr(end, name))


@pytest.mark.bits
@pytest.mark.parametrize("processor", [nullcontext, RoundsByPlace])
def test_chunks_of_the_network_of_the_thesis_equal_the_whole_bit_for_bit(processor):
    frames = 5 * torch.randn(41, 3, 11, 11, generator=torch.Generator().manual_seed(4))
    network = TwoBranchSpikes(3, theta=0.7)
    with processor():
        whole, potential, _ = network(frames)
        parts = []
        state = None
        for first, last in ((0, 5), (5, 6), (6, 30), (30, 41)):
            spikes, levels, state = network(frames[first:last], state)
            parts.append((spikes, levels))
    assert 0.02 < float(whole.detach().mean()) < 0.9
    assert torch.equal(torch.cat([spikes for spikes, _ in parts]), whole)
    assert torch.equal(torch.cat([levels for _, levels in parts]), potential)


@pytest.mark.bits
def test_batches_are_sequences_of_their_own():
    one, t_s = clip(seed=1)
    other, _ = clip(seed=2)
    model = disturbed()
    together, _ = model(torch.stack((one, other), 1), t_s)
    # a convolution of two pictures may round differently from one of one: levels of at most 6 and sums of at
    # most 54 products, 6 * 54 * 2e-16 = 1e-13, against thresholds of 0.2. Of 1e4 events hardly one stands so
    # near to its threshold that it comes a frame later
    for index, frames in enumerate((one, other)):
        alone, _ = model(frames, t_s)
        moved = (together[:, :, index] - alone).cumsum(0)
        assert alone.sum() > 1000
        assert moved.abs().max() <= 1
        assert int((moved != 0).sum()) <= 1


def test_bandwidth_is_the_photoreceptor_of_the_hard_sensor():
    frames, t_s = clip()
    model = SpikeEsim(0.2, 0.25, cutoff_hz=40.0)
    with torch.no_grad():
        model.bandwidth.gate.fill_(1.0)
        model.bandwidth.double().log_cutoff.fill_(math.log(40.0))
    truth = events.dense_counts(frames, t_s, SensorModel(0.2, 0.25, cutoff_hz=40.0))
    # both solve the same equation exactly; a level within rounding (1e-14) of a threshold may count one frame
    # later
    counts, _ = model(frames, t_s)
    assert truth.sum() > 200
    assert float((counts - truth).detach().abs().sum()) <= 1e-3 * float(truth.sum())


def test_tone_curve_with_one_slope_scales_the_threshold():
    frames, t_s = clip()
    model = SpikeEsim(0.2, 0.25)
    with torch.no_grad():
        model.tone.double().log_slope.fill_(math.log(2.0))
    truth = events.dense_counts(lin_log(frames), t_s, SensorModel(0.1, 0.125), log_input=True)
    moved = (model(frames, t_s)[0] - truth).cumsum(0)
    assert moved.abs().max() <= 1  # rounding moves an event by a frame, and loses none
    assert int((moved != 0).sum()) <= 1e-3 * int(truth.sum())


def test_thresholds_scale_at_test_time():
    frames, t_s = clip()
    truth = events.dense_counts(lin_log(frames), t_s, SensorModel(0.3, 0.5), log_input=True)
    counts, _ = SpikeEsim(0.2, 0.25)(frames, t_s, theta_scale=torch.tensor([1.5, 2.0]))
    assert float((counts - truth).detach().abs().sum()) <= 1e-3 * float(
        truth.sum()
    )  # 1.5 * 0.2 is not 0.3 to the last bit


def test_a_still_scene_gives_nothing_and_a_slow_ramp_all_its_thresholds():
    model = disturbed()
    still = torch.full((30, 8, 8), 80.0, dtype=D)
    t_s = torch.arange(401, dtype=D) / 500
    assert model(still, t_s[:30])[0].sum() == 0
    ramp = (
        (3.5 + torch.linspace(0, 1.701, 401, dtype=D)).exp()[:, None, None].expand(-1, 4, 4)
    )  # 8 thresholds of 0.2 and half a one
    counts, _ = SpikeEsim(0.2, 0.2)(ramp, t_s)
    assert torch.equal(
        counts.sum(0), torch.stack((torch.full((4, 4), 8.0, dtype=D), torch.zeros(4, 4, dtype=D)))
    )


def test_levels_have_exact_gradients_in_every_parameter():
    frames, t_s = clip(frames=5, side=4)
    model = disturbed(width=2).double()
    names = [
        name
        for name, _ in model.named_parameters()
        if name.startswith(("prefilter", "tone", "bandwidth", "branch"))
    ]

    def levels(*values):
        return torch.func.functional_call(
            _Levels(model), dict(zip([f"model.{name}" for name in names], values, strict=True)), (frames, t_s)
        )

    assert torch.autograd.gradcheck(
        levels,
        tuple(model.get_parameter(name).detach().clone().requires_grad_() for name in names),
        atol=1e-6,
    )


class _Levels(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, frames, t_s):
        return self.model._levels(frames, t_s, None)[0]


def test_drawn_noise_is_poisson_of_the_expected_rate():
    model = SpikeEsim()
    with torch.no_grad():
        model.noise_rate.amplitude_hz.copy_(torch.tensor([30.0, 10.0]))
        model.noise_rate.fade.fill_(2.0)
    frames = torch.full((201, 30, 30), 117.5, dtype=D)
    t_s = torch.arange(201, dtype=D) / 500
    expected = torch.tensor([30.0, 10.0]) * math.exp(-2.0 * 0.5) / 500  # light (117.5 + 20)/275 = 1/2
    assert torch.allclose(model.expected_noise(frames, t_s)[0, :, 0, 0], expected.double(), rtol=1e-6)
    counts, _ = model.draw(frames, t_s, torch.Generator().manual_seed(0))  # a still scene: nothing but noise
    for polarity in (0, 1):
        found = counts[:, polarity]
        error = math.sqrt(float(expected[polarity]) / found.numel())
        assert abs(float(found.mean() - expected[polarity])) < 4 * error
        assert (
            abs(float(found.var() - expected[polarity])) < 4 * error * 1.1
        )  # variance of the sample variance: (m + 2 m^2)/n


@pytest.mark.bits
def test_saved_generators_come_back(tmp_path):
    frames, t_s = clip()
    model = disturbed(refractory_s=1e-3, depth=2)
    model.save(tmp_path / "generator.npz")
    again = SpikeEsim.load(tmp_path / "generator.npz")
    assert again.settings == model.settings
    assert torch.equal(again(frames, t_s)[0], model(frames, t_s)[0])
    (tmp_path / "other.npz").write_bytes(b"no archive")
    for name, words in (("absent.npz", "no file lies at"), ("other.npz", "SpikeEsim.save wrote")):
        with pytest.raises(FileFormatError, match=words):
            SpikeEsim.load(tmp_path / name)
    with torch.no_grad():
        model.tone.log_slope[0] = math.nan
    model.save(tmp_path / "poisoned.npz")
    with pytest.raises(FileFormatError, match="NaN"):
        SpikeEsim.load(tmp_path / "poisoned.npz")


def test_the_generator_that_comes_along_has_learnt_its_sensor():
    model = SpikeEsim.load(Path(spiking.__file__).parent / "spike_esim_rendered.npz")
    # it was trained on hard events of a sensor with thresholds 0.18 and 0.22 and 1 ms dead time; tone and
    # bandwidth trade with thresholds by some percent
    assert model.thetas().tolist() == pytest.approx([0.18, 0.22], rel=0.1)
    dead_s = model.refractory_s()
    assert dead_s is not None
    assert float(dead_s.detach()) == pytest.approx(1e-3, rel=0.2)
    frames, t_s = clip(frames=60, side=24, dtype=torch.float32)
    found, _ = model(frames, t_s)
    target = events.dense_counts(frames, t_s, SensorModel(0.18, 0.22, cutoff_hz=60.0, refractory_s=1e-3))
    # white changes from frame to frame are nothing it was trained on; an ideal sensor gives three times the
    # events
    assert float(found.detach().sum() / target.sum()) == pytest.approx(1, abs=0.25)


def steps_first(array):
    return torch.from_numpy(np.moveaxis(array, -1, 0).astype(np.float64).copy())


def of_thesis(data, through_reset):
    network = TwoBranchSpikes(
        3,
        theta=0.7,
        surrogate=Laplace(float(data["alpha"]), float(data["beta"])),
        through_reset=through_reset,
    ).double()
    with torch.no_grad():
        network.weight_on.copy_(torch.from_numpy(data["wp"]))
        network.weight_off.copy_(torch.from_numpy(data["wn"]))
    return network


@pytest.mark.bits
@pytest.mark.filterwarnings("ignore:max rho:RuntimeWarning")
@pytest.mark.parametrize(("through_reset", "name"), [("off", "gw_slayer"), ("full", "gw_bptt")])
def test_network_of_the_thesis_equals_the_reference(shared, through_reset, name):
    data = dict(np.load(shared("refs/srm/z_spike_esim.npz")))
    network = of_thesis(data, through_reset)
    spikes, potential, _ = network(steps_first(data["I"]))
    assert torch.equal(spikes, steps_first(data["spikes"]))
    assert (potential - steps_first(data["u"])).abs().max() <= 1e-12
    loss = van_rossum(spikes, steps_first(data["target"]), tau_s=float(data["tau_s"]))
    assert abs(float(loss.detach()) - float(data["loss"])) <= 1e-10  # of 212
    weights = [network.weight_on, network.weight_off]
    found = torch.stack(torch.autograd.grad(loss, weights))
    assert (found - torch.from_numpy(data[name])).abs().max() <= 1e-9  # values up to 340
    if through_reset == "full":
        drive, _ = network._drive(steps_first(data["I"]), None)
        spikes, _, _ = srm(drive, theta=0.7, smooth=True, **network._options)
        loss = van_rossum(spikes, steps_first(data["target"]), tau_s=float(data["tau_s"]))
        found = torch.stack(torch.autograd.grad(loss, weights))
        assert abs(float(loss.detach()) - float(data["smooth_loss"])) <= 1e-10
        assert (found - torch.from_numpy(data["smooth_gw"])).abs().max() <= 1e-9
        # central differences of the reference, of 1e-8 relative precision
        assert (found[0] - torch.from_numpy(data["smooth_gw_fd_pos"])).abs().max() <= 1e-6


def test_smoothing_is_the_alpha_response_of_the_drive_and_its_delay_two_time_constants():
    tau = 10.0
    network = TwoBranchSpikes(1, theta=1.0, smoothing_tau=tau).double()
    with torch.no_grad():
        network.weight_on.zero_()[0, 1, 1] = 0.01  # far below the threshold: no reset
    frames = torch.zeros(201, 3, 3, dtype=D)
    frames[1:] = 1.0  # one step of brightness
    spikes, potential, _ = network(frames)
    k = torch.arange(200, dtype=D)
    truth = 0.01 * k / tau * torch.exp(1 - k / tau)
    assert spikes.sum() == 0
    assert (potential[:, 0, 1, 1] - truth).abs().max() <= 1e-14
    course = potential[:, 0, 1, 1].detach()
    delay = float((k * course).sum() / course.sum())
    assert delay == pytest.approx(
        2 * tau, rel=1e-3
    )  # mean of t exp(-t/tau) is 2 tau; sampled: tau coth(1/(2 tau)), 8e-4 more


def test_it_forgets_a_slow_ramp_and_wakes_on_silence_are_refused():
    network = TwoBranchSpikes(1)
    slow = torch.linspace(0, 8, 801)[:, None, None].expand(
        -1, 4, 4
    )  # eight thresholds in steps of a hundredth
    with torch.no_grad():
        network.weight_on.fill_(1 / 9)
    assert network(slow)[0].sum() == 0
    with pytest.raises(DomainError, match="silent"):
        network.wake(torch.full((10, 4, 4), 3.0))


def test_a_woken_network_reaches_its_threshold_with_the_share_asked():
    frames = torch.rand(30, 16, 16, generator=torch.Generator().manual_seed(2), dtype=D)
    network = TwoBranchSpikes(1, theta=0.7, kernel="step").double()
    network.wake(frames, share=0.1)
    drive, _ = network._drive(frames, None)
    for branch in (0, 1):
        assert float((drive[:, branch] >= 0.7 * (1 - 1e-6)).double().mean()) == pytest.approx(
            0.1, abs=1 / drive[:, branch].numel()
        )


def test_van_rossum_of_a_lone_event_has_its_closed_form():
    target = torch.zeros(4000, 2, 1, 1, dtype=D)
    found = torch.zeros(4000, 2, 1, 1, dtype=D)
    found[3, 0] = 1
    h = 0.1
    dt = 2e-3
    q = math.exp(-2 * h)
    truth = 0.5 * dt * h**2 * math.e**2 * q * (1 + q) / (1 - q) ** 3  # sum of k^2 q^k
    assert float(van_rossum(found, target, tau_s=dt / h, dt=dt)) == pytest.approx(truth, rel=1e-12)
    assert truth == pytest.approx(
        math.e**2 * (dt / h) / 8, rel=1e-2
    )  # the integral; the sum differs by O(h^2)
    apart = found.roll(40, 0)  # the overlap of two responses z = 4 tau apart: e^2 tau/4 e^-z (1 + z)
    overlap = math.e**2 * (dt / h) / 4 * math.exp(-4) * (1 + 4)
    assert float(van_rossum(found, apart, tau_s=dt / h, dt=dt)) == pytest.approx(
        2 * truth - overlap, rel=1e-2
    )


def test_count_loss_is_half_the_chi_square_of_blocks():
    target = torch.zeros(4, 2, 4, 4, dtype=D)
    target[0, 0, 0, 0] = 3  # block (0, 0, 0) of ON holds 3
    found = torch.zeros(4, 2, 4, 4, dtype=D)
    found[1, 0, 1, 1] = 1  # the same block: 1 against 3, (1 - 3)^2/(3 + 1) = 1
    found[3, 1, 3, 3] = 2  # OFF, another block: 2 against 0, 4/1
    assert float(count_loss(found, target, side_px=2, steps=2)) == 2.5
    assert float(count_loss(target, target, side_px=2, steps=2)) == 0


FRAMES, T_S = clip(frames=4)
OURS = SpikeEsim()
STATE = OURS(FRAMES, T_S)[1]
NETWORK = TwoBranchSpikes(1)
COUNTS = torch.zeros(4, 2, 3, 3)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: OURS(FRAMES * math.nan, T_S), DomainError, "NaN"),
        (lambda: OURS(FRAMES * math.inf, T_S), DomainError, "infinit"),
        (lambda: OURS(-FRAMES, T_S), DomainError, "negative"),
        (lambda: OURS(FRAMES[:1], T_S[:1]), ShapeError, "at least 2"),
        (lambda: OURS(FRAMES[:, 0], T_S), ShapeError, "H, W"),
        (lambda: OURS(FRAMES, T_S[:3]), ShapeError, r"\[4\]"),
        (lambda: OURS(FRAMES, T_S, STATE), DomainError, "go on increasing"),
        (lambda: OURS(FRAMES[:, :6], T_S + 1, STATE), ShapeError, "keeps its frame size"),
        (lambda: OURS(FRAMES.float(), T_S + 1, STATE), ShapeError, "keeps its frame size"),
        (lambda: OURS(FRAMES, T_S, theta_scale=0.0), DomainError, "theta_scale"),
        (lambda: OURS(FRAMES, T_S, theta_scale=torch.ones(3)), DomainError, "theta_scale"),
        (lambda: SpikeEsim(theta_on=0.0), DomainError, "theta_on"),
        (lambda: SpikeEsim(theta_off=math.nan), DomainError, "theta_off"),
        (lambda: SpikeEsim(comparator="soft"), DomainError, "comparator"),
        (lambda: SpikeEsim(refractory_s=-1.0), DomainError, "refractory_s"),
        (lambda: SpikeEsim(refractory_s=1e-3, comparator="srm"), DomainError, "dead time"),
        (lambda: NETWORK(FRAMES * math.nan), DomainError, "NaN"),
        (lambda: NETWORK(FRAMES[:1]), ShapeError, "at least 2"),
        (lambda: NETWORK(FRAMES[:, None].expand(-1, 3, -1, -1)), ShapeError, "channels=1"),
        (lambda: NETWORK(FRAMES[:, :4], NETWORK(FRAMES)[2]), ShapeError, "keeps its frame size"),
        (lambda: TwoBranchSpikes(0), DomainError, "channels"),
        (lambda: van_rossum(COUNTS, COUNTS[..., :2], tau_s=1.0), ShapeError, "no distance"),
        (lambda: van_rossum(COUNTS[:, 0, 0], COUNTS[:, 0, 0], tau_s=1.0), DomainError, "ON first"),
        (lambda: count_loss(COUNTS, COUNTS, side_px=4, steps=2), ShapeError, "do not fit"),
    ],
)
def test_bad_input_is_refused(call, error, words):
    with pytest.raises(error, match=words):
        call()
