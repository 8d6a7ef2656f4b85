"""What every network that flow is compared with promises besides test_estimators (emptiness around
an image changes nothing, a budget of weights, the same network from its configuration and its
file), and of each its arithmetic written out."""

import numpy as np
import pytest
import torch

from codesign.flow import checkpoint
from codesign.flow.baselines import FlowNetEvents, SpikeFlowNet
from codesign.flow.baselines.parts import count_weights
from codesign.flow.entry import normalise, presence
from studies.train_flow.peers import ECN, IDNet
from tests.flow.volumes import drawn, in_even_bins
from tests.numbers import D, close, f64, randn64, seeded

BINS = 4
SPAN_S = 0.05
NETWORKS = [FlowNetEvents, SpikeFlowNet, ECN, IDNet]


def small(network, **options):
    return network(bins=BINS, width=8.0, **options).double()


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("size", [(21, 37), (16, 16), (1, 2)])
def test_any_size_is_padded_with_emptiness_and_cropped_back(network, size):
    # the pixels keep their places: the same events in the corner of a larger empty image, already a
    # multiple of the stride
    height, width = size
    net = small(network)
    counts = drawn(1, 2, BINS, height, width, rate=0.3)
    large = torch.zeros(
        1, 2, BINS, height + -height % net.STRIDE, width + -width % net.STRIDE, dtype=D
    )
    large[..., :height, :width] = counts
    found = net.predictions(in_even_bins(counts, SPAN_S))
    for a, b in zip(found, net.predictions(in_even_bins(large, SPAN_S)), strict=True):
        assert a.flow_px.shape == (1, 2, height, width)
        close(a.flow_px, b.flow_px[..., :height, :width], rtol=1e-12, atol=1e-12)
    assert torch.equal(found[-1].flow_px, net(in_even_bins(counts, SPAN_S)).flow_px)
    assert found[-1].interval_s == pytest.approx(0.05)


@pytest.mark.parametrize("network", [FlowNetEvents, SpikeFlowNet, ECN])
def test_predictions_are_the_levels_in_full_resolution_pixels(network):
    net = small(network)
    volume = in_even_bins(drawn(2, 2, BINS, 32, 48, rate=0.3), SPAN_S)
    levels = net.levels(normalise(volume.counts).flatten(1, 2), volume)
    shown = presence(volume.counts)
    for factor, level, field in zip((8, 4, 2, 1), levels, net.predictions(volume), strict=True):
        assert level.shape == (2, 2, 32 // factor, 48 // factor)
        # a bilinear resampling keeps the mean of a field whose border repeats; the vectors grow
        # with the grid
        close(
            field.flow_px.mean((2, 3)), factor * (level * shown).mean((2, 3)), rtol=1e-9, atol=1e-12
        )


def test_the_flow_fades_in_with_the_square_of_the_events():
    counts = torch.zeros(3, 2, BINS, 16, 16, dtype=D)
    counts[1, 0, 0, 3, 4], counts[2, 1, 2, 5, 5] = 10.0, 1.0
    torch.testing.assert_close(presence(counts).flatten(), f64([0.0, 0.5, 1 / 101]))


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("budget", [300_000, 432_413])
def test_a_weight_budget_is_filled_hardly_exceeded_and_begins_as_that_width_does(network, budget):
    net = network.with_weights(budget)
    assert budget <= count_weights(net) <= 1.04 * budget
    sizes = {name: net.config[name] for name in ("bins", "width", "hidden")}
    for again in (network(**net.config), network(**sizes)):
        for found, wanted in zip(net.parameters(), again.parameters(), strict=True):
            assert torch.equal(found, wanted)


def test_weights_by_hand():
    """From the sizes of the layers of a plain network 16 channels wide; of the peers the numbers as
    delivered, published 0.15 and 1.4 million."""
    w = 16
    encoder = 9 * w * (16 + 1 * 2 * w + 2 * 4 * w + 4 * 8 * w)
    residual = 4 * 9 * (8 * w) ** 2
    decoder = 9 * (16 * w * 4 * w + (8 * w + 2) * 2 * w + (4 * w + 2) * w + (2 * w + 2) * w // 2)
    norms = 2 * (1 + 2 + 4 + 8 + 4 * 8 + 4 + 2 + 1 + 0.5) * w
    heads = 2 * (4 + 2 + 1 + 0.5) * w + 8
    assert count_weights(FlowNetEvents(8, float(w))) == encoder + residual + decoder + norms + heads
    assert (count_weights(ECN()), count_weights(IDNet())) == (166_680, 1_389_378)


@pytest.mark.bits
@pytest.mark.parametrize("network", NETWORKS)
def test_configuration_and_file_make_the_same_network(network, tmp_path):
    net = network(bins=BINS, width=8.0, seed=3)
    volume = in_even_bins(drawn(1, 2, BINS, 32, 32, rate=0.3).float(), SPAN_S)
    right = net(volume).flow_px
    # the seed alone draws the weights
    assert torch.equal(network(**net.config)(volume).flow_px, right)
    assert not torch.equal(network(**{**net.config, "seed": 4})(volume).flow_px, right)
    checkpoint.save(net, tmp_path / "net.safetensors")
    assert torch.equal(checkpoint.load(tmp_path / "net.safetensors")(volume).flow_px, right)


def test_the_recurrent_unit_written_out():
    """On one cell the 3 x 3 kernels touch their centre alone: z and r by the logistic function, h'
    = tanh(U (r h) + W x), h <- (1 - z) h + z h'."""
    net = small(IDNet)
    read = randn64(seeded(5), 1, BINS, 32, 1, 1)
    held = net.state_dict()
    gates, candidate = (
        (held[f"{name}.weight"][:, :, 1, 1].numpy(), held[f"{name}.bias"].numpy())
        for name in ("gates", "candidate")
    )
    h = np.zeros(32)
    for x in read[0, :, :, 0, 0].numpy():
        z, r = np.split(1 / (1 + np.exp(-(gates[0] @ np.concatenate([h, x]) + gates[1]))), 2)
        new = np.tanh(candidate[0] @ np.concatenate([r * h, x]) + candidate[1])
        h = (1 - z) * h + z * new
    np.testing.assert_allclose(net._read(read)[0, :, 0, 0].detach().numpy(), h, rtol=1e-12)


def test_the_second_iteration_reads_what_the_first_one_deblurred():
    """With a head that always says 8 px to the right on cells of 8, each bin is read where its
    points have got to: 8 t px further; a bar that moves so stands still."""
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
    flows = net.predictions(in_even_bins(counts, SPAN_S))
    assert torch.allclose(flows[1].flow_px[:, 0], 2 * flows[0].flow_px[:, 0])
    first, second = (bins.unflatten(0, (1, BINS)) for bins in seen)
    torch.testing.assert_close(first.transpose(1, 2)[..., :24, :40], normalise(counts))
    for k in range(1, BINS):
        torch.testing.assert_close(second[:, k], second[:, 0])
    assert (second[0, 0, 0, 4:20, 8] > 0).all()
