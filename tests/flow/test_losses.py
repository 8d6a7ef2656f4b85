"""Losses against values worked out by hand, the true motion of moving dots, and finite
differences."""
# pyright: reportArgumentType=false

import math
from dataclasses import replace

import pytest
import torch

from codesign.flow import losses, metrics
from codesign.flow.export import evenly_timed
from codesign.types import FlowField
from tests.numbers import D, f64, rand64, randn64


def field(values, valid=None, **claims):
    """FlowField [B, 2, 1, N] of [B][N] pairs."""
    flow = f64(values).permute(0, 2, 1)[:, :, None]
    valid = (
        torch.ones_like(flow[:, 0], dtype=torch.bool)
        if valid is None
        else torch.tensor(valid)[:, None]
    )
    return FlowField(flow, valid, 0.05, **claims)


def check_gradients(function, *inputs):
    given = [value.clone().requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(function, given, eps=1e-6, atol=1e-8, rtol=1e-5)


# supervised


def test_charbonnier_by_hand():
    squared = f64([0.0, 9.0, 16.0])
    # sqrt(9 + 16) - 4
    assert losses.charbonnier(squared, 4.0).tolist() == pytest.approx([0, 1, math.sqrt(32) - 4])
    assert losses.charbonnier(squared, 4.0, 1.0).tolist() == pytest.approx([0, 9, 16])


TRUTH = field([[(0.0, 0.0), (1.0, 0.0)], [(0.0, 2.0), (9.0, 9.0)]], [[True, True], [True, False]])
FIRST = field([[(3.0, 0.0), (1.0, 0.0)], [(0.0, 0.0), (0.0, 0.0)]])
LAST = field([[(0.0, 3.0), (1.0, 3.0)], [(0.0, 2.0), (5.0, 5.0)]])


# epsilon 4: an error of 3 px costs 1, one of 2 px sqrt(20) - 4. FIRST: samples (1 + 0) / 2 and
# sqrt(20) - 4; LAST: (1 + 1) / 2 and 0
ONE = (0.5 + math.sqrt(20) - 4) / 2


@pytest.mark.parametrize(
    ("predictions", "options", "right"),
    [
        ([FIRST], {}, ONE),
        ([FIRST, LAST], {"gamma": 0.5}, (0.5 * ONE + 0.5) / 1.5),
        ([FIRST, FIRST, LAST], {"gamma": 0.5}, (0.75 * ONE + 0.5) / 1.75),
        # in half pixels: 6 of 8 costs sqrt(36 + 64) - 8 = 2, 4 of 8 costs sqrt(16 + 64) - 8
        ([FIRST], {"epsilon": 8.0, "unit_per_px": 2.0}, 2 * ONE),
        # 2 px of the second sample count 3
        ([FIRST], {"unit_per_px": f64([1.0, 1.5])}, (0.5 + 1) / 2),
    ],
)
def test_supervised_loss_by_hand(predictions, options, right):
    found = losses.supervised_loss(predictions, TRUTH, **{"epsilon": 4.0, **options})
    assert float(found) == pytest.approx(right)


def test_the_relative_unit_by_hand():
    # mean squared true lengths 1/2 and 4, and the floor of 1 px
    assert losses.relative_unit(TRUTH).tolist() == pytest.approx([1.5**-0.5, 5**-0.5])
    half = FlowField(torch.full((1, 2, 64, 64), 6.0).half(), torch.ones(1, 64, 64).bool(), 1.0)
    assert float(losses.relative_unit(half)) == pytest.approx(73**-0.5)
    far = torch.tensor([300.0, 30.0]).half()[:, None, None]
    angle = metrics.angular_error_deg(far, torch.tensor([300.0, 0.0]).half()[:, None, None])
    assert float(angle) == pytest.approx(math.degrees(math.atan2(30, math.hypot(300, 1))), rel=1e-3)


def test_samples_without_truth_count_zero_and_may_hold_anything():
    nan = math.nan
    truth = field(
        [[(nan, nan), (1.0, 0.0)], [(nan, 2.0), (math.inf, 9.0)]], [[False, True], [False, False]]
    )
    flow = FIRST.flow_px.clone().requires_grad_()
    loss = losses.supervised_loss([replace(FIRST, flow_px=flow + 1)], truth, epsilon=4.0)
    # the one error is (1, 1); the second sample adds 0 to the mean of two
    assert loss.item() == pytest.approx((math.sqrt(18) - 4) / 2)
    (grad,) = torch.autograd.grad(loss, flow)
    slope = 1 / math.sqrt(18) / 2
    assert grad.flatten().tolist() == pytest.approx([0, slope, 0, slope, 0, 0, 0, 0])


def test_gradcheck_of_the_supervised_losses(generator):
    flow = randn64(generator, 2, 2, 1, 2)
    factor = randn64(generator, 2, 3, 1, 2)
    confidence = rand64(generator, 2, 1, 2)

    def supervised(flow, unit=1.0):
        return losses.supervised_loss([FIRST, replace(LAST, flow_px=flow)], TRUTH, unit_per_px=unit)

    def claiming(flow, factor):
        a, b, c = factor.unbind(1)
        claim = torch.stack([a * a, a * b, b * b + c * c], 1)
        return losses.laplace_loss([replace(LAST, flow_px=flow, covariance_px2=claim)], TRUTH)

    def confident(flow, confidence):
        return losses.laplace_loss([replace(LAST, flow_px=flow, confidence=confidence)], TRUTH)

    check_gradients(lambda flow: supervised(flow, losses.relative_unit(TRUTH)), flow)
    check_gradients(supervised, TRUTH.flow_px)  # smooth at zero error
    check_gradients(claiming, flow, factor)
    check_gradients(confident, flow, confidence)


def test_long_tailed_likelihood_is_that_of_a_density_with_the_covariance_claimed(generator):
    """exp(-sqrt(3) |e|) integrated over the plane in polar coordinates has the second moment 1
    along each axis; with it the loss is the log density of errors whitened by the claim."""
    radius = torch.linspace(0, 40, 400_001, dtype=D)
    density = torch.exp(-math.sqrt(3) * radius) * radius
    moment = torch.trapezoid(density * radius**2, radius) / torch.trapezoid(density, radius)
    assert float(moment) == pytest.approx(2, rel=1e-8)
    factor = randn64(generator, 4, 2, 2) + torch.eye(2, dtype=D)
    matrix = factor @ factor.mT
    flow, truth = 3 * randn64(generator, 2, 1, 4, 2)
    claim = torch.stack([matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]])[None, :, None]
    spare = matrix + 0.0025 * torch.eye(2, dtype=D)
    white = torch.linalg.solve(torch.linalg.cholesky(spare), (flow - truth)[0][..., None])
    expected = (
        math.sqrt(3) * white.square().sum((-1, -2)).add(1e-4).sqrt() + torch.logdet(spare) / 2
    )
    found = losses.laplace_loss([field(flow.tolist(), covariance_px2=claim)], field(truth.tolist()))
    assert float(found) == pytest.approx(float(expected.mean()))


