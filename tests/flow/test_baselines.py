"""What both baseline networks promise: any size, empty volumes, exact gradients, a weight budget, the same
network from its configuration."""

import math

import pytest
import torch

from codesign.errors import DomainError, ShapeError
from codesign.flow.baselines import FlowNetEvents, SpikeFlowNet
from codesign.flow.baselines.rescale import rescale_flow
from codesign.flow.baselines.weights import channels, count_weights
from codesign.flow.entry import presence
from codesign.types import EventVolume

D = torch.float64
BINS = 4
NETWORKS = [FlowNetEvents, SpikeFlowNet]


def as_volume(counts):
    bins = counts.shape[2]
    return EventVolume(
        counts, torch.linspace(0, 0.05, bins, dtype=D), torch.full((bins,), 0.05 / bins, dtype=D)
    )


def busy(batch=1, height=32, width=32, seed=0, mean=0.3, bins=BINS):
    return torch.poisson(
        torch.full((batch, 2, bins, height, width), mean, dtype=D),
        generator=torch.Generator().manual_seed(seed),
    )


def small(network, **options):
    return network(bins=BINS, width=8.0, **options).double()


@pytest.mark.bits
@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("size", [(37, 53), (16, 16), (5, 90), (1, 1)])
def test_any_size_is_padded_with_emptiness_and_cropped_back(network, size):
    # the pixels keep their places: the same events in the corner of a larger empty image, already a multiple
    # of the stride
    height, width = size
    net = small(network)
    counts = busy(1, height, width)
    large = torch.zeros(1, 2, BINS, height + -height % 16, width + -width % 16, dtype=D)
    large[..., :height, :width] = counts
    found = net.predictions(as_volume(counts))
    truth = net.predictions(as_volume(large))
    for a, b in zip(found, truth, strict=True):
        assert a.flow_px.shape == (1, 2, height, width)
        assert torch.equal(a.flow_px, b.flow_px[..., :height, :width])


