"""Training in one call: what is learnt, kept, resumed and refused, alone and in two processes."""

import json
import signal
from functools import partial
from typing import Any

import pytest
import torch
from torch import nn

from codesign import train
from codesign.errors import FileFormatError
from tests import refusals
from tests.flow_training_case import TRUE_WEIGHTS, Linear, Made, in_two_processes, state_of


def linear() -> Any:
    torch.manual_seed(0)
    return Linear()


def adam(network, rate=0.05):
    return torch.optim.Adam(network.parameters(), rate)


def distance(network: Any):
    return float((network.layer.weight.detach()[:, :, 0, 0] - TRUE_WEIGHTS).abs().max())


def test_a_flow_network_finds_the_known_answer():
    """At the end of a falling schedule Adam is within about its last step sizes of the answer: 1e-2
    of weights of order 1."""
    network = linear().eval()
    made = train.fit(network, Made(), steps=250, batch=4, optimiser=adam(network))
    assert distance(network) < 1e-2
    assert made.step == len(made.loss) == len(made.norm) == len(made.rate) == 250
    assert made.rate[0] == pytest.approx(0.0005)
    assert max(made.rate) == pytest.approx(0.05, rel=0.05)
    assert not network.training, "left in the mode it came in"


def test_a_network_without_earlier_predictions_and_a_mix_are_enough():
    class Plain(nn.Module):
        def __init__(self):
            super().__init__()
            self.inner = linear()

        def forward(self, volume):
            return self.inner(volume)

    asked = {"a": [], "b": []}
    network = Plain()
    mix = [(0.75, Made(before=asked["a"].extend)), (0.25, Made(before=asked["b"].extend))]
    train.fit(network, mix, steps=40, batch=4, optimiser=adam(network))
    # one looked at each
    assert len(asked["a"]) == pytest.approx(121, abs=4)
    assert len(asked["b"]) == pytest.approx(41, abs=4)


def test_the_best_weights_are_what_remains():
    """A step that is far too long in the second half leaves the answer again."""
    network = linear()
    scores = []

    def judge(network):
        scores.append(distance(network))
        return scores[-1]

    made = train.fit(
        network,
        Made(),
        steps=60,
        batch=4,
        optimiser=adam(network),
        schedule=lambda share: 1.0 if share < 0.5 else 40.0,
        validate=judge,
        validate_every=7,
    )
    assert [entry["step"] for entry in made.validation] == [7, 14, 21, 28, 35, 42, 49, 56, 60]
    assert [entry["score"] for entry in made.validation] == scores
    assert distance(network) == min(scores) < scores[8]


class Noisy(nn.Module):
    """A network that draws, and has running statistics."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(3)
        self.layers = nn.Sequential(
            nn.Linear(2, 8), nn.BatchNorm1d(8), nn.Dropout(0.4), nn.Linear(8, 1)
        )

    def forward(self, x):
        return self.layers(x)


def far(y, x, k=1.0):
    return (y - k * x[:, :1]).square().mean()


def noisy_fit(folder, network, **options):
    def batches(step):
        return torch.randn(16, 2, generator=torch.Generator().manual_seed(step))

    return train.fit(
        network,
        batches,
        **{"steps": 8, "loss": far, **options},
        predict=lambda network, x: network(x),
        average=0.9,
        validate=lambda network: float((network(batches(1000)) - 1).square().mean()),
        validate_every=3,
        save_to=folder,
        save_every=2,
    )


@pytest.mark.bits
def test_interrupted_and_resumed_is_uninterrupted_bit_for_bit(tmp_path):
    whole = Noisy()
    expected = noisy_fit(tmp_path / "whole", whole)

    def stop(step, loss):
        if step == 5:
            signal.raise_signal(signal.SIGINT)

    earlier = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        noisy_fit(tmp_path / "parts", Noisy(), progress=stop)
    assert signal.getsignal(signal.SIGINT) == earlier
    stored = json.loads((tmp_path / "parts" / "checkpoint.json").read_text())
    assert stored["progress"]["step"] == 5, (
        "saved at a whole step, between those that are saved anyway"
    )
    told = []
    parts: Any = Noisy()
    found = noisy_fit(
        tmp_path / "parts", parts, progress=lambda step, loss: told.append((step, loss))
    )
    assert told == [(step, expected.loss[step - 1]) for step in (6, 7, 8)]
    assert (found.loss, found.norm, found.rate) == (expected.loss, expected.norm, expected.rate)
    assert found.validation == expected.validation
    assert state_of(tmp_path / "parts") == state_of(tmp_path / "whole")
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, parts.state_dict()[name]), name
    assert noisy_fit(tmp_path / "parts", Noisy()).step == 8, "nothing is left to do"


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"steps": 9}, "written with steps 8, this run has 9"),
        ({"clip": 1.0}, "written with clip inf, this run has 1.0"),
    ],
)
def test_another_training_is_not_resumed(tmp_path, options, sentence):
    noisy_fit(tmp_path, Noisy())
    with pytest.raises(FileFormatError, match=sentence):
        noisy_fit(tmp_path, Noisy(), **options)
    assert noisy_fit(tmp_path, Noisy(), **options, resume=False).step == options.get("steps", 8)


@pytest.mark.parametrize("of", [lambda k: partial(far, k=k), lambda k: lambda y, x: far(y, x, k)])
def test_another_loss_is_not_resumed(tmp_path, of):
    noisy_fit(tmp_path, Noisy(), loss=of(2.0))
    assert noisy_fit(tmp_path, Noisy(), loss=of(2.0)).step == 8
    with pytest.raises(FileFormatError, match=r"functions .*, this run has .*; start a new"):
        noisy_fit(tmp_path, Noisy(), loss=of(3.0))
    stored = json.loads((tmp_path / "checkpoint.json").read_text())
    del stored["functions"]  # as of a run begun before it was written
    (tmp_path / "checkpoint.json").write_text(json.dumps(stored))
    assert noisy_fit(tmp_path, Noisy(), loss=of(3.0)).step == 8


@refusals.table(__file__, "fits")
def test_what_is_unfit_is_refused_before_the_first_step(row):
    asked = []
    network = linear()

    def fit(blind=False, **options):
        windows = Made(frames=False, blind=blind, before=asked.append)
        train.fit(network, windows, **{"steps": 2, **options})

    row.holds(globals() | {"fit": fit})
    assert asked in ([], [[0]]), "one window may be looked at, no more"
    assert torch.equal(network.layer.weight, linear().layer.weight)


def nearness(network):
    """A score that the first weights judged win, not the last."""
    return -distance(network)


SHARED = """
import signal, sys, torch
from codesign import train
from tests.flow_training_case import Made
from tests.train.test_fit import linear, nearness
ranks = train.join()
asked = []
def before(indices):
    asked.append(len(indices))
    if ranks.rank == 1 and len(asked) == 4:  # one look at the windows, then three steps
        signal.raise_signal(signal.SIGINT)
