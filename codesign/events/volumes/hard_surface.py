"""Time surfaces of hard counts, with the gradient of their mean over where pixels stand inside their thresholds.

A surface shows the last event of a pixel alone. In the mean over places inside a threshold C it is (1/C) times the
integral of exp(-age/tau) over the last C of level that the pixel went through: later crossings hide what fired more
than a threshold before. The gradient needs that window. One hard pixel does not know where it ends, but its own last
event lies evenly in it and the one before evenly in the threshold behind, so the mean of the windows that begin at
either is right to first order in their length. Reading the last event alone takes half of the window.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.errors import DomainError
from codesign.events.entry import Times, check_counts, check_times
from codesign.events.volumes.traces import check_tau


def surface_from_hard_counts(
    counts: Tensor, t_s: Times, at_s: Tensor | Sequence[float], tau_s: float
) -> Tensor:
    """Time surface at given times of events that sit at the middles of their intervals.

    Args:
      counts: [T-1, 2, ..., H, W] whole numbers >= 0, ON first, of short intervals (``EventLayer.finely``). t_s:
        [T] seconds, strictly increasing. at_s: [K] reference times, seconds, strictly increasing; an interval
        belongs to those at or after its end. tau_s: seconds, > 0.
    Returns: [K, 2, ..., H, W] exp(-age/tau) of the last event, 0 where none was yet.
    Gradient: counts: made for counts that carry the slope of their mean (``memory``), then that of the mean
      surface over beginnings, to first order in exp(-age/tau) per threshold, and where a level did not turn since.
      None for the surface as a function of a count.
    Raises: ShapeError, DomainError as ``from_counts``; DomainError for counts that are not whole, and for tau.
    Source: the surface: Lagorce et al., HOTS, PAMI 2017; the gradient is ours.
    """
    tau_s = check_tau(tau_s)
    check_counts(counts)
    times_s = check_times(t_s, len(counts) + 1)
    wrong = counts.detach()[(counts.detach() < 0) | (counts.detach() % 1 != 0)]
    if len(wrong):
        raise DomainError(
            f"counts hold {float(wrong[0]):g}; whole numbers of events are needed (surface_from_counts takes "
            "shares of events)."
        )
    return _LastEvents.apply(counts, times_s, check_times(at_s), tau_s)


class _LastEvents(Function):
    @staticmethod
    def forward(ctx, counts, times_s, at_s, tau_s):
        middle_s = (times_s[1:] + times_s[:-1]) / 2
        seen = torch.searchsorted(times_s[1:], at_s, right=True).tolist()
        # 1 + index of the interval of the last event, and of the one before it; 0: none was
        last = torch.zeros(counts.shape[1:], dtype=torch.long, device=counts.device)
        before = torch.zeros_like(last)
        surface = []
        older = []
        start = 0
        for stop, time_s in zip(seen, at_s, strict=True):
            for index in range(start, stop):
                fired = counts[index] > 0
                before = torch.where(counts[index] > 1, index + 1, torch.where(fired, last, before))
                last = torch.where(fired, index + 1, last)
            start = max(start, stop)
            shown = torch.cat((torch.zeros(1, dtype=middle_s.dtype), ((middle_s - time_s) / tau_s).exp()))
            shown = shown.to(counts)
            surface.append(shown[last])
            older.append(shown[before])
        ctx.course = seen, middle_s, at_s, tau_s
        surface = torch.stack(surface)
        ctx.save_for_backward(counts.clamp(max=2).to(torch.uint8), surface, torch.stack(older))
        return surface

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        """Once back through time. A surface joins in at the last interval that it sees; its windows leave at the
        event that they begin at, the last one or the one before it."""
        counts, last, before = ctx.saved_tensors
        seen, middle_s, at_s, tau_s = ctx.course
        pull = torch.zeros(counts.shape, dtype=grad.dtype, device=grad.device)
        # of the surfaces whose last event is not met yet, and of those with one event met: what an event now would
        # show, less what the windows' beginnings show
        now = torch.zeros_like(pull[0])
        begun = now
        begun_before = now
        now_past = now
        begun_past = now
        number = len(seen) - 1
        for index in range(len(counts) - 1, -1, -1):
            if index + 1 < len(counts):
                fade = math.exp(float(middle_s[index] - middle_s[index + 1]) / tau_s)
                now = now * fade
                now_past = now_past * fade
            while number >= 0 and seen[number] > index:
                now = now + grad[number] * math.exp(float(middle_s[index] - at_s[number]) / tau_s)
                begun = begun + grad[number] * last[number]
                begun_before = begun_before + grad[number] * before[number]
                number -= 1
            once = counts[index] == 1
            quiet = counts[index] == 0
            now_past = torch.where(quiet, now_past, torch.where(once, now, 0))
            begun_past = torch.where(quiet, begun_past, torch.where(once, begun_before, 0))
            now, begun, begun_before = (torch.where(quiet, value, 0) for value in (now, begun, begun_before))
            pull[index] = now + (now_past - begun - begun_before - begun_past) / 2
        return pull, None, None, None
