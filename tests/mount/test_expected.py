"""The error to be expected, against drawn flow errors; the trend of precision, against laws that it
has to find."""

from dataclasses import replace

import pytest
import torch

from codesign.mount import (
    PLANAR,
    EgoVelocity,
    FlowErrors,
    PrecisionTrend,
    Readings,
    expected_errors,
)
from tests.numbers import D, f64, rand64, randn64, seeded

UNIT = torch.eye(2, dtype=D)


def readings(count=1, points=40, axes=3, seed=0):
    """Independent points with rows, precisions and confidences drawn at random."""
    random = seeded(seed)
    rows = randn64(random, count, points, 2, axes)
    root = 0.3 * randn64(random, count, points, 2, 2)
    precision = torch.linalg.inv(root @ root.mT + 0.1 * UNIT)
    confidence = 0.5 + 0.5 * rand64(random, count, points)
    depth = 0.2 + 2 * rand64(random, count, points)
    flow = torch.zeros(count, points, 2, dtype=D)
    return Readings(
        flow, flow, precision, confidence, depth, rows, torch.ones(count, points, dtype=D), 1
    )


def estimator(**how):
    return EgoVelocity(PLANAR, (1.0, 0.5, 2.0), **how)


TWIST = f64([[0.8, 0.3, 0.0, 0.0, 0.0, -0.6]])


def drawn_errors(ours, read, true_rows, errors, draws=40_000):
    """Errors [draws, 3] of least squares on flow c J v + e, the errors drawn from the model."""
    velocity = TWIST[:, list(ours.axes)]
    flow = (true_rows @ velocity[:, None, :, None])[..., 0]
    root = torch.linalg.cholesky(errors.covariance(read, flow))
    deviate = randn64(seeded(1), draws, *flow.shape[1:])
    seen = read.confidence[..., None] * flow + (root @ deviate[..., None])[..., 0]
    many = {
        name: getattr(read, name).expand(draws, *getattr(read, name).shape[1:]) for name in READ
    }
    return ours.solve(replace(read, flow_px=seen, **many)).velocity - velocity


READ = ("pixels", "precision", "confidence", "depth_m", "rows", "share")


@pytest.mark.parametrize("wrong", [False, True], ids=["true depth", "wrong depth"])
def test_mean_and_covariance_are_those_of_drawn_flow(wrong):
    ours = estimator(outlier=None)
    read = readings()
    true_rows = 1.15 * read.rows if wrong else read.rows
    errors = FlowErrors(claimed=0.8, share=0.2, reach_px=1.5, width_px=0.4)
    found = expected_errors(ours, read, TWIST, true_rows, errors)
    drawn = drawn_errors(ours, read, true_rows, errors)
    noise = (found.covariance[0].diagonal() / len(drawn)).sqrt()
    assert ((drawn.mean(0) - found.mean[0]).abs() < 4 * noise).all()
    assert torch.allclose(
        drawn.T.cov(), found.covariance[0], rtol=0.05, atol=0.03 * float(found.covariance.max())
    )
    assert torch.allclose(drawn.square().mean(0), found.squared[0], rtol=0.04)


def test_points_that_fit_worse_than_they_claim_count_less():
    """As in the estimator itself: a point of wrong depth, far beyond its claim, moves the mean
    little."""
    read = readings()
    true_rows = read.rows.clone()
    true_rows[:, :4] *= 30.0
    plain = expected_errors(estimator(outlier=None), read, TWIST, true_rows)
    robust = expected_errors(estimator(outlier=3.0), read, TWIST, true_rows)
    assert robust.mean.norm() < 0.1 * plain.mean.norm()


