"""Losses against values worked out by hand, the true motion of moving dots, and finite differences."""

import math
from dataclasses import replace

import pytest
import torch

from codesign.errors import DomainError, ShapeError
from codesign.flow import losses
from codesign.types import EventVolume, FlowField

D = torch.float64


def field(values, valid=None, **claims):
    """FlowField [B, 2, 1, N] of [B][N] pairs."""
    flow = torch.tensor(values, dtype=D).permute(0, 2, 1)[:, :, None]
    valid = torch.ones_like(flow[:, 0], dtype=torch.bool) if valid is None else torch.tensor(valid)[:, None]
    return FlowField(flow, valid, 0.05, **claims)


def check_gradients(function, *inputs):
    assert torch.autograd.gradcheck(
        function, [value.clone().requires_grad_() for value in inputs], eps=1e-6, atol=1e-8, rtol=1e-5
    )


# supervised


def test_charbonnier_by_hand():
    squared = torch.tensor([0.0, 9.0, 16.0], dtype=D)
    assert losses.charbonnier(squared, 4.0).tolist() == pytest.approx(
        [0, 1, math.sqrt(32) - 4]
    )  # sqrt(9 + 16) - 4
    assert losses.charbonnier(squared, 4.0, 1.0).tolist() == pytest.approx([0, 9, 16])


TRUTH = field([[(0.0, 0.0), (1.0, 0.0)], [(0.0, 2.0), (9.0, 9.0)]], [[True, True], [True, False]])
FIRST = field([[(3.0, 0.0), (1.0, 0.0)], [(0.0, 0.0), (0.0, 0.0)]])
LAST = field([[(0.0, 3.0), (1.0, 3.0)], [(0.0, 2.0), (5.0, 5.0)]])


def test_supervised_loss_by_hand():
    # epsilon 4: an error of 3 px costs 1, one of 2 px sqrt(20) - 4. FIRST: samples (1 + 0) / 2 and sqrt(20) -
    # 4; LAST: (1 + 1) / 2 and 0
    first = (0.5 + math.sqrt(20) - 4) / 2
    last = 0.5
    assert float(losses.supervised_loss([FIRST], TRUTH, epsilon=4.0)) == pytest.approx(first)
    assert float(losses.supervised_loss([FIRST, LAST], TRUTH, gamma=0.5, epsilon=4.0)) == pytest.approx(
        (0.5 * first + last) / 1.5
    )
    three = [FIRST, FIRST, LAST]
    assert float(losses.supervised_loss(three, TRUTH, gamma=0.5, epsilon=4.0)) == pytest.approx(
        (0.75 * first + last) / 1.75
    )


@pytest.mark.parametrize("unit", [2.0, [2.0, 2.0], [[2.0, 2.0]], [[[2.0, 2.0]], [[2.0, 2.0]]]])
def test_units_scale_the_error_before_the_parabola(unit):
    # FIRST in half pixels: 6 of 8 costs sqrt(36 + 64) - 8 = 2, 4 of 8 costs sqrt(16 + 64) - 8: twice as much
    # as before
    found = losses.supervised_loss([FIRST], TRUTH, epsilon=8.0, unit_per_px=torch.tensor(unit, dtype=D))
    assert float(found) == pytest.approx(0.5 + math.sqrt(80) - 8 + 0.5 - 0.5 - (math.sqrt(80) - 8) / 2 + 0.0)


def test_one_unit_per_sample():
    found = losses.supervised_loss([FIRST], TRUTH, epsilon=4.0, unit_per_px=torch.tensor([1.0, 1.5], dtype=D))
    assert float(found) == pytest.approx((0.5 + 1) / 2)  # 2 px count 3
    # mean squared true lengths 1/2 and 4, and the floor of 1 px
    assert losses.relative_unit(TRUTH).tolist() == pytest.approx([1.5**-0.5, 5**-0.5])


