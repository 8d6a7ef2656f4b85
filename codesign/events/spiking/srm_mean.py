"""The gradient of a spike response layer whose reset fades: that of the mean response of ``srm_ages``."""

import math

from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.events.spiking.instead import instead
from codesign.events.spiking.srm_ages import PACE, mean_spikes, rested
from codesign.events.spiking.srm_kernels import RESETS, STATES, reset_coefficients
from codesign.events.spiking.srm_state import SrmState

AGES_PER_TAU = 2  # an age for every step up to so many time constants of the reset, and MORE_AGES
MORE_AGES = 3
MOST_AGES = 64


def check_mean(
    kernel: str, coupled: bool, others: dict[str, tuple[object, object]], state: SrmState | None
) -> None:
    """Raises: DomainError where the neurons of a pixel have no mean response of this kind, an argument of surrogates
    is given (others: name -> (value, default)), or a state comes from a layer with another gradient."""
    if kernel == "step":
        raise DomainError(
            "gradient 'mean' goes with a reset that fades ('slayer', 'thesis' or 'exp'), got kernel 'step'; use "
            "gradient='play' for a layer that memorises a level."
        )
    if coupled:
        raise DomainError(
            "gradient 'mean' goes with coupled=False: it takes the neurons of one polarity by themselves; use "
            "gradient='surrogate'."
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


def meant(
    spikes: Tensor,
    response: Tensor,
    theta: Tensor,
    h_reset: Tensor,
    kernel: str,
    reset_scale: float,
    before: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """The spikes with the gradient of the mean response.

    Args: spikes: [T, ...] hard. response: [T, ...] of the drive, before any reset. theta, h_reset: threshold and
      dt / tau_r, positive, broadcasting over [...]. before: [1 + states, ages, ...] of the chunk before, or None.
    Returns: the same spikes; shares and states of the ages to carry on, with their graph. Gradient: response, theta,
      h_reset, before.
    """
    pixels = response.shape[1:]
    states = STATES[RESETS[kernel]]
    count = _ages(h_reset) if before is None else before.shape[1]
    theta, h_reset = (value.expand(pixels).reshape(-1).to(response) for value in (theta, h_reset))
    wanted = (1 + states, count, *pixels)
    if before is None:
        start = rested(count, states, h_reset)
    elif before.shape == wanted and before.dtype == response.dtype:
        start = before.reshape(1 + states, count, -1)
    else:
        raise ShapeError(
            f"state.mean is {before.dtype} {list(before.shape)}, this layer keeps {response.dtype} {list(wanted)}; "
            "pass the state of the same layer and frame."
        )
    reset = reset_coefficients(kernel, h_reset, -reset_scale * theta)
    flat = response.reshape(len(response), -1)
    # the noise is the model's: held where tau_r moves, as it moves no hard spike
    pace = PACE * h_reset.detach()
    mean, after = mean_spikes(RESETS[kernel], flat, theta, reset.a, reset.m, pace, start)
    return instead(spikes, mean.reshape(response.shape)), after.reshape(wanted)


def _ages(h_reset):
    """How many ages tell neurons with these time constants apart."""
    longest = 1 / float(h_reset.detach().min())
    count = math.ceil(AGES_PER_TAU * longest) + MORE_AGES
    if count > MOST_AGES:
        raise DomainError(
            f"tau_r is up to {longest:.3g} steps, and gradient 'mean' goes up to "
            f"{(MOST_AGES - MORE_AGES) // AGES_PER_TAU}, since it takes {AGES_PER_TAU} ages per step of it; take longer "
            "steps, or gradient='surrogate'."
        )
    return count
