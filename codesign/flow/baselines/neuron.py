"""Integrate-and-fire neurons over a few time steps, with a gradient below the threshold too."""

import torch
from torch import Tensor

from codesign.backend import NoSecondDerivative
from codesign.errors import DomainError, ShapeError
from codesign.events.spiking.surrogate import Surrogate
from codesign.flow.checks import check_number, check_real

_FIRST_ONLY = "a surrogate stands for the first derivative of a spike only; a second one through integrate-and-fire neurons was asked for. Use differences of gradients instead."


class _Fire(torch.autograd.Function):
    @staticmethod
    def forward(ctx, current, threshold, surrogate):
        ctx.threshold = threshold
        ctx.surrogate = surrogate
        ctx.save_for_backward(
            current
            # the potential is made again: it would weigh as much, and the current ties a second derivative to its
            # refusal
        )
        return _run(current, threshold, torch.empty_like(current[:1]))

    @staticmethod
    def backward(ctx, *grads):
        (current,) = ctx.saved_tensors
        with torch.no_grad():
            potential = torch.empty_like(current)
            spikes = _run(current, ctx.threshold, potential)
            result = grads[0] * ctx.surrogate.torch_density(potential.sub_(ctx.threshold))
            for t in range(len(result) - 2, -1, -1):
                result[t].add_(result[t + 1]).addcmul_(result[t + 1], spikes[t], value=-1)
        if torch.is_grad_enabled():
            (result,) = NoSecondDerivative.apply(_FIRST_ONLY, 1, result, current, *grads)  # pyright: ignore[reportGeneralTypeIssues]
        return result, None, None


def _run(current, threshold, potential):
    """Spikes [T, ...]; potentials before the reset are left in ``potential``, as far as it is long. Into
    buffers made once: fresh ones cost more than the arithmetic."""
    spikes = torch.empty_like(current)
    rest = torch.zeros_like(current[0])
    for t in range(len(current)):
        u = torch.add(rest, current[t], out=potential[t % len(potential)])
        torch.ge(u, threshold, out=spikes[t])
        torch.addcmul(u, u, spikes[t], value=-1, out=rest)
    return spikes


def integrate_and_fire(current: Tensor, threshold: float, surrogate: Surrogate) -> Tensor:
    """Spikes of neurons without leak that fall back to 0 when they fire: u_t = u_{t-1} (1 - s_{t-1}) + I_t,
    s_t = [u_t >= threshold].

    Args:
      current: [T, ...] input of every step, in units of the potential.
      threshold: > 0. surrogate: codesign.events.spiking.surrogate.Surrogate, its density at u - threshold
        stands for the derivative of the step.
    Returns: [T, ...] spikes, 0 or 1.
    Gradient: current; lambda_t = g_t rho(u_t - threshold) + (1 - s_t) lambda_{t+1}, the reset taken as it
      happened. First derivatives only.
    Raises: GradientError for a second derivative; ShapeError without a step; DomainError for a threshold <=
      0.
    Source: Lee et al., Spike-FlowNet, ECCV 2020, eqs. 1 to 3, which lets rho be 1 / threshold above it and 0
      below.
    """
    check_real(current, "the current")
    if current.ndim < 1 or len(current) < 1:
        raise ShapeError(f"the current needs a time axis with at least one step, got {tuple(current.shape)}.")
    check_number(threshold, "the threshold", above=0.0)
    if not isinstance(surrogate, Surrogate):
        raise DomainError(
            f"the surrogate is a {type(surrogate).__name__}; give one such as events.FastSigmoid."
        )
    return _Fire.apply(current, threshold, surrogate)