def test_parts_of_a_batch_average_to_the_whole():
    def part(flow, k):
        return replace(flow, flow_px=flow.flow_px[k : k + 1], valid=flow.valid[k : k + 1])

    whole = losses.supervised_loss([FIRST, LAST], TRUTH)
    parts = [losses.supervised_loss([part(FIRST, k), part(LAST, k)], part(TRUTH, k)) for k in (0, 1)]
    torch.testing.assert_close(sum(parts) / 2, whole, rtol=1e-14, atol=0)


def test_samples_without_truth_count_zero_and_may_hold_anything():
    nan = math.nan
    truth = field([[(nan, nan), (1.0, 0.0)], [(nan, 2.0), (math.inf, 9.0)]], [[False, True], [False, False]])
    flow = FIRST.flow_px.clone().requires_grad_()
    loss = losses.supervised_loss([replace(FIRST, flow_px=flow + 1)], truth, epsilon=4.0)
    assert loss.item() == pytest.approx(
        (math.sqrt(18) - 4) / 2
    )  # the one error is (1, 1); the second sample adds 0 to the mean of two
    (grad,) = torch.autograd.grad(loss, flow)
    slope = 1 / math.sqrt(18) / 2
    assert grad.flatten().tolist() == pytest.approx([0, slope, 0, slope, 0, 0, 0, 0])
    with pytest.raises(DomainError, match=r"samples \[1\] have no pixel"):
        losses.require_valid(truth)
    assert losses.require_valid(TRUTH) is TRUTH


def test_gradcheck_of_the_supervised_losses(generator):
    flow = torch.randn(2, 2, 1, 2, generator=generator, dtype=D)
    factor = torch.randn(2, 3, 1, 2, generator=generator, dtype=D)
    confidence = torch.rand(2, 1, 2, generator=generator, dtype=D)

    def covariance(factor):
        a, b, c = factor.unbind(1)
        return torch.stack([a * a, a * b, b * b + c * c], 1)

    check_gradients(
        lambda f: losses.supervised_loss(
            [FIRST, replace(LAST, flow_px=f)], TRUTH, unit_per_px=losses.relative_unit(TRUTH)
        ),
        flow,
    )
    check_gradients(
        lambda f, k: losses.likelihood_loss([replace(LAST, flow_px=f, covariance_px2=covariance(k))], TRUTH),
        flow,
        factor,
    )
    check_gradients(
        lambda f, c: losses.likelihood_loss([replace(LAST, flow_px=f, confidence=c)], TRUTH), flow, confidence
    )
    check_gradients(
        lambda f: losses.supervised_loss([replace(LAST, flow_px=f)], TRUTH), TRUTH.flow_px
    )  # smooth at zero error


def test_likelihood_is_that_of_a_gaussian(generator):
    factor = torch.randn(1, 4, 2, 2, generator=generator, dtype=D)
    matrix = factor @ factor.mT
    flow, truth = torch.randn(2, 1, 4, 2, generator=generator, dtype=D)
    known = torch.distributions.MultivariateNormal(truth, matrix + 0.01 * torch.eye(2, dtype=D))
    expected = -known.log_prob(flow).mean() - math.log(2 * math.pi)
    claim = torch.stack([matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]], 1)[:, :, None]
    found = losses.likelihood_loss(
        [field(flow.tolist(), covariance_px2=claim)], field(truth.tolist()), floor_px=0.1
    )
    assert float(found) == pytest.approx(float(expected))


def test_long_tailed_likelihood_is_that_of_a_density_with_the_covariance_claimed(generator):
    """exp(-sqrt(3) |e|) integrated over the plane in polar coordinates has the mass 2 pi / 3 and the
    second moment 1 along each axis; with it the loss is the log density of errors whitened by the claim."""
    radius = torch.linspace(0, 40, 400_001, dtype=D)
    density = torch.exp(-math.sqrt(3) * radius) * 2 * math.pi * radius
    mass = float(torch.trapezoid(density, radius))
    assert mass == pytest.approx(2 * math.pi / 3, rel=1e-8)
    assert float(torch.trapezoid(density * radius**2, radius)) / mass == pytest.approx(2, rel=1e-8)
    factor = torch.randn(1, 4, 2, 2, generator=generator, dtype=D) + 3 * torch.eye(2, dtype=D)
    matrix = factor @ factor.mT
    flow, truth = 5 * torch.randn(2, 1, 4, 2, generator=generator, dtype=D)
    white = torch.linalg.solve(
        torch.linalg.cholesky(matrix + 0.0025 * torch.eye(2, dtype=D)), (flow - truth)[..., None]
    )
    expected = math.sqrt(3) * white.square().sum((-1, -2)).add(1e-4).sqrt()
    expected = (expected + torch.linalg.slogdet(matrix + 0.0025 * torch.eye(2, dtype=D))[1] / 2).mean()
    claim = torch.stack([matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]], 1)[:, :, None]
    found = losses.laplace_loss([field(flow.tolist(), covariance_px2=claim)], field(truth.tolist()))
    assert float(found) == pytest.approx(float(expected))


