"""The network of the thesis and the losses against an independent case and closed forms."""

import math

import numpy as np
import pytest
import torch

from codesign.errors import DomainError, ShapeError
from codesign.events.spiking.losses import count_loss, van_rossum
from codesign.events.spiking.surrogate import Laplace
from codesign.events.spiking.two_branches import TwoBranchSpikes

D = torch.float64


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
    found = torch.stack(torch.autograd.grad(loss, [network.weight_on, network.weight_off]))
    assert (found - torch.from_numpy(data[name])).abs().max() <= 1e-9  # values up to 340


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


def test_bad_input_is_refused():
    network = TwoBranchSpikes(1)
    frames = torch.rand(5, 6, 6)
    _, _, state = network(frames)
    for pictures, before, error, words in [
        (frames * math.nan, None, DomainError, "NaN"),
        (frames[:1], None, ShapeError, "at least 2"),
        (frames[:, None].expand(-1, 3, -1, -1), None, ShapeError, "channels=1"),
        (frames[:, :4], state, ShapeError, "keeps its frame size"),
    ]:
        with pytest.raises(error, match=words):
            network(pictures, before)
    with pytest.raises(DomainError, match="channels"):
        TwoBranchSpikes(0)
    with pytest.raises(ShapeError, match="no distance"):
        van_rossum(torch.zeros(4, 2, 3, 3), torch.zeros(4, 2, 3, 2), tau_s=1.0)
    with pytest.raises(DomainError, match="ON first"):
        van_rossum(torch.zeros(4, 3), torch.zeros(4, 3), tau_s=1.0)
    with pytest.raises(ShapeError, match="do not fit"):
        count_loss(torch.zeros(4, 2, 3, 3), torch.zeros(4, 2, 3, 3), side_px=4, steps=2)
