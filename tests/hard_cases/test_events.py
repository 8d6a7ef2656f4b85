"""Hard cases of the event stage: counts in closed form, gradients that stay finite, streams that refuse what
cannot be."""

import math

import pytest
import torch

from codesign.errors import DomainError
from codesign.events import (
    SensorModel,
    SensorState,
    lin_log,
    memory,
    sensor_counts,
    simulate,
    soft_counts,
    to_counts,
)

D = torch.float64
THETAS = (1e-3, 0.013, 0.2, 10.0)


def level_of(value):
    """Lin-log level by the formula, in plain numbers."""
    return value * math.log(20) / 20 if value <= 20 else math.log(value)


def hard_total(values, theta):
    """Signed and absolute counts of one pixel, by the definition in plain numbers."""
    reference = level_of(values[0])
    on = 0
    off = 0
    for value in values[1:]:
        count = math.trunc((level_of(value) - reference) / theta)
        reference += count * theta
        on = on + max(count, 0)
        off = off + max(-count, 0)
    return on, off


CASES = {
    "black": [0.0, 0.0, 0.0, 0.0],
    "black to light and back": [0.0, 255.0, 0.0, 255.0],
    "saturated": [255.0, 255.0, 255.0, 255.0],
    "constant": [77.0] * 6,
    "step of 1e4": [1.0, 1e4, 1e4, 1.0],
    "step of 1e4 in the dark": [1e-4, 1.0, 1e-4, 1.0],
    "around the joint of the front end": [19.9, 20.1, 19.9, 20.1, 25.0],
    "tiny flicker": [100.0, 100.0 + 1e-6, 100.0, 100.0 + 1e-6],
    "brighter than any film": [1e6, 1e12, 1e6],
}


# brighter than any film at a threshold of 0.001: rate x dead time is 9, beyond what was measured
@pytest.mark.filterwarnings("ignore:rate x dead time")
@pytest.mark.bits
@pytest.mark.parametrize("theta", THETAS)
@pytest.mark.parametrize("case", CASES)
def test_counts_are_those_of_the_definition_and_gradients_are_finite(case, theta):
    frames = torch.tensor(CASES[case], dtype=D)[:, None, None].requires_grad_()  # a picture of one pixel
    truth = hard_total(CASES[case], theta)
    t_s = torch.tensor([0.0, 1e-5, 0.3, 0.30001, 7.0, 7.5])[: len(frames)]  # far from uniform
    counts, _ = memory(frames, theta, theta)
    # a level that meets a threshold to the last bit may count one frame later: at most one event per frame
    # and polarity
    found = counts.sum((0, 2, 3)).tolist()
    assert abs(found[0] - truth[0]) <= 1
    assert abs(found[1] - truth[1]) <= 1
    assert abs((found[0] - found[1]) - (truth[0] - truth[1])) <= 1
    events = simulate(frames.detach(), t_s, SensorModel(theta, theta))
    assert torch.equal(to_counts(events, t_s, dtype=D), counts.detach())
    full = SensorModel(theta, theta, cutoff_hz=100.0, refractory_s=1e-4)
    for counted in (
        lambda f: memory(f, theta, theta)[0],
        lambda f: soft_counts(f, theta, theta),
        lambda f: sensor_counts(f, t_s, full, cutoff_hz=torch.tensor(100.0), refractory_s=torch.tensor(1e-4))[
            0
        ],
    ):
        (grad,) = torch.autograd.grad(counted(frames).square().sum(), frames)
        assert bool(grad.isfinite().all())


def test_ten_thousand_events_of_one_pixel_come_evenly():
    events = simulate(
        torch.tensor([0.0, 10.0005], dtype=D)[:, None, None],
        [0.0, 1.0],
        SensorModel(1e-3, 1e-3),
        log_input=True,
    )
    assert len(events) == 10_000
    truth = (torch.arange(1, 10_001) * 1e-3 / 10.0005 * 1e6).round().long()
    assert (events.t_us - truth).abs().max() <= 1


def test_a_long_pause_between_frames_loses_no_microsecond():
    # one day between two frames: the crossing of the level's middle at half a day
    day_s = 86_400.0
    events = simulate(
        torch.tensor([4.0, 5.0], dtype=D)[:, None, None],
        [1e9, 1e9 + day_s],
        SensorModel(0.5, 0.5),
        log_input=True,
    )
    assert (events.t_us - torch.tensor([int(1e15 + day_s * 5e5), int(1e15 + day_s * 1e6)])).abs().max() <= 1


def test_refused_frames_leave_a_stream_as_it_was():
    sensor = SensorModel(theta_sigma=0.02, shot_rate_hz=5.0)
    state = SensorState()
    good = torch.rand(5, 3, 4, generator=torch.Generator().manual_seed(0)) * 200
    simulate(good, torch.arange(5) * 0.01, sensor, state=state)
    for frames, times, words in (
        (good, torch.arange(5) * 0.01, "go on increasing"),
        (good, torch.tensor([0.1, 0.2, 0.2, 0.3, 0.4]), "increase"),
        (good * math.nan, torch.arange(5) + 1.0, "NaN"),
        (good - 300, torch.arange(5) + 1.0, "negative"),
        (good * math.inf, torch.arange(5) + 1.0, "NaN or infinite"),
        (good[:, :2], torch.arange(5) + 1.0, "keeps its size"),
    ):
        before = {name: tensor.clone() for name, tensor in state.tensors().items()}
        with pytest.raises(ValueError, match=words):
            simulate(frames, times, sensor, state=state)
        assert all(torch.equal(tensor, before[name]) for name, tensor in state.tensors().items())
    with pytest.raises(DomainError, match="exceed 64-bit"):
        simulate(good[:2].expand(2, 3, 4), [0.0, 1e13], SensorModel())


def test_more_events_than_a_pixel_can_make_are_refused_instead_of_counted_for_ever():
    for frames, sensor, gap_s in (
        (torch.tensor([0.0, 1e30]), SensorModel(), 1.0),
        (torch.tensor([0.0, 3e4]), SensorModel(1e-3, 1e-3), 1.0),
        (torch.tensor([0.0, 0.0]), SensorModel(shot_rate_hz=1e6), 1e4),
        (torch.tensor([0.0, 0.0]), SensorModel(leak_rate_hz=1e6), 1e4),
    ):
        with pytest.raises(DomainError, match="would fire more than 1000000 events"):
            simulate(frames[:, None, None], [0.0, gap_s], sensor, log_input=True)


def test_levels_and_thresholds_beyond_single_precision_steps_still_add_up():
    # float32 near ln(1e12) = 27.6 resolves 2e-6: counts over a long ramp stay whole and add up to the way
    # within one
    frames = torch.logspace(6, 12, 200)[:, None, None]
    counts, state = memory(frames, 1e-3, 1e-3)
    way = float(lin_log(frames.double())[-1] - lin_log(frames.double())[0])
    assert abs(float(counts[:, 0].sum()) - way / 1e-3) <= 1 + 200 * 2e-6 / 1e-3
    assert not counts[:, 1].any()
    assert abs(float(state[0]) - math.log(1e12)) < 2e-3
