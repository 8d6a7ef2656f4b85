"""What dead time lets pass of mean counts: the expectation over where events stand in a pixel's threshold, as a
smooth function of the counts and the dead time.

A pixel's events come one by one as its mean count I grows by one, at I = i + u, with a phase u that is as good
as random. Event i is kept unless one kept before lies less than T back, and no two kept ones do:

    kept_i = 1 - sum over j < i with t_i - t_j < T of kept_j,

a linear recursion, exact for every single phase. Here it runs for PHASES groups of neighbouring phases, each
WIDTH of a count wide and mixed within; S(t) is what a group has kept until t, and a phase that has its event
during a step is kept by 1 - (S(its event before) - S(t - T)). The first event after a pause is never lost, and
dead time reaches over frames, turns and polarities. What the mixing costs is in docs/events.md.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.events.level_path import parts

PHASES = 6
WIDTH = 2 / PHASES  # of a count: every phase belongs to two groups
GOLDEN = (5**0.5 - 1) / 2  # its multiples spread evenly: neighbouring pixels stand at different phases


@dataclass(frozen=True)
class DeadTimeState:
    """What ``pass_dead_time`` carries over chunks. position: [P] mean count so far, modulo 1. begun:
    [PHASES, P] what a group had kept when its last event began. kept: [N, PHASES, P] what it had kept at ago_s:
    [N] seconds before the end, the last one 0. All keep their graph."""

    position: Tensor
    begun: Tensor
    kept: Tensor
    ago_s: Tensor


def pass_dead_time(
    counts: Tensor, interval_s: Tensor, refractory_s: Tensor, state: DeadTimeState | None = None
) -> tuple[Tensor, DeadTimeState]:
    """Mean counts behind a dead time.

    Args:
      counts: [T, 2, ...] mean counts per interval without dead time, >= 0, evenly spread over the interval.
      interval_s: [T] float64 lengths, at most a third of the dead time. refractory_s: 0-dim, > 0.
      state: DeadTimeState of an earlier chunk.
    Returns: kept counts [T, 2, ...], in [0, counts]; DeadTimeState.
    Gradient: counts, refractory_s, state; exact.
    """
    flat = counts.flatten(2)
    if state is None:
        pixels = torch.arange(flat.shape[-1], dtype=torch.float64)
        nothing = flat.new_zeros(PHASES, flat.shape[-1])
        position = ((0.37 + GOLDEN * pixels) % 1).to(flat)
        state = DeadTimeState(position, nothing, nothing[None], interval_s.new_zeros(1))
    rows_s = torch.cat((-state.ago_s, interval_s.cumsum(0)))
    passed, kept, begun, position = _Passed.apply(
        flat, refractory_s, state.kept, state.begun, state.position, rows_s
    )
    ago_s = rows_s[-1] - rows_s
    # the rows that the next chunk looks back at, one more for the interval in which the dead time begins
    first = max(0, int((ago_s > float(refractory_s.detach())).sum()) - 1)
    base = kept[-1].detach()
    after = DeadTimeState(
        position - position.detach().floor(), begun - base, kept[first:] - base, ago_s[first:]
    )
    return passed.reshape(counts.shape), after


class _Passed(Function):
    @staticmethod
    def forward(ctx, counts, refractory_s, kept, begun, position, rows_s):
        run = _Steps(counts, refractory_s, len(kept), rows_s)
        history = torch.cat((kept, counts.new_empty(len(counts), *kept.shape[1:])))
        passed = torch.empty_like(counts)
        begins = [begun]
        positions = [position]
        for index in range(len(counts)):
            step = run.step(index, history, begins[-1], positions[-1])
            passed[index] = counts[index] * run.share(index, step.added)
            history[run.first + index + 1] = step.before + step.added
            begins.append(step.begun)
            positions.append(step.position)
        ctx.save_for_backward(
            counts, refractory_s, history, torch.stack(begins), torch.stack(positions), rows_s
        )
        return passed, history, begins[-1], positions[-1]

    @staticmethod
    @once_differentiable
    def backward(ctx, *grads):
        counts, refractory_s, history, begins, positions, rows_s = ctx.saved_tensors
        seed, grad_history, grad_begun, grad_position = grads
        grad_history = grad_history.clone()
        grad_counts = torch.empty_like(counts)
        grad_dead = counts.new_zeros(())
        run = _Steps(counts, refractory_s, len(history) - len(counts), rows_s)
        for index in reversed(range(len(counts))):
            step = run.step(index, history, begins[index], positions[index])
            row = run.first + index
            # passed = counts * mean(added) / total
            share = run.share(index, step.added)
            pull = (seed[index] * counts[index]).sum(0) / run.total[index].clamp(min=run.tiny)
            added = pull / PHASES + grad_history[row + 1]
            # the event begun before this step, and the one that begins in it
            late = added * step.late
            late_mass = added * step.kept_late
            grad_begun = grad_begun - late * (step.kept_late < 1)
            looked = late * (step.kept_late < 1)
            middle = torch.where(step.begins, grad_begun, 0)
            grad_begun = torch.where(step.begins, 0, grad_begun)
            early = (added + middle) * step.early
            early_mass = (added + middle) * step.kept_early
            grad_begun = grad_begun - early * (step.kept_early < 1)
            looked = looked + early * (step.kept_early < 1)
            grad_history[row] += grad_history[row + 1] + middle
            at, part, slope = run.look[index]
            grad_history[at] += (1 - part) * looked
            grad_history[at + 1] += part * looked
            grad_dead = grad_dead - slope * (looked * (history[at + 1] - history[at])).sum()
            end = torch.where(step.begins, late_mass * step.single, early_mass) * step.fills_after
            start = early_mass * step.fills_before
            grad_position = grad_position + end.sum(0)
            grad_counts[index] = seed[index] * share - share * pull + grad_position
            grad_position = grad_position - start.sum(0)
        kept = grad_history[: run.first + 1]
        return grad_counts, grad_dead.to(refractory_s), kept, grad_begun, grad_position, None


@dataclass(frozen=True)
class _Step:
    """One step of every group: masses of the event begun before it (early) and of the one that begins in it
    (late), the share of each that is kept, what is kept more, and the state after."""

    before: Tensor
    early: Tensor
    late: Tensor
    kept_early: Tensor
    kept_late: Tensor
    added: Tensor
    begins: Tensor
    begun: Tensor
    position: Tensor
    fills_before: Tensor
    fills_after: Tensor
    single: Tensor


class _Steps:
    """The recursion's arithmetic, for both directions of time."""

    def __init__(self, counts, refractory_s, rows, rows_s):
        self.total = counts.sum(1)
        self.tiny = torch.finfo(counts.dtype).tiny
        self.first = rows - 1
        self.offset = torch.arange(PHASES, dtype=counts.dtype, device=counts.device)[:, None] / PHASES
        self.look = _looks(rows_s, self.first, float(refractory_s.detach()))

    def share(self, index, added):
        """Kept over all, [P]."""
        return added.mean(0) / self.total[index].clamp(min=self.tiny)

    def step(self, index, history, begun, position) -> Any:
        before = history[self.first + index]
        at, part, _ = self.look[index]
        free = torch.lerp(history[at], history[at + 1], part) if part else history[at]
        start = position + self.offset
        after = position + self.total[index]
        end = after + self.offset
        filled, fills_before = _filled(start)
        filled_after, fills_after = _filled(end)
        begins = end.floor() > start.floor()
        border = start.floor() + 1
        early = torch.where(begins, border, filled_after) - filled
        grown = torch.where(begins, filled_after - border, 0)
        late = grown.clamp(max=1)  # further ones of this step are lost to it
        kept_early = (1 - (begun - free)).clamp(max=1)
        middle = before + kept_early * early
        begun = torch.where(begins, middle, begun)
        kept_late = (1 - (begun - free)).clamp(max=1)
        added = kept_early * early + kept_late * late
        return _Step(
            before,
            early,
            late,
            kept_early,
            kept_late,
            added,
            begins,
            begun,
            after,
            fills_before,
            fills_after,
            grown <= 1,
        )


