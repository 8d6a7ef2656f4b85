"""Ways to a gradient: which is chosen where autograd is right or wrong by construction, and what each gives, against
closed forms."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from codesign.errors import DomainError, GradientError, NonFiniteError, ShapeError
from codesign.grad import Choice, choose, gradient

D = torch.float64
DRAWS = range(30)
EVOLUTION = Choice("evolution", 1.0, 0.0, 0.1, 2 * 4000)
DIFFERENCES = Choice("differences", 1.0, 0.0, 0.1, 0)
AUTOGRAD = Choice("autograd", 0.0, 1.0, 0.1, 0)


class Flipped(torch.autograd.Function):
    """x with a gradient of the wrong sign."""

    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, *grads):
        return -grads[0]


def flipped(x):
    return Flipped.apply(x)


def centre(draw, count):
    """Of a draw's quadratic: normal about zero."""
    return torch.randn(count, generator=torch.Generator().manual_seed(draw), dtype=D)


def quadratic(x, draw):
    """Mean over draws: gradient 2 (x - mean of the centres); differences of it are exact at any step."""
    return (x - centre(draw, x.numel()).reshape(x.shape)).square().sum()


def slope(x):
    mean = torch.stack([centre(draw, x.numel()) for draw in DRAWS]).mean(0)
    return 2 * (x - mean.reshape(x.shape))


POINT = {"right": torch.tensor([3.0, -2.0], dtype=D), "wrong": torch.tensor([[4.0], [5.0], [-4.0]], dtype=D)}
SCALES = {"right": 0.5, "wrong": 0.5}


def half_wrong(p, draw):
    return quadratic(p["right"], draw) + quadratic(flipped(p["wrong"]), draw)


def test_a_group_is_kept_where_autograd_is_right_and_goes_by_differences_where_it_is_not():
    chosen = choose(half_wrong, POINT, DRAWS, scales=SCALES)
    assert {name: choice.way for name, choice in chosen.items()} == {
        "right": "autograd",
        "wrong": "differences",
    }
    assert chosen["right"].relative_l2 < 1e-12
    assert chosen["right"].cosine == pytest.approx(1, abs=1e-12)
    assert chosen["wrong"].relative_l2 == pytest.approx(2, abs=1e-12)
    assert chosen["wrong"].cosine == pytest.approx(-1, abs=1e-12)
    assert chosen["right"].calls == 0
    assert chosen["wrong"].calls == 6
    for name, choice in chosen.items():
        x = POINT[name]
        centres = torch.stack([centre(draw, x.numel()) for draw in DRAWS])
        spread = (
            2 * centres.std(0).norm() / math.sqrt(len(DRAWS))
        )  # slopes of draws spread as their centres do
        assert choice.noise == pytest.approx(float(spread / slope(x).norm()), rel=1e-12)
    found = torch.stack([gradient(half_wrong, POINT, chosen, draw, scales=SCALES)["wrong"] for draw in DRAWS])
    torch.testing.assert_close(found.mean(0), slope(POINT["wrong"]), rtol=0, atol=1e-12)
    assert str(chosen["wrong"]) == (
        "differences, 6 calls a draw: autograd is off by 200.0% (cosine -1.000), differences are known to "
        f"{chosen['wrong'].noise:.1%}"
    )


@pytest.mark.parametrize("cut", ["this group", "everything"])
def test_a_cut_graph_is_a_gradient_of_zero(cut):
    def loss(p, draw):
        held = p["right"].detach() if cut == "everything" else p["right"]
        return quadratic(held, draw) + quadratic(p["wrong"].detach(), draw)

    chosen = choose(loss, POINT, DRAWS, scales=SCALES)
    assert chosen["wrong"].way == "differences"
    assert chosen["wrong"].relative_l2 == pytest.approx(1)
    assert chosen["right"].way == ("differences" if cut == "everything" else "autograd")


