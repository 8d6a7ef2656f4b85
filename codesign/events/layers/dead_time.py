"""What dead time lets pass of mean counts: the expectation over where events stand in a pixel's threshold, as
a smooth function of the levels, the thresholds and the dead time.

A pixel has an event whenever its mean signed count I (ON less OFF) passes i + u, up or down, with a phase u
that is
as good as random: on a way back those come first that came last. Event i is kept unless one kept before lies
  less
than T back, and no two kept ones do:

    kept_i = 1 - sum over j < i with t_i - t_j < T of kept_j,

a linear recursion, exact for every single phase. Here it runs for PHASES groups of neighbouring phases, each
WIDTH of a count wide and mixed within; S(t) is what a group has kept until t, and a phase that has its event
during a step is kept by 1 - (S(its event before) - S(t - T)). The first event after a pause is never lost,
and dead time reaches over frames, turns and polarities. What the mixing costs is in docs/events.md.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.errors import DomainError
from codesign.events.layers import dead_time_kernel as kernel
from codesign.events.layers.dead_time_kernel import PHASES, Parts
from codesign.events.level_path import parts

GOLDEN = (5**0.5 - 1) / 2  # its multiples spread evenly: neighbouring pixels stand at different phases
STEPS = 5  # of the recursion in a dead time, at least
MOST_ROWS = 2000  # of the recursion in a dead time: they lie in the memory of a thread
MOST_LOAD = 5.0  # rate x dead time up to which gradients were measured to point right
THRESHOLD_LOAD = 2.0  # the same for gradients to thresholds
FEWEST = 8  # dead times shorter than an interval over this are taken as local


@dataclass(frozen=True)
class DeadTimeState:
    """What ``mean_counts`` carries over chunks. position: [...] mean signed count so far, modulo 1. heading:
    [...] 1 where the last counts were ON, -1 where they were OFF. begun: [PHASES, ...] what a group had kept
    when its last event began. kept: [N, PHASES, ...] what it had kept at ago_s: [N] seconds
    before the end, the last one 0. All keep their graph."""

    position: Tensor
    heading: Tensor
    begun: Tensor
    kept: Tensor
    ago_s: Tensor


def mean_counts(
    level: Tensor,
    centre: Tensor,
    thetas: Sequence[Tensor],
    interval_s: Tensor,
    refractory_s: Tensor | float,
    state: DeadTimeState | None = None,
) -> tuple[Tensor, Tensor, DeadTimeState]:
    """Mean counts behind a dead time, of levels linear between frames.

    Args:
      level: [T + 1, ...] log levels. centre: [...] of the play at the first one. thetas: ON, OFF, 0-dim or
        [...].
      interval_s: [T] float64 lengths. refractory_s: 0-dim, > 0. state: DeadTimeState of an earlier chunk.
    Returns: kept counts [T, 2, ...], ON first; the play's centre [...]; DeadTimeState.
    Gradient: level, centre, thetas, refractory_s, state; exact, of the recursion.
    Raises: DomainError for a dead time that reaches over more than MOST_ROWS intervals.
    Cost: one pass forward and two backward; beside counts and gradients some 15 numbers per part (a fifth of
      the dead time, or an interval) and pixel.
    """
    dead_s = torch.as_tensor(refractory_s, dtype=torch.float64)
    thetas = [torch.as_tensor(theta).to(level) for theta in thetas]
    if state is None:
        pixels = torch.arange(level[0].numel(), dtype=torch.float64)
        nothing = level.new_zeros(PHASES, *level.shape[1:])
        position = ((0.37 + GOLDEN * pixels) % 1).to(level).reshape(level.shape[1:])
        state = DeadTimeState(position, nothing[0], nothing, nothing[None], interval_s.new_zeros(1))
    cut, rows_s = _cut(interval_s, float(dead_s.detach()), state.ago_s)
    missing = cut.reach - len(state.kept)
    rows = state.kept[-cut.reach :]
    if missing > 0:
        rows = torch.cat((rows.new_zeros(missing, *rows.shape[1:]), rows))
    passed, centre, position, heading, begun, rows = _Kept.apply(
        level, *thetas, dead_s, centre, state.position, state.heading, state.begun, rows, cut
    )
    ago_s = rows_s[-1] - rows_s
    kept = rows[-_wanted(ago_s, float(dead_s.detach())) :]
    base = kept[-1].detach()
    after = DeadTimeState(
        position - position.detach().floor(), heading, begun - base, kept - base, ago_s[-len(kept) :]
    )
    return passed, centre, after


class _Kept(Function):
    @staticmethod
    def forward(ctx, level, theta_on, theta_off, dead_s, centre, position, heading, begun, rows, cut):
        passed, after, stored = kernel.forward(
            cut, level, theta_on, theta_off, centre, position, heading, begun, rows
        )
        ctx.mark_non_differentiable(after[2])
        ctx.cut = cut
        ctx.stored = stored
        ctx.save_for_backward(level, theta_on, theta_off)
        return passed, *after

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads):
        level, theta_on, theta_off = ctx.saved_tensors
        of_level, of_on, of_off, of_dead, of_centre, of_position, *of_kept = kernel.adjoint(
            ctx.cut, level, theta_on, theta_off, ctx.stored, grads[0], grads[1:]
        )
        return (
            of_level,
            of_on.sum_to_size(theta_on.shape),
            of_off.sum_to_size(theta_off.shape),
            of_dead.sum(dtype=torch.float64),
            of_centre,
            of_position,
            None,
            *of_kept,
            None,
        )


def _cut(interval_s, refractory_s, ago_s):
    """Parts of the intervals, at most a fifth of the dead time long, as the kernel wants them; the times
    [rows] that it knows what was kept at, of the state's rows and of the ends of parts."""
    ends_s = torch.cat((interval_s.new_zeros(1), interval_s.cumsum(0)))
    interval, share, fine_s = parts(ends_s, refractory_s / STEPS)
    first = len(ago_s) - 1
    rows_s = torch.cat((-ago_s, fine_s[1:]))
    # what had been kept a dead time before the middle of every part
    middle = (rows_s[first:-1] + rows_s[first + 1 :]) / 2 - refractory_s
    now = first + torch.arange(len(middle))
    at = torch.searchsorted(rows_s, middle, right=True) - 1
    at = torch.minimum(at.clamp(min=0), now - 1)  # -1 where nothing was before
    step = rows_s[at + 1] - rows_s[at]
    blend = (middle - rows_s[at]) / step
    inside = (blend > 0) & (blend <= 1)
    back = now - at
    reach = max(int(back.max()) + 1, _wanted(rows_s[-1] - rows_s, refractory_s))
    if reach > MOST_ROWS:
        raise DomainError(
            f"the dead time of {refractory_s:g} s reaches over {int(back.max())} intervals; its gradient "
            f"over fewer than {MOST_ROWS}: give fewer frames per second."
        )
    reach = -(-reach // 4) * 4  # few sizes, and so few kernels
    slope = torch.where(inside, 1 / step, 0)
    return Parts(interval, share, back, blend.clamp(0, 1), slope, reach), rows_s


def _wanted(ago_s, refractory_s):
    """How many rows the next chunk looks back at: one more for the interval in which the dead time begins."""
    return len(ago_s) - max(0, int((ago_s > refractory_s).sum()) - 1)


def reaches(interval_s: Tensor, refractory_s: float) -> bool:
    """Whether a dead time is long enough beside the intervals for the recursion; otherwise
    ``local_share``."""
    return refractory_s * FEWEST >= float(interval_s.max())


@torch.no_grad()
def load(
    level: Tensor,
    thetas: Sequence[Tensor | float],
    interval_s: Tensor,
    refractory_s: Tensor | float,
) -> float:
    """Rate x dead time, the mean over events. level: [T, ...]. interval_s: [T-1]."""
    step = level.diff(dim=0)
    moved = (step.clamp(min=0) / thetas[0] + (-step).clamp(min=0) / thetas[1]).sum(0)
    rate_hz = moved / float(interval_s.sum())
    return float((rate_hz * moved).sum() / moved.sum().clamp(min=1e-30)) * float(refractory_s)


def warn_beyond(
    level: Tensor, thetas: Sequence[Tensor], interval_s: Tensor, refractory_s: Tensor | float
) -> None:
    """Warn where rate x dead time is beyond ``MOST_LOAD``, the mean over events, or beyond ``THRESHOLD_LOAD``
    where thresholds have gradients."""
    most = load(level, thetas, interval_s, refractory_s)
    if most > MOST_LOAD:
        warnings.warn(
            f"rate x dead time is {most:.2g} for the average event, of which about one in {most + 0.5:.2g} "
            "is "
            f"kept; gradients are measured up to {MOST_LOAD:g} (docs/events.md). Beyond, which event is kept "
            "depends on each one before, and the gradient of a shift is lost first (cosine 0.45 against "
            "differences at 8.8): shorten the dead time or raise the thresholds.",
            stacklevel=4,
        )
    elif most > THRESHOLD_LOAD and any(theta.requires_grad for theta in thetas):
        # no figure in it, so that a design loop says it once
        warnings.warn(
            f"rate x dead time is above {THRESHOLD_LOAD:g} for the average event: gradients to "
            "thresholds, one apart from the other, may point wrong there (docs/events.md); shorten the "
            "dead time, or set thresholds by differences.",
            stacklevel=4,
        )


def local_share(
    step: Tensor, thetas: Sequence[Tensor], interval_s: Tensor, refractory_s: Tensor | float
) -> Tensor:
    """Share of regularly arriving events that a short dead time lets pass, [T-1, ...]: one in ceil(r T),
    averaged over phases. step: [T-1, ...] of the level."""
    theta = torch.where(step > 0, thetas[0], thetas[1])
    rate_hz = step.abs() / theta / interval_s.to(step).reshape(-1, *[1] * (step.ndim - 1))
    return 1 / (rate_hz * refractory_s + 0.5).clamp(min=1)