def test_likelihood_of_a_confidence_is_least_where_it_is_honest():
    # an error of e px per axis: (2 e^2 / s + 2 ln s) / 2 is least at s = e^2 = 64 (1 - c) + 0.01
    truth = field([[(0.0, 0.0)]])
    confidence = torch.tensor([[[1 - (4 - 0.01) / 64]]], dtype=D, requires_grad=True)
    loss = losses.likelihood_loss([field([[(2.0, -2.0)]], confidence=confidence)], truth)
    assert loss.item() == pytest.approx(1 + math.log(4))
    assert torch.autograd.grad(loss, confidence)[0].item() == pytest.approx(0, abs=1e-12)
    certain = losses.likelihood_loss([field([[(0.0, 0.0)]], confidence=torch.ones(1, 1, 1, dtype=D))], truth)
    assert float(certain) == pytest.approx(2 * math.log(0.1))  # the bound


def test_a_degenerate_covariance_keeps_its_floor_in_single_precision():
    # fully correlated, 100 px: S = 1e4 [[1, 1], [1, 1]] + 0.01 I has the determinant 1e-4 + 0.01 * 2e4;
    # float32 loses it in xx yy - xy^2
    claim = torch.full((1, 3, 1, 1), 1e4)
    shape = (1, 2, 1, 1)
    truth = FlowField(torch.zeros(shape), torch.ones(1, 1, 1, dtype=torch.bool), 0.05)
    found = losses.likelihood_loss(
        [FlowField(torch.tensor([1.0, -1.0]).reshape(shape), truth.valid, 0.05, covariance_px2=claim)], truth
    )
    assert float(found) == pytest.approx(
        (2 / 0.01 + math.log(1e-4 + 200)) / 2, rel=1e-5
    )  # (1, -1) lies across the long axis


# frames


def test_photometric_loss_of_a_moved_picture(generator):
    wide = 255 * torch.rand(9, 14, generator=generator, dtype=D)
    frames = torch.stack([wide[:, 3:], wide[:, :-3]])[
        None
    ]  # what is at x in the first is at x + 3 in the second
    flow = torch.tensor([3.0, 0.0], dtype=D)[None, :, None, None].expand(1, 2, 9, 11).contiguous()
    # the last three columns leave and keep their zero-flow difference; all others fit
    still = losses.charbonnier(((frames[:, 1] - frames[:, 0]) / 255).square(), 1e-3, 0.45)
    assert float(losses.photometric_loss(frames, flow)) == pytest.approx(
        float(still[..., -3:].sum() / still.numel())
    )
    for away in (1e3, -1e6):
        assert float(losses.photometric_loss(frames, torch.full_like(flow, away))) == pytest.approx(
            float(still.mean())
        )
    assert float(losses.photometric_loss(frames, torch.zeros_like(flow))) == pytest.approx(
        float(still.mean())
    )


