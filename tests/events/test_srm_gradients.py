"""The gradients "mean" and "play" of the spike response layer: the mean of a fading reset against
recursions written out, that of a memorised level against hard counts over enumerated beginnings,
both against differences."""

import doctest
import itertools
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from codesign import events
from codesign.events.kernels import recursion
from codesign.events.spiking import srm_means
from codesign.events.spiking.srm import count_spikes, srm
from codesign.events.spiking.srm_means import PACE, WIDTH, held_back, rested
from tests.numbers import D, close, f64, rand64, randn64, seeded

THETA = 0.2
KINDS = {"pair": 2, "early": 1}
FADING = {"theta": THETA, "kernel": "exp", "response": "alpha", "tau_s": 2.4, "tau_r": 1.2}


def mean_spikes(kind, response, theta, a, m, pace, start):
    """Mean spikes, and shares and states after them, of a noise whose pace is given."""
    step = partial(srm_means._step, kind, start.shape[1])
    numbers = torch.stack([x.expand(response.shape[1]) for x in (theta, a, m, pace)])
    mean, after = recursion(step, response, numbers, start.flatten(0, 1))
    return mean, after.reshape(start.shape)


def drawn(kind, ages=4, steps=7, lanes=3):
    """Response, theta, decay, amplitude, pace and start of pixels, of which some spike and some
    rest."""
    generator = seeded()
    ranges = ((-0.1, 0.6), (0.3, 0.6), (-0.5, -0.3), (0.15, 0.3), (0.2, 1.5))
    response, a, m, theta, pace = (
        low + (high - low) * rand64(generator, shape)
        for (low, high), shape in zip(ranges, ((steps, lanes), *[(lanes,)] * 4), strict=True)
    )
    return response, theta, a, m, pace, rested(ages, KINDS[kind], -a.log())


def slow_mean(kind, response, theta, a, m, pace, start):
    """Mean spikes of one pixel, age by age."""
    groups = [(shares[0], shares[1:]) for shares in start.T]
    found = []
    for v in response:
        spiking, resting = [], []
        for share, states in groups:
            older = a * states
            if kind == "pair":
                older = np.array([older[0], a * (states[0] + states[1])])
            u = v + m * (states[0] if kind == "early" else older[-1])
            firing = 1 - (1 + np.exp((u - theta) / (WIDTH * theta))) ** -pace
            spiking.append((share * firing, older))
            resting.append((share * (1 - firing), older))
        total, states = together(spiking)
        found.append(total)
        states[0] += 1
        groups = [(total, states), *resting[:-2], together(resting[-2:])]
    return np.array(found)


def together(groups):
    shares = np.array([share for share, _ in groups])
    return shares.sum(), shares @ np.array([states for _, states in groups]) / shares.sum()


@pytest.mark.parametrize("kind", KINDS)
def test_the_mean_is_that_of_the_ages_written_out_and_passes_gradcheck(kind):
    given = drawn(kind)
    mean, _ = mean_spikes(kind, *given)
    for lane in range(3):
        one = (x[..., lane].numpy() for x in given)
        # the kernel keeps shares of 1e-9 per age, so that an empty one has states
        np.testing.assert_allclose(mean[:, lane], slow_mean(kind, *one), rtol=1e-6, atol=1e-9)

    def both(*given):
        mean, after = mean_spikes(kind, *given)
        # states of an age that holds next to nobody are steep, and weigh nothing
        return mean, after[0]

    assert torch.autograd.gradcheck(both, [x.requires_grad_() for x in given])


