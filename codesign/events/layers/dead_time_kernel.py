"""The recursion of ``dead_time`` behind the play of the mean count, as a drjit loop over time per pixel: forward and
adjoint.

Intervals are cut into parts. A pixel carries the centre of its play, its mean count so far (position), and of every
group of phases what it had kept when its last event began, and what it had kept at the ends of the parts within a
dead time (rows). Rows lie in memory local to the pixel's thread: ``reach`` before a block of parts, then those of
the block. The forward loop stores the state at the beginning of every block; the adjoint goes from block to block
backward, walks each forward once more, and then back.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.events.layers.pixel_loop import Loop
from codesign.exclusive import exclusive

PHASES = 6
WIDTH = 2 / PHASES  # of a count: every phase belongs to two groups
BLOCK = 32  # parts, at least


@dataclass(frozen=True)
class Parts:
    """Parts of intervals. interval: [N] that each lies in. share: [N] of the interval that has passed at its end.
    back: [N] >= 1 rows from its start to the row before the look, a dead time before its middle; blend: [N] of the
    way from that row to the next; slope: [N] of blend, per second of dead time, negative sign left out.
    reach: rows to keep."""

    interval: Tensor
    share: Tensor
    back: Tensor
    blend: Tensor
    slope: Tensor
    reach: int

    @property
    def block(self) -> int:
        """Parts between two stored states: as many as rows of a state, so that both take the same memory."""
        return max(BLOCK, self.reach)


class Run(Loop):
    """One call of a loop over parts: what both directions of time share."""

    def __init__(self, parts, level, theta_on, theta_off):
        super().__init__(level, theta_on, theta_off)
        count = len(parts.interval)
        self.size = parts.block
        self.reach = parts.reach
        self.count = self.opaque(count)
        self.blocks = -(-count // self.size)
        self.interval = self._of(self.arr.UInt32, parts.interval)
        self.back = self._of(self.arr.UInt32, parts.back)
        self.share, self.blend, self.slope = (
            self._of(self.arr.Float, values) for values in (parts.share, parts.blend, parts.slope)
        )
        self.half = (self.theta_on + self.theta_off) * 0.25
        self.stored = self.reach * PHASES + PHASES + 3  # numbers of a state
        self.zero = self.dr.zeros(self.arr.Float, self.width)

    def _of(self, kind, values):
        return kind(values.tolist())

    def opaque(self, value):
        return self.dr.opaque(self.arr.UInt32, value, self.width)

    def nothing(self, rows):
        """Zeros [rows] of every pixel."""
        found = self.dr.zeros(self.arr.Float, rows * self.width)
        self.dr.eval(found)
        return found

    def local(self, rows, several=PHASES):
        """Zeros in the memory of a thread: [rows] of every pixel, several times."""
        # one block each: numbers that are read at the same row share the work of finding it
        return [self.dr.alloc_local(self.arr.Float, rows, value=self.arr.Float(0)) for _ in range(several)]

    def repeat(self, count, body, *carried):
        """body(index, *carried) -> carried, for index from 0 to count - 1."""

        def step(index, *carried):
            return index + 1, *body(index, *carried)

        start = self.dr.zeros(self.arr.UInt32, self.width)
        return self.dr.while_loop((start, *carried), lambda index, *_: index < count, step, mode="symbolic")[
            1:
        ]

    def gather(self, source, row):
        return self.dr.gather(self.arr.Float, source, row * self.pixels + self.lane)

    def scatter(self, target, value, row):
        place = row * self.pixels + self.lane
        self.dr.scatter(target, value, place, mode=self.dr.ReduceMode.NoConflicts)

    def add(self, target, value, row, active=True):
        place = row * self.pixels + self.lane
        self.dr.scatter_reduce(
            self.dr.ReduceOp.Add,
            target,
            value,
            place,
            active=active,
            mode=self.dr.ReduceMode.NoConflicts,
        )

    def of_part(self, source, part):
        return self.dr.gather(type(source), source, part)

    def ends(self, block):
        """First part of a block, and how many parts it has."""
        first = block * self.size
        return first, self.dr.minimum(self.count - first, self.size)

    def play(self, part, centre):
        """The interval of a part, and how far its level lies above and below the play."""
        interval = self.of_part(self.interval, part)
        low = self.gather(self.values, interval)
        high = self.gather(self.values, interval + 1)
        level = self.dr.lerp(low, high, self.of_part(self.share, part))
        return interval, *self.beyond(level, centre)

    def look(self, rows, part, now):
        """What every group had kept a dead time ago, and by how much more at the row behind than at the one
        before."""
        before = now - self.of_part(self.back, part)
        blend = self.of_part(self.blend, part)
        found = []
        for mine in rows:
            low = mine[before]
            more = mine[before + 1] - low
            found.append((self.dr.fma(blend, more, low), more))
        return found

    def heads(self, rise, fall, heading, rows, now, begun):
        """Where the play heads now, and what groups had kept when their last event began: at a turn one begins,
        of those phases that the level has just passed."""
        dr = self.dr
        ahead = dr.select(rise > 0, 1, dr.select(fall > 0, -1, heading))
        turned = ahead * heading < 0
        kept = [mine[now] for mine in rows]
        begun = [dr.select(turned, now, before) for now, before in zip(kept, begun, strict=True)]
        return ahead, turned, kept, begun

    def walk(self, rows, part, now, centre, position, heading, begun):
        """One part forward; rows gain one. Returns interval, rise, fall, kept counts, and the state after it."""
        interval, rise, fall = self.play(part, centre)
        total = rise / self.theta_on + fall / self.theta_off
        ahead, _, kept, begun = self.heads(rise, fall, heading, rows, now, begun)
        passed = self.zero
        after = []
        for group, (free, _) in enumerate(self.look(rows, part, now)):
            step = _Step(self.dr, group, position, ahead, total, kept[group], begun[group], free)
            rows[group][now + 1] = step.before + step.added
            passed = passed + step.added
            after.append(step.begun)
        centre = centre + (rise - fall)
        return interval, rise, fall, passed / PHASES, centre, position + ahead * total, ahead, after

    def pull(self, seed, target, pulls, pull, rows, part, now, centre, position, heading, begun):
        """One part backward: what ``walk`` did, differentiated. pulls: gradients of the state after it, by name; pull:
        of the rows. Returns those of the state before it."""
        dr = self.dr
        interval, rise, fall = self.play(part, centre)
        is_on = rise > 0
        is_off = fall > 0
        moves = is_on | is_off
        total = rise / self.theta_on + fall / self.theta_off
        of_kept = self.gather(seed, 2 * interval + dr.select(is_on, 0, 1)) / PHASES
        of_kept = dr.select(moves, of_kept, 0)
        blend = self.of_part(self.blend, part)
        before = now - self.of_part(self.back, part)
        ahead, turned, kept, begun = self.heads(rise, fall, heading, rows, now, begun)
        of_total = pulls["position"] * ahead
        of_position = pulls["position"]
        of_dead = self.zero
        of_begun = []
        for group, (free, more) in enumerate(self.look(rows, part, now)):
            step = _Step(dr, group, position, ahead, total, kept[group], begun[group], free)
            of_row = pull[group][now + 1]
            of_end, of_start, looked, of_middle, older = step.pull(of_kept + of_row, pulls["begun"][group])
            of_total = of_total + of_end
            of_position = of_position + ahead * (of_end - of_start)
            of_dead = of_dead + looked * more
            of_begun.append(dr.select(turned, 0, older))
            _increase(pull[group], now, of_row + of_middle + dr.select(turned, older, 0))
            _increase(pull[group], before, (1 - blend) * looked)
            _increase(pull[group], before + 1, blend * looked)
        # the play: the edge that the level has reached stands at the level
        theta = dr.select(is_on, self.theta_on, self.theta_off)
        per_level = dr.select(moves, of_total / theta, 0)
        signed = dr.select(is_on, per_level, -per_level)
        of_level = dr.select(moves, signed + pulls["centre"], 0)
        of_half = dr.select(is_on, -of_level, of_level)  # of a quarter of each threshold
        share = self.of_part(self.share, part)
        self.add(target, (1 - share) * of_level, interval)
        self.add(target, share * of_level, interval + 1)
        return {
            "centre": dr.select(moves, -signed, pulls["centre"]),
            "position": of_position,
            "begun": of_begun,
            "theta_on": pulls["theta_on"] + of_half / 4 - dr.select(is_on, per_level * total, 0),
            "theta_off": pulls["theta_off"] + of_half / 4 - dr.select(is_off, per_level * total, 0),
            "dead": pulls["dead"] - self.of_part(self.slope, part) * of_dead,
        }


class _Step:
    """One part of one group: masses of the event begun before it (early) and of the one that begins in it (late), the
    share of each that is kept, what is kept more, and what had been kept when the last event began."""

    def __init__(self, dr, group, position, ahead, total, before, begun, free):
        self.dr = dr
        place = position + group / PHASES
        start = dr.select(ahead < 0, WIDTH - place, place)  # downward, the same events come in reverse order
        end = start + total
        filled, self.fills_before = _filled(dr, start)
        filled_after, self.fills_after = _filled(dr, end)
        border = dr.floor(start) + 1
        self.begins = dr.floor(end) > dr.floor(start)
        self.early = dr.select(self.begins, border, filled_after) - filled
        grown = dr.select(self.begins, filled_after - border, 0)
        self.single = grown <= 1
        self.late = dr.minimum(grown, 1)  # further ones of this part are lost to it
        self.kept_early = dr.minimum(1 - (begun - free), 1)
        self.before = before
        self.begun = dr.select(self.begins, before + self.kept_early * self.early, begun)
        self.kept_late = dr.minimum(1 - (self.begun - free), 1)
        self.added = self.kept_early * self.early + self.kept_late * self.late

    def pull(self, of_added, of_begun):
        """Of gradients to what is kept more and to ``begun``: those to end, start, look, kept before, begun before."""
        dr = self.dr
        late = of_added * self.late
        late_mass = of_added * self.kept_late
        late_looks = dr.select(self.kept_late < 1, late, 0)
        of_begun = of_begun - late_looks
        middle = dr.select(self.begins, of_begun, 0)
        of_begun = dr.select(self.begins, 0, of_begun)
        early = (of_added + middle) * self.early
        early_mass = (of_added + middle) * self.kept_early
        early_looks = dr.select(self.kept_early < 1, early, 0)
        end = dr.select(self.begins, dr.select(self.single, late_mass, 0), early_mass) * self.fills_after
        return (
            end,
            early_mass * self.fills_before,
            late_looks + early_looks,
            middle,
            of_begun - early_looks,
        )


def _filled(dr, place):
    """Mass of a group's events up to a place, and its slope."""
    whole = dr.floor(place)
    share = (place - whole) * (1 / WIDTH)
    return whole + dr.minimum(share, 1), dr.select(share < 1, 1 / WIDTH, 0)


