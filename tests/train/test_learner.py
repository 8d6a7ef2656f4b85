"""Steps of a learner, its running average, the best weights it keeps, and its state."""

import math
from typing import Any

import pytest
import torch
from torch import nn

from codesign.train import Learner, adamw
from codesign.train.learner import Step
from tests import refusals

X = torch.tensor([[1.0, 2.0], [3.0, -1.0]])


def apply(network, batch):
    return network(batch)


def mean(prediction, batch):
    return prediction.mean()


def line(weight=(1.0, 1.0)) -> Any:
    """y = w x; the gradient of its mean over X is the mean of X, (2, 0.5), whatever w."""
    network = nn.Linear(2, 1, bias=False)
    with torch.no_grad():
        network.weight.copy_(torch.tensor([weight]))
    return network


def first_size(network: Any):
    return float(network[0].weight.square().sum())


def sgd(network, rate=0.1, **options):
    return torch.optim.SGD(network.parameters(), rate, **options)


def learner(network=None, **options) -> Any:
    network = network or line()
    return Learner(
        network, mean, options.pop("optimiser", None) or sgd(network), predict=apply, **options
    )


def test_a_step_is_that_of_plain_descent():
    made = learner()
    seen = made.step(X, factor=0.5)
    assert seen == Step(2.5, seen.norm, clipped=False, rate=0.05)
    assert seen.norm == pytest.approx(math.hypot(2, 0.5))
    assert made.network.weight.tolist() == [pytest.approx([1 - 0.05 * 2, 1 - 0.05 * 0.5])]
    assert made.optimiser.param_groups[0]["lr"] == 0.1, "the optimiser is left as it was given"
    assert made.steps == 1


def test_a_long_gradient_is_shortened_to_the_limit():
    made = learner(clip=1.0)
    assert made.step(X).clipped
    moved = (1 - made.network.weight.detach()[0]).tolist()
    assert moved == pytest.approx([0.1 * 4 / math.sqrt(17), 0.1 / math.sqrt(17)], rel=1e-5)


def test_the_running_average_spans_a_tenth_of_the_steps_at_first():
    """The weight falls by 0.1 times the gradient each step, so the average can be followed by
    hand."""
    made = learner(average=0.5)
    gradient = torch.tensor([[2.0, 0.5]])
    weight = torch.tensor([[1.0, 1.0]])
    expected = weight
    for decay in (0.1, 2 / 11, 0.25, 4 / 13, 5 / 14, 0.4, 7 / 16, 8 / 17, 0.5, 0.5):
        made.step(X)
        weight = weight - 0.1 * gradient
        expected = decay * expected + (1 - decay) * weight
    assert torch.allclose(made.delivered.weight, expected, rtol=1e-6)
    made.settle()
    assert torch.equal(made.network.weight, made.delivered.weight)


def test_the_weights_with_the_lowest_score_are_kept():
    scores = iter([3.0, 1.0, 2.0])
    modes = []

    def judge(network):
        modes.append((network.training, torch.is_grad_enabled()))
        return next(scores)

    made = learner(validate=judge)
    seen = []
    for _ in range(3):
        made.step(X)
        seen.append(made.network.weight.detach().clone())
        made.validate()
    assert made.best is not None
    assert (made.best.score, made.best.step) == (1.0, 2)
    assert modes == [(False, False)] * 3
    assert made.network.training
    made.settle()
    assert torch.equal(made.network.weight, seen[1])


def test_chance_within_a_step_is_the_seed_and_the_number_of_the_step():
    network = nn.Sequential(nn.Dropout(0.5), line((1.0,) * 2))
    made = learner(network, optimiser=sgd(network, 0.0), seed=3)
    batch = torch.ones(1, 2)
    torch.manual_seed(0)
    expected = torch.rand(4)
    torch.manual_seed(0)
    first = [made.step(batch).loss for _ in range(40)]
    assert torch.equal(torch.rand(4), expected), "the user's random numbers are left alone"
    assert set(first) == {0.0, 2.0, 4.0}
    again = learner(network, optimiser=sgd(network, 0.0), seed=3)
    again.steps = 20
    assert [again.step(batch).loss for _ in range(20)] == first[20:]
    other = learner(network, optimiser=sgd(network, 0.0), seed=4)
    assert [other.step(batch).loss for _ in range(40)] != first


