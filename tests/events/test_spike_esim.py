"""Spike-ESIM against the hard sensor, the network of the thesis against an independent case, closed
forms of their parts and losses, chunks against the whole."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import FileFormatError
from codesign.events import SensorModel, lin_log, spiking
from codesign.events.spiking.losses import count_loss, van_rossum
from codesign.events.spiking.spike_esim import SpikeEsim
from codesign.events.spiking.srm import srm
from codesign.events.spiking.surrogate import Laplace
from codesign.events.spiking.thesis_network import TwoBranchSpikes
from tests.numbers import D, close, f64, rand64, seeded
from tests.rounding_case import RoundsByPlace


def clip(frames=40, side=12, seed=0, dtype=D, step=0.15):
    """Smooth random pictures that change by about a threshold every few frames."""
    draw = torch.randn(frames, side, side, generator=seeded(seed), dtype=dtype)
    level = (3.5 + (step * draw).cumsum(0)).clamp(0.1, 5.5)
    return level.exp(), torch.arange(frames, dtype=D) / 500


def levels(frames):
    """Log levels, picture by picture as the generators take them: a logarithm may round by its
    place."""
    return torch.stack([lin_log(picture[None])[0] for picture in frames])


def disturbed(**options):
    """A generator all of whose parameters have moved from where they start."""
    model = SpikeEsim(0.2, 0.25, **options)
    draw = seeded(1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.empty_like(parameter).normal_(std=0.05, generator=draw))
        model.bandwidth.gate.fill_(0.6)
    return model


# a spiking comparator is the ideal sensor where no step holds two events, here at most a threshold
# of 8 sigma
@pytest.mark.bits
@pytest.mark.parametrize(
    ("options", "step"),
    [({}, 0.15), ({"refractory_s": 1e-3}, 0.15), ({"comparator": "srm"}, 0.03)],
)
@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_untrained_it_is_the_sensor(options, step, dtype):
    frames, t_s = clip(dtype=dtype, step=step)
    counts, _ = SpikeEsim(0.2, 0.25, **options)(frames, t_s)
    sensor = SensorModel(0.2, 0.25, refractory_s=options.get("refractory_s", 0.0))
    truth = events.dense_counts(levels(frames), t_s, sensor, log_input=True)
    assert truth.sum() > 50
    assert torch.equal(counts, truth)


@pytest.mark.bits
@pytest.mark.parametrize("options", [{}, {"refractory_s": 1e-3}, {"comparator": "srm"}, None])
def test_chunks_equal_the_whole_bit_for_bit_on_a_processor_that_rounds_by_place(options):
    frames, t_s = clip(frames=41, side=11, dtype=torch.float32)
    if options is None:  # the network of the thesis
        network = TwoBranchSpikes(1, theta=0.05)

        def model(frames, t_s, state=None):
            return network(frames, state)[::2]
    else:
        model = disturbed(**options)
    with RoundsByPlace():
        whole, end = model(frames, t_s)
        state, parts = None, []
        for first, last in ((0, 3), (3, 4), (4, 21), (21, 41)):
            counts, state = model(frames[first:last], t_s[first:last], state)
            parts.append(counts)
    assert whole.detach().mean() > 0.01
    assert torch.equal(torch.cat(parts), whole)
    for name in () if options is None else ("level", "filtered", "slow", "frame"):
        assert torch.equal(getattr(state, name), getattr(end, name))


@pytest.mark.bits
def test_batches_are_sequences_of_their_own_and_a_still_scene_gives_nothing():
    one, t_s = clip(seed=1)
    other, _ = clip(seed=2)
    model = disturbed()
    together, _ = model(torch.stack((one, other), 1), t_s)
    # a convolution of two pictures may round differently from one of one: levels of at most 6 and
    # sums of at most 54 products, 6 * 54 * 2e-16 = 1e-13, against thresholds of 0.2. Of 1e4 events
    # hardly one stands so near to its threshold that it comes a frame later
    for index, frames in enumerate((one, other)):
        alone, _ = model(frames, t_s)
        moved = (together[:, :, index] - alone).cumsum(0)
        assert alone.sum() > 1000
        assert moved.abs().max() <= 1
        assert (moved != 0).sum() <= 1
    assert model(one[:1].expand(30, -1, -1), t_s[:30])[0].sum() == 0


def double_slope(model):
    model.tone.double().log_slope.fill_(math.log(2.0))


def photoreceptor(model):
    model.bandwidth.gate.fill_(1.0)
    model.bandwidth.double().log_cutoff.fill_(math.log(40.0))


@pytest.mark.parametrize(
    ("change", "options", "sensor"),
    [
        (photoreceptor, {}, SensorModel(0.2, 0.25, cutoff_hz=40.0)),
        (double_slope, {}, SensorModel(0.1, 0.125)),
        (lambda model: None, {"theta_scale": torch.tensor([1.5, 2.0])}, SensorModel(0.3, 0.5)),
    ],
)
def test_bandwidth_tone_and_scaled_thresholds_are_those_of_the_hard_sensor(change, options, sensor):
    frames, t_s = clip()
    model = SpikeEsim(0.2, 0.25)
    with torch.no_grad():
        change(model)
        found, _ = model(frames, t_s, **options)
    moved = (found - events.dense_counts(frames, t_s, sensor)).cumsum(0)
    # rounding (1e-14) moves an event by a frame, and loses none
    assert moved.abs().max() <= 1
    assert (moved != 0).sum() <= 3


def test_levels_have_exact_gradients_in_every_parameter():
    frames, t_s = clip(frames=5, side=4)
    model = disturbed(width=2).double()
    stages = ("prefilter", "tone", "bandwidth", "branch")
    names = [name for name, _ in model.named_parameters() if name.startswith(stages)]
    values = [model.get_parameter(name).detach().clone().requires_grad_() for name in names]
    model.forward = lambda frames, t_s: model._levels(frames, t_s, None)[0]

    def levels(*values):
        return torch.func.functional_call(
            model, dict(zip(names, values, strict=True)), (frames, t_s)
        )

    assert torch.autograd.gradcheck(levels, values, atol=1e-6)


def test_drawn_noise_is_poisson_of_the_expected_rate():
    model = SpikeEsim()
    with torch.no_grad():
        model.noise_rate.amplitude_hz.copy_(torch.tensor([30.0, 10.0]))
        model.noise_rate.fade.fill_(2.0)
    frames = torch.full((201, 30, 30), 117.5, dtype=D)
    t_s = torch.arange(201, dtype=D) / 500
    # (117.5 + 20)/275 = 1/2
    expected = f64([30.0, 10.0]) * math.exp(-2.0 * 0.5) / 500
    found = model.expected_noise(frames, t_s)[0, :, 0, 0]
    close(found, expected, rtol=1e-6)
    # a still scene: nothing but noise
    counts, _ = model.draw(frames, t_s, seeded(0))
    for found, mean in zip(counts.unbind(1), expected.tolist(), strict=True):
        error = math.sqrt(mean / found.numel())
        assert abs(found.mean() - mean) < 4 * error
        # variance of the sample variance: (m + 2 m^2)/n
        assert abs(found.var() - mean) < 4 * error * 1.1


@pytest.mark.bits
def test_saved_generators_come_back(tmp_path):
    frames, t_s = clip()
    model = disturbed(refractory_s=1e-3, depth=2)
    model.save(tmp_path / "generator.npz")
    again = SpikeEsim.load(tmp_path / "generator.npz")
    assert again.settings == model.settings
    assert torch.equal(again(frames, t_s)[0], model(frames, t_s)[0])
    with torch.no_grad():
        model.tone.log_slope[0] = math.nan
    model.save(tmp_path / "poisoned.npz")
    (tmp_path / "other.npz").write_bytes(b"no archive")
    wrong = {"absent": "no file lies at", "other": "SpikeEsim.save wrote", "poisoned": "NaN"}
    for name, words in wrong.items():
        with pytest.raises(FileFormatError, match=words):
            SpikeEsim.load(tmp_path / f"{name}.npz")


def test_the_generator_that_comes_along_has_learnt_its_sensor():
    model = SpikeEsim.load(Path(spiking.__file__).parent / "spike_esim_rendered.npz")
    # it was trained on hard events of a sensor with thresholds 0.18 and 0.22 and 1 ms dead time;
    # tone and bandwidth trade with thresholds by some percent
    assert model.thetas().tolist() == pytest.approx([0.18, 0.22], rel=0.1)
    assert model.refractory_s().item() == pytest.approx(1e-3, rel=0.2)
    frames, t_s = clip(frames=60, side=24, dtype=torch.float32)
    found, _ = model(frames, t_s)
    sensor = SensorModel(0.18, 0.22, cutoff_hz=60.0, refractory_s=1e-3)
    target = events.dense_counts(frames, t_s, sensor)
    # white changes from frame to frame are nothing it was trained on; an ideal sensor gives three
    # times the events
    assert float(found.detach().sum() / target.sum()) == pytest.approx(1, abs=0.25)


@pytest.mark.bits
@pytest.mark.filterwarnings("ignore:max rho:RuntimeWarning")
@pytest.mark.parametrize(("through_reset", "name"), [("off", "gw_slayer"), ("full", "gw_bptt")])
def test_network_of_the_thesis_equals_the_reference(shared, through_reset, name):
    file = np.load(shared("refs/srm/z_spike_esim.npz"))
    data = {key: torch.from_numpy(np.asarray(file[key]).astype(np.float64)) for key in file.files}
    for key in ("I", "spikes", "u", "target"):
        data[key] = data[key].movedim(-1, 0).clone()
    options = {"surrogate": Laplace(float(data["alpha"]), float(data["beta"])), "theta": 0.7}
    network = TwoBranchSpikes(3, through_reset=through_reset, **options).double()
    weights = [network.weight_on, network.weight_off]
    with torch.no_grad():
        network.weight_on.copy_(data["wp"])
        network.weight_off.copy_(data["wn"])

    def loss_and_slopes(spikes):
        loss = van_rossum(spikes, data["target"], tau_s=float(data["tau_s"]))
        return loss.detach(), torch.stack(torch.autograd.grad(loss, weights))

    spikes, potential, _ = network(data["I"])
    assert torch.equal(spikes, data["spikes"])
    assert (potential - data["u"]).abs().max() <= 1e-12
    loss, found = loss_and_slopes(spikes)
    assert abs(loss - data["loss"]) <= 1e-10  # of 212
    assert (found - data[name]).abs().max() <= 1e-9  # values up to 340
    if through_reset == "full":
        drive, _ = network._drive(data["I"], None)
        loss, found = loss_and_slopes(srm(drive, theta=0.7, smooth=True, **network._options)[0])
        assert abs(loss - data["smooth_loss"]) <= 1e-10
        assert (found - data["smooth_gw"]).abs().max() <= 1e-9
        # central differences of the reference, of 1e-8 relative precision
        assert (found[0] - data["smooth_gw_fd_pos"]).abs().max() <= 1e-6


def test_a_woken_network_reaches_its_threshold_with_the_share_asked():
    frames = rand64(seeded(2), 30, 16, 16)
    network = TwoBranchSpikes(1, theta=0.7, kernel="step").double()
    network.wake(frames, share=0.1)
    drive, _ = network._drive(frames, None)
    reached = (drive >= 0.7 * (1 - 1e-6)).double().mean((0, 2, 3))
    assert reached.tolist() == pytest.approx([0.1] * 2, abs=2 / drive.numel())


def test_losses_have_their_closed_forms():
    found = torch.zeros(4000, 2, 1, 1, dtype=D)
    found[3, 0] = 1
    h, dt = 0.1, 2e-3
    q = math.exp(-2 * h)
    truth = 0.5 * dt * h**2 * math.e**2 * q * (1 + q) / (1 - q) ** 3  # sum of k^2 q^k
    distance = float(van_rossum(found, 0 * found, tau_s=dt / h, dt=dt))
    assert distance == pytest.approx(truth, rel=1e-12)
    target, found = torch.zeros(2, 4, 2, 4, 4, dtype=D)
    target[0, 0, 0, 0] = 3  # block (0, 0, 0) of ON holds 3
    found[1, 0, 1, 1] = 1  # the same block: 1 against 3, (1 - 3)^2/(3 + 1) = 1
    found[3, 1, 3, 3] = 2  # OFF, another block: 2 against 0, 4/1
    assert count_loss(found, target, side_px=2, steps=2) == 2.5
