"""Scores of estimators, against sums worked out by hand."""

import math

import pytest
import torch

from codesign.errors import DomainError
from codesign.flow.export import evenly_timed
from codesign.train.validation import error_ratio, score
from codesign.types import EventVolume, FlowField, FlowWindows
from tests.flow_training_case import TRUE_WEIGHTS, Linear, Made


def test_scores_are_those_worked_out_by_hand():
    """Two windows: true flow (3, 4) on 2 pixels and (0, 1) on 1. The estimate (3, 0) is 4, 4 and
    sqrt(10) off; zero flow 5, 5 and 1. Then the first window once more."""
    flow = torch.zeros(2, 2, 1, 2)
    flow[0, 0], flow[0, 1], flow[1, 1] = 3, 4, 1
    valid = torch.tensor([[[True, True]], [[False, True]]])
    guess = torch.zeros(2, 2, 1, 2)
    guess[:, 0] = 3

    def windows(count):
        volume = evenly_timed(torch.zeros(count, 2, 2, 1, 2))
        return FlowWindows(volume, FlowField(flow[:count], valid[:count], 1.0))

    def guessed(volume):
        return FlowField(guess[: len(volume.counts)], valid, 1.0)

    found = score(guessed, [windows(2), windows(1)])
    assert found.aee_px == pytest.approx((16 + math.sqrt(10)) / 5)
    assert found.zero_flow_px == pytest.approx(21 / 5)
    assert found.ratio == pytest.approx((16 + math.sqrt(10)) / 21)
    assert found.worse_percent == pytest.approx(100 / 3)
    assert found.windows == 3
    flow[1, :, 0, 0] = torch.nan  # what is not valid means nothing
    assert score(guessed, [windows(2), windows(1)]) == found


class Short(Made):
    """A source with an end, that says what it is asked for."""

    def __len__(self):
        return 19


def test_the_judge_of_a_fit_is_the_ratio_on_windows_made_once():
    made = []
    judge = error_ratio(Short(before=made.append), 20)
    network = Linear()
    with torch.no_grad():
        network.layer.weight.zero_()
        assert judge(network) == 1.0
        network.layer.weight.copy_(TRUE_WEIGHTS[:, :, None, None])
    assert judge(network) < 1e-6
    assert [list(each) for each in made] == [list(range(16)), [16, 17, 18]]


def test_windows_without_truth_are_judged_by_the_blur_of_their_events():
    """A dot crosses 4 px in a window: along its flow all five events fall on one pixel (a fifth of
    the energy spread out, less the stretch of smoothing), unmoved they lie side by side, which is
    1, and against it they part further."""
    counts = torch.zeros(1, 2, 5, 9, 15)
    counts[0, 0, torch.arange(5), 4, 5 + torch.arange(5)] = 1.0
    volume = EventVolume(
        counts, torch.linspace(0, 1, 5), torch.tensor([0.125, 0.25, 0.25, 0.25, 0.125])
    )
    unknown = FlowField(torch.zeros(1, 2, 9, 15), torch.zeros(1, 9, 15, dtype=torch.bool), 1.0)

    def judged(length_px):
        flow = torch.zeros(1, 2, 9, 15)
        flow[:, 0] = length_px
        return score(lambda _: FlowField(flow, unknown.valid, 1.0), [FlowWindows(volume, unknown)])

    along, still, against = judged(4.0), judged(0.0), judged(-4.0)
    assert still.ratio == pytest.approx(1.0)
    assert along.ratio < 0.6 < 1.0 < against.ratio
    assert (along.worse_percent, against.worse_percent, along.windows) == (0.0, 100.0, 1)


def test_windows_that_stand_still_judge_no_network():
    truth = FlowField(torch.zeros(1, 2, 4, 4), torch.ones(1, 4, 4, dtype=torch.bool), 0.01)
    windows = FlowWindows(evenly_timed(torch.ones(1, 2, 2, 4, 4)), truth, None)
    with pytest.raises(DomainError, match="is 0 everywhere"):
        score(lambda volume: truth, [windows])
    with pytest.raises(DomainError, match="no windows to judge on"):
        score(lambda volume: truth, [])