@pytest.mark.parametrize("confidence", [0.0, 0.9, 1.0])
def test_a_confidence_is_the_share_of_the_prior_that_the_events_have_removed(confidence):
    found = field([[(2.0, -2.0)]], confidence=torch.full((1, 1, 1), confidence, dtype=D))
    variance = 64 * (1 - confidence) + 0.0025
    right = math.sqrt(3) * math.sqrt(8 / variance + 1e-4) + math.log(variance)
    assert float(losses.laplace_loss([found], field([[(0.0, 0.0)]]))) == pytest.approx(right)


def test_a_degenerate_covariance_keeps_its_floor_in_single_precision():
    # fully correlated, 100 px: S = 1e4 [[1, 1], [1, 1]] + 0.0025 I has the determinant 6.25e-6 +
    # 0.0025 * 2e4; float32 loses it in xx yy - xy^2
    claim = torch.full((1, 3, 1, 1), 1e4)
    shape = (1, 2, 1, 1)
    truth = FlowField(torch.zeros(shape), torch.ones(1, 1, 1, dtype=torch.bool), 0.05)
    found = replace(truth, flow_px=torch.tensor([1.0, -1.0]).reshape(shape), covariance_px2=claim)
    # (1, -1) lies across the long axis
    right = math.sqrt(3 * 2 / 0.0025) + math.log(50) / 2
    assert float(losses.laplace_loss([found], truth)) == pytest.approx(right, rel=1e-5)


