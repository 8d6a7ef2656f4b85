"""The default event layer: counts against a per-pixel memorised level, with a straight-through gradient."""

import torch
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.errors import ShapeError
from codesign.events.entry import check_theta
from codesign.events.intensity import log_levels


def memory(frames, theta_on, theta_off, *, state=None, log_input=False):
    """Event counts per pixel and interval against the memorised log level r of each pixel.

    Per interval, with L the new log level and C = theta_on where L > r, else theta_off: n = trunc((L - r) / C), then r += C n.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale (lin-log is applied here), any pixel shape; log intensity with ``log_input``.
      theta_on, theta_off: contrast thresholds > 0, natural log units; scalar or broadcasting over one frame (mismatch), learnable or not.
      state: r of an earlier chunk, [...] log units. None: r starts at the first frame, and T frames give T-1 intervals.
        With a state every frame is new: T frames give T intervals, so chunks [0:k], [k:] with the state equal the whole bit for bit.
    Returns:
      counts: [T-1, 2, ...] ([T, 2, ...] with a state), ON first, whole numbers >= 0.
      state: [...] the memorised level to carry on. It keeps its graph: detach it to cut the gradient between chunks.
    Gradient: frames, thetas, state. Straight-through, dn/dL = 1/C and dn/dC = -(L - r)/C^2, through the memory (r is not detached). The polarity is
      chosen by the sign of L - r; at exactly 0 both polarities count half (the mean of the two one-sided slopes). Second derivatives raise.
      Since dr'/dr = 1 - C/C = 0, the tangent of n_t is (dL_t - dL_{t-1})/C_t: the backward pass needs no recurrence.
      Against differences of the hard count it falls short by about half a threshold per swing between turning points (the way back to the
      memorised level counts under the old polarity): 2.5 % for swings of 20 thresholds.
    Numerics: the count is the exact floor of the quotient of the two floats. In float32 a level within about 1e-7 |L| of a crossing may fall
      to either side; it is then counted in a later frame, never lost.
    Raises: ShapeError for too few frames or shapes that do not fit; DomainError for theta <= 0, NaN, infinite or negative input.
    Source: Rebecq et al., ESIM, CoRL 2018; v2e (Hu et al., CVPR-W 2021), memorised brightness; Bengio et al. 2013, straight-through.
    """
    level = log_levels(frames, log_input, minimum=2 if state is None else 1)
    theta_on, theta_off = check_theta(theta_on, "theta_on", level), check_theta(theta_off, "theta_off", level)
    if state is None:
        level, state = level[1:], level[0]
    elif state.shape != level.shape[1:] or state.dtype != level.dtype:
        given, wanted = f"{state.dtype} {list(state.shape)}", f"{level.dtype} {list(level.shape[1:])}"
        raise ShapeError(f"state is {given}, one frame is {wanted}; pass the state of the same sensor.")
    return _MemorisedCounts.apply(level, theta_on, theta_off, state)


def soft_counts(frames, theta_on, theta_off, *, log_input=False):
    """Counts without quantisation or memory: the smooth twin of ``memory``.

    Args: as for ``memory``.
    Returns:
      [T-1, 2, ...] ON = max(dL, 0)/theta_on, OFF = max(-dL, 0)/theta_off, with dL the step between consecutive frames; >= 0, 0 for a static scene.
      Equals the memory layer's counts to within one event per pixel at any time, summed over a monotone stretch.
    Gradient: frames, thetas; exact, but at dL = 0, where both polarities get half their slope (the central difference).
    Raises: as ``memory``.
    """
    level = log_levels(frames, log_input, minimum=2)
    theta_on, theta_off = check_theta(theta_on, "theta_on", level), check_theta(theta_off, "theta_off", level)
    step = level.diff(dim=0)
    return torch.stack(((step.abs() + step) / (2 * theta_on), (step.abs() - step) / (2 * theta_off)), dim=1)


def compare(difference, theta_on, theta_off, reference, counts):
    """One comparator step, in place: write ``counts`` [2, ...] for level minus reference, and move ``reference`` by whole thresholds.

    Floor division is exact on floats (v2e uses the same), so no count hangs on the rounding of a quotient.
    """
    is_on = _share_of_on(difference)
    theta = torch.lerp(theta_off, theta_on, is_on)
    total = difference.abs().div_(theta, rounding_mode="floor")
    torch.mul(total, is_on, out=counts[0])
    torch.sub(total, counts[0], out=counts[1])
    reference.add_(torch.sub(counts[0], counts[1], out=total).mul_(theta))


def _share_of_on(difference):
    """1 where the level rose, 0 where it fell, 1/2 where it stayed: weights at which ``lerp`` picks either end exactly."""
    return difference.sign().mul_(0.5).add_(0.5)


class _MemorisedCounts(Function):
    @staticmethod
    def forward(ctx, level, theta_on, theta_off, start):
        reference = start.clone()
        counts = level.new_empty((level.shape[0], 2, *level.shape[1:]))
        keep = any(ctx.needs_input_grad)
        differences = torch.empty_like(level) if keep else level.new_empty((1, *level.shape[1:]))
        for step in range(level.shape[0]):
            difference = torch.sub(level[step], reference, out=differences[step if keep else 0])
            compare(difference, theta_on, theta_off, reference, counts[step])
        if keep:
            ctx.save_for_backward(differences, theta_on, theta_off, counts)
        return counts, reference

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads):
        grad_counts, grad_state = grads
        differences, theta_on, theta_off, counts = ctx.saved_tensors
        needs_level, *needs_theta, _ = ctx.needs_input_grad
        grad_level = torch.empty_like(differences) if needs_level else None
        grad_theta = [torch.zeros_like(differences[0]) if needs else None for needs in needs_theta]
        grad_reference = grad_state  # adjoint of the reference after the step
        for step in reversed(range(differences.shape[0])):
            difference, grad_on, grad_off = differences[step], grad_counts[step, 0], grad_counts[step, 1]
            # adjoint of L_t - r_t through n_t alone
            through_count = torch.lerp(grad_off / -theta_off, grad_on / theta_on, _share_of_on(difference))
            if grad_level is not None:
                # to first order r_{t+1} = L_t, so the next count (or the state handed on) sees L_t too
                torch.add(through_count, grad_reference, out=grad_level[step])
            for index, (theta, grad, sign) in enumerate(((theta_on, grad_on, 1.0), (theta_off, grad_off, -1.0))):
                if grad_theta[index] is not None:
                    quotient = (sign * difference).clamp_(min=0) / theta
                    grad_theta[index] += sign * grad_reference * (counts[step, index] - quotient) - grad * quotient / theta
            grad_reference = -through_count
        grad_on, grad_off = (grad if grad is None else grad.sum_to_size(theta.shape) for grad, theta in zip(grad_theta, (theta_on, theta_off), strict=True))
        return grad_level, grad_on, grad_off, grad_reference
