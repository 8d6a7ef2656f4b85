"""The memory layer against closed forms, a plain autograd loop, and differences of the hard count."""

import math

import pytest
import torch

from codesign.events import lin_log, memory, soft_counts


def plain_loop(level, theta_on, theta_off, state=None):
    """The same model as ordinary loops: whole counts forward, the play's slopes backward. Returns counts,
    memorised level, centre of the play."""
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


def random_walk(frames=30, pixels=(5, 4), seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return (0.3 * torch.randn(frames, *pixels, generator=generator, dtype=dtype)).cumsum(0)


@pytest.mark.parametrize("per_pixel", [False, True])
@pytest.mark.parametrize("with_state", [False, True])
def test_counts_and_all_gradients_equal_a_plain_autograd_loop(per_pixel, with_state):
    generator = torch.Generator().manual_seed(1)
    shape = (5, 4) if per_pixel else ()
    level = random_walk()
    inputs = [
        level.requires_grad_(),
        (0.2 + 0.05 * torch.rand(shape, generator=generator, dtype=torch.float64)).requires_grad_(),
    ]
    inputs.append((0.3 + 0.05 * torch.rand(shape, generator=generator, dtype=torch.float64)).requires_grad_())
    if with_state:
        inputs.append(torch.zeros(5, 4, dtype=torch.float64, requires_grad=True))
    counts, state = memory(
        *inputs[:3], state=inputs[3] if with_state else None, log_input=True, gradient="play"
    )
    truth, reference, centre = plain_loop(*inputs)
    torch.testing.assert_close(counts, truth, rtol=0, atol=1e-12)  # n + (s - s) rounds
    torch.testing.assert_close(state.detach(), torch.stack((reference, centre)).detach(), rtol=0, atol=1e-13)
    weights = [
        torch.randn(tensor.shape, generator=generator, dtype=torch.float64) for tensor in (counts, centre)
    ]
    found = torch.autograd.grad((counts, state[1]), inputs, weights)
    expected = torch.autograd.grad((truth, centre), inputs, weights)
    for mine, theirs in zip(found, expected, strict=True):
        # the same sums in another order: some thousand terms of float64 rounding
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12 * float(theirs.abs().max()))


@pytest.mark.bits
@pytest.mark.parametrize("cut", [1, 2, 13, 29])
def test_chunks_equal_the_whole_bit_for_bit_gradients_included(cut):
    whole, parts = (random_walk(dtype=torch.float32).requires_grad_() for _ in range(2))
    theta = torch.tensor(0.2)
    counts, state = memory(whole, theta, 0.25, log_input=True, gradient="play")
    if cut == 1:  # a single first frame needs no call: it is the state
        second, state_two = memory(parts[1:], theta, 0.25, state=parts[0], log_input=True, gradient="play")
        first = second[:0]
    else:
        first, middle = memory(parts[:cut], theta, 0.25, log_input=True, gradient="play")
        second, state_two = memory(parts[cut:], theta, 0.25, state=middle, log_input=True, gradient="play")
    joined = torch.cat((first, second))
    assert torch.equal(counts, joined)
    assert torch.equal(state, state_two)
    weight = torch.randn(counts.shape, generator=torch.Generator().manual_seed(3))
    (counts * weight).sum().backward()
    (joined * weight).sum().backward()
    torch.testing.assert_close(whole.grad, parts.grad, rtol=0, atol=0)


def test_gradient_is_the_slope_of_the_mean_hard_count():
    """d(weighted counts)/d(contrast) of moving textures against differences of whole counts, 2000 phases.

    Rounding leaves an error of half an event per pixel and end, evenly spread: 0.4/sqrt(2000) of an event
    against slopes of some 10 events per unit times a step of 0.8: 0.2 %; that of the step's curvature
    (turning points move with the phase only) is below it.
    """
    generator = torch.Generator().manual_seed(5)
    phase = torch.rand(2000, generator=generator, dtype=torch.float64) * 2 * math.pi
    time = torch.linspace(0, 1, 61, dtype=torch.float64)[:, None]
    weight = torch.cos(math.pi * time[1:])  # sees when events come, so the memory matters

    def loss(contrast):
        level = contrast * torch.sin(2 * math.pi * time + phase)
        counts, _ = memory(level, 0.15, 0.2, log_input=True, gradient="play")
        return (weight * (counts[:, 0] + 0.5 * counts[:, 1])).sum() + counts.sum()

    contrast = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(contrast), contrast)
    difference = (loss(torch.tensor(2.4)) - loss(torch.tensor(1.6))) / 0.8
    assert float(slope / difference) == pytest.approx(1, abs=0.007)