def _filled(position):
    """Mass of a group's events up to a position, and its slope."""
    whole = position.floor()
    share = (position - whole) / WIDTH
    return whole + share.clamp(max=1), torch.where(share < 1, 1 / WIDTH, 0.0)


def _looks(rows_s, first, refractory_s):
    """For the middle of every step a dead time ago: row before, part of the way to the next, 1/step in 1/s."""
    middle = (rows_s[first:-1] + rows_s[first + 1 :]) / 2 - refractory_s
    at = (torch.searchsorted(rows_s, middle, right=True) - 1).clamp(0, max(0, len(rows_s) - 2))
    step = rows_s[at + 1] - rows_s[at]
    part = (middle - rows_s[at]) / step
    inside = (part > 0) & (part <= 1)
    slope = torch.where(inside, 1 / step, 0)
    return list(zip(at.tolist(), part.clamp(0, 1).tolist(), slope.tolist(), strict=True))


MOST_LOAD = 5.0  # rate x dead time up to which gradients were measured to point right
STEPS = 5  # of the recursion in a dead time
FEWEST = 8  # dead times shorter than an interval over this are taken as local


def reaches(interval_s: Tensor, refractory_s: float) -> bool:
    """Whether a dead time is long enough beside the intervals for the recursion; otherwise ``local_share``."""
    return refractory_s * FEWEST >= float(interval_s.max())