def _increase(local, index, value):
    local[index] = local[index] + value


@exclusive
def forward(parts, level, theta_on, theta_off, centre, position, heading, begun, rows):
    """Kept counts [T, 2, ...] of levels [T + 1, ...]; the state after them; the stored states.

    Args: centre, position, heading: [...]. begun: [PHASES, ...]. rows: [reach, PHASES, ...], the last one now.
    """
    run = Run(parts, level, theta_on, theta_off)
    target = run.nothing(2 * (len(level) - 1))
    stored = run.fresh(run.blocks * run.stored * run.width)
    behind = run.fresh(run.reach * PHASES * run.width)
    begun_rows = run.load(rows)
    local = run.local(run.reach + run.size)

    def begin(row, local):
        for group, mine in enumerate(local):
            mine[run.size + row] = run.gather(begun_rows, row * PHASES + group)
        return (local,)

    def walk_block(block, centre, position, heading, begun, local):
        first, size = run.ends(block)
        place = block * run.stored

        def shift(row, local):
            for group, mine in enumerate(local):
                value = mine[run.size + row]
                mine[row] = value
                run.scatter(stored, value, place + row * PHASES + group)
            return (local,)

        (local,) = run.repeat(run.reach, shift, local)
        for index, value in enumerate((*begun, centre, position, heading)):
            run.scatter(stored, value, place + run.reach * PHASES + index)

        def walk(index, centre, position, heading, begun, local):
            part = first + index
            interval, rise, fall, kept, *after = run.walk(
                local, part, index + run.reach - 1, centre, position, heading, begun
            )
            run.add(target, kept, 2 * interval, rise > 0)
            run.add(target, kept, 2 * interval + 1, fall > 0)
            return *after, local

        return run.repeat(size, walk, centre, position, heading, begun, local)

    (local,) = run.repeat(run.reach, begin, local)
    start = (*map(run.load, (centre, position, heading)), [run.load(one) for one in begun])
    centre, position, heading, begun, local = run.repeat(run.blocks, walk_block, *start, local)
    last = run.count - (run.blocks - 1) * run.size

    def write(row, local):
        for group, mine in enumerate(local):
            run.scatter(behind, mine[last + row], row * PHASES + group)
        return (local,)

    run.repeat(run.reach, write, local)
    run.dr.eval(target, stored, behind, centre, position, heading, begun)
    run.dr.sync_thread()
    shape = level.shape[1:]
    kept = run.tensor(target, (len(level) - 1, 2, *shape))
    after = (
        run.tensor(centre, shape),
        run.tensor(position, shape),
        run.tensor(heading, shape),
        torch.stack([run.tensor(one, shape) for one in begun]),
        run.tensor(behind, (run.reach, PHASES, *shape)),
    )
    return kept, after, stored


