"""The exact gradient of the memory layer for unequal thresholds, against enumeration over beginnings and
closed forms."""

import math

import pytest
import torch

from codesign.events import memory

BEGINNINGS = 1 << 16
PAIRS_OF_THRESHOLDS = [(0.1, 0.3), (0.3, 0.1), (0.155, 0.172), (0.17, 0.23)]


def mean_counts(level, theta_on, theta_off, beginnings=BEGINNINGS):
    """Counts [T-1, 2] of one path [T], the mean over a pixel's beginnings: its memorised level lies evenly
    from theta_on/2 below the first level to theta_off/2 above it."""
    share = (torch.arange(beginnings, dtype=torch.float64) + 0.5) / beginnings
    begun = level[0] - theta_on / 2 + share * (theta_on + theta_off) / 2
    later = level[1:, None].expand(-1, beginnings)
    return memory(later, theta_on, theta_off, state=begun, log_input=True)[0].mean(2)


def gradient(level, theta_on, theta_off, weight, **options):
    level = level.clone().requires_grad_()
    counts, _ = memory(level[:, None], theta_on, theta_off, log_input=True, **options)
    return torch.autograd.grad((counts[:, :, 0] * weight).sum(), level)[0]


def path(turns, steps, seed):
    """[T] float64: straight stretches of a random length up to 0.8, each cut into ``steps`` random steps."""
    generator = torch.Generator().manual_seed(seed)
    length = 0.1 + 0.7 * torch.rand(turns + 1, generator=generator, dtype=torch.float64)
    share = torch.rand(turns + 1, steps, generator=generator, dtype=torch.float64) + 0.1
    share = share / share.sum(1, keepdim=True)
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64).repeat(turns + 1)[: turns + 1]
    moves = (sign * length)[:, None] * share
    return torch.cat((torch.zeros(1, dtype=torch.float64), moves.flatten().cumsum(0)))


@pytest.mark.parametrize(("theta_on", "theta_off"), PAIRS_OF_THRESHOLDS)
@pytest.mark.parametrize("seed", range(3))
def test_the_gradient_of_random_turns_is_that_of_enumeration(theta_on, theta_off, seed):
    level = path(turns=3, steps=3, seed=seed)
    generator = torch.Generator().manual_seed(100 + seed)
    weight = torch.randn(len(level) - 1, 2, generator=generator, dtype=torch.float64)
    slopes = gradient(level, theta_on, theta_off, weight, gradient="exact")
    # the mean is piecewise linear in every level; its grid of beginnings leaves some 1e-5 of an event in each
    # count, so that a difference over 4e-4 is good to some 0.1 where slopes are 5 to 20
    step = 2e-4
    found = []
    for k in range(len(level)):
        move = torch.zeros_like(level)
        move[k] = step
        ends = [mean_counts(level + sign * move, theta_on, theta_off) for sign in (1, -1)]
        found.append(float(((ends[0] - ends[1]) * weight).sum()) / (2 * step))
    torch.testing.assert_close(slopes, torch.tensor(found, dtype=torch.float64), rtol=0, atol=0.3)


