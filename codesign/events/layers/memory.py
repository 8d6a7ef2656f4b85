"""The default event layer: counts against a per-pixel memorised level, with a straight-through
gradient."""

import warnings

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.checks import FLOATS, check, check_choice, check_kind
from codesign.events.entry import check_frames, check_level, check_per_pixel, warn_of_scale
from codesign.events.intensity import FrontEnd, log_levels
from codesign.events.layers import memory_kernel as kernel

GRADIENTS = ("exact", "play")
# of the two thresholds: up to it the play met all that was asked of the exact gradient
PLAY_RATIO = 1.25
MOST_RATIO = 4  # of the two thresholds, up to which gradients were set beside differences


def memory(
    frames: Tensor,
    theta_on: Tensor | float,
    theta_off: Tensor | float,
    *,
    state: Tensor | None = None,
    log_input: bool = False,
    gradient: str | None = None,
) -> tuple[Tensor, Tensor]:
    """Event counts per pixel and interval against the memorised log level r of each pixel.

    Per interval, with L the new log level and C = theta_on where L > r, else theta_off: n =
    trunc((L - r) / C), then r += C n.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale (lin-log is applied here), any pixel
        shape; log intensity with ``log_input``.
      theta_on, theta_off: contrast thresholds > 0, natural log units; scalar or broadcasting over
        one frame (mismatch), learnable or not.
      state: what an earlier chunk returned, [2, ...], or a memorised level [...]. None: r starts at
        the first frame, and T frames give T-1 intervals. With a state every frame is new: T frames
        give T intervals, so chunks [0:k], [k:] with the state equal
          the whole bit for bit.
    Returns:
      counts: [T-1, 2, ...] ([T, 2, ...] with a state), ON first, whole numbers >= 0.
      state: [2, ...] the memorised level, and the centre of its play (below), to carry on. It keeps
        its graph: detach it to cut the gradient between chunks.
    Gradient: frames, thetas, state: of the mean count over all places of a pixel inside its
      thresholds (straight through the rounding): D = L - r begins evenly from -theta_off/2 to
      theta_on/2. After a turn of the signal the mean count stays 0 until the way back exceeds the
      threshold of that side. For equal thresholds this is a play, exactly. For unequal ones:
        "exact": of the ideal sensor, by pairs of pixels followed from every turn. Slopes beat
          against the thresholds: a wide step's mean slope is met only over many pixels or places.
          To the thresholds as
            "play".
        "play": of width (theta_on + theta_off)/2, the mean over the scatter of real thresholds;
        smooth.
        None: "exact" where all pixels share one pair of thresholds that differ by more than a
          quarter, else "play". docs/events.md has both in figures.
      Thresholds: that of the play, exact for equal ones that change together, else approximate.
      Scenes that never reach half a threshold have no gradient: start those with ``soft_counts``.
      Chunks have the gradient of the whole with "play"; with "exact" each begins evenly around the
      play's centre. Second derivatives raise.
    Numerics: the count is the exact floor of the quotient of the two floats. In float32 a level
      within about 1e-7 |L| of a crossing may fall to either side; it is then counted in a later
      frame, never lost.
    Raises: ShapeError for too few frames or shapes that do not fit; DomainError for theta <= 0,
      NaN, infinite or negative input.
    Warns: RuntimeWarning where a gradient may be asked for and thresholds differ by more than a
      factor of 4.
    Cost: one pass over the frames forward, one backward; no memory beside counts, gradients and two
      bits per pixel and frame. "exact" takes 4 to 6 times as long backward.
    Source: Rebecq et al., ESIM, CoRL 2018; v2e (Hu et al., CVPR-W 2021), memorised brightness;
      Bengio et al. 2013, straight-through; the mean count's play and pairs are ours.

    Example:
    >>> from codesign import events
    >>> frames = torch.tensor([50.0, 100.0, 60.0]).reshape(3, 1, 1)  # a pixel brightens and darkens
    >>> counts, state = events.memory(frames, theta_on=0.2, theta_off=0.2)
    >>> counts.flatten(1).tolist()  # ln 2 / 0.2 = 3.5; then from 3 thresholds up back to ln 1.2
    [[3.0, 0.0], [0.0, 2.0]]
    """
    front_end = FrontEnd(log_input)
    check(frames, "T>=2 ..." if state is None else "T ...", "frames", FLOATS)
    theta_on = check_per_pixel(theta_on, "theta_on", frames)
    theta_off = check_per_pixel(theta_off, "theta_off", frames)
    warn_of_scale(frames, log_input)
    if state is not None:
        check_kind(state, Tensor, "the state", "pass what the call before returned")
    if state is not None and state.shape == frames.shape[1:]:
        state = torch.stack((state, state))
    if state is not None:
        check_level(state, frames[:1].expand(2, *frames.shape[1:])[None])
    steers = torch.is_grad_enabled() and any(x.requires_grad for x in (frames, theta_on, theta_off))
    gradient = _gradient(gradient, theta_on, theta_off, steers)
    return _MemorisedCounts.apply(frames, theta_on, theta_off, state, front_end, gradient)


