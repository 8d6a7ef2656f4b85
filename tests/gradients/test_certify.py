"""The certificate itself: it must pass right gradients and fail wrong ones, by amounts that are
known."""

import math
from pathlib import Path

import pytest
import torch

from codesign.grad import certify
from codesign.grad.differences import Ladder, rounding_noise
from codesign.grad.row import verdict
from tests.gradients.wrong_case import certified, grad_of
from tests.numbers import D, seeded


def test_right_gradient_passes_with_the_plateau_between_bending_and_rounding():
    (row,) = certify(
        lambda p: p["x"].sin().sum(), {"x": torch.linspace(0.1, 1, 5, dtype=D)}, tolerance=1e-8
    )
    # central differences of sin: h^2/6 of bending and 1e-16/h of rounding meet near h = 1e-5, at
    # about 1e-11
    assert row.verdict == "pass"
    assert row.relative_error < 1e-9
    assert row.cosine == pytest.approx(1, abs=1e-12)
    assert all(1e-6 < step < 1e-2 for step in row.step_plateau)


@pytest.mark.parametrize("factor", [0.9, 1.25, -1.0])
def test_wrong_scale_is_seen_as_bias_of_that_size(factor):
    def sines(p):
        x = p["x"]
        return (x.sin() + (factor - 1) * x.detach().cos() * (x - x.detach())).sum()

    (row,) = certify(sines, {"x": torch.linspace(0.1, 1, 5, dtype=D)})
    assert row.verdict == "fail"
    assert row.signed_bias == pytest.approx(factor - 1, abs=1e-6)
    assert row.relative_error == pytest.approx(abs(factor - 1), abs=1e-6)
    assert row.cosine == pytest.approx(math.copysign(1, factor), abs=1e-6)


def test_scales_set_the_unit_of_every_number():
    (row,) = certify(
        lambda p: (2 * p["x"]).sum(), {"x": torch.zeros(1, dtype=D)}, scales={"x": 0.25}
    )
    assert row.autograd == pytest.approx((0.5,))
    assert row.difference == pytest.approx((0.5,))


def on_a_thousand(seed, longer):
    """A mean of squares on top of 1,000 in single precision, whose gradient is longer by a
    share."""
    generator = seeded(seed)
    weight = torch.rand(12, 12, generator=generator)
    x = 2 * torch.rand(12, 12, generator=generator) - 1

    def fn(x):
        return 1e3 + (weight * x.square()).mean()

    return certified(fn, x, longer * grad_of(fn, x), directions=4, generator=generator)


@pytest.mark.parametrize("error", [0.0, 0.03, -0.07])
@pytest.mark.parametrize("offset", [1.0, 1e2, 1e3, 1e4])
def test_single_precision_returned_in_double_is_judged_as_single_precision(offset, error):
    for seed in range(5):

        def fn(p):
            x = p["x"] + error * (p["x"] - p["x"].detach())
            return 0.01 * x.float().square().sum() + offset

        x = {"x": torch.randn(3, generator=seeded(seed)).double()}
        (single,), (double,) = certify(fn, x), certify(lambda p, fn=fn: fn(p).double(), x)
        assert double.verdict == single.verdict
        assert offset > 1e2 or double.verdict == ("fail" if error else "pass")
    (row,) = certify(lambda p: offset + 0 * p["x"].sum(), x)
    assert row.verdict == "pass"


def test_the_weights_of_a_network_with_kinks():
    verdicts = {"right": [], "wrong": []}
    for seed in range(4):
        generator = seeded(seed)
        image = torch.rand(2, 1, 12, 12, generator=generator)
        weights = torch.randn(4 * 9 + 2 * 4 * 9, generator=generator) / 3

        def fn(x, image=image):
            hidden = torch.nn.functional.conv2d(image, x[:36].view(4, 1, 3, 3)).relu()
            return torch.nn.functional.conv2d(hidden, x[36:].view(2, 4, 3, 3)).square().mean()

        grad = grad_of(fn, weights)
        noise = torch.randn(grad.shape, generator=generator)
        turned = noise - (noise @ grad) / (grad @ grad) * grad
        # a flipped sign is an error of twice its size: those of the smallest, up to 0.3 in all
        order = grad.abs().argsort()
        flipped = torch.zeros_like(grad)
        few = order[grad[order].square().cumsum(0).sqrt() < 0.15 * grad.norm()]
        flipped[few] = -2 * grad[few]
        errors = (-0.3 * grad, 0.3 * grad, 0.3 * turned * grad.norm() / turned.norm(), flipped)
        verdicts["right"].append(certified(fn, weights, 0 * grad, generator=generator).verdict)
        verdicts["wrong"].append(certified(fn, weights, errors[seed], generator=generator).verdict)
    assert verdicts == {"right": ["pass"] * 4, "wrong": ["fail"] * 4}


