"""The parts that intervals are cut into for the recursion of dead time, and the rows that it keeps."""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.events.level_path import parts

STEPS = 5  # of the recursion in a dead time, at least
MOST_ROWS = 2000  # of the recursion in a dead time: they lie in the memory of a thread


@dataclass(frozen=True)
class Parts:
    """Parts of intervals. interval: [N] that each lies in. share: [N] of the interval that has
    passed at its end.
    back: [N] >= 1 rows from its start to the row before the look, a dead time before its middle;
    blend: [N] of the way from that row to the next; slope: [N] of blend, per second of dead time,
    negative sign left out.
    reach: rows to keep."""

    interval: Tensor
    share: Tensor
    back: Tensor
    blend: Tensor
    slope: Tensor
    reach: int


def cut_intervals(interval_s, refractory_s, ago_s):
    """Parts of the intervals, at most a fifth of the dead time long, as the kernel wants them; the
    times [rows] that it knows what was kept at, of the state's rows and of the ends of parts."""
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
    reach = max(int(back.max()) + 1, rows_wanted(rows_s[-1] - rows_s, refractory_s))
    if reach > MOST_ROWS:
        raise DomainError(
            f"the dead time of {refractory_s:g} s reaches over {int(back.max())} intervals; its gradient "
            f"over fewer than {MOST_ROWS}: give fewer frames per second."
        )
    reach = -(-reach // 4) * 4  # few sizes, and so few kernels
    slope = torch.where(inside, 1 / step, 0)
    return Parts(interval, share, back, blend.clamp(0, 1), slope, reach), rows_s


def rows_wanted(ago_s, refractory_s):
    """How many rows the next chunk looks back at: one more for the interval in which the dead time
    begins."""
    return len(ago_s) - max(0, int((ago_s > refractory_s).sum()) - 1)
