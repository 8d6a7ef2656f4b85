"""From the level that a pixel sees to its events: the memorised-reference layer, the coupled spike response
layer, or a pixel with dead time."""

from typing import Any

import torch
from torch import Tensor

from codesign.events.entry import Times
from codesign.events.layers.memory import memory
from codesign.events.layers.physical import sensor_counts
from codesign.events.sensor.model import SensorModel
from codesign.events.spiking.srm import srm
from codesign.events.spiking.srm_play import with_play
from codesign.events.spiking.surrogate import FastSigmoid


def count_memorised(
    level: Tensor, t_s: Times, theta: Tensor, state: Any, refractory_s: Tensor | None
) -> tuple[Tensor, Any]:
    """Counts of ``events.memory``, or, with a dead time, those of ``events.sensor_counts``.

    Args: level: [T, ...]. t_s: [T]. theta: [2]. state: what an earlier call returned, or None. refractory_s:
      0-dim tensor > 0, or None.
    Returns: counts [T-1, 2, ...] ([T, 2, ...] with a state); state to carry on. Gradient: by the play of
      ``events.memory``.
    """
    if refractory_s is None:
        return memory(level, theta[0], theta[1], state=state, log_input=True)
    return sensor_counts(
        level,
        t_s,
        SensorModel(),
        state=state,
        log_input=True,
        theta_on=theta[0],
        theta_off=theta[1],
        refractory_s=refractory_s,
    )


def count_spikes(
    level: Tensor,
    t_s: Times | None,
    theta: Tensor,
    state: Any,
    refractory_s: Tensor | None,
    gradient: str = "play",
) -> tuple[Tensor, Any]:
    """At most one event per step and polarity: a spike response layer with step kernels and coupled
    polarities, which memorises the same level.

    Args: as for ``count_memorised``. theta: [2], or [2, ...] of every pixel. It has no dead time; refractory_s
      must be None. gradient: "play" or "surrogate".
    Gradient: "play": of the mean count over places inside the threshold, with the cap of one event per step
      (``events.srm``). "surrogate": by a fast sigmoid of width theta, through the reset where it cannot grow.
    """
    start, neurons, play = (level[:1], None, None) if state is None else (state[0][None], *state[1:])
    step = torch.cat((start, level if state is not None else level[1:])).diff(dim=0)
    thetas = theta.to(level)[(..., *[None] * (level.ndim - theta.ndim))]
    with torch.set_grad_enabled(torch.is_grad_enabled() and gradient == "surrogate"):
        spikes, _, neurons = srm(
            torch.stack((step, -step), 1),
            theta=thetas,
            kernel="step",
            response="step",
            reset_scale=1.0,
            coupled=True,
            state=neurons,
            surrogate=FastSigmoid.unit(float(theta.detach().mean())),
            through_reset="bounded",
        )
    if gradient == "play" and torch.is_grad_enabled():
        # a chunk that kept no gradient carries no play on: it begins again at the last level
        begun = level if play is not None or state is None else torch.cat((start, level))
        spikes, play = with_play(spikes, begun, thetas[0], thetas[1], play)
    return spikes, (level[-1], neurons, play)


COMPARATORS = {"memory": count_memorised, "srm": count_spikes}