@exclusive
def adjoint(parts, level, theta_on, theta_off, stored, grad_kept, grad_after):
    """Adjoint of ``forward``: gradients of level, theta_on, theta_off [...], dead time [...] and of the state.

    Args: stored: of ``forward``. grad_kept: [T, 2, ...]. grad_after: of the state after, in the order of ``forward``.
    """
    run = Run(parts, level, theta_on, theta_off)
    dr = run.dr
    seed = run.load(grad_kept)
    target = run.nothing(len(level))
    ahead = run.load(grad_after[4])
    before = run.fresh(run.reach * PHASES * run.width)

    def begin(row, pull):
        for group, mine in enumerate(pull):
            mine[row] = run.gather(ahead, row * PHASES + group)
        return (pull,)

    def end(row, pull):
        for group, mine in enumerate(pull):
            run.scatter(before, mine[row], row * PHASES + group)
        return (pull,)

    def back_block(done, pulls, pull, local, path):
        block = run.blocks - 1 - done
        first, size = run.ends(block)
        place = block * run.stored

        def restore(row, local):
            for group, mine in enumerate(local):
                mine[row] = run.gather(stored, place + row * PHASES + group)
            return (local,)

        (local,) = run.repeat(run.reach, restore, local)
        begun = [run.gather(stored, place + run.reach * PHASES + group) for group in range(PHASES)]
        centre = run.gather(stored, place + run.reach * PHASES + PHASES)
        position = run.gather(stored, place + run.reach * PHASES + PHASES + 1)
        heading = run.gather(stored, place + run.reach * PHASES + PHASES + 2)

        def walk(index, centre, position, heading, begun, local, path):
            for mine, value in zip(path, (*begun, centre, position, heading), strict=True):
                mine[index] = value
            *_, centre, position, heading, begun = run.walk(
                local, first + index, index + run.reach - 1, centre, position, heading, begun
            )
            return centre, position, heading, begun, local, path

        *_, local, path = run.repeat(size, walk, centre, position, heading, begun, local, path)

        def shift(done, pull):  # what later blocks pull at lies behind this one
            row = run.reach + size - 1 - done
            old = row >= size
            for mine in pull:
                value = mine[dr.select(old, row - size, 0)]
                mine[row] = dr.select(old, value, 0)
            return (pull,)

        (pull,) = run.repeat(run.reach + size, shift, pull)

        def back(done, pulls, pull, local, path):
            index = size - 1 - done
            *begun, centre, position, heading = (mine[index] for mine in path)
            now = index + run.reach - 1
            before = (centre, position, heading, begun)
            return run.pull(seed, target, pulls, pull, local, first + index, now, *before), pull, local, path

        return run.repeat(size, back, pulls, pull, local, path)

    pull = run.local(run.reach + run.size)
    (pull,) = run.repeat(run.reach, begin, pull)
    pulls = {
        "centre": run.load(grad_after[0]),
        "position": run.load(grad_after[1]),
        "begun": [run.load(one) for one in grad_after[3]],
        "theta_on": run.zero,
        "theta_off": run.zero,
        "dead": run.zero,
    }
    path = run.local(run.size, PHASES + 3)
    pulls, pull, *_ = run.repeat(run.blocks, back_block, pulls, pull, run.local(run.reach + run.size), path)
    run.repeat(run.reach, end, pull)
    dr.eval(target, before, pulls)
    dr.sync_thread()
    shape = level.shape[1:]
    one = {name: run.tensor(value, shape) for name, value in pulls.items() if name != "begun"}
    return (
        run.tensor(target, level.shape),
        one["theta_on"],
        one["theta_off"],
        one["dead"],
        one["centre"],
        one["position"],
        torch.stack([run.tensor(value, shape) for value in pulls["begun"]]),
        run.tensor(before, (run.reach, PHASES, *shape)),
    )
