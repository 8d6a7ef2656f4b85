"""The spike response model as an event layer: exact kernels by recursion, learnable thresholds and
time constants, explicit state."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from codesign.checks import (
    FLOATS,
    MOST,
    check,
    check_choice,
    check_finite,
    check_flag,
    check_number,
    check_positive,
)
from codesign.errors import DomainError, ShapeError
from codesign.events.entry import check_per_pixel
from codesign.events.spiking.srm_loops import RESETS, RESPONSES, STATES, Setup, Srm
from codesign.events.spiking.srm_means import check_mean, mean_spikes, straight_through, with_play
from codesign.events.spiking.surrogate import Laplace, Surrogate

GRADIENTS = ("surrogate", "mean")
THROUGH_RESET = ("off", "full", "bounded")
MOST_STEPS = 1e9
# the layer that memorises a level
MEMORISING: dict[str, Any] = {
    "kernel": "step",
    "response": "step",
    "reset_scale": 1.0,
    "coupled": True,
}


@dataclass(frozen=True)
class SrmState:
    """State after the last step of a chunk. It keeps its graph: ``detach`` it to cut the gradient
    between chunks.

    response: [states, ...] of the response kernel, float64 whatever the drive (0 to 2 states).
    reset: [states, ...] of the reset kernel, likewise (1 or 2 states).
    mean: [1 + states, ages, ...] with ``gradient="mean"``, in the type of the drive: shares of
      neurons by the age of their last spike, and the mean states of their resets; else None.
    """

    response: Tensor
    reset: Tensor
    mean: Tensor | None = None

    def detach(self) -> "SrmState":
        """The same state without its graph."""
        mean = None if self.mean is None else self.mean.detach()
        return SrmState(self.response.detach(), self.reset.detach(), mean)


def srm(
    drive: Tensor,
    *,
    theta: Tensor | float,
    tau_s: Tensor | float | None = None,
    tau_r: Tensor | float | None = None,
    dt: float = 1.0,
    kernel: str = "slayer",
    state: SrmState | None = None,
    response: str = "none",
    reset_scale: float = 2.0,
    coupled: bool = False,
    gradient: str = "surrogate",
    surrogate: Surrogate | None = None,
    through_reset: str = "off",
    smooth: bool = False,
) -> tuple[Tensor, Tensor, SrmState]:
    """Spikes s_t = [u_t >= theta] of the potential u_t = (response of the drive)_t + sum over k >=
    1 of nu_k s_{t-k}; a tie u_t = theta spikes.

    Args:
      drive: [T, ...] float32 or float64, any pixel shape; without a response it is the synaptic
        potential itself, in the units of theta.
      theta: threshold > 0; scalar or broadcasting over one frame, learnable or not, as are the time
        constants.
      tau_s: time constant of the alpha response, in the unit of dt; only ``response="alpha"`` uses
        it.
      tau_r: time constant of the reset kernel, in the unit of dt; every reset kernel but "step"
        uses it.
      dt: length of a step.
      kernel: reset, with amplitude A = reset_scale * theta and h = k dt / tau_r: "slayer" nu_k = -A
        h exp(1 - h); "thesis" -A exp(1 - h); "exp" -A exp(-(k - 1) dt / tau_r); "step" -A.
      state: SrmState of the chunk before; None: at rest.
      response: "none"; "alpha": kernel (k dt / tau_s) exp(1 - k dt / tau_s), k >= 1, not multiplied
        by dt; "step": the sum of all drives so far.
      coupled: drive is [T, 2, ...], ON first, and the reset of one polarity is added with the other
        sign to the other. With ``kernel="step"``, ``response="step"``, ``reset_scale=1`` and
        log-intensity steps as drive (ON +, OFF -) this is the memorised-reference event model.
      gradient: "surrogate"; for resets that fade "mean": the exact gradient of a smooth mean
        response, of many neurons with noise at the threshold that spiked last at a random time. It
        points better than a surrogate; docs/srm.md says how well. (That of the event model's mean
        count: ``events.layer("srm")``.)
      surrogate: Laplace, FastSigmoid or Triangular; None: Laplace of unit mass and width
        mean(theta), that is alpha = 2 theta, beta = 1 / theta.
      through_reset: gradient of a spike by way of the resets it causes: "off" (as SLAYER), "full",
        or "bounded", in which rho there is at most 0.9 / sum|nu|, so that the adjoint cannot grow.
      smooth: replace the spike by the surrogate's integral: the smooth twin, whose gradient with
        "full" is exact.
    Returns:
      spikes, potential: [T, ...] as ``drive``; spikes are 0 or 1.
      state: SrmState to carry on. The recursion runs in float64 whatever the drive, and chunks
        equal the whole bit for bit.
    Gradient: drive, theta, tau_s, tau_r, state; spikes by the surrogate. theta and tau_r act
      through the reset amplitude with spikes held, also when through_reset is "off". With
      ``gradient="mean"`` spikes carry one to drive, theta, tau_s, tau_r, state.response and
      state.mean, and the potential none. Second derivatives raise.
    Raises: ShapeError for T = 0, no pixel, shapes that do not fit; DomainError for thresholds, time
      constants or dt that are not positive, unknown names, NaN or infinite drive; NonFiniteError
      when a finite drive overflows. Warns (RuntimeWarning) when "full" breaks max rho * sum|nu| <
      1.
    Source: Gerstner and Kistler, Spiking Neuron Models, 2002, section 4.2; Shrestha and Orchard,
      SLAYER, NeurIPS 2018.

    Example:
    >>> from codesign import events
    >>> drive = torch.full((6, 1), 1.2)  # a neuron driven above its threshold in every step
    >>> spikes, potential, state = events.srm(drive, theta=1.0, tau_r=1.0, kernel="exp", reset_scale=1.0)
    >>> spikes.flatten().tolist()  # it rests until the reset has faded to less than 0.2: e^-2
    [1.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    """
    # the loop over time looks at every value anyway
    check(drive, "T ...", "drive", FLOATS)
    pixels = drive.shape[1:]
    check_flag(coupled, "coupled")
    check_flag(smooth, "smooth")
    if coupled and (not pixels or pixels[0] != 2):
        raise ShapeError(
            f"coupled polarities need a drive of shape [T, 2, ...], ON first, got {list(drive.shape)}; "
            "stack the two drives on axis 1."
        )
    for value, name, choices in (
        (kernel, "kernel", RESETS),
        (response, "response", RESPONSES),
        (through_reset, "through_reset", THROUGH_RESET),
        (gradient, "gradient", GRADIENTS),
    ):
        check_choice(value, name, choices)
    dt = check_positive(dt, "dt")
    reset_scale = check_number(reset_scale, "reset_scale", 0.0, MOST)
    theta = check_per_pixel(theta, "theta", drive, torch.float64)
    tau_s = _time_constant(tau_s, "tau_s", drive, dt) if response == "alpha" else None
    tau_r = (
        _time_constant(tau_r, "tau_r", drive, dt) if kernel != "step" else torch.ones_like(theta)
    )
    if gradient == "mean":
        others = {
            "surrogate": (surrogate, None),
            "through_reset": (through_reset, "off"),
            "smooth": (smooth, False),
        }
        check_mean(kernel, coupled, others, state)
        times = {"tau_s": tau_s, "dt": dt, "response": response}
        return _with_mean(drive, theta, tau_r, kernel, reset_scale, state, times)
    if surrogate is None:
        surrogate = Laplace.unit(float(theta.detach().mean()))
    elif not isinstance(surrogate, Surrogate):
        raise DomainError(
            f"surrogate is {surrogate!r}; pass events.Laplace, events.FastSigmoid or events.Triangular."
        )
    if drive.numel() >= 2**32:
        raise ShapeError(
            f"drive holds {drive.numel()} values, a call addresses up to 2**32; give it in chunks of time "
            "and carry the state."
        )
    channels = 2 if coupled else 1
    shape = tuple(drive.shape)
    setup = Setup(
        RESPONSES[response], kernel, channels, reset_scale, surrogate, smooth, through_reset, shape
    )
    h_reset = dt / tau_r
    if through_reset == "full" and torch.is_grad_enabled():
        _warn_if_unstable(setup, theta.detach(), h_reset.detach(), drive.shape[0])
    state = _entering(state, setup, pixels, drive.device)

    def lanes(x):
        return x.expand(pixels).reshape(setup.channels, -1).contiguous()

    spikes, potential, *after = Srm.apply(
        setup,
        drive.reshape(drive.shape[0], setup.channels, -1),
        lanes(theta),
        None if tau_s is None else lanes(dt / tau_s),
        lanes(h_reset),
        *(
            rows.reshape(len(rows), setup.channels, pixels.numel() // setup.channels)
            for rows in (state.response, state.reset)
        ),
    )
    after = SrmState(*(rows.reshape(len(rows), *pixels) for rows in after))
    return spikes.view(drive.shape), potential.view(drive.shape), after


def count_spikes(level: Tensor, theta: Tensor, state: Any) -> tuple[Tensor, Any]:
    """At most one event per step and polarity: a layer with step kernels and coupled polarities,
    which memorises a level.

    Args:
      level: [T, ...].
      theta: [2], or [2, ...] of every pixel.
      state: what an earlier call returned, or None.
    Returns: counts [T-1, 2, ...] ([T, 2, ...] with a state); state to carry on.
    Gradient: of the mean count over places inside the threshold, with the cap of one event per
      step.
    """
    start, neurons, play = (
        (level[:1], None, None) if state is None else (state[0][None], *state[1:])
    )
    step = torch.cat((start, level if state is not None else level[1:])).diff(dim=0)
    thetas = theta.to(level)[(..., *[None] * (level.ndim - theta.ndim))]
    with torch.no_grad():
        drive = torch.stack((step, -step), 1)
        spikes, _, neurons = srm(drive, theta=thetas, state=neurons, **MEMORISING)
    if torch.is_grad_enabled():
        # a chunk that kept no gradient carries no play on: it begins again at the last level
        begun = level if play is not None or state is None else torch.cat((start, level))
        spikes, play = with_play(spikes, begun, thetas[0], thetas[1], play)
    return spikes, (level[-1].clone(), neurons, play)


def alpha_response(
    signal: Tensor, *, tau_s: Tensor | float, dt: float = 1.0, state: SrmState | None = None
) -> tuple[Tensor, SrmState]:
    """The alpha kernel applied to a signal, exactly: y_t = sum over k >= 1 of (k h) exp(1 - k h)
    signal_{t-k} with h = dt / tau_s.

    Args:
      as for ``srm``.
      signal: [T, ...], for example spikes (their difference to a target gives the van Rossum loss).
    Returns: y [T, ...] and the SrmState to carry on.
    Gradient: signal, tau_s, state.
    Raises: as ``srm``.
    """
    return _response(signal, tau_s=tau_s, dt=dt, response="alpha", state=state)


def drive_scale(
    drive: Tensor,
    *,
    theta: Tensor | float,
    tau_s: Tensor | float | None = None,
    dt: float = 1.0,
    response: str = "none",
    share: float = 0.05,
) -> float:
    """Factor for the drive that lifts a share of all potentials to their threshold before any
    reset, so that training does not start dead or saturated.

    Args:
      drive: [T, ...]; theta, tau_s, dt, response: as for ``srm``.
      share: of (time, pixel) pairs that reach the threshold, 0 < share < 1.
    Returns: factor > 0, a float.
    Raises: DomainError when less than that share of the potentials is above 0 (a silent input: no
      factor helps), or share is out of range.
    """
    check_number(share, "share", above=0.0, below=1.0, remedy="0.05 is typical")
    with torch.no_grad():
        potential, _ = _response(drive, tau_s=tau_s, dt=dt, response=response)
        relative = (potential / check_per_pixel(theta, "theta", drive, torch.float64)).flatten()
        reached = max(1, round(share * relative.numel()))
        level = float(relative.kthvalue(relative.numel() + 1 - reached).values)
    if level <= 0:
        above = int((relative > 0).sum())
        raise DomainError(
            f"only {above} of {relative.numel()} potentials are above 0, {reached} are to reach the "
            "threshold; the input is silent: check it, or lower share."
        )
    return 1 / level


def _response(drive, state=None, **times):
    """The response of the drive alone, and the state after it."""
    _, response, state = srm(drive, theta=1.0, kernel="step", reset_scale=0.0, state=state, **times)
    return response, state


def _with_mean(drive, theta, tau_r, kernel, reset_scale, state, times):
    """The hard layer with the gradient of its mean response."""
    with torch.no_grad():
        spikes, potential, after = srm(
            drive,
            theta=theta,
            tau_r=tau_r,
            kernel=kernel,
            reset_scale=reset_scale,
            state=state,
            **times,
        )
    before = None if state is None else SrmState(state.response, torch.zeros_like(after.reset[:1]))
    driven, responded = _response(drive, before, **times)
    before = None if state is None else state.mean
    mean, ages = mean_spikes(driven, theta, times["dt"] / tau_r, kernel, reset_scale, before)
    return (
        straight_through(spikes, mean),
        potential,
        replace(after, response=responded.response, mean=ages),
    )


def _time_constant(value, name, drive, dt):
    """A time constant of every pixel, float64. Beyond a billionth and a billion of a step it is
    none:
    kernels and their derivatives leave double precision."""
    value = check_per_pixel(value, name, drive, torch.float64)
    low, high = (float(bound) / dt for bound in value.detach().aminmax())
    if not 1 / MOST_STEPS <= low <= high <= MOST_STEPS:
        raise DomainError(
            f"{name} is {low:.3g} to {high:.3g} steps of dt; {1 / MOST_STEPS:g} to {MOST_STEPS:g} are "
            "possible."
        )
    return value


def _warn_if_unstable(setup, theta, h_reset, steps):
    bound = float(setup.reset_sum(theta, h_reset, steps).max()) / setup.surrogate.alpha
    if bound >= 1:
        warnings.warn(
            f"max rho * sum|nu| is {bound:.3g}, not below 1: gradients through the reset may grow without "
            "bound over time; use through_reset='bounded', or a larger alpha.",
            RuntimeWarning,
            stacklevel=3,
        )


def _entering(state, setup, pixels, device):
    """The state a chunk begins with: the given one, checked, or rest.

    Raises: DomainError for something else than an SrmState, or values that are not finite;
      ShapeError for a state of other size, type or device.
    """
    shapes = [(STATES[kind], *pixels) for kind in (setup.response, setup.reset)]
    if state is None:
        return SrmState(
            *(torch.zeros(shape, dtype=torch.float64, device=device) for shape in shapes)
        )
    if not isinstance(state, SrmState):
        raise DomainError(
            f"state is a {type(state).__name__}; pass the SrmState that the chunk before returned, or None "
            "to begin at rest."
        )
    for name, shape in zip(("response", "reset"), shapes, strict=True):
        given = getattr(state, name)
        if (given.shape, given.dtype, given.device.type) != (shape, torch.float64, device.type):
            raise ShapeError(
                f"state.{name} is {given.dtype} {list(given.shape)} on {given.device}, this layer keeps "
                f"{torch.float64} {list(shape)} on {device}; pass the state of the same layer and frame."
            )
        check_finite(given, f"state.{name}", "begin again from a state that is finite")
    return state
