"""Mean counts behind a dead time, written out in torch: the judge of the kernel, in value and, by torch's own
differentiation, in gradient."""

import torch

from codesign.events.layers.dead_time import GOLDEN, STEPS
from codesign.events.layers.dead_time_kernel import PHASES, WIDTH
from codesign.events.level_path import parts


def written_out(level, centre, thetas, interval_s, dead_s):
    """Kept counts [T, 2, P], the play's centre [P] after them, and position [P].

    Args: level: [T + 1, P]. centre: [P]. thetas: two, 0-dim or [P]. interval_s: [T]. dead_s: 0-dim tensor.
    """
    fixed_s = float(dead_s.detach())
    ends_s = torch.cat((interval_s.new_zeros(1), interval_s.cumsum(0)))
    intervals, shares, times_s = parts(ends_s, fixed_s / STEPS)
    offset = torch.arange(PHASES, dtype=level.dtype)[:, None] / PHASES
    half = (thetas[0] + thetas[1]) / 4
    position = (0.37 + GOLDEN * torch.arange(level.shape[1], dtype=torch.float64)) % 1
    position = position.to(level)
    rows = [level.new_zeros(PHASES, level.shape[1])]
    begun = rows[0]
    heading = rows[0][0]
    kept = [[level.new_zeros(level.shape[1])] * 2 for _ in interval_s]
    for part, interval in enumerate(intervals.tolist()):
        now = torch.lerp(level[interval], level[interval + 1], float(shares[part]))
        rise = (now - centre - half).clamp(min=0)
        fall = (centre - half - now).clamp(min=0)
        centre = torch.where(rise > 0, now - half, torch.where(fall > 0, now + half, centre))
        total = rise / thetas[0] + fall / thetas[1]
        free = looked(rows, times_s, (times_s[part] + times_s[part + 1]) / 2 - dead_s)
        ahead = torch.where(rise > 0, 1.0, torch.where(fall > 0, -1.0, heading))
        begun = torch.where(ahead * heading < 0, rows[-1], begun)
        heading = ahead
        # downward, windows are entered from above
        start = torch.where(ahead < 0, WIDTH - position - offset, position + offset)
        end = start + total
        border = start.detach().floor() + 1
        begins = end >= border
        early = torch.where(begins, border, filled(end)) - filled(start)
        early = early * at_most_one(1 - (begun - free))
        begun = torch.where(begins, rows[-1] + early, begun)
        late = torch.where(begins, at_most_one(filled(end) - border), 0) * at_most_one(1 - (begun - free))
        rows.append(rows[-1] + early + late)
        passed = (early + late).mean(0)
        on, off = kept[interval]
        kept[interval] = [on + torch.where(rise > 0, passed, 0), off + torch.where(fall > 0, passed, 0)]
        position = position + ahead * total
    return torch.stack([torch.stack(pair) for pair in kept]), centre, position


def looked(rows, times_s, when_s):
    """Rows [PHASES, P] at known times, linear between, nothing before the first."""
    if when_s <= times_s[0] or len(rows) == 1:
        return rows[0]
    at = int((times_s[: len(rows) - 1] <= when_s).sum()) - 1
    return rows[at] + (rows[at + 1] - rows[at]) * ((when_s - times_s[at]) / (times_s[at + 1] - times_s[at]))


def at_most_one(share):
    """No slope from 1 on: a phase that nothing blocks stays so."""
    return torch.where(share < 1, share, 1.0)


def filled(place):
    """Mass of a group's events up to a place."""
    whole = place.detach().floor()
    return whole + at_most_one((place - whole) / WIDTH)
