"""Dense event frames: the sensor's comparator with a surrogate slope, at most one event per pixel, polarity
and frame."""

import torch
from torch import Tensor
from torch.autograd import Function

from codesign.events.entry import check_level, check_per_pixel, check_positive
from codesign.events.intensity import log_levels


def dense(
    frames: Tensor,
    theta_on: Tensor | float,
    theta_off: Tensor | float,
    *,
    sharpness: float = 5.0,
    state: Tensor | None = None,
    log_input: bool = False,
) -> tuple[Tensor, Tensor]:
    """Events of a comparator that looks once per frame; a pixel that fires memorises the level it sees.

    With u = (L - r)/theta_on - 1 an ON event is the step H(u), likewise OFF; then r := L where one fired. In
    the manner of SENPI: the physics of the pixel forward, a surrogate only for the step.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale, or log levels with ``log_input``. theta_on,
        theta_off: thresholds > 0, scalar or broadcasting over one frame. sharpness: b of the surrogate slope
        b/(1 + b |u|)^2, > 0. state: [...] memorised level of an earlier chunk.
    Returns: counts [T-1, 2, ...] of 0 and 1 ([T, 2, ...] with a state), ON first; state [...].
    Gradient: frames, thetas, state; surrogate slope at the step, exact elsewhere, through the memory.
    Raises: ShapeError, DomainError as ``memory``.
    Source: comparator surrogate: Zenke and Ganguli 2018 (fast sigmoid).
    """
    level = log_levels(frames, log_input, minimum=2 if state is None else 1)
    theta_on = check_per_pixel(theta_on, "theta_on", level)
    theta_off = check_per_pixel(theta_off, "theta_off", level)
    check_positive(sharpness, "sharpness")
    reference = level[0] if state is None else check_level(state, level)
    counts = []
    for now in level[1:] if state is None else level:
        difference = now - reference
        fired = torch.stack(
            (
                _Step.apply(difference / theta_on - 1, sharpness),
                _Step.apply(-difference / theta_off - 1, sharpness),
            )
        )
        reference = reference + (fired[0] + fired[1]) * difference
        counts.append(fired)
    return torch.stack(counts), reference


class _Step(Function):
    @staticmethod
    def forward(ctx, value, sharpness):
        ctx.save_for_backward(value)
        ctx.sharpness = sharpness
        return (value >= 0).to(value)

    @staticmethod
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        (value,) = ctx.saved_tensors
        return grad * ctx.sharpness / (1 + ctx.sharpness * value.abs()) ** 2, None
