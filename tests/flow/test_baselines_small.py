"""ECN and IDNet: what every baseline promises, their arithmetic written out, their weights by hand."""

import numpy as np
import pytest
import torch

from codesign.errors import DomainError
from codesign.flow import checkpoint
from codesign.flow.baselines import ECN, IDNet
from codesign.flow.baselines.idnet import _blended
from codesign.flow.baselines.weights import count_weights
from codesign.flow.entry import normalise
from codesign.types import EventVolume

D = torch.float64
BINS = 4
STRIDES = {ECN: 16, IDNet: 8}
NETWORKS = list(STRIDES)


def as_volume(counts):
    bins = counts.shape[2]
    return EventVolume(
        counts,
        (torch.arange(bins, dtype=D) + 0.5) * 0.05 / bins,
        torch.full((bins,), 0.05 / bins, dtype=D),
    )


def busy(batch=1, height=32, width=32, seed=0):
    mean = torch.full((batch, 2, BINS, height, width), 0.3, dtype=D)
    return torch.poisson(mean, generator=torch.Generator().manual_seed(seed))


def small(network, **options):
    return network(bins=BINS, width=4.0, **options).double()


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("size", [(21, 37), (16, 16), (1, 2)])
def test_any_size_is_padded_with_emptiness_and_cropped_back(network, size):
    height, width = size
    stride = STRIDES[network]
    net = small(network)
    counts = busy(1, height, width)
    large = torch.zeros(1, 2, BINS, height + -height % stride, width + -width % stride, dtype=D)
    large[..., :height, :width] = counts
    for a, b in zip(net.predictions(as_volume(counts)), net.predictions(as_volume(large)), strict=True):
        assert a.flow_px.shape == (1, 2, height, width)
        torch.testing.assert_close(a.flow_px, b.flow_px[..., :height, :width], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("network", NETWORKS)
def test_a_batch_is_its_samples_and_an_empty_one_has_no_flow(network):
    net = small(network)
    counts = busy(3)
    counts[1] = 0
    counts.requires_grad_()
    field = net(as_volume(counts))
    assert not field.flow_px[1].any()
    assert field.valid.flatten(1).all(1).tolist() == [True, False, True]
    (grad,) = torch.autograd.grad(field.flow_px.square().sum() + field.flow_px.sum(), counts)
    assert not grad[1].any()
    assert bool((grad[[0, 2]].flatten(1).norm(dim=1) > 0).all())
    for k in (0, 2):
        alone = net(as_volume(counts[k : k + 1].detach())).flow_px
        torch.testing.assert_close(alone, field.flow_px[k : k + 1], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("network", NETWORKS)
def test_gradients_of_counts_and_weights_against_differences_of_the_loss(network, generator):
    """Central differences in float64 along random directions: error of order step^2 and rounding / step."""
    net = small(network)
    counts = (busy(1, 20, 24) + 0.5).requires_grad_()
    weight = torch.randn(1, 2, 20, 24, generator=generator, dtype=D)
    learnt = list(net.parameters())

    def loss():
        return (net(as_volume(counts)).flow_px * weight).sum()

    found = torch.autograd.grad(loss(), [counts, *learnt])
    tangents = [torch.randn(each.shape, generator=generator, dtype=D) for each in found]
    step = 1e-6
    places = range(len(found)) if network is ECN else [0, 1, len(found) - 4, len(found) - 1]
    for place in places:
        value = [counts, *learnt][place]
        with torch.no_grad():
            value += step * tangents[place]
            above = loss()
            value -= 2 * step * tangents[place]
            below = loss()
            value += step * tangents[place]
        truth = float(above - below) / (2 * step)
        assert float((found[place] * tangents[place]).sum()) == pytest.approx(truth, rel=2e-5, abs=1e-6)


def test_weights_of_the_cascade_by_hand():
    w = 16
    encoder = 9 * (16 * w + w * 2 * w + 2 * w * 3 * w + 3 * w * 4 * w) + 2 * 10 * w
    block = 2 * 9 * 4 * w * 2 * w + 2 * (2 * w + 4 * w)
    decoder = 9 * (7 * w * 3 * w + (5 * w + 2) * 2 * w + (3 * w + 2) * w + (w + 2) * w // 2) + 2 * 13 * w // 2
    heads = 2 * 13 * w // 2 + 8
    assert count_weights(ECN(8, 16.0)) == encoder + block + decoder + heads


def test_weights_of_the_recurrent_network_by_hand():
    """1.4 million as published for the small one."""
    w, state, inside = 32, 128, 256
    encoder = 9 * (2 * w + w * 2 * w + 4 * w * w + 2 * w * state) + 2 * (w + 4 * w + state)
    recurrent = 9 * 2 * state * 3 * state + 3 * state
    head = 9 * (state * inside + inside * 2) + inside + 2
    blend = 9 * 64 * (state + 1)
    assert count_weights(IDNet(8, 32.0)) == encoder + recurrent + head + blend
    assert 1.3e6 < encoder + recurrent + head + blend < 1.5e6


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("budget", [150_000, 432_413])
def test_a_weight_budget_is_filled_and_hardly_exceeded(network, budget):
    net = network.with_weights(budget)
    assert budget <= count_weights(net) <= 1.04 * budget
    assert count_weights(network(**net.config)) == count_weights(net)


@pytest.mark.parametrize("network", NETWORKS)
def test_files_bring_the_same_network_back(network, tmp_path):
    net = network(bins=BINS, width=4.0, seed=3)
    volume = as_volume(busy().float())
    checkpoint.save(net, tmp_path / "net.safetensors")
    assert torch.equal(checkpoint.load(tmp_path / "net.safetensors")(volume).flow_px, net(volume).flow_px)
    other = network(**{**net.config, "seed": 4})
    assert not torch.equal(other(volume).flow_px, net(volume).flow_px)


def test_the_recurrent_unit_written_out():
    """On one cell the 3 x 3 kernels touch their centre alone: z and r by the logistic function, h' = tanh(U (r
    h) + W x), h <- (1 - z) h + z h'."""
    net = small(IDNet)
    read = torch.randn(1, BINS, 16, 1, 1, dtype=D, generator=torch.Generator().manual_seed(5))
    held = net.state_dict()
    gates, candidate = (
        (held[f"{name}.weight"][:, :, 1, 1].numpy(), held[f"{name}.bias"].numpy())
        for name in ("gates", "candidate")
    )
    h = np.zeros(16)
    for x in read[0, :, :, 0, 0].numpy():
        z, r = np.split(1 / (1 + np.exp(-(gates[0] @ np.concatenate([h, x]) + gates[1]))), 2)
        new = np.tanh(candidate[0] @ np.concatenate([r * h, x]) + candidate[1])
        h = (1 - z) * h + z * new
    np.testing.assert_allclose(net._read(read)[0, :, 0, 0].detach().numpy(), h, rtol=1e-12)


def test_the_second_iteration_reads_what_the_first_one_deblurred():
    """With a head that always says 8 px to the right on cells of 8, each bin is read where its points have got
    to: 8 t px further; a bar that moves so stands still."""
    net = small(IDNet, iterations=2)
    with torch.no_grad():
        for parameter in net.head.parameters():
            parameter.zero_()
        net.get_parameter("head.2.bias").copy_(torch.tensor([1.0, 0.0]))
    seen = []
    net.encoder.register_forward_hook(lambda _, given, __: seen.append(given[0]))
    counts = torch.zeros(1, 2, BINS, 24, 40, dtype=D)
    for k in range(BINS):
        counts[0, 0, k, 4:20, 9 + 2 * k] = 1.0  # times 1/8, 3/8, ...: at 8 + 8 t
    flows = net.predictions(as_volume(counts))
    assert torch.allclose(flows[1].flow_px[:, 0], 2 * flows[0].flow_px[:, 0])
    first, second = (bins.unflatten(0, (1, BINS)) for bins in seen)
    torch.testing.assert_close(first.transpose(1, 2)[..., :24, :40], normalise(counts))
    for k in range(1, BINS):
        torch.testing.assert_close(second[:, k], second[:, 0])
    assert bool((second[0, 0, 0, 4:20, 8] > 0).all())


def test_a_blend_of_an_even_flow_is_even_and_of_centres_is_nearest():
    flow = torch.randn(1, 2, 3, 4, dtype=D)
    anything = torch.randn(1, 576, 3, 4, dtype=D)
    even = _blended(torch.full((1, 2, 3, 4), 1.5, dtype=D), anything)
    torch.testing.assert_close(even, torch.full((1, 2, 24, 32), 1.5, dtype=D))
    centre = torch.zeros(1, 9, 64, 3, 4, dtype=D)
    centre[:, 4] = 1e3
    nearest = _blended(flow, centre.flatten(1, 2))
    torch.testing.assert_close(nearest, flow.repeat_interleave(8, 2).repeat_interleave(8, 3))


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: ECN(bins=1), "whole number >= 2"),
        (lambda: ECN(hidden=6), "hidden is 6"),
        (lambda: IDNet(width=0.0), "width is 0.0"),
        (lambda: IDNet(iterations=0), "iterations"),
        (lambda: IDNet.with_weights(100), "budget of 100 weights is too small"),
    ],
)
def test_unfit_constructions_are_refused(build, sentence):
    with pytest.raises(DomainError, match=sentence):
        build()
