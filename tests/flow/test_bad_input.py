"""Wrong calls of the flow package, as somebody makes who meets it for the first time: each gets one
sentence that names what was given. And right calls of every size and type: they get an answer."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import flow
from codesign.errors import CodesignError
from codesign.flow.export import evenly_timed

BINS = 4


def generator():
    return torch.Generator().manual_seed(0)


NETWORKS = {
    "refiner": flow.Refiner(BINS, width=16, steps=1),
    "flownet": flow.FlowNetEvents(BINS, width=4.0),
    "spiking": flow.SpikeFlowNet(BINS, width=4.0),
    "ecn": flow.ECN(BINS, width=4.0),
    "idnet": flow.IDNet(BINS, width=4.0),
}
ESTIMATORS = {"lk": flow.estimate_lk, **NETWORKS}


def volume(height=20, width=24, batch=2, dtype=torch.float32):
    counts = torch.rand(batch, 2, BINS, height, width, generator=generator(), dtype=torch.float64)
    return evenly_timed(counts.to(dtype))


def with_counts(counts):
    return replace(volume(), counts=counts)


COUNTS = volume().counts


@pytest.mark.parametrize("estimate", [flow.estimate_lk, NETWORKS["flownet"]], ids=["lk", "flownet"])
@pytest.mark.parametrize(
    ("given", "words"),
    [
        (None, "NoneType; an EventVolume"),
        (COUNTS, "Tensor; an EventVolume"),
        (with_counts([1.0]), "is a list"),
        (with_counts(COUNTS.round().long()), "int64"),
        (with_counts(COUNTS > 0.5), "bool"),
        (with_counts(COUNTS.half()), "float16"),
        (with_counts(COUNTS.to(torch.complex64)), "complex64"),
        (with_counts(COUNTS.to_sparse()), "sparse"),
        (with_counts(COUNTS.to("meta")), "without values"),
        (with_counts(COUNTS[0]), r"\[B, 2, .*, H, W\], got \(2, 4, 20, 24\)"),
        (with_counts(COUNTS[:, :1]), "got"),
        (with_counts(COUNTS[:0]), "empty"),
        (with_counts(COUNTS[..., :0]), "empty"),
        (with_counts(COUNTS[..., :0, :]), "empty"),
        (with_counts(COUNTS[:, :, :1]), "bins|B, 2, 4, H, W"),
        (with_counts(COUNTS - 0.5), "reach down to -0.4"),
        (with_counts(COUNTS * math.nan), "NaN"),
        (with_counts(COUNTS.index_fill(4, torch.tensor(3), math.inf)), "infinite"),
        (replace(volume(), centroid_s=None), "centroid_s .* is a NoneType"),
        (replace(volume(), centroid_s=torch.ones(3)), r"centroid_s .* is \[3\]"),
        (replace(volume(), collected_s=torch.zeros(BINS)), "collected_s"),
        (replace(volume(), collected_s=torch.full((BINS,), math.nan)), "collected_s"),
    ],
)
def test_volumes_that_are_none(estimate, given, words):
    with pytest.raises(CodesignError, match=words):
        estimate(given)


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (3, 40), (13, 12), (33, 17)], ids=str)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_size_has_an_answer_of_its_own_size_or_a_sentence(name, size):
    given = volume(*size)
    if min(size) < 2 and name in ("lk", "refiner"):  # a single row or column has no slope
        with pytest.raises(CodesignError, match="at least 2 x 2"):
            ESTIMATORS[name](given)
        return
    found = ESTIMATORS[name](given)
    assert found.flow_px.shape == (2, 2, *size)
    assert bool(found.flow_px.isfinite().all())


def few_events(draw):
    """A volume of 0 to 40 events at places drawn at random, some of them many times over."""
    counts = torch.zeros(3, 2, BINS, 20, 24)
    for sample in range(3):
        for _ in range(int(torch.randint(0, 14, (), generator=draw)) * sample):
            cell = [int(torch.randint(side, (), generator=draw)) for side in counts.shape[1:]]
            counts[(sample, *cell)] += float(torch.randint(1, 4, (), generator=draw))
    return evenly_timed(counts)


@pytest.mark.parametrize("name", [*NETWORKS, "constant", "affine", "quadratic", "local"])
def test_confidence_lies_between_none_and_all(name):
    draw = torch.Generator().manual_seed(1)
    for given in [few_events(draw) for _ in range(5)] + [
        with_counts(1000 * COUNTS),
        with_counts(0 * COUNTS),
    ]:
        found = NETWORKS[name](given) if name in NETWORKS else flow.estimate_lk(given, name)
        assert found.confidence is not None
        least, most = found.confidence.detach().aminmax()
        assert float(least) >= 0
        assert float(most) <= 1
        empty = given.counts.sum((1, 2, 3, 4)) == 0
        unseen = torch.where(empty[:, None, None], found.confidence.detach(), 0.0)
        assert float(unseen.max()) < 1e-6  # of single precision
        assert not found.valid[empty].any()


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_takes_both_types_and_gives_that_of_the_events_back(name):
    narrow = NETWORKS[name](volume())
    for weights, counts in (
        (torch.float32, torch.float64),
        (torch.float64, torch.float32),
        (torch.float64, torch.float64),
    ):
        network = NETWORKS[name].to(weights)
        found = network(volume(dtype=counts))
        NETWORKS[name].to(torch.float32)
        for part in ("flow_px", "confidence", "covariance_px2"):
            value = getattr(found, part)
            assert value is None or value.dtype == counts
        # single precision, gathered over some tens of layers
        torch.testing.assert_close(found.flow_px.float(), narrow.flow_px, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_gradient_to_wide_events_goes_through_narrow_weights(name):
    wide = volume(dtype=torch.float64)
    counts = wide.counts.requires_grad_()
    narrow = volume()
    narrow.counts.requires_grad_()
    for events in (wide, narrow):
        NETWORKS[name](events).flow_px.square().sum().backward()
    assert counts.grad is not None
    assert counts.grad.dtype == torch.float64
    assert narrow.counts.grad is not None
    scale = float(counts.grad.abs().max())
    assert float((counts.grad - narrow.counts.grad).abs().max()) < 1e-3 * scale


@pytest.mark.parametrize("name", NETWORKS)
def test_events_and_weights_on_two_devices(name):
    network = type(NETWORKS[name])(**NETWORKS[name].config).to("meta")
    with pytest.raises(CodesignError, match="events are on cpu, the weights of the network on meta"):
        network(volume())
