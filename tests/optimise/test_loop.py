"""The loop and the descent on bowls whose minimum is known: noise, going back, resuming,
refusals."""

import math

import pytest
import torch
from torch import nn

from codesign.errors import NonFiniteError
from codesign.optimise import Descent, Loop
from codesign.optimise.gradients import clipped_mean, sample_gradients
from tests import refusals

GOAL = torch.tensor([2.0, -1.0], dtype=torch.float64)


def parameter(*values):
    return nn.Parameter(torch.tensor(values, dtype=torch.float64))


def sgd_loop(samples, x=None, **options):
    """A parameter from 0 whose steps are those of its gradient, and its loop."""
    x = parameter(0.0) if x is None else x
    return x, Loop(
        torch.optim.SGD([x], lr=1.0), lambda step: samples(x, step), clip=None, **options
    )


def noisy_loop(seed=0, optimiser=lambda p: Descent(p, 0.3)):
    """A bowl about GOAL; four samples a step with Cauchy noise of scale 1 on every gradient: a mean
    would not exist."""
    x = parameter(0.0, 0.0)

    def samples(step):
        draw = torch.Generator().manual_seed(1000 * seed + step)
        for _ in range(4):
            noise = torch.empty(2, dtype=torch.float64).cauchy_(generator=draw)
            yield (x - GOAL).square().sum() / 2 + (x * noise).sum()

    return Loop(optimiser([x]), samples, judge=lambda: float((x - GOAL).square().sum()))


def test_descent_finds_a_minimum_under_heavy_tailed_noise():
    for seed in range(5):
        assert float((noisy_loop(seed).run(60)[0] - GOAL).norm()) < 0.4


def test_one_step_of_descent_is_its_formula():
    x = parameter(1.0, 2.0)
    optimiser = Descent([x], lr=0.5, momentum=0.6, pull=0.1, grain=0)
    gradient = torch.tensor([0.3, -0.4], dtype=torch.float64)
    velocity = torch.zeros(2, dtype=torch.float64)
    expected = x.detach().clone()
    for _ in range(3):
        x.grad = gradient
        optimiser.step()
        velocity = 0.6 * velocity + 0.4 * (gradient + 0.1 * expected)
        expected = expected - 0.5 * velocity
        torch.testing.assert_close(x.detach(), expected, rtol=1e-14, atol=0)


def test_normalised_descent_steps_as_far_as_told_over_all_parameters_and_stays_on_its_grid():
    a, b = parameter(0.0), parameter(0.0, 0.0)
    optimiser = Descent([a, b], lr=5.0, pull=0.0, normalised=True, grain=4)
    a.grad = torch.tensor([3e-9], dtype=torch.float64)
    b.grad = torch.tensor([0.0, -4e-9], dtype=torch.float64)
    optimiser.step()
    assert [a.tolist(), b.tolist()] == [[-3.0], [0.0, 4.0]]
    a.grad = torch.tensor([1.0], dtype=torch.float64)
    optimiser.step()
    assert float((a.detach() * 4) % 1) == 0


@pytest.mark.parametrize("size", [0.0, 1e-40, 1e-24, 1e20, 1e38])
def test_a_normalised_step_in_single_precision_is_as_long_for_any_gradient(size):
    x = nn.Parameter(torch.zeros(2))
    x.grad = torch.tensor([0.6, -0.8]) * size
    Descent([x], lr=0.5, pull=0.0, normalised=True, grain=0).step()
    goal = [-0.3, 0.4] if size else [0.0, 0.0]
    torch.testing.assert_close(x.tolist(), goal, rtol=1e-5, atol=0)


def test_sample_gradients_are_clipped_one_by_one():
    x = parameter(0.0, 0.0)
    slopes = torch.tensor([[3.0, 4.0], [0.3, 0.4], [0.0, -1.0]], dtype=torch.float64)
    values, gradients, felt = sample_gradients(((x * s).sum() + 1 for s in slopes), [x])
    assert felt == [True]
    assert values.tolist() == [1.0, 1.0, 1.0]
    torch.testing.assert_close(gradients, slopes)
    for limit in (1.0, None):  # the median length is 1
        mean = clipped_mean(gradients, limit)
        torch.testing.assert_close(mean, torch.tensor([0.9 / 3, 0.2 / 3], dtype=torch.float64))


def test_groups_are_clipped_by_themselves():
    x, y = parameter(0.0), parameter(0.0)
    optimiser = torch.optim.SGD([{"params": [x], "lr": 1.0}, {"params": [y], "lr": 1.0}])
    Loop(optimiser, lambda step: [100 * x.sum() + 0.5 * y.sum()], clip=1.0).run(1)
    assert [x.item(), y.item()] == pytest.approx([-1.0, -0.5])


