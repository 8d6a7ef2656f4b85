"""The spiking baseline against its published form, and the cure for each of the troubles that form
is known for (docs/flow_baselines.md)."""

import numpy as np
import pytest
import torch
from torch.nn.functional import conv2d, conv_transpose2d, interpolate, leaky_relu

from codesign.errors import GradientError
from codesign.events.spiking.surrogate import FastSigmoid
from codesign.flow.baselines import SpikeFlowNet
from codesign.flow.baselines.parts import count_weights
from codesign.flow.baselines.spike_flownet import integrate_and_fire, to_halves
from codesign.flow.entry import normalise
from codesign.flow.export import evenly_timed
from tests.flow.volumes import drawn
from tests.numbers import D, close, f64

THETA = 0.75


def by_hand(net, halves):
    """Sums and flows of the published loop: step by step, layer by layer, hard reset, every neck
    and head on its own; each level adds to the coarser flow."""
    sums = [torch.zeros(len(halves), 8 << i, 16 >> i, 16 >> i, dtype=D) for i in range(4)]
    potential = list(sums)
    for t in range(halves.shape[4]):
        x = halves[..., t]
        for i, layer in enumerate(net.encoder):
            current = conv2d(x, layer.weight, stride=2, padding=1)
            sums[i] = sums[i] + current
            u = potential[i] + current
            x = (u >= THETA).to(u)
            potential[i] = u * (1 - x)
    x = sums[3]
    flows = []
    for first, second in net.residual:
        hidden = leaky_relu(conv2d(x, first.weight, padding=1), 0.1)
        x = x + leaky_relu(conv2d(hidden, second.weight, padding=1), 0.1)
    for level in range(4):
        neck = conv_transpose2d(x, net.necks[level].weight, stride=2, padding=1)
        # twice the pixels, twice the vectors
        coarser = 2 * interpolate(flows[-1], scale_factor=2.0, mode="bilinear") if flows else 0.0
        flows.append(coarser + conv2d(neck, net.heads[level].weight))
        if level < 3:
            up = leaky_relu(
                conv_transpose2d(x, net.decoder[level].weight, stride=2, padding=1), 0.1
            )
            x = torch.cat([sums[2 - level], up, flows[-1]], 1)
    return sums, flows


def test_all_steps_at_once_equal_the_published_loop():
    net = SpikeFlowNet(bins=8, width=8.0).double()
    halves = to_halves(drawn(2, 2, 8, 32, 32, rate=0.6))
    sums, flows = by_hand(net, halves)
    assert sums[3].detach().abs().max() > 0.1  # spikes went all the way
    found = net.encode(halves)
    for a, b in zip([*found, *net.decode(found)], [*sums, *flows], strict=True):
        close(a, b, rtol=1e-10, atol=1e-10)  # sums in another order


def test_weights_of_the_published_size():
    encoder = 9 * (4 * 64 + 64 * 128 + 128 * 256 + 256 * 512)
    residual = 9 * 4 * 512 * 512
    decoder = 16 * (512 * 128 + 386 * 64 + 194 * 4)
    necks = 16 * 32 * (512 + 386 + 194 + 70)
    assert encoder + residual + decoder + necks + 4 * 2 * 32 == 13_039_232  # 13.04 M as published
    with torch.device("meta"):
        assert count_weights(SpikeFlowNet(bins=10)) == 13_039_232


def test_halves_are_on_off_former_latter():
    counts = torch.arange(2 * 2 * 6 * 3 * 5, dtype=D).reshape(2, 2, 6, 3, 5)
    halves = to_halves(counts)
    assert halves.shape == (2, 4, 3, 5, 3)
    for half, polarity, step in np.ndindex(2, 2, 3):
        assert torch.equal(
            halves[:, 2 * half + polarity, ..., step], counts[:, polarity, 3 * half + step]
        )


def test_spikes_and_their_gradient_by_hand():
    # potentials .5, 1 (fires, back to 0), -.2, .5, .9 (fires)
    current = torch.tensor([0.5, 0.5, -0.2, 0.7, 0.4], dtype=D, requires_grad=True)
    surrogate = FastSigmoid.unit(THETA)
    spikes = integrate_and_fire(current, THETA, surrogate)
    assert spikes.tolist() == [0, 1, 0, 0, 1]
    seed = f64([1.0, 2.0, 3.0, 4.0, 5.0])
    potential = f64([0.5, 1.0, -0.2, 0.5, 0.9])
    own = seed / (2 * THETA * (1 + (potential - THETA).abs() / THETA) ** 2)
    # nothing passes the reset after the second step
    truth = torch.stack([own[0] + own[1], own[1], own[2:].sum(), own[3:].sum(), own[4]])
    (grad,) = torch.autograd.grad(spikes, current, seed, create_graph=True)
    close(grad, truth, rtol=1e-14)
    with pytest.raises(GradientError, match="first derivative of a spike only"):
        torch.autograd.grad(grad.sum(), current)


# trouble (a): gradients that vanish below the threshold and jump at it


# trouble (b): another sensor, another contrast


@pytest.mark.parametrize("factor", [0.5, 20.0])
def test_the_input_does_not_depend_on_the_threshold_that_made_the_counts(factor):
    # usual count (sum c^2 + 1) / (sum c + 1): a factor k on all counts cancels but for the added
    # event, 1 part in k sum c or so
    counts = drawn(1, 2, 8, 32, 32, rate=0.6)
    n = float(counts.sum())
    n2 = float(counts.square().sum())
    expected = factor * ((n2 + 1) / (n + 1)) / ((factor**2 * n2 + 1) / (factor * n + 1))
    assert abs(expected - 1) <= 2 / (min(factor, 1.0) * n)
    close(normalise(factor * counts), normalise(counts) * expected, rtol=1e-12)


def test_mixed_precision_makes_no_neuron_fire_that_did_not():
    # the decoder alone rounds to bfloat16, 2^-9 relative in each of its seven layers
    net = SpikeFlowNet(bins=8, width=8.0)
    volume = evenly_timed(drawn(1, 2, 8, 32, 32, rate=0.6).float())
    with torch.no_grad():
        exact = net(volume).flow_px
        with torch.autocast("cpu", dtype=torch.bfloat16):
            rounded = net(volume).flow_px
    assert 0 < (rounded - exact).norm() <= 7 * 2**-9 * 2 * exact.norm()