@pytest.mark.parametrize("network", NETWORKS)
def test_predictions_are_the_levels_in_full_resolution_pixels(network):
    net = small(network)
    volume = as_volume(busy(2, 32, 48))
    levels = net._levels(volume)
    found = net.predictions(volume)
    shown = presence(volume.counts)
    for factor, level, field in zip((8, 4, 2, 1), levels, found, strict=True):
        assert level.shape == (2, 2, 32 // factor, 48 // factor)
        # a bilinear resampling keeps the mean of a field whose border repeats; the vectors grow with the grid
        torch.testing.assert_close(
            field.flow_px.mean((2, 3)), factor * (level * shown).mean((2, 3)), rtol=1e-9, atol=1e-12
        )
    assert torch.equal(found[-1].flow_px, net(volume).flow_px)
    assert found[-1].interval_s == pytest.approx(0.05)


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_an_empty_sample_has_zero_flow_confidence_and_gradient_and_does_not_touch_the_others(network, dtype):
    net = small(network).to(dtype)
    counts = busy(3).to(dtype)
    counts[1] = 0
    counts.requires_grad_()
    field = net(as_volume(counts))
    assert not field.flow_px[1].any()
    assert field.confidence is not None
    assert not field.confidence[1].any()
    assert field.valid.flatten(1).all(1).tolist() == [True, False, True]
    (grad,) = torch.autograd.grad(field.flow_px.square().sum() + field.flow_px.sum(), counts)
    assert not grad[1].any()
    assert bool((grad[[0, 2]].flatten(1).norm(dim=1) > 0).all())
    alone = counts[2:].detach().requires_grad_()
    flow = net(as_volume(alone)).flow_px
    (grad_alone,) = torch.autograd.grad(flow.square().sum() + flow.sum(), alone)
    tolerance = 1e-12 if dtype == D else 1e-5  # sums in another order
    torch.testing.assert_close(
        flow, field.flow_px[2:], rtol=0, atol=tolerance * float(flow.detach().abs().max())
    )
    torch.testing.assert_close(grad_alone, grad[2:], rtol=0, atol=10 * tolerance * float(grad.abs().max()))


def test_the_flow_fades_in_with_the_square_of_the_events():
    counts = torch.zeros(3, 2, BINS, 16, 16, dtype=D)
    counts[1, 0, 0, 3, 4], counts[2, 1, 2, 5, 5] = 10.0, 1.0
    torch.testing.assert_close(presence(counts).flatten(), torch.tensor([0.0, 0.5, 1 / 101], dtype=D))


def case(name):
    counts = torch.zeros(1, 2, BINS, 20, 24, dtype=D)
    if name == "one event":
        counts[0, 0, 1, 7, 9] = 1
    elif name == "saturated":
        counts = counts + busy(1, 20, 24, mean=200.0)
    elif name == "constant":
        counts = counts + 0.5
    else:
        counts = counts + busy(1, 20, 24)
    return counts


@pytest.mark.parametrize("name", ["busy", "one event", "saturated", "constant"])
def test_gradient_of_the_plain_network_against_central_differences(name, generator):
    net = small(FlowNetEvents)
    counts = case(name).requires_grad_()
    weight = torch.randn(1, 2, 20, 24, generator=generator, dtype=D)

    def loss(counts):
        return (net(as_volume(counts)).flow_px * weight).sum()

    (found,) = torch.autograd.grad(loss(counts), counts)
    for _ in range(3):
        tangent = torch.randn(counts.shape, generator=generator, dtype=D)
        step = 1e-5
        with torch.no_grad():
            truth = float(loss(counts + step * tangent) - loss(counts - step * tangent)) / (2 * step)
        # error of a central difference: step^2 times the third derivative, here of the order of the first
        # over (a tenth)^2, and rounding 1e-15 / step
        assert float((found * tangent).sum()) == pytest.approx(truth, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("budget", [300_000, 400_000, 500_000])
def test_a_weight_budget_is_filled_and_hardly_exceeded(network, budget):
    # a step of 4 hidden channels adds 2 blocks of 2 layers of 9 x 4 weights to each of the last layer's
    # channels, and their two norms
    net = network.with_weights(budget)
    step = 2 * (2 * 9 * 4 * channels(net.config["width"], 8) + 2 * 4)
    assert budget <= count_weights(net) < budget + step
    assert step <= 0.04 * budget
    assert count_weights(network(**net.config)) == count_weights(net)


def test_weights_of_the_plain_network_by_hand():
    w = 16
    bins = 8
    encoder = 9 * w * (2 * bins + 1 * 2 * w + 2 * 4 * w + 4 * 8 * w)
    residual = 4 * 9 * (8 * w) ** 2
    decoder = 9 * (16 * w * 4 * w + (8 * w + 2) * 2 * w + (4 * w + 2) * w + (2 * w + 2) * w // 2)
    norms = 2 * (1 + 2 + 4 + 8 + 4 * 8 + 4 + 2 + 1 + 0.5) * w
    heads = 2 * (4 + 2 + 1 + 0.5) * w + 8
    assert count_weights(FlowNetEvents(bins, 16.0)) == encoder + residual + decoder + norms + heads


@pytest.mark.bits
@pytest.mark.parametrize("network", NETWORKS)
def test_configuration_and_weights_make_the_same_network(network):
    net = small(network, seed=3)
    volume = as_volume(busy())
    again = network(**net.config).double()
    assert torch.equal(again(volume).flow_px, net(volume).flow_px)  # the seed alone draws the weights
    other = network(**{**net.config, "seed": 4}).double()
    assert not torch.equal(other(volume).flow_px, net(volume).flow_px)
    other.load_state_dict(net.state_dict())
    assert torch.equal(other(volume).flow_px, net(volume).flow_px)


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize(
    ("counts", "error", "sentence"),
    [
        (torch.zeros(2, BINS, 32, 32), ShapeError, rf"\[B, 2, {BINS}, H, W\], got \(2, 4, 32, 32\)"),
        (torch.zeros(1, 2, 6, 32, 32), ShapeError, f"make the volume with {BINS} bins"),
        (torch.zeros(1, 3, BINS, 32, 32), ShapeError, r"\[B, 2"),
        (torch.zeros(0, 2, BINS, 32, 32), ShapeError, r"\[B, 2"),
        (torch.full((1, 2, BINS, 16, 16), math.inf), DomainError, "event volume"),
    ],
)
def test_unfit_volumes_are_refused(network, counts, error, sentence):
    with pytest.raises(error, match=sentence):
        network(bins=BINS, width=8.0)(as_volume(counts))


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: FlowNetEvents(bins=1), "whole number >= 2"),
        (lambda: SpikeFlowNet(bins=5), "an even whole number"),
        (lambda: SpikeFlowNet(threshold=0.0), "threshold is 0.0"),
        (lambda: FlowNetEvents.with_weights(100), "budget of 100 weights is too small"),
        (lambda: FlowNetEvents(hidden=6), "hidden is 6"),
        (lambda: FlowNetEvents(width=0.0), "width is 0.0"),
    ],
)
def test_unfit_constructions_are_refused(build, sentence):
    with pytest.raises(DomainError, match=sentence):
        build()


@pytest.mark.parametrize("size", [(24, 36), (7, 5), (12, 30)])
def test_rescaled_flow_of_an_affine_motion(size):
    # pixel i of n has its centre at (i + 1/2) / n of the image; bilinear interpolation is exact for an affine
    # field where no border is repeated
    matrix = torch.tensor([[0.3, -0.2], [0.1, 0.4]], dtype=D)
    shift = torch.tensor([1.5, -2.0], dtype=D)

    def field(height, width):
        y, x = torch.meshgrid(
            (torch.arange(height, dtype=D) + 0.5) / height,
            (torch.arange(width, dtype=D) + 0.5) / width,
            indexing="ij",
        )
        of_image = (
            torch.einsum("ij,jhw->ihw", matrix, torch.stack([x, y])) + shift[:, None, None]
        )  # in widths and heights of the image
        return (of_image * torch.tensor([width, height], dtype=D)[:, None, None])[None], x, y

    source = field(12, 10)[0]
    truth = field(*size)
    found, (expected, x, y) = rescale_flow(source, size), truth
    inside = (x > 0.5 / 10) & (x < 1 - 0.5 / 10) & (y > 0.5 / 12) & (y < 1 - 0.5 / 12)
    assert int(inside.sum()) >= 12
    torch.testing.assert_close(found[..., inside], expected[..., inside], rtol=1e-12, atol=1e-12)


def test_rescaling_refuses_what_is_no_flow():
    with pytest.raises(ShapeError, match=r"\[B, 2, H, W\]"):
        rescale_flow(torch.zeros(1, 3, 4, 4), (8, 8))
    with pytest.raises(ShapeError, match="0 x 8"):
        rescale_flow(torch.zeros(1, 2, 4, 4), (0, 8))
