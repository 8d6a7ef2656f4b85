"""The gradient of the coupled step layer against the mean of hard counts over enumerated beginnings."""

import doctest
from pathlib import Path

import pytest
import torch

from codesign import events
from codesign.errors import DomainError
from codesign.events.spiking.srm import srm
from codesign.events.spiking.srm_play import _Limited

D = torch.float64
THETA = 0.2
STEP = {"theta": THETA, "kernel": "step", "response": "step", "reset_scale": 1.0, "coupled": True}


def walk(seed, frames=24, pixels=6, size=0.25):
    """Levels [frames, pixels]; most steps are below the threshold, some are two or three of them."""
    generator = torch.Generator().manual_seed(seed)
    return (size * torch.randn(frames, pixels, generator=generator, dtype=D)).cumsum(0)


def hard(level, beginnings):
    """Mean counts [T-1, 2, N] of a level [T, N] that begins evenly over half a threshold either way."""
    place = (torch.arange(beginnings, dtype=D) + 0.5) / beginnings - 0.5
    memorised = level[0][:, None] + THETA * place
    found = []
    for now in level[1:]:
        on = (now[:, None] - memorised >= THETA).to(D)
        off = (memorised - now[:, None] >= THETA).to(D)
        memorised = memorised + THETA * (on - off)
        found.append(torch.stack((on.mean(1), off.mean(1))))
    return torch.stack(found)


def spikes_of(level):
    return events.layer("srm", events.SensorModel(THETA, THETA), log_input=True)(
        level[:, None], torch.arange(len(level), dtype=D)
    )[:, :, 0]


@pytest.mark.parametrize("size", [0.05, 0.25])
def test_the_gradient_is_that_of_the_mean_over_beginnings(size):
    first = walk(0, size=size)
    last = first + 0.3 * walk(1, size=0.2)
    generator = torch.Generator().manual_seed(2)
    weights = torch.rand(len(first) - 1, 2, 1, generator=generator, dtype=D)
    sections = 400
    slope = torch.zeros(first.shape[1], dtype=D)
    for k in range(sections):
        level = (first + (last - first) * (k + 0.5) / sections).requires_grad_()
        (spikes_of(level) * weights).sum().backward()
        slope += (level.grad * (last - first)).sum(0) / sections
    truth = ((hard(last, 20000) - hard(first, 20000)) * weights).sum((0, 1))
    # a kink inside a section moves it by at most its share of a slope of 1/C times the way, some 40 of them
    torch.testing.assert_close(slope, truth, rtol=0, atol=40 * 0.5 / sections)
    assert float(truth.abs().max()) > 0.5


def test_what_a_large_step_leaves_over_fires_later_and_by_the_same_level():
    # a step of 3.3 thresholds: three frames of a certain event, then one with probability 0.8
    level = torch.tensor([0.0, 3.3 * THETA, 3.3 * THETA, 3.3 * THETA, 3.3 * THETA], dtype=D)
    truth = hard(level[:, None], 1000)[:, 0, 0]
    torch.testing.assert_close(truth, torch.tensor([1.0, 1.0, 0.8, 0.0], dtype=D))
    for row, slope in ((0, 0.0), (1, 0.0), (2, 1 / THETA)):
        moved = level[:, None].clone().requires_grad_()
        spikes_of(moved)[row, 0, 0].backward()
        torch.testing.assert_close(moved.grad[row + 1, 0], torch.tensor(slope, dtype=D))


def test_the_level_that_is_held_back_passes_gradcheck():
    level = walk(3).requires_grad_()
    centre = (level.detach()[0] + 0.01).requires_grad_()
    on, off = (torch.tensor(c, dtype=D, requires_grad=True) for c in (0.2, 0.3))
    assert torch.autograd.gradcheck(_Limited.apply, (level, centre, on, off))


def test_the_slope_to_the_threshold_is_that_of_the_mean():
    level = walk(5, size=0.1)
    theta = torch.tensor(THETA, dtype=D, requires_grad=True)
    step = level.diff(dim=0)
    drive = torch.stack((step, -step), 1)
    spikes, _, _ = srm(drive, **{**STEP, "theta": theta}, gradient="play")
    spikes[:, 0].sum().backward()
    wide = 200_000
    # by scaling: counts of (level, C) are those of (level / C, 1)
    up, down = (hard(level * THETA / c, wide)[:, 0].sum() for c in (THETA * 1.0005, THETA * 0.9995))
    # neither side has a kink here; the even beginnings leave 24 * 6 / wide of either sum
    assert float(theta.grad) == pytest.approx(float(up - down) / (0.001 * THETA), abs=2 * 144 / wide / 2e-4)


