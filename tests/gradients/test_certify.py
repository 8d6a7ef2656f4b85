"""The certificate itself: it must pass right gradients and fail wrong ones, by amounts that are known."""

import math

import pytest
import torch

from codesign.errors import GradientError
from codesign.grad import certify, plateau

D = torch.float64


class Scaled(torch.autograd.Function):
    """sin(x) whose gradient is wrong by a known factor."""

    @staticmethod
    def forward(ctx, x, factor):
        ctx.save_for_backward(x)
        ctx.factor = factor
        return x.sin()

    @staticmethod
    def backward(ctx, *grads):
        return grads[0] * ctx.saved_tensors[0].cos() * ctx.factor, None


def test_right_gradient_passes_with_the_plateau_between_bending_and_rounding():
    (row,) = certify(lambda p: p["x"].sin().sum(), {"x": torch.linspace(0.1, 1, 5, dtype=D)}, tolerance=1e-8)
    # central differences of sin: h^2/6 of bending and 1e-16/h of rounding meet near h = 1e-5, at about 1e-11
    assert row.verdict == "pass"
    assert row.relative_error < 1e-9
    assert row.cosine == pytest.approx(1, abs=1e-12)
    assert all(1e-6 < step < 1e-2 for step in row.step_plateau)


@pytest.mark.parametrize("factor", [0.9, 1.25, -1.0])
def test_wrong_scale_is_seen_as_bias_of_that_size(factor):
    (row,) = certify(lambda p: Scaled.apply(p["x"], factor).sum(), {"x": torch.linspace(0.1, 1, 5, dtype=D)})  # pyright: ignore[reportOptionalMemberAccess]
    assert row.verdict == "fail"
    assert row.signed_bias == pytest.approx(factor - 1, abs=1e-6)
    assert row.relative_error == pytest.approx(abs(factor - 1), abs=1e-6)
    assert row.cosine == pytest.approx(math.copysign(1, factor), abs=1e-6)


def test_scales_set_the_unit_of_every_number():
    (row,) = certify(lambda p: (2 * p["x"]).sum(), {"x": torch.zeros(1, dtype=D)}, scales={"x": 0.25})
    assert row.autograd == pytest.approx((0.5,))
    assert row.difference == pytest.approx((0.5,))


def test_noise_is_told_from_error():
    # A loss rounded to 1e-3 has differences good to about 1e-3 / h: on this ladder they cannot judge a
    # gradient of 1
    def noisy(p):
        return torch.round(p["x"].sum() * 1e3) / 1e3 + (p["x"].sum() - p["x"].sum().detach())

    (row,) = certify(
        noisy, {"x": torch.full((3,), 0.12345, dtype=D)}, ladder=(3e-3, 2e-3, 1.3e-3), tolerance=1e-6
    )
    assert row.verdict in ("noise", "pass")
    assert row.relative_error < 0.5


def test_cut_graph_is_refused():
    with pytest.raises(GradientError, match="does not depend on 'y'"):
        certify(lambda p: p["x"].sum(), {"x": torch.ones(2, dtype=D), "y": torch.ones(1, dtype=D)})


def test_plateau_of_a_cubic():
    # d/dx x^3 at 1: difference is 3 + h^2, so neighbouring rungs agree best at the smallest steps and the
    # floor is their half distance
    found = plateau(
        lambda x: x.pow(3).sum(), torch.ones(1, dtype=D), torch.ones(1, dtype=D), (1e-1, 1e-2, 1e-3)
    )
    assert found.value == pytest.approx(3 + (1e-4 + 1e-6) / 2, abs=1e-9)
    assert found.noise == pytest.approx((1e-4 - 1e-6) / 2, rel=1e-6)
