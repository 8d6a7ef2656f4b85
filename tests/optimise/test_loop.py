"""The loop and the descent on bowls whose minimum is known: noise, going back, resuming, refusals."""

import math

import pytest
import torch
from torch import nn

from codesign.errors import CodesignError, DomainError, GradientError, NonFiniteError, ShapeError
from codesign.optimise import Descent, Loop, SampleGradients, clipped_mean, sample_gradients

GOAL = torch.tensor([2.0, -1.0], dtype=torch.float64)


def bowl(x, noise):
    """Loss whose gradient is x - GOAL + noise."""
    return (x - GOAL).square().sum() / 2 + (x * noise).sum()


def noisy_loop(seed=0, optimiser=None, **options):
    """Four samples a step with Cauchy noise of scale 1 on every gradient: a mean would not exist."""
    x = nn.Parameter(torch.zeros(2, dtype=torch.float64))

    def samples(step):
        draw = torch.Generator().manual_seed(1000 * seed + step)
        return (bowl(x, torch.empty(2, dtype=torch.float64).cauchy_(generator=draw)) for _ in range(4))

    made = (optimiser or (lambda p: Descent(p, 0.3)))([x])
    return x, Loop(made, samples, judge=lambda: float((x - GOAL).square().sum()), **options)


def test_descent_finds_a_minimum_under_heavy_tailed_noise():
    for seed in range(5):
        best = noisy_loop(seed)[1].run(60)[0]
        assert float((best - GOAL).norm()) < 0.4


def test_one_step_of_descent_is_its_formula():
    x = nn.Parameter(torch.tensor([1.0, 2.0], dtype=torch.float64))
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
    a = nn.Parameter(torch.zeros(1, dtype=torch.float64))
    b = nn.Parameter(torch.zeros(2, dtype=torch.float64))
    optimiser = Descent([a, b], lr=5.0, pull=0.0, normalised=True, grain=4)
    a.grad = torch.tensor([3e-9], dtype=torch.float64)
    b.grad = torch.tensor([0.0, -4e-9], dtype=torch.float64)
    optimiser.step()
    assert a.tolist() == [-3.0]
    assert b.tolist() == [0.0, 4.0]
    a.grad = torch.tensor([1.0], dtype=torch.float64)
    optimiser.step()
    assert float((a.detach() * 4) % 1) == 0


def test_sample_gradients_are_clipped_one_by_one():
    x = nn.Parameter(torch.zeros(2, dtype=torch.float64))
    slopes = torch.tensor([[3.0, 4.0], [0.3, 0.4], [0.0, -1.0]], dtype=torch.float64)
    found = sample_gradients(((x * s).sum() + 1 for s in slopes), [x])
    assert found.values.tolist() == [1.0, 1.0, 1.0]
    torch.testing.assert_close(found.gradients, slopes)
    mean = clipped_mean(found.gradients, 1.0)
    torch.testing.assert_close(mean, torch.tensor([0.9 / 3, 0.2 / 3], dtype=torch.float64))
    torch.testing.assert_close(clipped_mean(found.gradients, None), mean)  # the median length is 1


def test_groups_are_clipped_by_themselves():
    x = nn.Parameter(torch.zeros(1, dtype=torch.float64))
    y = nn.Parameter(torch.zeros(1, dtype=torch.float64))
    optimiser = torch.optim.SGD([{"params": [x], "lr": 1.0}, {"params": [y], "lr": 1.0}])
    Loop(optimiser, lambda step: [100 * x.sum() + 0.5 * y.sum()], clip=1.0).run(1)
    assert x.item() == pytest.approx(-1.0)
    assert y.item() == pytest.approx(-0.5)


def test_a_worse_score_goes_back_to_the_best_with_smaller_steps():
    x = nn.Parameter(torch.zeros(1, dtype=torch.float64))
    scores = iter([5.0, 3.0, 4.0, 6.0, 1.0])
    loop = Loop(
        torch.optim.SGD([x], lr=1.0),
        lambda step: [x.sum()],
        clip=None,
        judge=lambda: next(scores),
        judge_every=1,
        patience=1,
        shrink=0.25,
    )
    best = loop.run(4)
    # judged at 0 (5), -1 (3), -2 (4: borne), -3 (6: back to -1, step 1/4), -1.25 (1)
    assert x.item() == best[0].item() == -1.25
    assert loop.record.kept == [True, True, False, False, True]
    assert loop.best_score == 1.0


