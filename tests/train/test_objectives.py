"""Objectives of flow networks, put together by hand."""

from dataclasses import replace

import pytest
import torch

from codesign.errors import ShapeError
from codesign.flow.losses import laplace_loss
from codesign.train import Contrast, Photometric, Supervised
from codesign.train.objectives import flow_predictions
from codesign.types import FlowField
from tests.flow_training_case import SIDE, Made
from tests.numbers import seeded


def field(seed, covariance=None):
    flow = torch.randn(4, 2, SIDE, SIDE, generator=seeded(seed)).requires_grad_()
    return FlowField(
        flow, torch.ones(4, SIDE, SIDE, dtype=torch.bool), 1.0, covariance_px2=covariance
    )


@pytest.mark.parametrize("objective", [Contrast(0.3), Photometric(0.3)])
def test_an_earlier_prediction_counts_four_fifths_of_the_next(objective):
    windows = Made().batch(range(4))
    one, two, three = (field(seed) for seed in range(3))
    alone = [float(objective([each], windows).detach()) for each in (one, two, three)]
    together = float(objective([one, two, three], windows).detach())
    expected = (0.64 * alone[0] + 0.8 * alone[1] + alone[2]) / 2.44
    assert together == pytest.approx(expected, rel=1e-6)


def test_the_likelihood_teaches_the_claim_and_leaves_the_flow_alone():
    windows = Made().batch(range(4))

    def gradients(weight):
        claim = (
            torch.tensor([1.0, 0.0, 2.0])[:, None, None].repeat(4, 1, SIDE, SIDE).requires_grad_()
        )
        prediction = field(0, claim)
        loss = Supervised(claim_weight=weight)([prediction], windows)
        found = torch.autograd.grad(loss, (prediction.flow_px, claim), allow_unused=True)
        return float(loss.detach()), *found

    plain, flow, unseen = gradients(0.0)
    both, same, claim = gradients(0.3)
    prediction = field(0, torch.tensor([1.0, 0.0, 2.0])[:, None, None].repeat(4, 1, SIDE, SIDE))
    likelihood = float(laplace_loss([prediction], windows.truth, 0.8).detach())
    assert both == pytest.approx(plain + 0.3 * likelihood, rel=1e-6)
    assert torch.equal(flow, same)
    assert unseen is None
    assert float(claim.abs().min()) > 0


def test_windows_of_other_bins_than_the_network_are_refused():
    network = torch.nn.Conv2d(10, 2, 3)
    network.config = {"bins": 5}
    windows = Made().batch(range(4))
    given = windows.volume.counts.shape[2]
    with pytest.raises(ShapeError, match=f"windows have {given} time bins, the network 5"):
        flow_predictions(network, windows)


def test_windows_with_a_start_are_refined_from_it():
    class Refines(torch.nn.Module):
        def refined(self, volume, start, through):
            return [volume, start, through]

    windows = Made().batch(range(2))
    begun = replace(windows, start=field(3))
    assert flow_predictions(Refines(), begun) == [begun.volume, begun.start, False]
