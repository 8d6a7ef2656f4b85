"""How far the gradients of dead time were measured to point right, and the share that a dead time
short beside the intervals lets pass."""

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

MOST_LOAD = 5.0  # rate x dead time up to which gradients were measured to point right
THRESHOLD_LOAD = 2.0  # the same for gradients to thresholds
FEWEST = 8  # dead times shorter than an interval over this are taken as local


def reaches(interval_s: Tensor, refractory_s: float) -> bool:
    """Whether a dead time is long enough beside the intervals for the recursion; otherwise
    ``local_share``."""
    return refractory_s * FEWEST >= float(interval_s.max())


def warn_beyond(
    level: Tensor, thetas: Sequence[Tensor], interval_s: Tensor, refractory_s: Tensor | float
) -> None:
    """Warn where rate x dead time is beyond ``MOST_LOAD``, the mean over events, or beyond
    ``THRESHOLD_LOAD`` where thresholds have gradients."""
    with torch.no_grad():
        step = level.diff(dim=0)
        moved = (step.clamp(min=0) / thetas[0] + (-step).clamp(min=0) / thetas[1]).sum(0)
        rate_hz = moved / float(interval_s.sum())
        mean_hz = float((rate_hz * moved).sum() / moved.sum().clamp(min=1e-30))
        most = mean_hz * float(torch.as_tensor(refractory_s))
    if most > MOST_LOAD:
        warnings.warn(
            f"rate x dead time is {most:.2g} for the average event, of which about one in {most + 0.5:.2g} "
            f"is kept; gradients are measured up to {MOST_LOAD:g} (docs/events.md). Beyond, which event is "
            "kept depends on each one before, and the gradient of a shift is lost first (cosine 0.45 "
            "against differences at 8.8): shorten the dead time or raise the thresholds.",
            stacklevel=5,
        )
    elif most > THRESHOLD_LOAD and any(theta.requires_grad for theta in thetas):
        # no figure in it, so that a design loop says it once
        warnings.warn(
            f"rate x dead time is above {THRESHOLD_LOAD:g} for the average event: gradients to "
            "thresholds, one apart from the other, may point wrong there (docs/events.md); shorten the "
            "dead time, or set thresholds by differences.",
            stacklevel=5,
        )


def local_share(
    step: Tensor, thetas: Sequence[Tensor], interval_s: Tensor, refractory_s: Tensor | float
) -> Tensor:
    """Share of regularly arriving events that a short dead time lets pass, [T-1, ...]: one in
    ceil(r T), averaged over phases. step: [T-1, ...] of the level."""
    theta = torch.where(step > 0, thetas[0], thetas[1])
    rate_hz = step.abs() / theta / interval_s.to(step).reshape(-1, *[1] * (step.ndim - 1))
    return 1 / (rate_hz * refractory_s + 0.5).clamp(min=1)
