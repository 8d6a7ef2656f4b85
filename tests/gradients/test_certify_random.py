"""The certificate on functions drawn at random: of twelve families, 1 to 200 numbers, in both
precisions.

The truth is the gradient of the same function in double precision. No right gradient may fail, and
no wrong one pass whose error is above twice the tolerance and above the noise.
"""

from collections import Counter

import pytest
import torch

from tests.gradients.wrong_case import certified, grad_of

D = torch.float64
NUMBERS = (1, 2, 5, 30, 200)
TOLERANCE = 0.01
SEEDS = range(13)


class Draw:
    """Random numbers of one case: uniform ones of the length of x, and single ones over decades."""

    def __init__(self, seed):
        self.generator = torch.Generator().manual_seed(seed)
        self.numbers = NUMBERS[seed % len(NUMBERS)]

    def uniform(self, *shape):
        return torch.rand(shape or (self.numbers,), generator=self.generator, dtype=D)

    def decades(self, low, high):
        return (low * (high / low) ** self.uniform(1)).item()


def waves(low, high):
    def draw(of):
        rate, phase = of.decades(low, high), 6 * of.uniform()
        return of.uniform(), lambda x: (rate * x + phase.to(x)).sin().sum() / rate

    return draw


def several_scales(of):
    waves = [(of.decades(*rates), of.decades(0.1, 1)) for rates in ((1, 30), (30, 1e3), (1e3, 3e4))]
    return of.uniform(), lambda x: sum(
        share / rate * (rate * x).sin().sum() for rate, share in waves
    )


def kinks(of):
    x, height = of.uniform(), of.uniform()
    at = x + 1000 ** (of.uniform() - 1) * (of.uniform() - 0.5).sign()
    return x, lambda x: ((x - at.to(x)).abs() * height.to(x) + x.sin()).sum()


def single_inside(of):
    offset = of.decades(1, 1e3)
    return (
        of.uniform(),
        lambda x: (offset + (3 * x.float()).sin().sum()).to(x) + 0.3 * x.square().sum(),
    )


def coupled(of):
    matrix = of.uniform(of.numbers, of.numbers) - 0.5
    return of.uniform(), lambda x: (2 * matrix.to(x) @ x).tanh().square().mean()


def with_a_number(low, high, fn, at=Draw.uniform):
    def draw(of):
        number = of.decades(low, high)
        return at(of), lambda x: fn(x, number)

    return draw


FAMILIES = {
    "slow waves": waves(0.1, 100),
    "fast waves": waves(100, 3e4),
    "faster than the ladder": waves(3e4, 1e6),
    "several scales": several_scales,
    "exponentials": with_a_number(0.1, 10, lambda x, rate: (rate * x).exp().mean()),
    "logarithms": with_a_number(
        1,
        1,
        lambda x, _: (x + 1).log().square().mean(),
        lambda of: of.decades(0.1, 300) * of.uniform(),
    ),
    "rational": with_a_number(0.02, 1, lambda x, width: (1 / (width + x.square())).mean()),
    "powers": with_a_number(
        0.2, 3, lambda x, power: x.pow(power).mean(), lambda of: 1e6 ** of.uniform() / 1e3
    ),
    "small on an offset": with_a_number(1, 1e4, lambda x, offset: offset + (3 * x).sin().mean()),
    "kinks": kinks,
    "single precision inside": single_inside,
    "coupled": coupled,
}


def of_the_smoothed(grad, fn, x, of):
    near = [x * (0.8 + 0.4 * of.uniform()).to(x) for _ in range(8)]
    return torch.stack([grad_of(fn, each) for each in near]).mean(0)


WRONG = (
    lambda grad, *_: -grad,
    lambda grad, *_: 1.05 * grad,
    lambda grad, *_: 1.02 * grad,
    lambda grad, *_: torch.where(grad.abs() == grad.abs().max(), 0.0, grad),
    of_the_smoothed,
)


def judged(fn, x, error):
    """Row for the right gradient plus an error that the function's values do not show."""
    lines = None if x.numel() <= 5 else 4
    return certified(fn, x, error, directions=lines, tolerance=TOLERANCE)


@pytest.mark.parametrize("name", FAMILIES)
def test_no_right_gradient_fails_and_no_wrong_one_passes(name):
    verdicts = Counter()
    for seed in SEEDS:
        for dtype in (torch.float32, D):
            of = Draw(seed)
            x, fn = FAMILIES[name](of)
            x = x.to(dtype)
            grad, truth = grad_of(fn, x), grad_of(fn, x.double())
            if float((grad - truth).norm()) > 0.1 * TOLERANCE * float(truth.norm()):
                continue  # rounding has made single precision's own gradient a wrong one
            right = judged(fn, x, torch.zeros_like(x))
            verdicts[dtype, right.verdict] += 1
            assert right.verdict != "fail", (seed, right)
            wrong = judged(fn, x, WRONG[seed * 2 % 5](grad, fn, x, of) - grad)
            error = torch.tensor(wrong.autograd) - torch.tensor(right.autograd)
            gap = float(error.norm() / torch.tensor(right.autograd).norm())
            # three noise floors of the verdict's margin, and three by which the differences may be
            # off
            if gap > 1.99 * TOLERANCE and gap > TOLERANCE + 6 * wrong.noise_floor:
                assert wrong.verdict != "pass", (seed, wrong)
                verdicts["wrong", wrong.verdict] += 1
    # and it decides, where double precision has the digits
    assert verdicts[D, "pass"] >= 0.7 * len(SEEDS)
    assert verdicts["wrong", "fail"] >= 0.9 * (
        verdicts["wrong", "fail"] + verdicts["wrong", "noise"]
    )


IMAGES = {
    "logarithms": lambda x: (x + 1).log().square().sum(),
    "logsumexp": lambda x: (5 * x).flatten().logsumexp(0),
    "steps of log brightness": lambda x: (x + 0.1).log().diff(dim=-1).square().sum(),
}


@pytest.mark.parametrize("name", IMAGES)
def test_of_images_in_four_directions_every_right_gradient_passes_and_every_wrong_one_fails(name):
    """4,096 pixels in both precisions; wrong is 30 % too long, too short or turned."""
    fn = IMAGES[name]
    for seed in range(4):
        for dtype in (torch.float32, D):
            of = Draw(seed)
            x = of.uniform(64, 64).to(dtype)
            grad = grad_of(fn, x)
            noise = (of.uniform(64, 64) - 0.5).to(dtype)
            turned = noise - (noise * grad).sum() / grad.square().sum() * grad
            wrong = (0.3 * grad, -0.3 * grad, 0.3 * turned * grad.norm() / turned.norm())[seed % 3]
            assert judged(fn, x, 0 * grad).verdict == "pass", (seed, dtype)
            assert judged(fn, x, wrong).verdict == "fail", (seed, dtype)