def test_threshold_gradient_follows_the_hard_count():
    # the total count of a pixel that swings by S (many thresholds) is about S/C: d/dC = -S/C^2 = -(counts)/C.
    # The hard count over a 25 % wider and narrower threshold gives -S/(C^2 (1 - 0.0625)): 7 % steeper;
    # rounding adds under 1 % at 2000 pixels.
    generator = torch.Generator().manual_seed(6)
    swing = 3 + torch.rand(2000, generator=generator, dtype=torch.float64)
    level = torch.linspace(0, 1, 40, dtype=torch.float64)[:, None] * swing
    theta = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(memory(level, theta, 0.2, log_input=True)[0].sum(), theta)
    totals = [memory(level, value, 0.2, log_input=True)[0].sum() for value in (0.15, 0.25)]
    assert abs(float((totals[1] - totals[0]) / 0.1 / slope) - 1 / (1 - 0.0625)) < 0.05


def test_a_still_scene_is_silent_and_changes_below_the_threshold_have_no_gradient():
    level = torch.full((5, 3, 3), 4.0, dtype=torch.float64, requires_grad=True)
    counts, state = memory(level, 0.2, 0.2, log_input=True)
    assert not counts.any()
    counts.sum().backward()
    torch.testing.assert_close(level.grad, torch.zeros_like(level))
    assert torch.equal(state, torch.full((2, 3, 3), 4.0, dtype=torch.float64))
    # the play reaches a half threshold from where it starts: a quarter moves nothing, three quarters pull at
    # the end and push at the start
    small, large = (
        torch.tensor([0.0, 0.2 * share, 0.2 * share], dtype=torch.float64, requires_grad=True)
        for share in (0.25, 0.75)
    )
    for level, slopes in ((small, [0, 0, 0]), (large, [-5, 5, 0])):
        memory(level[:, None], 0.2, 0.2, log_input=True)[0].sum().backward()
        torch.testing.assert_close(level.grad, torch.tensor(slopes, dtype=torch.float64))


@pytest.mark.bits
def test_soft_counts_gradient_against_finite_differences_and_sum_against_memory():
    level = random_walk(8, (3, 2))
    thetas = [
        torch.tensor([[0.2], [0.3], [0.25]], dtype=torch.float64, requires_grad=True),
        torch.tensor(0.15, dtype=torch.float64, requires_grad=True),
    ]
    assert torch.autograd.gradcheck(
        lambda x, a, b: soft_counts(x, a, b, log_input=True), (level.requires_grad_(), *thetas)
    )
    climb = level.detach().abs().cumsum(0)
    soft = soft_counts(climb, 0.2, 0.2, log_input=True).sum(0)
    hard = memory(climb, 0.2, 0.2, log_input=True)[0].sum(0)
    assert torch.equal(soft.floor(), hard)


@pytest.mark.bits
def test_memory_applies_the_lin_log_front_end():
    frames = torch.rand(6, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(8)) * 200
    # two logarithms, 1e-15 apart: no level of these comes nearer than 1e-6 to a threshold
    assert torch.equal(memory(frames, 0.2, 0.2)[0], memory(lin_log(frames), 0.2, 0.2, log_input=True)[0])


def test_second_derivatives_raise():
    level = random_walk(4, (2,)).requires_grad_()
    weight = torch.ones(3, 2, 2, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(
        memory(level, 0.2, 0.2, log_input=True)[0], level, weight, create_graph=True
    )
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.sum().backward()
