"""Spike response layers: the coupled step layer by its play and by surrogates, and alpha responses of the steps of
the log level, ON and OFF apart, with a reset that fades, by their mean response and by surrogates."""

import itertools
import warnings
from typing import Any

import torch

from codesign import events
from studies.event_gradient import compare
from studies.event_gradient.case import DIRECTIONS, times
from studies.event_gradient.judge import distance, offsets
from studies.event_gradient.topic import Asked, Topic

THETA = 0.15  # of the coupled step layer
BEGINNINGS = 32
ALPHA_THETA = 0.2
TAU_S = 0.010  # s; with TAU_R, some 6 to 13 spikes per pixel in the 0.1 s
TAU_R = 0.005
KERNELS = ("step", "slayer", "exp")
SURROGATES = {"Laplace": events.Laplace, "FastSigmoid": events.FastSigmoid, "Triangular": events.Triangular}
THROUGH_RESET = ("off", "full", "bounded")
RATES_HZ = (240, 1000)
WHERE = tuple(d for d in DIRECTIONS if d.name in ("focus", "shift_x"))
PARAMETERS = ("theta", "tau_s", "tau_r")  # of the layers that fade
PARAMETER_STEP = 0.1  # of their value, either way
PARAMETER_SECTIONS = 12
PLAY = "play"
MEAN = "mean"
ASKED = Asked(0.95, (0.8, 1.25))


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
        if name in (PLAY, MEAN):
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


def jobs(quick):
    kernels = KERNELS[:1] if quick else KERNELS
    rates = RATES_HZ[:1] if quick else RATES_HZ
    compared = 2 if quick else len(SURROGATES) * len(THROUGH_RESET) + 1
    ways = [(kernel, rate, d.name, compared) for kernel in kernels for rate in rates for d in WHERE]
    fading = [kernel for kernel in kernels if kernel != "step"]
    return ways + [(kernel, rates[0], name, compared) for kernel in fading for name in PARAMETERS]


def gradients(kernel, rate_hz):
    """(name, through_reset) of what is compared; at many frames per second the best of the surrogates only."""
    found = list(
        itertools.product(SURROGATES, THROUGH_RESET if rate_hz == RATES_HZ[0] else THROUGH_RESET[-1:])
    )
    return [(PLAY if kernel == "step" else MEAN, "exact"), *found]


def measure(cases, kernel, rate_hz, name, compared):
    t_s = times(rate_hz)
    found = {gradient: [] for gradient in gradients(kernel, rate_hz)[:compared]}
    for case in cases:
        pairs = by_parameter if name in PARAMETERS else by_frames
        for gradient, pair in pairs(case, kernel, rate_hz, t_s, name, found):
            found[gradient].append(pair)
    for gradient, pairs in found.items():
        yield compare.row((kernel, *gradient, name, f"{rate_hz}fps"), pairs)


def by_frames(case, kernel, rate_hz, t_s, name, wanted):
    """Every wanted gradient and its pair along a direction of the scene."""
    ends = case.along(rate_hz, next(d for d in WHERE if d.name == name))
    difference = compare.blocks(truth(kernel, ends[-1], t_s) - truth(kernel, ends[0], t_s)).double() / 2
    for gradient in wanted:
        yield gradient, compare.Pair(compare.slope(ends, t_s, layer_of(kernel, *gradient)), difference)


def by_parameter(case, kernel, rate_hz, t_s, name, wanted):
    """Every wanted gradient and its pair along a parameter of the layer."""
    frames = case.frames(rate_hz).float()
    value = options(kernel, t_s)[name]
    down, up = (truth(kernel, frames, t_s, **{name: value * (1 + s * PARAMETER_STEP)}) for s in (-1, 1))
    difference = compare.blocks(up - down).double() / 2
    for gradient in wanted:
        slope: Any = 0.0
        for k in range(PARAMETER_SECTIONS):
            place = (2 * k + 1) / PARAMETER_SECTIONS - 1
            number = torch.full(
                (2, *frames.shape[1:]), value * (1 + place * PARAMETER_STEP), dtype=torch.float64
            )
            number.requires_grad_()
            maps = layer_of(kernel, *gradient, **{name: number})(frames, t_s)
            grads = [torch.autograd.grad(one.sum(), number, retain_graph=True)[0].sum(0) for one in maps]
            slope = slope + compare.blocks(torch.stack(grads)) * value * PARAMETER_STEP / PARAMETER_SECTIONS
        yield gradient, compare.Pair(slope, difference)


TOPIC = Topic(
    "Spike response layers",
    f"step: coupled polarities, theta {THETA}, at most one event per frame. slayer, exp: the alpha response of the steps "
    f"of the log level (tau_s {1000 * TAU_S:g} ms), theta {ALPHA_THETA}, reset of twice theta that fades with tau_r "
    f"{1000 * TAU_R:g} ms. Surrogates have unit mass and the width theta. theta, tau_s, tau_r: by {100 * PARAMETER_STEP:g} % "
    "either way, at the same frames.",
    ("reset", "gradient", "through_reset", "direction", "frames per second"),
    jobs,
    measure,
    lambda row: ASKED if row.names[1] in (PLAY, MEAN) else None,
    "srm",
)