def run():
    network = linear()
    network.layer.weight.data += ranks.rank  # the first process's weights count
    network.unseen = torch.nn.Parameter(torch.ones(2))  # stays, though it is to decay
    groups = [{"params": network.layer.parameters()}, {"params": [network.unseen], "weight_decay": 0.5}]
    judge = nearness if ranks.rank == 0 else lambda network: 1 / 0
    made = train.fit(network, Made(before=before), steps=6, batch=4, optimiser=torch.optim.AdamW(groups, 0.01, weight_decay=0),
        average=0.5, ranks=ranks, validate=judge, validate_every=2, save_to=sys.argv[1])
    assert network.unseen.tolist() == [1, 1]
    return network.layer.weight, made.loss, made.norm, len(made.validation)
try:
    run()
except KeyboardInterrupt:
    ranks.tell()  # the first process has saved
    torch.save((*run(), asked), f"{sys.argv[1]}.{ranks.rank}")
ranks.leave()
"""


def test_two_processes_interrupted_and_resumed_learn_what_one_does(tmp_path):
    """One of them is asked to stop, both do, after the same step. Halves of a batch are averaged in
    another
    order: float32 sums of 1024 terms differ by 1e-5 at most, and Adam takes steps of at most 1e-2
    times the relative change of a gradient."""
    network = linear()
    options = {"average": 0.5, "validate": nearness, "validate_every": 2}
    alone = train.fit(network, Made(), steps=6, batch=4, optimiser=adam(network, 0.01), **options)
    folder = tmp_path / "two"
    codes, said = in_two_processes(SHARED, folder)
    assert codes == [0, 0], said
    found = [torch.load(f"{folder}.{rank}") for rank in (0, 1)]
    assert torch.equal(found[0][0], found[1][0]), "the best weights reach every process"
    assert torch.allclose(found[0][0], network.layer.weight, atol=1e-5, rtol=0)
    assert not torch.equal(network.layer.weight, linear().layer.weight)
    for _, loss, norm, _, asked in found:
        assert loss == pytest.approx(alone.loss, rel=1e-5)
        assert norm == pytest.approx(alone.norm, rel=1e-5)
        assert asked == [1, 2, 2, 2] * 2, "one look and three steps on half a batch, twice"
    assert found[0][3] == 3
    assert [path.name for path in folder.glob("*.json")] == ["checkpoint.json"]


def test_parts_that_are_in_evaluation_stay_there():
    class Normed(nn.Module):
        def __init__(self):
            super().__init__()
            self.norm = nn.BatchNorm2d(4).requires_grad_(False).eval()
            self.inner = linear()

        def forward(self, volume):
            self.norm(volume.counts.flatten(1, 2))
            return self.inner(volume)

    network = Normed()
    weights = adam(network.inner)
    train.fit(network, Made(), steps=3, batch=2, optimiser=weights, validate=lambda _: 1.0)
    assert not network.norm.training
    assert network.inner.training
    assert float(network.norm.running_mean.abs().max()) == 0