@pytest.mark.bits
@pytest.mark.parametrize(
    ("kind", "options", "dtype"),
    [
        (torch.optim.SGD, {"momentum": 0.9}, torch.float32),
        (torch.optim.AdamW, {}, torch.float32),
        (torch.optim.RMSprop, {"centered": True}, torch.float32),
        (torch.optim.NAdam, {}, torch.float64),
        (torch.optim.Adafactor, {}, torch.float32),  # other moments of matrices than of vectors
    ],
)
def test_a_learner_goes_on_from_its_state_bit_for_bit(kind, options, dtype):
    def fresh() -> Any:
        torch.manual_seed(1)
        network = nn.Sequential(
            nn.Linear(2, 8), nn.BatchNorm1d(8), nn.Dropout(0.3), nn.Linear(8, 1)
        ).to(dtype)
        made = kind(network.parameters(), lr=0.01, **options)
        return learner(network, optimiser=made, average=0.9, validate=first_size)

    batches = torch.randn(6, 16, 2, generator=torch.Generator().manual_seed(0), dtype=dtype)
    whole = fresh()
    for batch in batches[:3]:
        whole.step(batch)
    whole.validate()
    parts = fresh()
    parts.load_state_dict(
        {name: tensor.detach().clone() for name, tensor in whole.state_dict().items()}
    )
    for made in (whole, parts):
        for batch in batches[3:]:
            made.step(batch)
    one, two = whole.state_dict(), parts.state_dict()
    assert one.keys() == two.keys()
    assert [name for name in one if not torch.equal(one[name], two[name])] == []
    assert whole.steps == parts.steps == 6


@refusals.table(__file__, "states of learners")
def test_a_state_of_something_else_is_refused(row):
    def load(change):
        made = learner()
        made.step(X)
        state = made.state_dict()
        change(state)
        learner().load_state_dict(state, "here")

    row.holds(globals() | {"load": load})


OTHER = line()
FROZEN = line().requires_grad_(False)


@refusals.table(__file__, "learners")
def test_what_does_not_fit_is_refused_before_the_first_step(row):
    row.holds(globals())


@refusals.table(__file__, "losses of learners")
def test_a_loss_that_is_of_no_use_leaves_the_weights_alone(row):
    made = learner()

    def step(loss):
        made.loss = loss
        made.step(X)

    row.holds(globals() | {"step": step})
    assert made.network.weight.tolist() == [[1.0, 1.0]]
    assert made.steps == 0


def test_a_weight_that_the_loss_does_not_see_stays():
    network: Any = nn.ModuleDict({"seen": line(), "unseen": line()})
    made = Learner(network, mean, sgd(network), predict=lambda network, x: network["seen"](x))
    made.step(X)
    assert network["unseen"].weight.tolist() == [[1.0, 1.0]]
    assert network["seen"].weight.tolist() != [[1.0, 1.0]]


def test_biases_do_not_decay():
    groups = adamw(nn.Linear(3, 2), 0.01, 0.5).param_groups
    shown = [(group["weight_decay"], [p.ndim for p in group["params"]]) for group in groups]
    assert shown == [(0.5, [2]), (0.0, [1])]


def test_a_weight_without_gradient_does_not_decay():
    network: Any = nn.ModuleDict({"seen": line(), "unseen": line()})
    optimiser = torch.optim.AdamW(network.parameters(), 0.1, weight_decay=0.5)
    made = Learner(network, mean, optimiser, predict=lambda network, x: network["seen"](x))
    made.step(X)
    assert network["unseen"].weight.tolist() == [[1.0, 1.0]]


def test_heads_that_take_turns_go_on_as_if_never_stopped():
    """A head that a step does not reach stays, before a stop and after it."""

    def made():
        network: Any = nn.ModuleDict({"a": line(), "b": line()})
        optimiser = torch.optim.AdamW(network.parameters(), 0.1, weight_decay=0.1)
        turn = lambda network, x: network["ab"[round(float(x[0, 0]))]](x)  # noqa: E731
        return Learner(network, mean, optimiser, predict=turn)

    batches = [torch.full_like(X, k % 2) for k in range(5)]
    through, stopped, resumed = made(), made(), made()
    for k, batch in enumerate(batches):
        held = through.network["ba"[k % 2]].weight.detach().clone()
        through.step(batch)
        assert torch.equal(through.network["ba"[k % 2]].weight, held)
    for batch in batches[:2]:
        stopped.step(batch)
    resumed.load_state_dict(stopped.state_dict())
    for batch in batches[2:]:
        resumed.step(batch)
    for one, other in zip(through.network.parameters(), resumed.network.parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_weight_under_two_names_has_one_average():
    class Tied(nn.Module):
        def __init__(self):
            super().__init__()
            self.one = self.other = line()

        def forward(self, x):
            return self.one(x)

    tied, alone = learner(Tied(), average=0.5), learner(average=0.5)
    for made in (tied, alone):
        made.step(X)
    assert torch.equal(tied.delivered.one.weight, alone.delivered.weight)


def test_learning_rates_are_part_of_the_state():
    made = learner()
    falling = torch.optim.lr_scheduler.StepLR(made.optimiser, 1, 0.1)
    made.step(X)
    falling.step()
    again = learner()
    again.load_state_dict(made.state_dict())
    assert again.optimiser.param_groups[0]["lr"] == pytest.approx(0.01)