@pytest.mark.bits
def test_smoothness_of_a_ramp_by_hand():
    # u grows by 3 per column and v by 4 per row: (9 + 16)^0.5 - 4 = 1 along x with epsilon 4, and (16 + 9)
    # ... along y: sqrt(16 + 16) - 4
    y, x = torch.meshgrid(torch.arange(4, dtype=D), torch.arange(5, dtype=D), indexing="ij")
    flow = torch.stack([3 * x, 4 * y])[None]
    assert float(losses.smoothness_loss(flow, epsilon=4.0, exponent=0.5)) == pytest.approx(
        1 + math.sqrt(32) - 4
    )
    edge = torch.zeros(1, 4, 5, dtype=D)
    edge[:, :, 2:] = (
        255 * 0.1 * math.log(2)
    )  # an edge between columns 1 and 2 that halves one of four differences in a row
    assert float(losses.smoothness_loss(flow, edge, epsilon=4.0, exponent=0.5)) == pytest.approx(
        3.5 / 4 + math.sqrt(32) - 4
    )
    # two powers that are equal but for their last bits, 1e-3^0.9 each and good to two units or so
    eps = torch.finfo(torch.float32).eps
    assert abs(float(losses.smoothness_loss(torch.ones(1, 2, 4, 5)))) <= 4 * eps * 1e-3**0.9


def test_gradcheck_of_the_frame_losses(generator):
    frames = 255 * torch.rand(1, 2, 5, 6, generator=generator, dtype=D)
    flow = 2 * torch.randn(1, 2, 5, 6, generator=generator, dtype=D)  # some of it leaves the image
    check_gradients(lambda f, g: losses.photometric_loss(255 * g, f, 0.1), flow, frames / 255)
    check_gradients(lambda f: losses.smoothness_loss(f, frames[:, 0], 0.1), flow)


def test_half_precision_predictions_lose_no_place(generator):
    # 0.25 px is exact in bfloat16, and so must the loss be: bfloat16 pixel numbers above 256 would be two
    # apart
    frames = 255 * torch.rand(1, 2, 3, 400, generator=generator)
    truth = FlowField(torch.zeros(1, 2, 3, 400), torch.ones(1, 3, 400, dtype=torch.bool), 0.05)
    volume = EventVolume(
        torch.rand(1, 2, 2, 3, 400, generator=generator), torch.tensor([0.0, 1.0]), torch.tensor([0.5, 0.5])
    )
    for loss in (
        lambda flow: losses.photometric_loss(frames, flow),
        lambda flow: losses.smoothness_loss(flow),
        lambda flow: losses.contrast_loss(volume, flow),
        lambda flow: losses.supervised_loss([replace(truth, flow_px=flow)], truth),
        lambda flow: losses.likelihood_loss(
            [replace(truth, flow_px=flow, confidence=flow[:, 0] + 0.5)], truth
        ),
    ):
        flow = torch.full((1, 2, 3, 400), 0.25)
        assert loss(flow.bfloat16()).item() == loss(flow).item()


TILTED = torch.tensor([1.0, 2.0, 1.0], dtype=D)[None, :, None, None].expand(2, 3, 1, 2)


@pytest.mark.parametrize(
    ("loss", "given", "error", "sentence"),
    [
        ("supervised_loss", ([], TRUTH), ShapeError, "no prediction"),
        (
            "supervised_loss",
            ([replace(FIRST, flow_px=FIRST.flow_px[..., :1])], TRUTH),
            ShapeError,
            r"must be \[2",
        ),
        ("supervised_loss", ([FIRST], TRUTH, 0.8, 0.01, torch.ones(3)), ShapeError, "unit_per_px must be"),
        ("likelihood_loss", ([FIRST], TRUTH), DomainError, "neither covariance_px2 nor confidence"),
        (
            "likelihood_loss",
            ([replace(FIRST, covariance_px2=TILTED)], TRUTH),
            DomainError,
            "not positive semi",
        ),
        (
            "likelihood_loss",
            ([replace(FIRST, confidence=1.5 + TILTED[:, 0])], TRUTH),
            DomainError,
            "outside 0 to 1",
        ),
        ("photometric_loss", (None, FIRST.flow_px), ShapeError, "frames must be"),
        ("smoothness_loss", (FIRST.flow_px, torch.zeros(1, 1, 2)), ShapeError, "the frame must be"),
    ],
)
def test_what_does_not_fit_is_refused(loss, given, error, sentence):
    with pytest.raises(error, match=sentence):
        getattr(losses, loss)(*given)
