"""The memory layer against the definition in plain numbers, a plain autograd loop, and the mean of
hard counts over a pixel's beginnings, enumerated; closed forms of its exact gradient for unequal
thresholds."""

import math

import pytest
import torch

from codesign.events import lin_log, memory, soft_counts
from tests.numbers import D, close, f64, rand64, randn64, seeded

PAIRS_OF_THRESHOLDS = [(0.2, 0.2), (0.1, 0.3), (0.3, 0.1), (0.155, 0.172), (0.17, 0.23)]


def plain_loop(level, theta_on, theta_off, state=None):
    """The same model as ordinary loops: whole counts forward, the play's slopes backward. Returns
    counts, memorised level, centre of the play."""
    if state is None:
        level, state = level[1:], level[0]
    reference = state.detach()
    centre = state
    width = (theta_on + theta_off) / 2
    counts = []
    for now in level:
        with torch.no_grad():
            on = (now - reference).clamp(min=0).div(theta_on, rounding_mode="floor")
            off = (reference - now).clamp(min=0).div(theta_off, rounding_mode="floor")
            reference = reference + theta_on * on - theta_off * off
        rise = (now - centre - width / 2).clamp(min=0)
        fall = (centre - width / 2 - now).clamp(min=0)
        centre = centre + rise - fall
        smooth = torch.stack((rise / theta_on, fall / theta_off))
        counts.append(torch.stack((on, off)) + (smooth - smooth.detach()))
    return torch.stack(counts), reference, centre


def random_walk(frames=30, pixels=(5, 4), seed=0, size=0.3):
    return (size * randn64(seeded(seed), frames, *pixels)).cumsum(0)


@pytest.mark.parametrize(("shape", "with_state"), [((), False), ((5, 4), True)])
def test_counts_and_all_gradients_equal_a_plain_autograd_loop(shape, with_state, generator):
    inputs = [random_walk()]
    inputs += [theta + 0.05 * rand64(generator, shape) for theta in (0.2, 0.3)]
    inputs += [torch.zeros(5, 4, dtype=D)] * with_state
    inputs = [one.requires_grad_() for one in inputs]
    state = inputs[3] if with_state else None
    counts, state = memory(*inputs[:3], state=state, log_input=True, gradient="play")
    truth, reference, centre = plain_loop(*inputs)
    close(counts, truth, atol=1e-12)  # n + (s - s) rounds
    close(state.detach(), torch.stack((reference, centre)).detach(), atol=1e-13)
    weights = [randn64(generator, one.shape) for one in (counts, centre)]
    found = torch.autograd.grad((counts, state[1]), inputs, weights)
    expected = torch.autograd.grad((truth, centre), inputs, weights)
    for mine, theirs in zip(found, expected, strict=True):
        # sums of up to 600 terms of float64 rounding
        close(mine, theirs, rtol=1e-12, atol=1e-12 * float(theirs.abs().max()))


def mean_counts(level, theta_on, theta_off, beginnings=1 << 16):
    """Counts [T-1, 2, ...] of paths [T, ...], the mean over a pixel's beginnings: its memorised
    level lies evenly from theta_on/2 below the first level to theta_off/2 above it."""
    share = (torch.arange(beginnings, dtype=D) + 0.5) / beginnings
    begun = level[0, ..., None] - theta_on / 2 + share * (theta_on + theta_off) / 2
    later = level[1:, ..., None].expand(*[-1] * level.ndim, beginnings)
    return memory(later, theta_on, theta_off, state=begun, log_input=True)[0].mean(-1)


def gradient(level, theta_on, theta_off, weight, **options):
    level = level.clone().requires_grad_()
    counts, _ = memory(level[:, None], theta_on, theta_off, log_input=True, **options)
    return torch.autograd.grad((counts[:, :, 0] * weight).sum(), level)[0]


def path(turns, steps, seed):
    """[T] float64: straight stretches of a random length up to 0.8, each cut into ``steps`` random
    steps."""
    length = 0.1 + 0.7 * rand64(seeded(seed), turns + 1)
    share = rand64(seeded(seed + 50), turns + 1, steps) + 0.1
    sign = f64([1.0, -1.0]).repeat(turns)[: turns + 1]
    moves = (sign * length)[:, None] * share / share.sum(1, keepdim=True)
    return torch.cat((torch.zeros(1, dtype=D), moves.flatten().cumsum(0)))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("theta_on", "theta_off"), PAIRS_OF_THRESHOLDS)
