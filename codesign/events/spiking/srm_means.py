"""The gradients of mean spikes: of the spike response layer with resets that fade, and of the one
that memorises a level.

**Mean**, of resets that fade: that of the mean response of many noisy neurons, by the age of their
last spike. All neurons of a pixel see one response v; a share P_k of them spiked last k steps ago,
and carries the mean states of its resets. Where u = v + reset comes near theta a neuron spikes at
the rate PACE / tau_r ln(1 + exp(x)), x = (u - theta) / (WIDTH theta): of each age the share F = 1 -
exp(-dt rate) spikes in a step and goes to age 0; the others grow older, into a last age that holds
all that are older still. The mean spikes, sum_k P_k F_k, are a smooth function of the response, and
their gradient is exact. The equations are those of a population of neurons with escape noise:
Gerstner and Kistler, Spiking Neuron Models, 2002, section 6.2, with the resets of earlier spikes as
a mean per age. For dt = tau_r / PACE the share is a logistic function of x.

**Play**, of coupled polarities with step kernels: that of the mean count of ``events.memory``, for
a level that runs no faster than one threshold per step. Such a layer fires at most once a step and
polarity; what is left of a larger step fires in the steps after it. With the memorised level r
spread evenly over one threshold C below the edge E of the last engaged step, all pixels fire once
where the level exceeds E + C, and r then fills the C below E + C: as if the level itself had
stopped there. For C_on = C_off the mean is exact; otherwise E is the edge of a play of their mean
width.
"""

import math
from functools import partial

import torch
from torch import Tensor
from torch.autograd import Function

from codesign.errors import DomainError, ShapeError
from codesign.events.kernels import beyond, recursion
from codesign.events.layers.memory import memory
from codesign.events.spiking.srm_loops import RESETS, STATES, advance, reset_coefficients

# of the noise, in thresholds; a narrower one is nearer to hard spikes, and its gradient more
# erratic
WIDTH = 0.087
PACE = 1.2  # spikes per tau_r and x, far above the threshold
MEAN_AGE = 3.0  # of the last spike before the first step, in time constants of the reset
TINY = 1e-9  # share below which an age has no states of its own
AGES_PER_TAU = 2  # an age for every step up to so many time constants of the reset, and MORE_AGES
MORE_AGES = 3
MOST_AGES = 64


def check_mean(kernel, coupled, others, state):
    """Raises: DomainError where the neurons of a pixel have no mean response of this kind, an
    argument of surrogates is given (others: name -> (value, default)), or a state comes from a
    layer with another gradient."""
    if kernel == "step":
        raise DomainError(
            "gradient 'mean' goes with a reset that fades ('slayer', 'thesis' or 'exp'), got kernel 'step'; "
            "use events.layer('srm') for a layer that memorises a level."
        )
    if coupled:
        raise DomainError(
            "gradient 'mean' goes with coupled=False: it takes the neurons of one polarity by themselves; "
            "use gradient='surrogate'."
        )
    for name, (value, default) in others.items():
        if value != default:
            raise DomainError(
                f"{name} is {value!r}, which gradient 'mean' has no use for; leave it out, or use "
                "gradient='surrogate'."
            )
    if state is not None and getattr(state, "mean", None) is None:
        raise DomainError(
            "the state comes from a layer without gradient='mean'; begin with that gradient, or go on with "
            "gradient='surrogate'."
        )