def test_gradient_is_that_of_differences():
    read = readings(count=2, seed=3)

    def value(x):
        moved = replace(
            read, rows=read.rows * (1 + 0.3 * x[0]), precision=read.precision * x[1].exp()
        )
        moved = replace(moved, confidence=read.confidence * (1 - 0.2 * x[2]))
        return expected_errors(estimator(), moved, TWIST.expand(2, 6), read.rows).squared.sum()

    at = torch.tensor([0.1, -0.2, 0.3], dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(value, at, eps=1e-6, rtol=1e-6, atol=1e-12)


def test_lost_flow_has_half_its_length_squared():
    """Far beyond the reach nothing of a flow is left: its error is the flow itself, half of the
    square in either component."""
    read = readings(points=3)
    flow = f64([[[3.0, 4.0], [0.1, 0.0], [100.0, 0.0]]])
    found = FlowErrors(claimed=0.0, share=0.0, reach_px=20.0, width_px=0.5).covariance(read, flow)
    assert found[0, 2].diagonal().tolist() == pytest.approx([5000.0, 5000.0])
    assert found[0, :2].max() < 1e-6


def lawful(seed=0, noise=0.5):
    """Readings whose precision goes with flow to the power 0.8 and depth to the power -1, times
    what the texture says."""
    random = seeded(seed)
    length = (6 * rand64(random, 20, 200) - 1.5).exp()
    depth = (2 * rand64(random, 20, 200) - 1.5).exp()
    texture = (noise * randn64(random, 20, 200)).exp()
    precision = ((length + 0.5) ** 0.8 * (1 / depth + 0.3) ** 1.0 * texture)[..., None, None] * UNIT
    confidence = torch.sigmoid(0.5 * (length + 0.5).log() + 0.3 * randn64(random, 20, 200))
    flow = torch.stack([length, torch.zeros_like(length)], -1)
    zero = torch.zeros_like(flow)
    share = torch.ones_like(length)
    return Readings(zero, zero, precision, confidence, depth, zero[..., None], share, 1), flow


def test_the_trend_is_found_through_the_texture():
    read, flow = lawful()
    trend = PrecisionTrend().add(read, flow)
    grown = torch.ones((), dtype=D, requires_grad=True)
    moved = trend.followed(replace(read, depth_m=read.depth_m / grown), flow * grown)
    assert torch.equal(moved.precision.detach(), read.precision)
    assert torch.allclose(moved.confidence.detach(), read.confidence, rtol=1e-9)
    sizes = 0.5 * torch.logdet(moved.precision)
    (slope,) = torch.autograd.grad(sizes.mean(), grown, retain_graph=True)
    length, near = flow[..., 0], 1 / read.depth_m
    law = (0.8 * length / (length + 0.5) + near / (near + 0.3)).mean()
    assert float(slope) == pytest.approx(float(law), rel=0.05)
    (odds,) = torch.autograd.grad((moved.confidence / (1 - moved.confidence)).log().mean(), grown)
    assert float(odds) == pytest.approx(float((0.5 * length / (length + 0.5)).mean()), rel=0.08)


def test_precision_is_carried_to_another_place():
    """From where all is twice as near and twice as fast the same textures are told as the law says;
    a window that showed nothing from here takes the texture of its neighbour, not that of all."""
    whole, flow = lawful()
    trend = PrecisionTrend().add(whole, flow)
    # bodies whose world has more texture than the law's
    rich = (torch.arange(20) % 2 == 0).to(D)[:, None]
    told = whole.precision * (1 + 4 * rich)[..., None, None]
    pixels = torch.cat([torch.zeros(20, 100, 2), torch.full((20, 100, 2), 50.0)], 1).to(D)
    here = replace(whole, precision=told, pixels=pixels, windows=2, share=whole.share.clone())
    here.share[:, 100:] = 0
    there = replace(whole, depth_m=whole.depth_m / 2, windows=2)
    truth = told * (((2 * flow[..., 0] + 0.5) / (flow[..., 0] + 0.5)) ** 0.8)[..., None, None]
    truth = truth * ((2 / whole.depth_m + 0.3) / (1 / whole.depth_m + 0.3))[..., None, None]
    found = trend.carried(here, trend.told(here, flow), there, trend.told(there, 2 * flow))
    assert found.depth_m is there.depth_m
    wrong = 0.5 * (torch.logdet(found.precision) - torch.logdet(truth))
    assert wrong[:, :100].abs().max() < 0.25  # the trend's third order against the law
    assert wrong[:, :100].mean().abs() < 0.02
    # of 100 points' textures
    assert wrong[:, 100:].mean(1).tolist() == pytest.approx([0.0] * 20, abs=0.25)
    odds = [(each / (1 - each)).log()[:, :100] for each in (found.confidence, whole.confidence)]
    law = 0.5 * ((2 * flow[..., 0] + 0.5) / (flow[..., 0] + 0.5)).log()[:, :100]
    assert (odds[0] - odds[1] - law).mean().abs() < 0.05


def test_what_the_body_covers_is_found_through_the_texture():
    """Windows of ten points whose precision falls by e to the power of four times what is covered
    of them."""
    read, flow = lawful(noise=0.3)
    random = seeded(4)
    covered = rand64(random, 20, 20) * (rand64(random, 20, 20) > 0.5)
    fall = (-4 * covered).exp().repeat_interleave(10, 1)[..., None, None]
    windows = replace(read, windows=20, precision=read.precision * fall)
    trend = PrecisionTrend().add(windows, flow, covered)
    more = covered.clone().requires_grad_()
    sizes = 0.5 * torch.logdet(trend.followed(windows, flow, more).precision)
    (slope,) = torch.autograd.grad(sizes.mean(), more)
    assert float(slope.sum()) == pytest.approx(-4.0, rel=0.05)


def test_points_without_a_surface_are_left_out():
    read, flow = lawful()
    half = torch.ones_like(read.share)
    half[:, ::2] = 0
    wild = torch.where(half[..., None, None] > 0, read.precision, 1e6 * UNIT)
    seen = {name: getattr(read, name)[:, 1::2] for name in (*READ, "flow_px")}
    torch.testing.assert_close(
        PrecisionTrend().add(replace(read, share=half, precision=wild), flow)._coefficients(),
        PrecisionTrend().add(replace(read, **seen), flow[:, 1::2])._coefficients(),
    )


def test_a_trend_without_surfaces_is_flat():
    read = readings()
    flow = rand64(seeded(0), 1, 40, 2)
    flow = flow.requires_grad_()
    covered = replace(read, share=torch.zeros_like(read.share))
    followed = PrecisionTrend().add(covered, flow.detach()).followed(covered, flow)
    (slope,) = torch.autograd.grad(followed.precision.sum(), flow)
    assert not slope.any()
    assert torch.equal(followed.precision, read.precision)