def test_the_gradient_of_random_turns_is_that_of_enumeration(theta_on, theta_off, seed):
    level = path(turns=3, steps=3, seed=seed)
    weight = randn64(seeded(100 + seed), len(level) - 1, 2)
    slopes = gradient(level, theta_on, theta_off, weight, gradient="exact")
    # the mean is piecewise linear in every level; its grid of beginnings leaves some 2e-5 of an
    # event in each count, so that a difference over 4e-4 is good to some 0.1 where slopes are 5 to
    # 20
    step = 2e-4
    moves = step * torch.eye(len(level), dtype=D)
    ends = [
        mean_counts(level[:, None] + sign * moves, theta_on, theta_off, 1 << 15) for sign in (1, -1)
    ]
    wanted = ((ends[0] - ends[1]) * weight[..., None]).sum((0, 1)) / (2 * step)
    close(slopes, wanted, atol=0.3)


def test_equal_thresholds_give_the_play_and_change_together_exactly(generator):
    level = random_walk(20, (), seed=6, size=0.1)
    weight = randn64(generator, 19, 2)
    slopes = [gradient(level, 0.2, 0.2, weight, gradient=name) for name in ("exact", "play")]
    close(*slopes, atol=1e-12)
    theta = torch.tensor(0.2, dtype=D, requires_grad=True)
    counts, _ = memory(level[:, None], theta, theta, log_input=True)
    (slope,) = torch.autograd.grad((counts[:, :, 0] * weight).sum(), theta)
    ends = [mean_counts(level, theta, theta) for theta in (0.2005, 0.1995)]
    assert float(slope) == pytest.approx(
        float(((ends[0] - ends[1]) * weight).sum()) / 1e-3, abs=0.1
    )


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_a_shift_of_all_levels_changes_no_count_however_many_turns(dtype):
    level = random_walk(400, (50,), seed=1, size=0.1).to(dtype).requires_grad_()
    counts, _ = memory(level, 0.17, 0.23, log_input=True)
    weight = torch.randn(counts.shape, generator=seeded(2), dtype=dtype)
    (slopes,) = torch.autograd.grad(counts, level, weight)
    scale = float(slopes.abs().sum(0).max())
    assert slopes.sum(0).abs().max() < (1e-5 if dtype == torch.float32 else 1e-13) * scale


@pytest.mark.bits
def test_soft_counts_add_up_to_those_of_memory():
    level = random_walk(8, (3, 2))
    climb = level.abs().cumsum(0)
    soft = soft_counts(climb, 0.2, 0.2, log_input=True).sum(0)
    assert torch.equal(soft.floor(), memory(climb, 0.2, 0.2, log_input=True)[0].sum(0))


@pytest.mark.parametrize(("theta_off", "taken"), [(0.24, "play"), (0.26, "exact")])
def test_which_gradient_is_taken_depends_on_the_thresholds(theta_off, taken):
    level = random_walk(30, (), seed=2, size=0.2)
    weight = torch.ones(29, 2, dtype=D)
    slopes = [gradient(level, 0.2, theta_off, weight, gradient=name) for name in (None, taken)]
    close(*slopes)


def test_thresholds_beyond_the_measured_ratio_and_second_derivatives_are_named():
    level = torch.tensor([0.0, 1.0, 2.0], requires_grad=True)
    memory(level.detach(), 0.05, 0.25, log_input=True)
    with pytest.warns(RuntimeWarning, match="ratio of 4"):
        counts, _ = memory(level, 0.05, 0.25, log_input=True)
    weight = torch.ones(2, 2, requires_grad=True)
    (slope,) = torch.autograd.grad(counts, level, weight, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()


def test_float32_levels_beyond_any_film_still_add_up():
    # float32 near ln(1e12) = 27.6 resolves 2e-6: counts over a long ramp stay whole and add up to
    # the way within one
    frames = torch.logspace(6, 12, 200)[:, None, None]
    counts, state = memory(frames, 1e-3, 1e-3)
    way = float(lin_log(frames.double())[-1] - lin_log(frames.double())[0])
    assert abs(counts[:, 0].sum() - way / 1e-3) <= 1 + 200 * 2e-6 / 1e-3
    assert not counts[:, 1].any()
    assert abs(state[0] - math.log(1e12)) < 2e-3