def test_a_small_signal_on_a_large_constant_is_noise_and_never_judged_wrongly():
    # one unit in the last place of 1000 is 6e-5; the mean of 144 squares moves by some 1e-4 along a
    # random direction of length 0.1, so four directions know the gradient to some ten percent and
    # no better
    right = [on_a_thousand(seed, 0.0) for seed in range(40)]
    assert {row.verdict for row in right} <= {"pass", "noise"}
    assert all(row.noise_floor > 0.01 for row in right)
    # a wrong length shows along the gradient itself, where the signal is twelve times as large
    wrong = [on_a_thousand(seed, 0.3) for seed in range(40)]
    assert "pass" not in {row.verdict for row in wrong}
    decided = [row for row in wrong if row.verdict == "fail"]
    assert len(decided) >= 30
    # the floor along the gradient is below 2 %, so three of them are 0.06
    assert all(
        row.length_bias == pytest.approx(0.3, abs=0.06)
        for row in decided
        if row.length_bias is not None
    )


@pytest.mark.parametrize("directions", [None, 4])
@pytest.mark.parametrize(
    ("fn", "at"), [(torch.relu, -1.0), (torch.square, 0.0), (lambda x: 1e3 + x.square(), 0.0)]
)
def test_nothing_against_nothing_passes(fn, at, directions):
    (row,) = certify(lambda p: fn(p["x"]).sum(), {"x": torch.full((3,), at)}, directions=directions)
    assert row.verdict == "pass"
    assert (row.relative_error, row.cosine, row.signed_bias) == (0.0, 1.0, 0.0)


def test_a_gradient_where_the_function_stands_still_fails():
    def straight_through(p):
        return (p["x"].round() + p["x"] - p["x"].detach()).sum()

    (row,) = certify(straight_through, {"x": torch.full((3,), 0.2)})
    assert (row.verdict, row.relative_error, row.signed_bias) == ("fail", 1.0, math.inf)
    assert row.noise_floor == 0  # every value is exactly zero


def test_rounding_noise_is_measured():
    # rounding to multiples of 1e-3, many of them apart: errors uniform in +-5e-4, 2.9e-4 rms; nine
    # points tell it within a factor of two
    def rounded(x):
        return (1e3 * (x.square().sum() + x.sum())).round() / 1e3

    found = rounding_noise(rounded, torch.ones(3, dtype=D), torch.ones(3, dtype=D), 0.0137)
    assert found == pytest.approx(1e-3 / 12**0.5, rel=1.0, abs=0)
    assert found > 1e-3 / 12**0.5 / 2
    assert (
        rounding_noise(
            lambda x: x.pow(3).sum(), torch.ones(3, dtype=D), torch.ones(3, dtype=D), 1e-3
        )
        < 1e-14
    )


def test_ladder_of_a_cubic_is_exact():
    # differences of x^3 are 3 + h^2, and two of them free of h^2
    ladder = Ladder(lambda x: x.pow(3).sum(), torch.ones(1, dtype=D), torch.ones(1, dtype=D))
    ladder.take((1e-1, 1e-2, 1e-3))
    found = ladder.difference()
    assert found.value == pytest.approx(3, abs=1e-12)
    assert [d for _, d in found.ladder] == pytest.approx([3.01, 3.0001, 3.000001], abs=1e-12)
    assert abs(found.value - 3) <= 3 * found.noise


def test_steps_out_of_the_domain_are_left_out_and_named():
    (row,) = certify(lambda p: p["x"].sqrt().sum(), {"x": torch.full((2,), 5e-3, dtype=D)})
    assert row.left_out == (0.01,)
    assert row.verdict == "pass"


def test_directions_are_the_same_at_every_call():
    x = {"x": torch.rand(20, dtype=D)}
    first, again = (certify(lambda p: p["x"].exp().sum(), x, directions=3)[0] for _ in range(2))
    assert first == again
    assert len(first.difference) == 3