def test_a_gradient_that_is_not_finite_is_not_kept():
    def loss(p, draw):
        return (p["x"] - 1).square().sqrt().sum() * 0 + quadratic(p["x"], draw)

    chosen = choose(loss, {"x": torch.tensor([1.0, 3.0], dtype=D)}, DRAWS, scales={"x": 0.1})
    assert chosen["x"].way == "differences"
    assert math.isnan(chosen["x"].relative_l2)


def counted(p, draw):
    """A hard count: 1 where x exceeds a threshold of the draw; thresholds are even over 0..1, so the mean over n draws is
    x, of slope 1, while no draw has a slope."""
    return (p["x"] > (draw + 0.5) / p["draws"][0]).to(D).sum()


def ramp(p, draw):
    """The same with a slope of 1 / 0.4 within 0.2 of the threshold: right on the average, never for a draw."""
    return ((p["x"] - (draw + 0.5) / p["draws"][0]) / 0.4 + 0.5).clamp(0, 1).sum()


def fixed(loss, draws):
    return lambda p, draw: loss({**p, "draws": (draws,)}, draw)


def test_steps_that_only_draws_smooth_go_by_differences_once_these_are_known():
    """Over 2 h = 0.2 a draw's threshold is crossed in a share 0.2 of draws, where the difference is 5: mean 1, variance
    25 x 0.2 x 0.8 n / (n - 1) = 4 n / (n - 1)."""
    point = {"x": torch.tensor([0.47], dtype=D)}
    for draws, way in ((200, "differences"), (20, "evolution")):
        (chosen,) = choose(fixed(counted, draws), point, range(draws), scales={"x": 0.1}).values()
        assert chosen.way == way
        assert chosen.noise == pytest.approx(math.sqrt(4 / (draws - 1)), rel=1e-12)
        assert chosen.relative_l2 == pytest.approx(1)


def test_a_surrogate_is_kept_where_its_mean_is_that_of_the_hard_judge():
    point = {"x": torch.tensor([0.47], dtype=D)}
    hard = fixed(counted, 200)
    (chosen,) = choose(fixed(ramp, 200), point, range(200), scales={"x": 0.1}, judge=hard).values()
    assert chosen.way == "autograd"
    assert chosen.relative_l2 < 1e-12
    twice = fixed(lambda p, draw: 2 * ramp(p, draw), 200)
    (chosen,) = choose(twice, point, range(200), scales={"x": 0.1}, judge=hard).values()
    assert (chosen.way, chosen.relative_l2, chosen.cosine) == (
        "differences",
        pytest.approx(1),
        pytest.approx(1),
    )
    found = [gradient(twice, point, {"x": chosen}, k, scales={"x": 0.1}, judge=hard) for k in range(200)]
    assert float(sum(each["x"] for each in found)) / 200 == pytest.approx(1)


def test_a_large_group_is_looked_at_in_random_directions():
    x = 5 + torch.arange(40, dtype=D).reshape(5, 8)
    kept = choose(lambda p, draw: quadratic(p["x"], draw), {"x": x}, DRAWS, scales={"x": 0.3})["x"]
    assert kept.way == "autograd"
    assert kept.relative_l2 < 1e-12
    lost = choose(
        lambda p, draw: quadratic(flipped(p["x"]), draw), {"x": x}, DRAWS, scales={"x": 0.3}, pairs=7
    )["x"]
    assert (lost.way, lost.calls) == ("evolution", 14)
    assert lost.relative_l2 == pytest.approx(2)