def soft_counts(
    frames: Tensor, theta_on: Tensor | float, theta_off: Tensor | float, *, log_input: bool = False
) -> Tensor:
    """Counts without quantisation or memory: the smooth twin of ``memory``.

    Args: as for ``memory``.
    Returns:
      [T-1, 2, ...] ON = max(dL, 0)/theta_on, OFF = max(-dL, 0)/theta_off, with dL the step between
      consecutive frames; >= 0, 0 for a static scene. Equals the memory layer's counts to within one
      event per pixel at any time, summed over a monotone stretch.
    Gradient: frames, thetas; exact, but at dL = 0, where both polarities get half their slope
      (the central difference).
    Raises: as ``memory``.

    Example:
    >>> from codesign import events
    >>> frames = torch.tensor([50.0, 100.0, 60.0]).reshape(3, 1, 1)
    >>> counts = events.soft_counts(frames, theta_on=0.2, theta_off=0.2)
    >>> [[round(count, 3) for count in step] for step in counts.flatten(1).tolist()]
    [[3.466, 0.0], [0.0, 2.554]]
    """
    level = log_levels(frames, log_input, minimum=2)
    theta_on = check_per_pixel(theta_on, "theta_on", level)
    theta_off = check_per_pixel(theta_off, "theta_off", level)
    step = level.diff(dim=0)
    rise, fall = step.abs() + step, step.abs() - step
    return torch.stack((rise / (2 * theta_on), fall / (2 * theta_off)), dim=1)


def _gradient(name, theta_on, theta_off, steers):
    """The gradient that the thresholds [...] ask for where the caller leaves it open. steers:
    whether one may be asked for at all."""
    if name is not None:
        check_choice(name, "gradient", GRADIENTS)
    if name is not None:
        return name
    if theta_on.numel() > 1 or theta_off.numel() > 1:
        return "play"
    on, off = float(theta_on.detach()), float(theta_off.detach())
    if steers and max(on, off) > MOST_RATIO * min(on, off):
        warnings.warn(
            f"theta_on is {on:g} and theta_off {off:g}; gradients of counts are measured up to a ratio of "
            f"{MOST_RATIO} (docs/events.md): check yours against differences.",
            RuntimeWarning,
            stacklevel=3,
        )
    return "exact" if max(on, off) > PLAY_RATIO * min(on, off) else "play"


class _MemorisedCounts(Function):
    @staticmethod
    def forward(ctx, frames, theta_on, theta_off, state, front_end, gradient):
        ctx.front_end = front_end
        ctx.gradient = gradient
        follows = any(ctx.needs_input_grad[1:3] if gradient == "exact" else ctx.needs_input_grad)
        counts, end, ctx.moves, bad = kernel.count(
            frames, state, theta_on, theta_off, front_end, keeps=follows
        )
        if bad:
            check_frames(frames, 1, non_negative=not front_end.log_input)
        ctx.save_for_backward(frames, theta_on, theta_off, state)
        return counts, end

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads):
        frames, theta_on, theta_off, state = ctx.saved_tensors
        call = (frames, state, theta_on, theta_off, ctx.front_end, *grads)
        wants_thetas = any(ctx.needs_input_grad[1:3])
        grad_thetas = [None, None]
        if ctx.gradient == "play" or wants_thetas:
            *found, of_thetas = kernel.play_adjoint(
                *call, moves=ctx.moves, wants_thetas=wants_thetas
            )
        if wants_thetas:
            needed = zip(of_thetas, (theta_on, theta_off), ctx.needs_input_grad[1:3], strict=True)
            grad_thetas = [
                grad.sum_to_size(theta.shape) if needs else None for grad, theta, needs in needed
            ]
        if ctx.gradient == "exact":
            found = kernel.turns_adjoint(*call)
        return found[0], *grad_thetas, found[1], None, None