def test_a_worse_score_goes_back_to_the_best_with_smaller_steps():
    scores = iter([5.0, 3.0, 4.0, 6.0, 1.0])
    x, loop = sgd_loop(lambda x, step: [x.sum()], judge=lambda: next(scores), judge_every=1)
    best = loop.run(4)
    # judged at 0 (5), -1 (3), -2 (4: back to -1, step 1/2), -1.5 (6: back, step 1/4), -1.25 (1)
    assert x.item() == best[0].item() == -1.25
    assert loop.record.kept == [True, True, False, False, True]
    assert loop.best_score == 1.0


@pytest.mark.bits
@pytest.mark.parametrize(
    "optimiser",
    [
        lambda p: Descent(p, 0.3),
        lambda p: torch.optim.NAdam(p, lr=0.2),  # keeps float32 numbers beside float64 moments
        lambda p: torch.optim.ASGD(p, lr=0.2),
    ],
)
def test_resumed_equals_uninterrupted(optimiser):
    # element-wise operations on two numbers, so the same bits by construction
    whole = noisy_loop(optimiser=optimiser)
    whole.run(23)
    assert whole.record.judged_step == [0, 5, 10, 15, 20, 23]
    first = noisy_loop(optimiser=optimiser)
    kept = []

    def stop(loss, score):
        if first.step_number == 11:
            tensors, numbers = first.state()
            kept.extend([{name: value.clone() for name, value in tensors.items()}, dict(numbers)])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first.run(23, advance=stop)
    second = noisy_loop(optimiser=optimiser).resume(*kept)
    assert second.best_score == first.best_score < math.inf
    second.run(23)
    assert second.record == whole.record
    assert torch.equal(second.best[0], whole.best[0])


def test_without_a_judge_the_last_point_is_the_best():
    assert sgd_loop(lambda x, step: [x.sum()])[1].run(7)[0].item() == -7.0


def test_a_bad_gradient_stops_the_loop_at_the_best_point():
    x, loop = sgd_loop(lambda x, step: [x.sum() * (math.nan if step == 3 else 1.0)])
    loop.judge, loop.judge_every = (lambda: float(x)), 1
    with pytest.raises(
        NonFiniteError, match="stopped at step 4; the parameters are back at the best point"
    ):
        loop.run(10)
    assert x.item() == -3.0


x, still = parameter(0.0, 0.0), nn.Parameter(torch.zeros(3), requires_grad=False)


def loop_of(*samples, optimiser=None, **options):
    return Loop(optimiser or torch.optim.SGD([x], lr=1.0), lambda step: list(samples), **options)


@refusals.table(__file__, "loops")
def test_what_cannot_be_optimised_is_refused_with_a_sentence(row):
    row.holds(globals())


def test_a_state_is_of_its_moment_and_loops_resumed_from_it_go_apart():
    whole, first = noisy_loop(), noisy_loop()
    whole.run(10)
    first.run(5)
    kept = first.state()
    second = noisy_loop().resume(*kept)
    second.run(10)
    first.run(10)
    third = noisy_loop().resume(*kept)
    assert third.step_number == 5
    third.run(10)
    for loop in (first, second, third):
        assert loop.record == whole.record
        torch.testing.assert_close(loop.best[0], whole.best[0], rtol=0, atol=1e-12)


def test_a_schedule_and_a_rate_set_between_runs_are_kept():
    x = parameter(0.0)
    optimiser = torch.optim.SGD([x], lr=0.1)
    halves = torch.optim.lr_scheduler.ExponentialLR(optimiser, 0.5)
    loop = Loop(optimiser, lambda step: [-x.sum()], clip=10.0)
    way = []

    def advance(**shown):
        halves.step()
        way.append(x.item())

    loop.run(5, advance)
    # 0.1 (1 + 1/2 + 1/4 ...)
    assert way == pytest.approx([0.2 * (1 - 0.5**k) for k in range(1, 6)])
    optimiser.param_groups[0]["lr"] = 0.01
    other = Loop(torch.optim.SGD([x], lr=0.1), loop.samples, clip=10.0).resume(*loop.state())
    assert other.optimiser.param_groups[0]["lr"] == 0.01
    loop.run(7)
    assert x.item() == pytest.approx(way[-1] + 0.02)
    assert optimiser.param_groups[0]["lr"] == 0.01


def test_weight_decay_leaves_alone_what_no_sample_reaches():
    """As torch does without the loop."""
    reached, far = parameter(1.0), parameter(1.0)
    optimiser = torch.optim.AdamW([reached, far], lr=0.1, weight_decay=0.5)
    Loop(optimiser, lambda step: [reached.square().sum()]).run(10)
    assert far.item() == 1.0 != reached.item()
