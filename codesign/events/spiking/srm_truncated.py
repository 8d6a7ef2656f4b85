"""The spike response model with finite kernels, step by step in torch: what SLAYER computes, for comparison
with work that used it."""

import torch

from codesign.errors import NonFiniteError
from codesign.events.spiking.srm_gradient import BOUND, reset_sum
from codesign.events.spiking.srm_state import SrmState, entering_state


def run_truncated(setup, drive, theta, h_response, h_reset, state, cut):
    """As ``events.srm``, every kernel ended at its first value below ``cut`` later than its time constant.

    Args:
      setup: Setup. drive: [T, ...] finite. theta, h_response (None: no alpha response), h_reset: float64,
        broadcasting over a frame.
      state: SrmState of the last drives and spikes, or None. cut: potential units.
    Returns: spikes, potential [T, ...] and SrmState.
    Gradient: torch's own, all inputs.
    Source: Shrestha and Orchard, SLAYER, NeurIPS 2018, section 3.
    """
    pixels = drive.shape[1:]
    taps = reset_taps(setup.kernel, h_reset, -setup.reset_scale * theta, cut, pixels).to(drive.dtype)
    response = (
        None
        if h_response is None
        else cut_taps(alpha, h_response, torch.ones_like(h_response), cut, pixels).to(drive.dtype)
    )
    total = setup.plan.response == "sum"
    kept = 1 if total else 0 if response is None else response.shape[0] - 1
    state = entering_state(state, (kept, taps.shape[0] - 1), pixels, drive.device, drive.dtype)
    inputs = torch.cat([state.response, drive])
    if total:
        filtered = inputs.cumsum(0)[1:]
        last = filtered[-1:]
    else:
        filtered = drive if response is None else finite_response(inputs, response, drive.shape[0])
        last = inputs[inputs.shape[0] - kept :]
    limit = (BOUND / reset_sum(setup, theta, h_reset, drive.shape[0])).to(drive.dtype)
    spikes = []
    potentials = []
    past = state.reset
    for y in filtered:
        r = (taps[1:] * past).sum(0)
        u = y + (r - r.flip(0) if setup.plan.channels == 2 else r)
        s, s_of_reset = spike(setup, u - theta.to(drive.dtype), limit)
        if setup.kernel == "step":  # one lag that never ends: the spikes so far
            past = past + s_of_reset
        elif past.shape[0]:
            past = torch.cat([s_of_reset[None], past[:-1]])
        spikes.append(s)
        potentials.append(u)
    potential = torch.stack(potentials)
    if not bool(potential.detach().isfinite().all()):
        raise NonFiniteError(
            "the potential of events.srm overflows; scale the drive down (events.drive_scale proposes a "
            "factor)."
        )
    return torch.stack(spikes), potential, SrmState(last, past)


def spike(setup, x, limit):
    """The spike of x = u - theta, and the spike that the reset sees; values are equal, gradients are not."""
    twin = setup.surrogate.torch_integral(x)
    s = twin if setup.plan.smooth else (x >= 0).to(x.dtype) + (twin - twin.detach())
    if setup.plan.through_reset == "full":
        return s, s
    if setup.plan.through_reset == "off":
        return s, s.detach()
    slope = torch.minimum(setup.surrogate.torch_density(x), limit).detach() * x
    return s, s.detach() + (slope - slope.detach())


def alpha(h, k):
    """(k h) exp(1 - k h)."""
    return k * h * (1 - k * h).exp()


def reset_taps(kernel, h, amplitude, cut, pixels):
    """Reset kernel at lags 0, 1, ... [taps, ...]; its value at lag 0 is 0. The step kernel has one lag, which
    stands for all."""
    if kernel == "step":
        later = amplitude.reshape(1, *[1] * (len(pixels) - amplitude.ndim), *amplitude.shape)
        return torch.cat([torch.zeros_like(later), later])
    shapes = {
        "slayer": alpha,
        "thesis": lambda h, k: (1 - k * h).exp(),
        "exp": lambda h, k: (-(k - 1) * h).exp(),
    }
    taps = cut_taps(shapes[kernel], h, amplitude, cut, pixels)
    return torch.cat([torch.zeros_like(taps[:1]), taps[1:]])


def cut_taps(shape, h, amplitude, cut, pixels):
    """Values of a kernel at lags 0 to the longest one kept over all pixels, zero where a pixel's own kernel
    has ended."""
    h, amplitude = (x.reshape((*[1] * (len(pixels) - x.ndim), *x.shape)) for x in (h, amplitude))
    lags = 64
    while True:
        k = torch.arange(lags, dtype=torch.float64, device=h.device).reshape(-1, *[1] * len(pixels))
        taps = amplitude * shape(h, k)
        kept = ~((taps.detach().abs() < cut) & (k * h.detach() > 1))
        if not bool(kept[-1].any()):
            return torch.where(kept, taps, 0)[: int(kept.reshape(lags, -1).any(1).sum())]
        lags *= 2


def finite_response(inputs, taps, steps):
    """Sum over lags of taps[k] inputs[t - k] for the last ``steps`` times."""
    begin = inputs.shape[0] - steps
    total = torch.zeros_like(inputs[begin:])
    for k, tap in enumerate(taps):
        total = total + tap * inputs[begin - k : begin - k + steps]
    return total