def test_evolution_of_a_quadratic_has_the_closed_forms_mean_and_spread():
    """Antithetic pairs cancel the even part: of f = |x - c|^2 a pair gives e e^T g with g = 2 (x - c), in units of the
    scale: mean g, variance |s g|^2 + (s g)_k^2 of number k over s_k^2."""
    x = torch.tensor([1.0, -2.0, 0.5], dtype=D)
    scale = torch.tensor([0.1, 0.2, 0.4], dtype=D)
    pairs = EVOLUTION.calls // 2

    def loss(p, draw):
        return quadratic(p["x"].detach(), draw)

    found = gradient(loss, {"x": x}, {"x": EVOLUTION}, 5, scales={"x": scale})["x"]
    g = 2 * (x - centre(5, 3))
    spread = ((scale * g).square().sum() + (scale * g).square()).sqrt() / scale / math.sqrt(pairs)
    assert bool(((found - g).abs() < 3.5 * spread).all())  # of three normal numbers: once in 700
    assert bool(((found - g).abs() > 1e-6 * spread).all())
    again = gradient(loss, {"x": x}, {"x": EVOLUTION}, 5, scales={"x": scale})["x"]
    assert torch.equal(found, again)


def test_evolution_is_the_gradient_of_the_smoothed_loss():
    """E f(x + s e) of f = x^3 is x^3 + 3 s^2 x. A pair gives (3 x^2 e + s^2 e^3) e: mean 3 x^2 + 3 s^2; its square's mean by
    the normal moments 3, 15, 105 of e^4, e^6, e^8."""
    x, s, pairs = 0.3, 0.7, 4000
    found = gradient(
        lambda p, draw: p["x"].pow(3).sum(),
        {"x": torch.tensor(x, dtype=D)},
        {"x": EVOLUTION},
        0,
        scales={"x": s},
    )["x"]
    mean = 3 * x**2 + 3 * s**2
    square = 3 * (3 * x**2) ** 2 + 2 * 15 * 3 * x**2 * s**2 + 105 * s**4
    assert abs(float(found) - mean) < 3.3 * math.sqrt((square - mean**2) / pairs)  # once in 1,000
    assert abs(mean - 3 * x**2) > 10 * math.sqrt((square - mean**2) / pairs), "the smoothing is seen"


def test_a_step_has_a_gradient_by_evolution():
    """Of a step at distance d, smoothed by a Gaussian: its density there. A pair is (e / 2 s) where |s e| exceeds d."""
    s, d, pairs = 0.5, 0.3, 4000
    found = gradient(
        lambda p, draw: (p["x"] > d).to(D).sum(),
        {"x": torch.zeros(1, dtype=D)},
        {"x": EVOLUTION},
        1,
        scales={"x": s},
    )["x"]
    density = math.exp(-((d / s) ** 2) / 2) / (s * math.sqrt(2 * math.pi))
    assert abs(float(found) - density) < 3.3 * 0.5 / s / math.sqrt(pairs)  # E (e / 2 s)^2 at most


def test_groups_by_three_ways_take_one_pass_of_autograd_and_keep_their_form():
    calls = []

    def loss(p, draw):
        calls.append(torch.is_grad_enabled())
        return torch.stack([quadratic(x, draw).float() for x in p.values()]).sum()

    point = {name: torch.ones(2, 3) for name in ("a", "b", "c")}
    point["d"] = torch.ones(4, dtype=D, requires_grad=True)
    ways = {"a": AUTOGRAD, "b": DIFFERENCES, "c": Choice("evolution", 1.0, 0.0, 0.1, 10), "d": AUTOGRAD}
    found = gradient(loss, point, ways, 2, scales=dict.fromkeys(point, 0.5))
    assert list(found) == list(point)
    assert calls.count(True) == 1
    assert calls.count(False) == 2 * 6 + 10
    for name, x in point.items():
        assert (found[name].shape, found[name].dtype) == (x.shape, x.dtype)
        assert not found[name].requires_grad
    # float32 of a loss near 20: 1e-6, over twice the step of 0.5
    torch.testing.assert_close(found["b"], found["a"], rtol=0, atol=1e-5)


