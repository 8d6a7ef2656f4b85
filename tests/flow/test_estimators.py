"""What every estimator of flow promises: an answer of its own for every sample, size and type,
nothing where nothing is seen, gradients that differences confirm, and one sentence for what is no
volume of events."""
# pyright: reportArgumentType=false, reportCallIssue=false

from copy import deepcopy
from dataclasses import replace
from functools import partial

import pytest
import torch

from codesign import flow
from codesign.errors import CodesignError
from codesign.flow.export import evenly_timed
from studies.train_flow.peers import ECN, IDNet
from tests import refusals
from tests.flow.volumes import drawn
from tests.numbers import D, close, f64, randn64

BINS = 4


def stirred(network):
    """The network with random weights also where a fresh one has zeros."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for parameter in network.parameters():
            if not bool(parameter.any()):
                torch.nn.init.normal_(parameter, std=0.1)
    return network.eval()


NETWORKS = {
    "refiner": stirred(flow.Refiner(BINS, width=16, steps=1)),
    "flownet": stirred(flow.FlowNetEvents(BINS, width=4.0)),
    "spiking": stirred(flow.SpikeFlowNet(BINS, width=4.0)),
    "ecn": stirred(ECN(BINS, width=4.0)),
    "idnet": stirred(IDNet(BINS, width=4.0)),
}
WIDE = {name: deepcopy(network).double() for name, network in NETWORKS.items()}
CLOSED = {
    name: partial(flow.estimate_lk, model=name)
    for name in ("constant", "affine", "quadratic", "local")
}
CLOSED |= {"choice": flow.estimate}


VOLUME = evenly_timed(drawn(2, 2, BINS, 20, 24).float())
COUNTS = VOLUME.counts


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (13, 12), (33, 17)], ids=str)
@pytest.mark.parametrize("name", [*NETWORKS, *CLOSED])
def test_a_batch_is_its_samples_and_an_empty_one_shows_nothing(name, size):
    """Few events, none, a hundred each, one each; sums in another order in double precision."""
    estimate = {**WIDE, **CLOSED}[name]
    counts = drawn(4, 2, BINS, *size)
    counts[:3] *= f64([0.01, 0.0, 100.0])[:, None, None, None, None]
    counts.requires_grad_()
    if min(size) < 2 and name in ("refiner", *CLOSED):  # a single row or column has no slope
        with pytest.raises(CodesignError, match="at least 2 x 2"):
            estimate(evenly_timed(counts))
        return
    field = estimate(evenly_timed(counts))
    assert field.flow_px.shape == (4, 2, *size)
    assert field.valid.flatten(1).all(1).tolist() == [True, False, True, True]
    assert 0 <= field.confidence.detach().min() <= field.confidence.detach().max() <= 1
    assert not field.flow_px[1].any()
    assert field.confidence[1].detach().abs().max() < 1e-12
    (grad,) = torch.autograd.grad(field.flow_px.square().sum() + field.flow_px.sum(), counts)
    assert not grad[1].any()
    for sample in (0, 3):
        alone = counts[[sample]].detach().requires_grad_()
        found = estimate(evenly_timed(alone)).flow_px
        (own,) = torch.autograd.grad(found.square().sum() + found.sum(), alone)
        close(found[0], field.flow_px[sample], rtol=1e-9, atol=1e-9)
        close(own[0], grad[sample], rtol=1e-8, atol=1e-8 * float(own.abs().max()))


@pytest.mark.parametrize(
    ("name", "rate"),
    [
        ("refiner", 1.0),
        ("refiner", 200.0),
        ("refiner by events", 1.0),
        ("flownet", 0.0),
        ("flownet", 1.0),
        ("flownet", 200.0),
        ("spiking", 1.0),
        ("ecn", 1.0),
        ("idnet", 1.0),
    ],
)
def test_gradients_of_counts_and_weights_are_those_of_differences(name, rate, generator):
    """Central differences in float64 along random directions: error of order step^2 and rounding /
    step. Counts of nothing but one event, of a textured scene, and of a saturated one. Of the
    spiking network those weights alone that no spike depends on."""
    net = WIDE[name.split()[0]]
    options = {"clock": "events"} if "by events" in name else {}
    counts = drawn(1, 2, BINS, 20, 24, rate=rate) + 0.5 * (rate > 0)
    counts[0, 0, 1, 7, 9] += 1
    weight = randn64(generator, 1, 6, 20, 24)
    learnt = list(net.parameters())
    places = [counts.requires_grad_(), *(learnt[k] for k in (0, len(learnt) // 2, -4, -1))]
    if name == "spiking":
        places = [
            value for key, value in net.named_parameters() if key.startswith(("necks", "heads"))
        ]

    def loss():
        field = net(evenly_timed(counts), **options)
        claims = (field.flow_px, field.confidence[:, None], field.covariance_px2)
        values = torch.cat([claim for claim in claims if claim is not None], 1)
        return (weight[:, : values.shape[1]] * values).sum()

    found = torch.autograd.grad(loss(), places, allow_unused=True, materialize_grads=True)
    step = 1e-6
    for value, grad in zip(places, found, strict=True):
        tangent = randn64(generator, value.shape)
        with torch.no_grad():
            value += step * tangent
            above = loss()
            value -= 2 * step * tangent
            below = loss()
            value += step * tangent
        truth = float(above - below) / (2 * step)
        assert float((grad * tangent).sum()) == pytest.approx(truth, rel=2e-5, abs=1e-6)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_takes_both_types_and_gives_that_of_the_events_back(name):
    given = COUNTS.double().requires_grad_()
    right = WIDE[name](evenly_timed(given))
    (grad,) = torch.autograd.grad(right.flow_px.square().sum(), given)
    for network, dtype in ((NETWORKS, torch.float32), (NETWORKS, D), (WIDE, torch.float32)):
        counts = COUNTS.to(dtype).requires_grad_()
        found = network[name](evenly_timed(counts))
        for part in ("flow_px", "confidence", "covariance_px2"):
            value, wide = getattr(found, part), getattr(right, part)
            assert (value is None) == (wide is None)
            if value is not None:
                # single precision, gathered over some tens of layers
                close(value, wide.to(dtype), rtol=1e-3, atol=1e-4)
        (own,) = torch.autograd.grad(found.flow_px.square().sum(), counts)
        assert own.dtype == dtype
        assert (own - grad).abs().max() < 1e-3 * grad.abs().max()


def counted(counts):
    return replace(VOLUME, counts=counts)


@pytest.mark.parametrize("estimate", [flow.estimate_lk, NETWORKS["flownet"]], ids=["lk", "flownet"])
@refusals.table(__file__, "volumes of events")
def test_volumes_that_are_none(estimate, row):
    row.holds(globals() | {"estimate": estimate})