def warn_beyond(
    level: Tensor, thetas: Sequence[Tensor], interval_s: Tensor, refractory_s: Tensor | float
) -> None:
    """Warn where rate x dead time is beyond ``MOST_LOAD``, the mean over events."""
    with torch.no_grad():
        step = level.diff(dim=0)
        moved = (step.clamp(min=0) / thetas[0] + (-step).clamp(min=0) / thetas[1]).sum(0)
        rate_hz = moved / float(interval_s.sum())
        load = float((rate_hz * moved).sum() / moved.sum().clamp(min=1e-30)) * float(refractory_s)
    if load > MOST_LOAD:
        warnings.warn(
            f"rate x dead time is {load:.2g} for the average event, of which about one in {load + 0.5:.2g} is "
            f"kept; gradients are measured up to {MOST_LOAD:g} (docs/events.md). Beyond, which event is kept "
            "depends on each one before, and the gradient of a shift is lost first (cosine below 0.9 against "
            "differences): shorten the dead time or raise the thresholds.",
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


def pass_play(
    level: Tensor,
    counts: Tensor,
    centre: Tensor,
    thetas: Sequence[Tensor],
    interval_s: Tensor,
    refractory_s: Tensor | float,
    state: DeadTimeState | None,
) -> tuple[Tensor, DeadTimeState]:
    """Mean counts behind a dead time, of ``memory``'s counts: values from a play, slopes from the layer.

    Args: level: [N + 1, ...]. counts: [N, 2, ...] of ``memory``. centre: [...] of the play at the first level.
      thetas: ON, OFF. interval_s: [N].
    Returns: [N, 2, ...]; DeadTimeState. Gradient: counts and refractory_s.
    """
    mean = torch.empty_like(counts, requires_grad=False)
    theta_on, theta_off = (theta.detach() for theta in thetas)
    half = (theta_on + theta_off) / 4
    with torch.no_grad():
        for now, pair in zip(level[1:], mean, strict=True):
            rise = (now - centre - half).clamp(min=0)
            fall = (centre - half - now).clamp(min=0)
            centre = centre + rise - fall
            pair[0] = rise / theta_on
            pair[1] = fall / theta_off
    return pass_dead_time(
        mean + (counts - counts.detach()),
        interval_s,
        torch.as_tensor(refractory_s, dtype=torch.float64),
        state,
    )


def finely(level: Tensor, interval_s: Tensor, refractory_s: float) -> tuple[Tensor, Tensor, Tensor]:
    """Levels at the ends of parts of at most a fifth of the dead time, linear between frames.

    Args: level: [T, ...]. interval_s: [T-1].
    Returns: levels [N + 1, ...]; lengths [N] of the parts; the interval [N] that each lies in.
    """
    ends_s = torch.cat((interval_s.new_zeros(1), interval_s.cumsum(0)))
    interval, share, fine_s = parts(ends_s, refractory_s / STEPS)
    share = share.to(level).reshape(-1, *[1] * (level.ndim - 1))
    frame = interval.to(level.device)
    return (
        torch.cat((level[:1], torch.lerp(level[frame], level[frame + 1], share))),
        fine_s.diff(),
        frame,
    )