def test_evolution_does_not_draw_what_the_loss_draws():
    """A loss that seeds its noise with the draw: the directions are others, and other for each group and draw."""
    seen = []

    def loss(p, draw):
        seen.append(p["x"] if bool(p["x"].any()) else p["y"])
        return quadratic(p["x"], draw) + quadratic(p["y"], draw)

    zero = {"x": torch.zeros(3, dtype=D), "y": torch.zeros(3, dtype=D)}
    ways = dict.fromkeys(zero, Choice("evolution", 1.0, 0.0, 0.1, 2))
    for draw in (3, 4):
        gradient(loss, zero, ways, draw, scales={"x": 1.0, "y": 1.0})
    directions = torch.stack([*seen[::2], centre(3, 3), centre(4, 3)])
    assert torch.equal(torch.stack(seen[::2]), -torch.stack(seen[1::2]))
    assert float(torch.pdist(directions).min()) > 0.1


def unseeded(p, draw):
    return p["x"].sum() + torch.rand(1)[0]


X = {"x": torch.tensor([1.0, 2.0], dtype=D)}


@pytest.mark.parametrize(
    ("loss", "options", "error", "sentence"),
    [
        (unseeded, {}, GradientError, "two calls at the same point"),
        (lambda p, draw: p["x"], {}, GradientError, r"a scalar function is needed, got shape \(2,\)"),
        (lambda p, draw: p["x"].sum() * math.nan, {}, NonFiniteError, "the loss is nan"),
        (
            lambda p, draw: (p["x"] - 0.6).sqrt().sum(),
            {},
            NonFiniteError,
            r"not finite when 'x' moves by its scale \(draw 0\)",
        ),
        (quadratic, {"draws": (4,)}, DomainError, "1 draws are given; two or more"),
        (quadratic, {"draws": (1, 2.5)}, DomainError, "draw must be a whole number, got 2.5"),
        (quadratic, {"scales": {}}, DomainError, "'x' has no scale"),
        (quadratic, {"scales": {"x": 1.0, "y": 1.0}}, DomainError, "no parameter"),
        (quadratic, {"scales": {"x": torch.ones(3)}}, ShapeError, r"shape \(3,\)"),
        (quadratic, {"scales": {"x": -1.0}}, DomainError, "positive"),
        (quadratic, {"cosine": 0.0}, DomainError, r"cosine must be .* got 0\.0"),
        (quadratic, {"relative_l2": math.inf}, DomainError, "relative_l2 must be a finite number .* got inf"),
        (quadratic, {"directions": 0}, DomainError, "directions must be a whole number >= 1, got 0"),
        (
            lambda p, draw: p["x"].sum(),
            {"judge": lambda p, draw: p["x"].detach().round().sum(), "scales": {"x": 0.1}},
            GradientError,
            "'x': the judge does not change in any draw",
        ),
    ],
)
def test_what_cannot_be_compared_is_refused(loss, options, error, sentence):
    function = (lambda p, draw: quadratic(p["x"], draw)) if loss is quadratic else loss
    given = {"draws": (0, 1), "scales": {"x": 0.5}, **options}
    with pytest.raises(error, match=sentence):
        choose(function, X, given.pop("draws"), **given)


def test_a_group_without_a_way_or_a_graph_is_refused():
    def loss(p, draw):
        return quadratic(p["x"].detach(), draw)

    with pytest.raises(DomainError, match="no way is chosen for 'x'"):
        gradient(loss, X, {}, 0, scales={"x": 1.0})
    with pytest.raises(GradientError, match="without a graph"):
        gradient(loss, X, {"x": AUTOGRAD}, 0, scales={"x": 1.0})


def test_the_example_of_the_page_chooses_as_it_says():
    page = (Path(__file__).parents[2] / "docs" / "certify.md").read_text(encoding="utf-8")
    block = page.split("## Where autograd fails")[1].split("```python\n")[1].split("```")[0]
    names: dict[str, Any] = {"torch": torch}
    exec(block, names)
    ways = {name: (choice.way, choice.calls) for name, choice in names["ways"].items()}
    assert ways == {"light": ("autograd", 0), "bias": ("differences", 4)}
    # rounded to 1.0 and 0.6, and to 0.8 and 0.4, at the ends of the steps, less 0.3, squared, over 0.4
    torch.testing.assert_close(names["one"]["bias"], torch.tensor([1.0, 0.6]), rtol=0, atol=1e-5)
