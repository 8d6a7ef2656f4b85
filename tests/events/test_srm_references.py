"""The spike response layer against independently computed cases: spikes, potentials, gradients of both
conventions, a trained network."""

import numpy as np
import pytest
import torch

from codesign.events.spiking.srm import srm
from codesign.events.spiking.srm_scale import alpha_response
from codesign.events.spiking.surrogate import Laplace

KERNELS = {"alpha": "slayer", "thesis": "thesis", "gehrig": "exp"}
CASES = ["a_slayer_vimeo", "b_thesis_vimeo", "d_half_ts", "g_silent", "h_saturating"]


def read(path):
    """Arrays of a case, time first, and the layer's settings."""
    data = np.load(path)
    number = {
        name: float(data[name]) for name in ("theta", "tau_r", "Ts", "scale", "alpha", "beta") if name in data
    }
    settings = {
        "theta": number["theta"],
        "tau_r": number["tau_r"],
        "dt": number["Ts"],
        "kernel": KERNELS[str(data["kind"])],
        "reset_scale": number["scale"],
        "surrogate": Laplace(number["alpha"], number["beta"]),
    }
    return data, settings


def steps_first(array):
    return torch.from_numpy(np.moveaxis(array, -1, 0).astype(np.float64).copy())


@pytest.mark.bits
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("segment", [None, 13])
def test_spikes_potentials_and_gradients_equal_the_reference(shared, case, segment):
    data, settings = read(shared(f"refs/srm/{case}.npz"))
    for convention, name in (("off", "grad_slayer"), ("full", "grad_bptt")):
        drive = steps_first(data["drive"]).requires_grad_()
        if convention == "full":  # 2 theta e / alpha > 1 for all these cases
            with pytest.warns(RuntimeWarning, match="not below 1"):
                spikes, potential, _ = srm(drive, through_reset=convention, segment=segment, **settings)
        else:
            spikes, potential, _ = srm(drive, through_reset=convention, segment=segment, **settings)
        assert torch.equal(spikes.detach(), steps_first(data["spikes"]))
        assert (potential.detach() - steps_first(data["u"])).abs().max() <= 1e-12
        (found,) = torch.autograd.grad(spikes, drive, steps_first(data["g"]))
        assert (found - steps_first(data[name])).abs().max() <= 1e-9


@pytest.mark.parametrize("case", CASES)
def test_truncated_kernels_and_forgotten_states_give_the_spikes_of_slayer(shared, case):
    data, settings = read(shared(f"refs/srm/{case}.npz"))
    drive = steps_first(data["drive"])
    assert torch.equal(srm(drive, truncation=0.01, **settings)[0], steps_first(data["spikes_slayer_trunc"]))
    chunk = int(data["chunk"])
    forgetful = torch.cat([srm(part, **settings)[0] for part in drive.split(chunk)])
    assert torch.equal(forgetful, steps_first(data["spikes_nocarry"]))


@pytest.mark.parametrize("case", CASES)
def test_alpha_response_of_the_spikes_equals_the_reference(shared, case):
    data, _ = read(shared(f"refs/srm/{case}.npz"))
    response, state = alpha_response(
        steps_first(data["spikes"]), tau_s=float(data["tau_s"]), dt=float(data["Ts"])
    )
    assert (response - steps_first(data["psp"])).abs().max() <= 1e-12
    assert (
        state.response - torch.from_numpy(data["psp_state"])
    ).abs().max() <= 1e-11  # sums of up to 100 spikes


@pytest.mark.parametrize("response", ["step", "none"])
def test_coupled_step_reset_is_the_memorised_reference_model(shared, response):
    data = np.load(shared("refs/srm/l_esim_limit.npz"))
    level = steps_first(data["L"])
    drive = torch.cat([level[:1], level.diff(dim=0)]) if response == "step" else level
    spikes, _, _ = srm(
        torch.stack([drive, -drive], 1),
        theta=float(data["C"]),
        kernel="step",
        response=response,
        reset_scale=1.0,
        coupled=True,
    )
    truth = torch.stack([steps_first(data["P"]), steps_first(data["N"])], 1)
    assert torch.equal(spikes, truth)  # levels are multiples of 2^-9 and theta of 2^-3: no rounding anywhere


def network(data, settings, through_reset, smooth):
    """Loss, spikes, potential and weight gradients of the two-branch network of the thesis."""
    steps = steps_first(data["I"]).diff(dim=0)  # [T, 3, 6, 6]
    weights = [torch.from_numpy(data[name]).requires_grad_() for name in ("wp", "wn")]
    drive = torch.cat(
        [torch.conv2d(sign * steps, w[None], padding=1) for sign, w in zip((1, -1), weights, strict=True)], 1
    )
    spikes, potential, _ = srm(drive, through_reset=through_reset, smooth=smooth, **settings)
    difference, _ = alpha_response(spikes - steps_first(data["target"]), tau_s=float(data["tau_s"]))
    loss = difference.square().sum() / 2
    of_spikes, *of_weights = torch.autograd.grad(loss, [spikes, *weights])
    return loss.detach(), spikes.detach(), potential.detach(), of_spikes, torch.stack(of_weights)


@pytest.mark.bits
@pytest.mark.filterwarnings("ignore:max rho:RuntimeWarning")
def test_loss_and_weight_gradients_of_the_spiking_network_equal_the_reference(shared):
    data = dict(np.load(shared("refs/srm/z_spike_esim.npz")))
    settings = {"theta": 0.7, "tau_r": 1.0, "surrogate": Laplace(float(data["alpha"]), float(data["beta"]))}
    for convention, name in (("off", "gw_slayer"), ("full", "gw_bptt")):
        loss, spikes, potential, of_spikes, of_weights = network(data, settings, convention, smooth=False)
        assert torch.equal(spikes, steps_first(data["spikes"]))
        assert (potential - steps_first(data["u"])).abs().max() <= 1e-12
        assert abs(loss - float(data["loss"])) <= 1e-10
        assert (of_spikes - steps_first(data["grad_s"])).abs().max() <= 1e-11  # values up to 20
        assert (
            of_weights - torch.from_numpy(data[name])
        ).abs().max() <= 1e-9  # values up to 340: 3e-12 relative
    loss, _, _, _, of_weights = network(data, settings, "full", smooth=True)
    assert abs(loss - float(data["smooth_loss"])) <= 1e-10
    assert (of_weights - torch.from_numpy(data["smooth_gw"])).abs().max() <= 1e-9
    # central differences of the reference, of 1e-8 relative precision
    assert (of_weights[0] - torch.from_numpy(data["smooth_gw_fd_pos"])).abs().max() <= 1e-6