def test_the_stages_of_the_page_are_certified():
    # docs/certify.md: an event layer, a lens layer and a network; test_chain has a chain
    page = (Path(__file__).parents[2] / "docs" / "certify.md").read_text(encoding="utf-8")
    blocks = page.split("```python\n")[1:4]
    names = {}
    for block in blocks:
        exec(block.split("```")[0], names)
        if "rows" in names:
            assert {row.verdict for row in names["rows"]} == {"pass"}
    assert [row.name for row in names["rows"]] == [
        "0.weight",
        "0.bias",
        "2.weight",
        "2.bias",
        "input",
    ]


def test_the_best_pair_weighs_rounding_against_what_is_left_of_truncation():
    # (4 x 1.01 - 1.04) / 3 = 1, known to hypot(4 x 0.02, 0.02) / 3 by rounding; it moved 1.01 by
    # 0.01
    ladder = Ladder(torch.sum, torch.ones(1, dtype=D), torch.ones(1, dtype=D))
    ladder.rungs = [(0.2, 1.04, 0.02), (0.1, 1.01, 0.02)]
    found = ladder.difference()
    assert (found.value, found.step) == (pytest.approx(1.0), 0.1)
    assert found.noise == pytest.approx(math.hypot(0.02 * 17**0.5 / 3, 0.01))


def test_rungs_that_agree_by_accident_are_contradicted_by_smaller_ones():
    # differences of x + c x^3 + e x^5 at 0 are 1 + c h^2 + e h^4, alike at 0.4 and 0.2 for
    # c = -e (0.4^2 + 0.2^2); there they are 1 - e 0.4^2 0.2^2 = 0.968
    ladder = Ladder(
        lambda x: (x - x**3 + 5 * x**5).sum(), torch.zeros(1, dtype=D), torch.ones(1, dtype=D)
    )
    ladder.take((0.4, 0.2, 0.1, 0.05))
    found = ladder.difference()
    assert [d for _, d in found.ladder[:2]] == pytest.approx([0.968, 0.968])
    assert abs(found.value - 1) <= found.noise < 0.01


@pytest.mark.parametrize(
    ("gap", "noise", "tolerance", "expected"),
    [
        (0.02, 0.0, 0.01, "fail"),  # plainly above the tolerance
        (0.05, 0.013, 0.01, "fail"),  # by more than three noise floors
        (0.05, 0.014, 0.01, "pass"),  # by less, and 0.05 + 0.042 is below ten tolerances
        (0.05, 0.017, 0.01, "noise"),  # 0.05 + 0.051 is above them
        (0.0, 0.034, 0.01, "noise"),
        (0.0, 0.033, 0.01, "pass"),
        (0.0, 0.034, 0.05, "noise"),  # ten tolerances are 0.5, of which no more than 0.1 count
        (0.1, 0.03, 0.2, "pass"),
        (0.1, 0.034, 0.2, "noise"),  # above a tolerance of 0.2
        (0.0, 1e-5, 1e-6, "noise"),
        (1.0, 0.5, 0.01, "noise"),
    ],
)
def test_the_verdict_is_a_statement_at_three_noise_floors(gap, noise, tolerance, expected):
    assert verdict(gap, 1.0, noise, tolerance) == expected
    assert verdict(10 * gap, 10.0, 10 * noise, tolerance) == expected


def test_larger_steps_that_the_function_refuses_are_left_out():
    def loss(p):
        if bool((p["x"] - 0.5).abs().max() > 0.02):
            raise ValueError("out of range")
        return 1e4 + p["x"].square().sum()

    (row,) = certify(loss, {"x": torch.full((2,), 0.5)})
    assert row.left_out[:2] == pytest.approx((10**-1.0, 10**-1.5))
    assert row.verdict != "fail"
    with pytest.raises(ValueError, match="out of range"):
        certify(loss, {"x": torch.full((2,), 0.5)}, ladder=(0.1, 0.01))  # these were asked for


def test_a_step_is_what_rounding_of_the_parameter_leaves_of_it():
    # numbers near 1000 are 6.1e-5 apart in single precision: 1e-4 becomes twice that, and 1e-5
    # nothing
    ladder = Ladder(lambda x: x.double().sum(), torch.full((1,), 1e3), torch.ones(1))
    ladder.take((1e-4, 1e-5))
    found = ladder.difference()
    assert found.value == pytest.approx(1.0, abs=1e-9)
    assert found.left_out == (1e-5,)