@pytest.mark.bits
@pytest.mark.parametrize("cut", [1, 7, 15])
def test_chunks_give_the_spikes_and_the_gradient_of_the_whole(cut):
    level = walk(6)
    step = level.diff(dim=0)
    seeds = torch.rand(len(step), 2, step.shape[1], generator=torch.Generator().manual_seed(7), dtype=D)
    found = []
    for parts in ((step,), (step[:cut], step[cut:])):
        leaves = [part.clone().requires_grad_() for part in parts]
        state = None
        spikes = []
        for leaf in leaves:
            some, _, state = srm(torch.stack((leaf, -leaf), 1), **STEP, gradient="play", state=state)
            spikes.append(some)
        (torch.cat(spikes) * seeds).sum().backward()
        found.append((torch.cat(spikes).detach(), torch.cat([leaf.grad for leaf in leaves])))
    assert torch.equal(found[0][0], found[1][0])
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-12, atol=1e-12)
    plain, _, _ = srm(torch.stack((step, -step), 1), **STEP)
    assert torch.equal(found[0][0], plain)


def test_the_event_layer_goes_on_in_chunks():
    level = walk(8).requires_grad_()
    t_s = torch.arange(len(level), dtype=D)
    made = events.layer("srm", events.SensorModel(THETA, THETA), log_input=True)
    whole = made(level[:, None], t_s)
    seeds = torch.rand(whole.shape, generator=torch.Generator().manual_seed(9), dtype=D)
    (by_whole,) = torch.autograd.grad((whole * seeds).sum(), level)
    first, state = made.advance(level[:9, None], t_s[:9])
    second, _ = made.advance(level[9:, None], t_s[9:], state)
    both = torch.cat((first, second))
    (by_chunks,) = torch.autograd.grad((both * seeds).sum(), level)
    assert torch.equal(both, whole)
    torch.testing.assert_close(by_chunks, by_whole, rtol=1e-12, atol=1e-12)


def test_enough_steps_per_frame_give_the_counts_and_gradients_of_the_memory_layer():
    level = walk(10, frames=12, size=0.4).requires_grad_()  # up to six thresholds between two frames
    t_s = torch.arange(12, dtype=D)
    seeds = torch.rand(11, 2, 1, 6, generator=torch.Generator().manual_seed(11), dtype=D)
    sensor = events.SensorModel(THETA, THETA)
    found = []
    for name, options in (("memory", {}), ("srm", {"steps": 16})):
        counts = events.layer(name, sensor, log_input=True, **options)(level[:, None], t_s)
        found.append((counts.detach(), torch.autograd.grad((counts * seeds).sum(), level)[0]))
    assert float((level.detach().diff(dim=0).abs() / THETA).max()) > 3
    assert torch.equal(found[0][0], found[1][0])
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-9, atol=1e-9)


def test_several_steps_per_frame_go_on_in_chunks():
    level = walk(12, frames=10, size=0.4)
    t_s = torch.arange(10, dtype=D)
    made = events.layer("srm", events.SensorModel(THETA, THETA), log_input=True, steps=3)
    first, state = made.advance(level[:4, None], t_s[:4])
    second, _ = made.advance(level[4:, None], t_s[4:], state)
    assert torch.equal(torch.cat((first, second)), made(level[:, None], t_s))
    with pytest.raises(DomainError, match="steps is 0; a whole number >= 1"):
        events.layer("srm", steps=0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kernel": "slayer", "tau_r": 1.0}, "goes with kernel='step'"),
        ({"response": "none"}, "goes with response='step'"),
        ({"reset_scale": 2.0}, "goes with reset_scale=1.0"),
        ({"coupled": False}, "goes with coupled=True"),
        ({"gradient": "exact"}, "gradient is 'exact'; choose one of"),
    ],
)
def test_other_layers_have_no_play(change, words):
    drive = torch.zeros(3, 2, 1)
    with pytest.raises(DomainError, match=words):
        srm(drive, **{**STEP, "gradient": "play", **change})


def test_drives_of_two_levels_and_states_without_a_play_are_refused():
    drive = torch.ones(3, 2, 1)
    with pytest.raises(DomainError, match="minus the ON drive"):
        srm(drive, **STEP, gradient="play")
    drive[:, 1] = -1
    _, _, state = srm(drive, **STEP)
    with pytest.raises(DomainError, match="the state comes from a layer without"):
        srm(drive, **STEP, gradient="play", state=state)
    with pytest.raises(DomainError, match="gradient is 'mean'"):
        events.layer("srm", gradient="mean")


def test_the_page_gives_what_it_says():
    page = Path(__file__).resolve().parents[2] / "docs" / "srm.md"
    found = doctest.testfile(str(page), module_relative=False)
    assert found.attempted > 0
    assert found.failed == 0