def test_the_mean_is_that_of_noisy_neurons_where_only_the_last_spike_counts():
    steps = 8
    response = 0.1 + 0.3 * rand64(seeded(3), steps, 1)
    a, m, pace = 1e-4, -2 * THETA, 0.7  # the reset of the spike before the last has faded to 1e-4
    start = torch.zeros(2, 3, 1, dtype=D)
    start[0, -1] = 1  # all have rested long
    numbers = [f64([x]) for x in (THETA, a, m, pace)]
    mean, _ = mean_spikes("early", response, *numbers, start)
    truth = np.zeros(steps)
    for history in itertools.product((0, 1), repeat=steps):
        chance, reset = 1.0, 0.0
        for v, spike in zip(response[:, 0].tolist(), history, strict=True):
            rate = pace * math.log(1 + math.exp((v + m * reset - THETA) / (WIDTH * THETA)))
            chance *= 1 - math.exp(-rate) if spike else math.exp(-rate)
            reset = a * reset + spike
        truth += chance * np.array(history)
    # a shift of the potential of 1e-4 * 2 theta, in each of the steps before, at a slope of less
    # than 1/(4 WIDTH theta)
    np.testing.assert_allclose(mean[:, 0], truth, rtol=0, atol=steps * 1e-4 * 2 / (4 * WIDTH))


def test_the_share_of_the_beginning_is_one_and_its_last_spike_three_time_constants_old():
    h = f64([0.2])
    shares, states, counted = rested(200, 2, h)[..., 0]
    steps = torch.arange(200, dtype=D) + 0.5  # since the spike
    age = steps * h
    assert float(shares.sum()) == pytest.approx(1, abs=1e-12)
    torch.testing.assert_close(states, (-age).exp())
    torch.testing.assert_close(counted, steps * states)
    # exponential, in steps of 0.2 / 3 of its mean
    assert float((shares * age).sum()) == pytest.approx(3, rel=1e-2)


def test_a_layer_passes_the_gradient_of_the_mean_on_to_drive_and_parameters():
    drive = 0.4 * randn64(seeded(), 20, 5)
    given = [drive, *(f64(x) for x in (THETA, 2.4, 1.2))]
    weights = rand64(seeded(1), drive.shape)

    def mean(drive, theta, tau_s, tau_r):
        """Sum of the mean spikes, put together by hand."""
        k = torch.arange(1, len(drive), dtype=D)
        kernel = k / tau_s * (1 - k / tau_s).exp()
        response = torch.stack([kernel[:t].flip(0) @ drive[:t] for t in range(len(drive))])
        h = (1 / tau_r).expand(5)
        pace = torch.full((5,), PACE / 1.2, dtype=D)  # held, also where tau_r moves
        numbers = (theta.expand(5), (-h).exp(), -2 * theta * math.e * h, pace)
        return (mean_spikes("pair", response, *numbers, rested(6, 2, h))[0] * weights).sum()

    def by_layer(drive, theta, tau_s, tau_r):
        options = FADING | {"kernel": "slayer", "theta": theta, "tau_s": tau_s, "tau_r": tau_r}
        return (srm(drive, **options, gradient="mean")[0] * weights).sum()

    found = []
    for total in (by_layer, mean):
        leaves = [x.clone().requires_grad_() for x in given]
        found.append(torch.autograd.grad(total(*leaves), leaves))
    for slope, wanted in zip(*found, strict=True):
        close(slope, wanted, rtol=1e-9, atol=1e-12)


def test_pixels_of_a_batch_have_gradients_of_their_own():
    given = 0.4 * torch.randn(20, 2, 3, 4, generator=seeded(5))
    theta = torch.linspace(0.1, 0.3, 12).reshape(3, 4)

    def slopes(drive, theta):
        drive = drive.clone().requires_grad_()
        spikes, _, _ = srm(drive, **FADING | {"theta": theta}, gradient="mean")
        return torch.autograd.grad(spikes.sum(), drive)[0]

    # a pixel's arithmetic is the same wherever it lies, but for the rounding of a processor's lanes
    close = partial(torch.testing.assert_close, rtol=1e-5, atol=1e-6)
    whole = slopes(given, theta)
    close(whole[:, 1], slopes(given[:, 1], theta))
    close(whole[:, 0, 1, 2], slopes(given[:, 0, 1, 2], theta[1, 2]))


