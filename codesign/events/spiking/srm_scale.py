"""The response of the spike response model alone, and a factor for the drive that avoids a dead start."""

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.events.entry import check_per_pixel
from codesign.events.spiking.srm import srm
from codesign.events.spiking.srm_state import SrmState


def alpha_response(
    signal: Tensor, *, tau_s: Tensor | float, dt: float = 1.0, state: SrmState | None = None
) -> tuple[Tensor, SrmState]:
    """The alpha kernel applied to a signal, exactly: y_t = sum over k >= 1 of (k h) exp(1 - k h) signal_{t-k}
    with h = dt / tau_s.

    Args: as for ``srm``. signal: [T, ...], for example spikes (their difference to a target gives the van
      Rossum loss).
    Returns: y [T, ...] and the SrmState to carry on.
    Gradient: signal, tau_s, state.
    Raises: as ``srm``.
    """
    _, response, state = srm(
        signal, theta=1.0, tau_s=tau_s, dt=dt, kernel="step", response="alpha", reset_scale=0.0, state=state
    )
    return response, state


def drive_scale(
    drive: Tensor,
    *,
    theta: Tensor | float,
    tau_s: Tensor | float | None = None,
    dt: float = 1.0,
    response: str = "none",
    share: float = 0.05,
) -> float:
    """Factor for the drive that lifts a share of all potentials to their threshold before any reset, so that
    training does not start dead or saturated.

    Args:
      drive: [T, ...]; theta, tau_s, dt, response: as for ``srm``.
      share: of (time, pixel) pairs that reach the threshold, 0 < share < 1.
    Returns: factor > 0, a float.
    Raises: DomainError when less than that share of the potentials is above 0 (a silent input: no factor
      helps), or share is out of range.
    """
    if isinstance(share, bool) or not isinstance(share, (int, float)) or not 0 < share < 1:
        raise DomainError(f"share is {share!r}; give a number between 0 and 1 (0.05 is typical).")
    with torch.no_grad():
        _, potential, _ = srm(
            drive, theta=1.0, tau_s=tau_s, dt=dt, kernel="step", response=response, reset_scale=0.0
        )
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