# frames


def test_photometric_loss_of_a_moved_picture(generator):
    wide = 255 * rand64(generator, 9, 14)
    # what is at x in the first is at x + 3 in the second
    frames = torch.stack([wide[:, 3:], wide[:, :-3]])[None]
    still = losses.charbonnier(((frames[:, 1] - frames[:, 0]) / 255).square(), 1e-3, 0.45)
    # the last three columns leave and keep their zero-flow difference; all others fit
    fitted = still[..., -3:].sum() / still.numel()
    for shift in (3.0, 1e3, -1e6, 0.0):
        right = fitted if shift == 3.0 else still.mean()
        flow = f64([shift, 0.0])[None, :, None, None].expand(1, 2, 9, 11)
        assert float(losses.photometric_loss(frames, flow)) == pytest.approx(float(right))


@pytest.mark.bits
def test_smoothness_of_a_ramp_by_hand():
    # u grows by 3 per column and v by 4 per row
    y, x = torch.meshgrid(torch.arange(4, dtype=D), torch.arange(5, dtype=D), indexing="ij")
    right = (9 + 1e-6) ** 0.45 + (16 + 1e-6) ** 0.45 - 2 * 1e-6**0.45
    assert float(losses.smoothness_loss(torch.stack([3 * x, 4 * y])[None])) == pytest.approx(right)
    # two powers that are equal but for their last bits, 1e-3^0.9 each and good to two units or so
    eps = torch.finfo(torch.float32).eps
    assert abs(losses.smoothness_loss(torch.ones(1, 2, 4, 5))) <= 4 * eps * 1e-3**0.9


def test_gradcheck_of_the_frame_losses(generator):
    frames = 255 * rand64(generator, 1, 2, 5, 6)
    flow = 2 * randn64(generator, 1, 2, 5, 6)  # some of it leaves the image
    check_gradients(lambda f, g: losses.photometric_loss(255 * g, f), flow, frames / 255)
    check_gradients(losses.smoothness_loss, flow)


def test_half_precision_predictions_lose_no_place(generator):
    # 0.25 px is exact in bfloat16, and so must the loss be: bfloat16 pixel numbers above 256 would
    # be two apart
    frames = 255 * torch.rand(1, 2, 3, 400, generator=generator)
    truth = FlowField(torch.zeros(1, 2, 3, 400), torch.ones(1, 3, 400, dtype=torch.bool), 0.05)
    volume = evenly_timed(torch.rand(1, 2, 2, 3, 400, generator=generator))
    for loss in (
        lambda flow: losses.photometric_loss(frames, flow),
        lambda flow: losses.smoothness_loss(flow),
        lambda flow: losses.contrast_loss(volume, flow),
        lambda flow: losses.supervised_loss([replace(truth, flow_px=flow)], truth),
        lambda flow: losses.laplace_loss(
            [replace(truth, flow_px=flow, confidence=flow[:, 0] + 0.5)], truth
        ),
    ):
        flow = torch.full((1, 2, 3, 400), 0.25)
        assert loss(flow.bfloat16()).item() == loss(flow).item()
