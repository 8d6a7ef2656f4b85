"""Spikes of spike response layers by one gradient, and the mean of hard spikes over beginnings, as maps to compare."""

import warnings
from typing import Any

import torch

from codesign import events
from studies.gradient_flow.events import compare
from studies.gradient_flow.events.compare import distance, offsets

THETA = 0.15  # of the coupled step layer
BEGINNINGS = 32
ALPHA_THETA = 0.2
# s; with TAU_R, some 6 to 13 spikes per pixel in the 0.1 s
TAU_S = 0.010
TAU_R = 0.005
SURROGATES = {"Laplace": events.Laplace, "FastSigmoid": events.FastSigmoid, "Triangular": events.Triangular}


def drives(frames):
    """Steps of the log level, [T-1, 2, ...], ON first."""
    step = events.lin_log(frames).diff(dim=0)
    return torch.stack((step, -step), 1)


def options(kernel, t_s):
    """Arguments of ``events.srm``; times in frames."""
    if kernel == "step":
        return {"theta": THETA, "kernel": "step", "response": "step", "reset_scale": 1.0, "coupled": True}
    frame_s = float(t_s[1] - t_s[0])
    tau = {"tau_s": TAU_S / frame_s, "tau_r": TAU_R / frame_s}
    return {"theta": ALPHA_THETA, "kernel": kernel, "response": "alpha", **tau}


def layer_of(kernel, name, through_reset, **changed):
    """Spikes by one gradient, as maps for ``compare``. changed: arguments in place of those of ``options``."""

    def layer(frames, t_s):
        given = options(kernel, t_s) | changed
        if name in ("play", "mean"):
            given["gradient"] = name
        else:
            given |= {
                "surrogate": SURROGATES[name].unit(options(kernel, t_s)["theta"]),
                "through_reset": through_reset,
            }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # "full" may grow without bound, and does
            return events.srm(drives(frames), **given)[0]

    return compare.of_layer(layer)


@torch.no_grad()
def truth(kernel, frames, t_s, **changed):
    """Mean of the hard spikes over beginnings: of the memorised level anywhere in its threshold, or of a pixel that
    fired last at a random time, three time constants ago on average. changed: as for ``layer_of``."""
    drive = drives(frames)
    places = offsets(tuple(drive.shape[2:]), BEGINNINGS)
    generator = torch.Generator().manual_seed(0)
    total: Any = 0.0
    for place in places:
        if kernel == "step":
            spikes = coupled(drive, distance(place, THETA, THETA))
        else:
            given = options(kernel, t_s) | changed
            spikes = events.srm(drive, **given, state=fired(kernel, drive, t_s, generator))[0]
        total = total + compare.parts(spikes)
    return total / len(places)


def coupled(drive, above):
    """The event model, written out: a level that begins ``above`` its memorised one."""
    spikes = torch.empty_like(drive)
    for now, found in zip(drive[:, 0], spikes, strict=True):
        above = above + now
        found[0] = above >= THETA
        found[1] = -above >= THETA
        above = above - THETA * (found[0] - found[1])
    return spikes


def fired(kernel, drive, t_s, generator):
    """The state of pixels that fired last at a random time."""
    age = (
        -3 * torch.rand(drive.shape[1:], generator=generator, dtype=torch.float64).log()
    )  # in time constants
    left = (-age).exp()
    tau = TAU_R / float(t_s[1] - t_s[0])
    reset = torch.stack((left, age * tau * left)) if kernel == "slayer" else left[None]
    return events.SrmState(torch.zeros(2, *drive.shape[1:], dtype=torch.float64), reset)
