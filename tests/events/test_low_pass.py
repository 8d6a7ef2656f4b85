"""The one-pole low-pass: a differential equation solved, closed forms, and its twin in the hard sensor's
kernel."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from codesign.events import SensorModel, SensorState, low_pass, one_pole, simulate
from codesign.events.low_pass import coefficients

D = torch.float64


def test_a_one_pole_filter_follows_the_differential_equation(generator):
    t_s = torch.arange(8, dtype=D) * 0.01
    level = torch.randn(8, 3, dtype=D, generator=generator)
    tau_s = torch.tensor(0.007, dtype=D)
    truth = [level[0].numpy()]
    out = one_pole(level, (0.01 / tau_s).expand(7))
    for before, now in pairwise(level.numpy()):  # one smooth piece at a time
        piece = (lambda t, y, a, b: (a + (b - a) * t / 0.01 - y) / 0.007), (0, 0.01), truth[-1]
        truth.append(solve_ivp(*piece, args=(before, now), method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1])
    assert (
        np.abs(out.numpy() - np.array(truth)).max() < 1e-9
    )  # the solver's tolerance over seven pieces, with room
    ramp = one_pole((3 * t_s)[:, None], (0.01 / tau_s).expand(7))[:, 0]
    assert torch.allclose(ramp, 3 * (t_s - tau_s * (1 - torch.exp(-t_s / tau_s))), atol=1e-14)
    assert torch.autograd.gradcheck(
        lambda level, tau_s: one_pole(level, (0.01 / tau_s).expand(7)),
        (level.requires_grad_(), tau_s.requires_grad_()),
    )


def drifting(frames, *pixels):
    drift = torch.randn(frames, *pixels, generator=torch.Generator().manual_seed(1), dtype=D).cumsum(0) * 0.1
    return (4 + drift).exp(), torch.arange(frames, dtype=D) * 2e-3


@pytest.mark.parametrize("cutoff_hz", [40.0, 1e-4])  # the second is in the series for small paces
def test_gradients_are_differences(cutoff_hz):
    frames, t_s = drifting(5, 2)
    cutoff = torch.tensor(cutoff_hz, dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda f, c: low_pass(f.log(), f, t_s.diff(), c), (frames.requires_grad_(), cutoff), atol=1e-7
    )


@pytest.mark.parametrize("cutoff_hz", [0.5, 45.0, 5000.0])
def test_the_low_pass_is_that_of_the_hard_sensor(cutoff_hz):
    frames, t_s = drifting(30, 6, 5)
    state = SensorState()
    simulate(frames, t_s, SensorModel(cutoff_hz=cutoff_hz), state=state)
    filtered = low_pass(frames.log(), frames, t_s.diff(), cutoff_hz)[-1]
    torch.testing.assert_close(filtered, state.level, rtol=0, atol=1e-12)


@pytest.mark.parametrize("pace", [0.0, 1e-9, 1e-4, 0.01, 0.03, 0.0499, 0.0501, 0.3, 2.0])
def test_the_mean_of_the_fading_and_its_slope_are_those_of_their_power_series(pace):
    """(1 - e^-a) / a = sum of (-a)^k / (k + 1)!, free of the cancellation of small a."""
    a = torch.tensor(pace, dtype=torch.float64, requires_grad=True)
    _, mean = coefficients(a, torch.exp, torch.where)
    (slope,) = torch.autograd.grad(mean, a)
    truth = sum((-pace) ** k / math.factorial(k + 1) for k in range(40))
    by_pace = sum(-k * (-pace) ** (k - 1) / math.factorial(k + 1) for k in range(1, 40))
    # below 0.05 the term a^5 / 720 is left out: 4e-10 of the value, 4e-8 of the slope
    assert mean.item() == pytest.approx(truth, rel=5e-10)
    assert slope.item() == pytest.approx(by_pace, rel=1e-7)