def mean_spikes(
    response: Tensor,
    theta: Tensor,
    h_reset: Tensor,
    kernel: str,
    reset_scale: float,
    before: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Mean spikes of the noisy neurons.

    Args:
      response: [T, ...] of the drive, before any reset.
      theta, h_reset: threshold and dt / tau_r, positive, broadcasting over [...].
      before: [1 + states, ages, ...] of the chunk before, or None.
    Returns: [T, ...] in 0 to 1; shares and states of the ages to carry on, with their graph.
      Gradient: response, theta, h_reset, before.
    """
    pixels = response.shape[1:]
    kind = RESETS[kernel]
    count = _ages(h_reset) if before is None else before.shape[1]
    theta, h_reset = (value.expand(pixels).reshape(-1).to(response) for value in (theta, h_reset))
    wanted = (1 + STATES[kind], count, *pixels)
    if before is None:
        before = rested(count, STATES[kind], h_reset)
    elif before.shape != wanted or before.dtype != response.dtype:
        raise ShapeError(
            f"state.mean is {before.dtype} {list(before.shape)}, this layer keeps {response.dtype} "
            f"{list(wanted)}; pass the state of the same layer and frame."
        )
    reset = reset_coefficients(kernel, h_reset, -reset_scale * theta)
    # the noise is the model's: held where tau_r moves, as it moves no hard spike
    pace = PACE * h_reset.detach()
    numbers = torch.stack((theta, reset.a, reset.m, pace))
    flat = response.reshape(len(response), -1)
    mean, after = recursion(
        partial(_step, kind, count), flat, numbers, before.reshape(-1, flat.shape[1])
    )
    return mean.reshape(response.shape), after.reshape(wanted)


def rested(ages: int, states: int, h: Tensor) -> Tensor:
    """[1 + states, ages, ...] shares and reset states of neurons that spiked last at a random time,
    MEAN_AGE time constants ago on average. h: [...] dt/tau of the reset."""
    # in time constants
    age = torch.arange(ages, dtype=h.dtype, device=h.device).reshape(-1, *[1] * h.ndim) * h
    older = (-age / MEAN_AGE).exp()
    shares = older - torch.cat((older[1:], torch.zeros_like(older[:1])))
    left = (-age - h / 2).exp()  # spikes come in the middle of a step on average
    return torch.stack((shares, left, (age / h + 0.5) * left)[: 1 + states])


def _ages(h_reset):
    """How many ages tell neurons with these time constants apart."""
    longest = 1 / float(h_reset.detach().min())
    count = math.ceil(AGES_PER_TAU * longest) + MORE_AGES
    if count > MOST_AGES:
        raise DomainError(
            f"tau_r is up to {longest:.3g} steps, and gradient 'mean' goes up to "
            f"{(MOST_AGES - MORE_AGES) // AGES_PER_TAU}, since it takes {AGES_PER_TAU} ages per step of it; "
            "take longer steps, or gradient='surrogate'."
        )
    return count


def _step(kind, ages, dr, response, numbers, flat):
    """Mean spikes of one step; shares and states of all ages after it."""
    theta, a, m, pace = numbers
    sharpness = 1 / (WIDTH * theta)
    rows = [flat[first : first + ages] for first in range(0, len(flat), ages)]
    fired, kept, carried = [], [], []
    for share, *states in zip(*rows, strict=True):
        reset, states = advance(kind, states, a, m)
        x = (response + reset - theta) * sharpness
        hazard = pace * (dr.maximum(x, 0) + dr.log(1 + dr.exp(-dr.abs(x))))
        kept.append(share * dr.exp(-hazard))
        fired.append(share - kept[-1])
        carried.append(states)
    new = _mixed(fired, carried)
    new[0] = new[0] + 1
    old = _mixed(kept[-2:], carried[-2:])
    after = [sum(fired), *kept[:-2], kept[-2] + kept[-1]]
    for j in range(len(new)):
        after += [new[j], *(states[j] for states in carried[:-2]), old[j]]
    return after[0], after


def _mixed(shares, carried):
    """Mean states of some ages."""
    total = sum(shares) + TINY * len(shares)
    weighted = [
        [(share + TINY) * x for x in states] for share, states in zip(shares, carried, strict=True)
    ]
    return [sum(column) / total for column in zip(*weighted, strict=True)]


def with_play(spikes, level, theta_on, theta_off, state):
    """The spikes with the gradient of the mean count.

    Args:
      spikes: [T-1, 2, ...] of a level [T, ...], or [T, 2, ...] with a state of the chunk before.
    Returns: the same spikes; state to carry on, with its graph: that of ``events.memory``, and the
      centre [...] of the play that holds the level back. Gradient: level, thetas, state.
    """
    now = level if state is not None else level[1:]
    before, centre = (level[0], level[0]) if state is None else state
    slow, centre = held_back(now, centre, theta_on, theta_off)
    counts, before = memory(slow, theta_on, theta_off, state=before, log_input=True)
    return straight_through(spikes, counts), (before, centre)


def held_back(
    level: Tensor,
    centre: Tensor,
    theta_on: Tensor,
    theta_off: Tensor,
) -> tuple[Tensor, Tensor]:
    """The level [T, ...], held back to one threshold beyond a play, and the centre [...] of the
    play after it."""
    pixels = level.shape[1:]
    numbers = torch.stack([theta.expand(pixels).reshape(-1) for theta in (theta_on, theta_off)])
    slow, after = recursion(_follow, level.reshape(len(level), -1), numbers, centre.reshape(1, -1))
    return slow.reshape(level.shape), after.reshape(pixels)


def _follow(dr, level, thetas, centres):
    """One step: a play as wide as the mean threshold is pushed by the level, by no more than a
    threshold."""
    on, off = thetas
    (centre,) = centres
    half = (on + off) * 0.25
    rise, fall = beyond(dr, level, centre, on, off)
    late = (rise > on) | (fall > off)
    after = centre + (dr.minimum(rise, on) - dr.minimum(fall, off))
    edge = after + dr.select(rise > 0, half, -half)
    return dr.select(late, edge, level), [after]


def straight_through(spikes, mean):
    """The spikes with the gradient of the mean, of the same shape."""
    return _StraightThrough.apply(spikes.detach(), mean)


class _StraightThrough(Function):
    @staticmethod
    def forward(ctx, spikes, mean):
        return spikes.view_as(spikes)

    @staticmethod
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, grad