@pytest.mark.bits
@pytest.mark.parametrize(
    "optimiser",
    [
        lambda p: Descent(p, 0.3),
        lambda p: torch.optim.Adam(p, lr=0.2),
        lambda p: torch.optim.NAdam(p, lr=0.2),  # keeps float32 numbers beside float64 moments
        lambda p: torch.optim.ASGD(p, lr=0.2),
    ],
)
def test_resumed_equals_uninterrupted(optimiser):
    # element-wise operations on two numbers, so the same bits by construction
    whole = noisy_loop(optimiser=optimiser)[1]
    whole.run(23)
    first = noisy_loop(optimiser=optimiser)[1]
    kept = []

    def stop(loss, score):
        if first.step_number == 11:
            kept.append(
                tuple(
                    {k: (v.clone() if torch.is_tensor(v) else v) for k, v in part.items()}
                    for part in first.state()
                )
            )
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first.run(23, advance=stop)
    second = noisy_loop(optimiser=optimiser)[1].resume(*kept[0])
    second.run(23)
    assert second.record == whole.record
    assert torch.equal(second.best[0], whole.best[0])


def test_without_a_judge_the_last_point_is_the_best():
    x = nn.Parameter(torch.zeros(1, dtype=torch.float64))
    loop = Loop(torch.optim.SGD([x], lr=1.0), lambda step: [x.sum()], clip=None)
    assert loop.run(7)[0].item() == -7.0


def test_a_schedule_scales_the_first_step_sizes():
    x = nn.Parameter(torch.zeros(1, dtype=torch.float64))
    Loop(
        torch.optim.SGD([x], lr=1.0), lambda step: [x.sum()], clip=None, schedule=lambda step: 1 / (step + 1)
    ).run(3)
    assert x.item() == pytest.approx(-(1 + 1 / 2 + 1 / 3))


def test_a_bad_gradient_stops_the_loop_at_the_best_point():
    x = nn.Parameter(torch.zeros(1, dtype=torch.float64))

    def samples(step):
        return [x.sum() * (math.nan if step == 3 else 1.0)]

    loop = Loop(torch.optim.SGD([x], lr=1.0), samples, clip=None, judge=lambda: float(x), judge_every=1)
    with pytest.raises(NonFiniteError, match="stopped at step 4; the parameters are back at the best point"):
        loop.run(10)
    assert x.item() == -3.0


def test_what_cannot_be_optimised_is_refused_before_the_first_step():
    x = nn.Parameter(torch.zeros(3), requires_grad=False)
    with pytest.raises(GradientError, match=r"parameter 0 of the optimiser, of shape \(3,\), is frozen"):
        Loop(torch.optim.SGD([x], lr=1.0), lambda step: [])
    y = nn.Parameter(torch.zeros(1))
    with pytest.raises(GradientError, match="depend on any parameter"):
        Loop(torch.optim.SGD([y], lr=1.0), lambda step: [nn.Parameter(torch.ones(1)).sum()]).run(1)
    with pytest.raises(GradientError, match="the graph is cut"):
        Loop(torch.optim.SGD([y], lr=1.0), lambda step: [y.detach().sum()]).run(1)
    with pytest.raises(DomainError, match="clip 0 must be above 0"):
        Loop(torch.optim.SGD([y], lr=1.0), lambda step: [], clip=0)
    other = noisy_loop()[1]
    with pytest.raises(ShapeError, match="the state of the same problem"):
        Loop(torch.optim.SGD([y], lr=1.0), lambda step: []).resume(*other.state())
    with pytest.raises(DomainError, match=r"momentum 1\.0 in"):
        Descent([y], lr=0.1, momentum=1.0)
    with pytest.raises(DomainError, match="LBFGS asks for the loss several times"):
        Loop(torch.optim.LBFGS([y]), lambda step: [])
    with pytest.raises(DomainError, match="patience -1 at least 0"):
        Loop(torch.optim.SGD([y], lr=1.0), lambda step: [], patience=-1)


x = nn.Parameter(torch.zeros(2, dtype=torch.float64))


@pytest.mark.parametrize(
    ("samples", "said"),
    [
        (lambda step: [], "no samples in this step"),
        (lambda step: x.sum(), "samples are one Tensor"),
        (lambda step: 1.0, "samples are one float"),
        (lambda step: [1.0], "a sample's loss is float"),
        (lambda step: [2 * x], r"a sample's loss is \(2,\)"),
        (lambda step: (lambda y: [y.sum(), y.sum()])(x.exp()), "share a graph"),
        (lambda step: SampleGradients(torch.zeros(3), torch.zeros(3, 5)), r"shape \(3, 5\); \[S, 2\]"),
        ([1.0], "samples is a list; give a function"),
    ],
)
def test_bad_samples_get_a_sentence(samples, said):
    with pytest.raises(CodesignError, match=said):
        Loop(torch.optim.SGD([x], lr=1.0), samples).run(1)


def test_a_state_of_another_optimiser_is_refused():
    first = noisy_loop(optimiser=lambda p: torch.optim.Adam(p, lr=0.2))[1]
    first.run(2)
    with pytest.raises(DomainError, match="of the optimiser Adam, this loop has NAdam"):
        noisy_loop(optimiser=lambda p: torch.optim.NAdam(p, lr=0.2))[1].resume(*first.state())