@pytest.mark.parametrize("back", [0.05, 0.25, 0.29, 0.31, 0.35, 0.39, 0.41, 0.55, 0.61, 0.65, 0.71])
def test_the_way_back_after_a_long_rise_in_closed_form(back):
    # 0.1 ON, 0.3 OFF, behind a rise of 2 the level difference lies evenly from 0 to 0.1: the way back is dead
    # for
    # 0.3, fires every pixel over the next 0.1, is dead for 0.2, and so on
    level = torch.tensor([0.0, 2.0, 2.0 - back], dtype=torch.float64)
    weight = torch.tensor([[0.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    slope = float(gradient(level, 0.1, 0.3, weight)[2])
    fires = any(0.3 * k < back < 0.3 * k + 0.1 for k in (1, 2))
    assert slope == pytest.approx(-10.0 if fires else 0.0, abs=1e-9)


def test_a_hundred_turns_leave_most_of_the_gradient_that_five_pairs_can_carry():
    generator = torch.Generator().manual_seed(5)
    found = []
    for _ in range(16):
        level, move = 0.1 * torch.randn(2, 100, generator=generator, dtype=torch.float64)
        level = level.cumsum(0)
        weight = torch.randn(99, 2, generator=generator, dtype=torch.float64)
        step = 2e-3
        ends = [mean_counts(level + sign * step * move, 0.17, 0.23, 1 << 14) for sign in (1, -1)]
        wanted = ((ends[0] - ends[1]) * weight).sum() / (2 * step)
        slopes = gradient(level, 0.17, 0.23, weight, gradient="exact")
        found.append(torch.stack((slopes @ move, wanted)))
    slopes, wanted = torch.stack(found, 1)
    # four seeds: 0.86 to 0.96, and 0.2 to 0.65 for the play
    assert slopes @ wanted / (slopes.norm() * wanted.norm()) > 0.85


def test_equal_thresholds_that_change_together_have_the_exact_gradient():
    generator = torch.Generator().manual_seed(6)
    level = (0.1 * torch.randn(20, generator=generator, dtype=torch.float64)).cumsum(0)
    weight = torch.randn(19, 2, generator=generator, dtype=torch.float64)
    theta = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    counts, _ = memory(level[:, None], theta, theta, log_input=True)
    (slope,) = torch.autograd.grad((counts[:, :, 0] * weight).sum(), theta)
    step = 5e-4
    ends = [mean_counts(level, 0.2 + sign * step, 0.2 + sign * step) for sign in (1, -1)]
    wanted = float(((ends[0] - ends[1]) * weight).sum()) / (2 * step)
    assert float(slope) == pytest.approx(wanted, abs=0.1)


def test_equal_thresholds_give_the_play():
    generator = torch.Generator().manual_seed(0)
    level = (0.1 * torch.randn(60, 30, generator=generator, dtype=torch.float64)).cumsum(0).requires_grad_()
    weight = torch.randn(59, 2, 30, generator=generator, dtype=torch.float64)
    slopes = []
    for name in ("exact", "play"):
        counts, _ = memory(level, 0.2, 0.2, log_input=True, gradient=name)
        slopes.append(torch.autograd.grad(counts, level, weight)[0])
    torch.testing.assert_close(*slopes, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_shift_of_all_levels_changes_no_count_however_many_turns(dtype):
    generator = torch.Generator().manual_seed(1)
    level = (0.1 * torch.randn(400, 50, generator=generator, dtype=dtype)).cumsum(0).requires_grad_()
    counts, _ = memory(level, 0.17, 0.23, log_input=True)
    weight = torch.randn(counts.shape, generator=generator, dtype=dtype)
    (slopes,) = torch.autograd.grad(counts, level, weight)
    scale = float(slopes.abs().sum(0).max())
    assert float(slopes.sum(0).abs().max()) < (1e-5 if dtype == torch.float32 else 1e-13) * scale


@pytest.mark.parametrize(("theta_on", "theta_off"), PAIRS_OF_THRESHOLDS[1:3])
def test_a_sine_of_one_threshold_follows_hard_counts_in_amplitude_and_phase(theta_on, theta_off):
    """Pooled over eighths of two periods and polarity, derivatives averaged over the step; where the play has
    cosines of 0.7 to 0.99 the exact gradient leaves 1 % (differences: 512 beginnings)."""
    time = torch.linspace(0, 2, 49, dtype=torch.float64)[:, None]
    theta = (theta_on + theta_off) / 2
    start = torch.linspace(0, 2 * math.pi, 25, dtype=torch.float64)[:-1]
    moves = {
        "amplitude": lambda s: theta * (1 + 0.3 * s) * torch.sin(2 * math.pi * time + start),
        "phase": lambda s: theta * torch.sin(2 * math.pi * time + start + 0.4 * s),
    }
    share = (torch.arange(512, dtype=torch.float64) + 0.5)[:, None] / 512

    def pooled(counts):
        return counts.reshape(8, 6, 2, -1).sum(1)

    def hard(level):
        begun = level[0] - theta_on / 2 + share * (theta_on + theta_off) / 2
        later = level[1:, None].expand(-1, 512, -1)
        counts = memory(later, theta_on, theta_off, state=begun, log_input=True)[0].mean(2)
        return pooled(counts)

    for move in moves.values():
        difference = hard(move(1.0)) - hard(move(-1.0))
        total = torch.zeros_like(difference)
        sections = 32
        for k in range(sections):
            first, last = (move(2 * (k + j) / sections - 1) for j in (0, 1))
            level = ((first + last) / 2).requires_grad_()
            counts = pooled(memory(level, theta_on, theta_off, log_input=True, gradient="exact")[0])
            for part in range(8):
                for polarity in (0, 1):
                    (slope,) = torch.autograd.grad(counts[part, polarity].sum(), level, retain_graph=True)
                    total[part, polarity] += (slope * (last - first)).sum(0)
        cosine = (total * difference).sum() / (total.norm() * difference.norm())
        assert cosine > 0.99
        assert float((total * difference).sum() / difference.square().sum()) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize(("theta_off", "taken"), [(0.2, "play"), (0.24, "play"), (0.26, "exact")])
def test_which_gradient_is_taken_depends_on_the_thresholds(theta_off, taken):
    level = (0.2 * torch.randn(30, 9, generator=torch.Generator().manual_seed(2))).cumsum(0)
    slopes = {}
    for name in (None, "exact", "play"):
        leaf = level.clone().requires_grad_()
        memory(leaf, 0.2, theta_off, log_input=True, gradient=name)[0].square().sum().backward()
        slopes[name] = leaf.grad
    torch.testing.assert_close(slopes[None], slopes[taken], rtol=0, atol=0)


def test_thresholds_beyond_the_measured_ratio_are_named_where_a_gradient_may_be_asked_for():
    level = torch.zeros(3, 2, requires_grad=True)
    with pytest.warns(RuntimeWarning, match="ratio of 4"):
        memory(level, 0.05, 0.25, log_input=True)
    memory(level.detach(), 0.05, 0.25, log_input=True)
