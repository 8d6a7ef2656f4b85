"""The parts of the closed-form estimator: fields and their prior, the noise model, and how well its
covariance says how large errors are."""

import math

import pytest
import torch

from codesign.flow import estimate_lk
from codesign.flow.lk import level, polynomials
from codesign.flow.lk.lanes import Grid
from codesign.types import EventVolume
from scenes.windows.rendered import RenderedWindows, planes
from tests.certain_case import certain

D = torch.float64


def nowhere(x_px, y_px):
    """No local part, known exactly."""
    return torch.zeros_like(torch.stack([x_px] * 2, 1)), torch.zeros_like(torch.stack([y_px] * 3, 1))


@pytest.mark.parametrize("model", ["affine", "quadratic"])
def test_step_to_the_start_solves_its_equation(model, generator):
    shape = polynomials.Polynomials(model, 20, 30)
    parameters = torch.randn(2, 2 * shape.terms, generator=generator, dtype=D) * 1.5
    flow, *_ = shape.at_start(parameters, torch.full((2,), -0.5, dtype=D), nowhere, False)
    # w(x) = v(x + w(x) / 2); the fixed point gains a factor of |grad v| / 2, some 0.3 for these wild fields,
    # in each of 4 steps
    y, x = torch.meshgrid(torch.arange(20, dtype=D), torch.arange(30, dtype=D), indexing="ij")
    basis = shape.basis(*shape.scaled(x + flow[:, 0] / 2, y + flow[:, 1] / 2), dim=1)
    again = torch.einsum("bck,bkhw->bchw", parameters.reshape(2, 2, -1), basis)
    assert float((again - flow).abs().max()) <= 0.3**4 * float(flow.abs().max())


def test_prior_and_its_spread_are_those_of_drawn_fields(generator):
    # fields drawn from the prior have the covariance that ``covariance`` gives; 20000 draws know a variance
    # to 1 %, tested at 5 standard errors
    shape = polynomials.Polynomials("quadratic", 8, 12)
    spread = torch.linalg.inv(shape.prior_precision(2.0))
    drawn = torch.randn(20000, 12, generator=generator, dtype=D) @ torch.linalg.cholesky(spread).T
    _, places, *_ = shape.at_start(
        torch.zeros(1, 12, dtype=D), torch.full((1,), -0.5, dtype=D), nowhere, False
    )
    flow = torch.einsum("nck,khw->nchw", drawn.reshape(-1, 2, 6), places[0])
    expected = shape.covariance(spread[None], places)[0]
    deviation = (flow - flow.mean(0)).square().mean(0)
    torch.testing.assert_close(deviation, expected[[0, 2]], rtol=0.05, atol=0)
    torch.testing.assert_close(
        (flow[:, 0] * flow[:, 1]).mean(0), expected[1], rtol=0, atol=0.05 * float(expected[0].max())
    )


def test_scattered_events_give_the_slopes_that_the_noise_model_says(generator):
    # unit noise per pixel behind a level's kernel: variance of a central difference, 160 x 160 samples;
    # neighbours within 4 pi sigma^2 are alike, so at sigma = 1 some 2000 and at sigma = 2 some 500
    # independent samples of 8 bins: 1 to 2 % in the variance, tested at 5 standard errors
    for sigma in (1.0, 2.0):
        noise = torch.randn(1, 8, 160, 160, generator=generator, dtype=D)
        step = level.stride(sigma)
        blurred = level.blurred_to(noise, sigma, Grid(160, 160, step))
        kernel = level._whole_kernel(sigma, step)
        dy, dx = torch.gradient(blurred[..., 3:-3, 3:-3], dim=(2, 3))
        found = float(((dx.square() + dy.square()) / 2)[..., 1:-1, 1:-1].mean()) / step**2
        assert found == pytest.approx(level._slope_of_noise(kernel, step), rel=0.1)
        assert float(blurred.square().mean()) == pytest.approx(
            1 / (4 * math.pi * sigma**2), rel=0.15
        )  # that of a Gaussian; its sampling costs up to 10 %


def test_squared_errors_are_those_of_the_covariance():
    # windows of photographs and speckle with hard events. Errors have tails (a wrong texture is a wrong
    # flow), so the mean is known to some 20 %; over kinds it runs from 0.4 to 1.7 (docs/flow_closed_form.md):
    # within a factor of 3 either way
    for kind in ("fine", "mixed"):
        windows = RenderedWindows(planes(kind, 0.2, (0.002, 0.002)), seed=11).batch(range(48))
        with torch.no_grad():
            field = certain(estimate_lk(windows.volume))
        error = field.flow_px - windows.truth.flow_px
        xx, xy, yy = field.covariance_px2.unbind(1)
        normalised = (yy * error[:, 0] ** 2 - 2 * xy * error[:, 0] * error[:, 1] + xx * error[:, 1] ** 2) / (
            2 * (xx * yy - xy**2)
        )
        assert 1 / 3 <= float(normalised.mean()) <= 3
        lengths = windows.truth.flow_px.norm(dim=1).mean((1, 2))
        assert float(error.norm(dim=1).mean()) <= {"fine": 0.23, "mixed": 0.55}[kind] * float(lengths.mean())
        assert float(field.confidence.min()) >= 0
        assert float(field.confidence.max()) < 1


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize(("name", "largest_px"), [("empty", 0.0), ("saturated", 0.01), ("constant", 0.01)])
def test_volumes_that_show_no_motion_give_none_and_finite_gradients(name, largest_px, dtype):
    # even counts have no slopes at all: next to no flow, with finite gradients of every output
    counts = torch.zeros(1, 2, 8, 32, 32, dtype=dtype)
    if name == "saturated":
        counts[:, 0] = 1e4
    if name == "constant":
        counts += 0.5
    counts.requires_grad_()
    share = torch.tensor([1, 2, 2, 2, 2, 2, 2, 1], dtype=D) / 14
    centroid = torch.tensor([1 / 21, *(k / 7 for k in range(1, 7)), 20 / 21], dtype=D)
    volume = EventVolume(counts * share.to(dtype)[:, None, None] * 8, centroid, share)
    field = certain(estimate_lk(volume))
    assert float(field.flow_px.detach().abs().max()) <= largest_px
    for value in (
        field.flow_px.sum(),
        field.flow_px.square().sum(),
        field.confidence.sum(),
        field.covariance_px2.sum(),
    ):
        (gradient,) = torch.autograd.grad(value, counts, retain_graph=True)
        assert bool(gradient.isfinite().all())
        if name == "empty":
            assert not gradient.any()