def walk(seed, frames=24, pixels=6, size=0.25):
    """Levels [frames, pixels]; most steps are below the threshold, some are two or three of
    them."""
    return (size * randn64(seeded(seed), frames, pixels)).cumsum(0)


def hard(level, beginnings):
    """Mean counts [T-1, 2, N] of a level [T, N] that begins evenly over half a threshold either
    way."""
    place = (torch.arange(beginnings, dtype=D) + 0.5) / beginnings - 0.5
    memorised = level[0][:, None] + THETA * place
    found = []
    for now in level[1:]:
        on = (now[:, None] - memorised >= THETA).to(D)
        off = (memorised - now[:, None] >= THETA).to(D)
        memorised = memorised + THETA * (on - off)
        found.append(torch.stack((on.mean(1), off.mean(1))))
    return torch.stack(found)


def layer_of(name="srm", **options):
    """Counts [T-1, 2, N] of levels [T, N]."""
    made = events.layer(name, events.SensorModel(THETA, THETA), log_input=True, **options)
    return lambda level: made(level[:, None], torch.arange(len(level), dtype=D))[:, :, 0]


def test_the_gradient_of_the_play_is_that_of_the_mean_over_beginnings():
    first = walk(0)
    way = 0.3 * walk(1, size=0.2)
    weights = rand64(seeded(2), len(first) - 1, 2, 1)
    sections = 200
    slope = torch.zeros(first.shape[1], dtype=D)
    for k in range(sections):
        level = (first + way * (k + 0.5) / sections).requires_grad_()
        (by_level,) = torch.autograd.grad((layer_of()(level) * weights).sum(), level)
        slope += (by_level * way).sum(0) / sections
    truth = ((hard(first + way, 20000) - hard(first, 20000)) * weights).sum((0, 1))
    # a kink inside a section moves it by at most its share of a slope of 1/C times the way, some 40
    # of them
    close(slope, truth, atol=40 * 0.5 / sections)
    assert truth.abs().max() > 0.5


def test_the_level_that_is_held_back_passes_gradcheck():
    level = walk(3).requires_grad_()
    centre = (level.detach()[0] + 0.01).requires_grad_()
    on, off = (torch.tensor(c, dtype=D, requires_grad=True) for c in (0.2, 0.3))
    assert torch.autograd.gradcheck(held_back, (level, centre, on, off))


def test_the_slope_to_the_threshold_is_that_of_the_mean():
    level = walk(5, size=0.1)
    theta = torch.tensor(THETA, dtype=D, requires_grad=True)
    spikes, _ = count_spikes(level, torch.stack((theta, theta)), None)
    (slope,) = torch.autograd.grad(spikes[:, 0].sum(), theta)
    wide = 200_000
    # by scaling: counts of (level, C) are those of (level / C, 1)
    up, down = (hard(level * THETA / c, wide)[:, 0].sum() for c in (THETA * 1.0005, THETA * 0.9995))
    # neither side has a kink here; the even beginnings leave 24 * 6 / wide of either sum
    assert float(slope) == pytest.approx(
        float(up - down) / (0.001 * THETA), abs=2 * 144 / wide / 2e-4
    )


def test_enough_steps_per_frame_give_the_counts_and_gradients_of_the_memory_layer():
    # up to six thresholds between two frames
    level = walk(10, frames=12, size=0.4).requires_grad_()
    assert (level.detach().diff(dim=0).abs() / THETA).max() > 3
    seeds = rand64(seeded(11), 11, 2, 6)
    found = []
    for layer in (layer_of("memory"), layer_of(steps=16)):
        counts = layer(level)
        found.append((counts.detach(), torch.autograd.grad((counts * seeds).sum(), level)[0]))
    assert torch.equal(found[0][0], found[1][0])
    close(found[1][1], found[0][1], rtol=1e-9, atol=1e-9)


def test_the_page_gives_what_it_says():
    page = Path(__file__).resolve().parents[2] / "docs" / "srm.md"
    found = doctest.testfile(str(page), module_relative=False)
    assert (found.attempted > 0, found.failed) == (True, 0)
