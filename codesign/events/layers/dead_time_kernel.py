"""The recursion of ``dead_time`` behind the play of the mean count, as a drjit loop over time per pixel:
forward and adjoint.

Intervals are cut into parts. A pixel carries the centre of its play, its mean count so far (position), and of
every group of phases what it had kept when its last event began, and what it had kept at the ends of the
parts within a dead time (rows). Rows lie in memory local to the pixel's thread: ``reach`` before a block of
parts, then those of the block. The forward loop stores the state at the beginning of every block; the adjoint
goes from block to block backward, walks each forward once more, and then back.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.backend import pull_back
from codesign.events.layers.pixel_loop import Loop
from codesign.exclusive import exclusive

PHASES = 6
WIDTH = 2 / PHASES  # of a count: every phase belongs to two groups
BLOCK = 32  # parts, at least


@dataclass(frozen=True)
class Parts:
    """Parts of intervals. interval: [N] that each lies in. share: [N] of the interval that has passed at its
    end.
    back: [N] >= 1 rows from its start to the row before the look, a dead time before its middle; blend: [N]
    of the way from that row to the next; slope: [N] of blend, per second of dead time, negative sign left
    out.
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
        self.back_rows = self._of(self.arr.UInt32, parts.back)
        self.share, self.blend, self.slope = (
            self._of(self.arr.Float, values) for values in (parts.share, parts.blend, parts.slope)
        )
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

    def add(self, target, value, row):
        place = row * self.pixels + self.lane
        self.dr.scatter_reduce(
            self.dr.ReduceOp.Add,
            target,
            value,
            place,
            mode=self.dr.ReduceMode.NoConflicts,
        )

    def fill(self, rows, source, place=0, at=0):
        """Rows in the memory of a thread, from ``at`` on, as they stand in a source from row ``place`` on."""

        def read(row, rows):
            for group, mine in enumerate(rows):
                mine[at + row] = self.gather(source, place + row * PHASES + group)
            return (rows,)

        return self.repeat(self.reach, read, rows)[0]

    def keep(self, rows, target, place=0, at=0):
        """The other way round."""

        def write(row, rows):
            for group, mine in enumerate(rows):
                self.scatter(target, mine[at + row], place + row * PHASES + group)
            return (rows,)

        return self.repeat(self.reach, write, rows)[0]

    def of_part(self, source, part):
        return self.dr.gather(type(source), source, part)

    def ends(self, block):
        """First part of a block, and how many parts it has."""
        first = block * self.size
        return first, self.dr.minimum(self.count - first, self.size)

    def given(self, rows, part, now, centre, position, begun):
        """What ``step`` takes: of the pixel, then of every group when its last event began, now, and at the
        rows around a dead time ago."""
        interval = self.of_part(self.interval, part)
        low = self.gather(self.values, interval)
        high = self.gather(self.values, interval + 1)
        level = self.dr.lerp(low, high, self.of_part(self.share, part))
        before = now - self.of_part(self.back_rows, part)
        groups = [
            value
            for mine, one in zip(rows, begun, strict=True)
            for value in (one, mine[now], mine[before], mine[before + 1])
        ]
        blend = self.of_part(self.blend, part)
        return [level, self.theta_on, self.theta_off, blend, centre, position, *groups]

    def step(self, heading, level, theta_on, theta_off, blend, centre, position, *groups):
        """One part, as drjit differentiates it. Returns where the play heads now; kept counts, centre,
        position, and of every group what it had kept when its last event began, and what it has kept now."""
        dr = self.dr
        half = (theta_on + theta_off) * 0.25
        rise, fall = (dr.select(far > 0, far, 0) for far in (level - centre - half, centre - half - level))
        total = rise / theta_on + fall / theta_off
        ahead = dr.select(rise > 0, 1, dr.select(fall > 0, -1, heading))
        turned = ahead * heading < 0
        passed = self.zero
        after = []
        for group in range(PHASES):
            begun, kept, low, high = groups[4 * group : 4 * group + 4]
            free = dr.fma(blend, high - low, low)
            # at a turn an event begins, of those phases that the level has just passed
            begun = dr.select(turned, kept, begun)
            place = position + group / PHASES
            # downward, the same events come in reverse order
            start = dr.select(ahead < 0, WIDTH - place, place)
            end = start + total
            border = dr.floor(dr.detach(start)) + 1
            begins = dr.floor(dr.detach(end)) >= border
            # masses of the event begun before this part, and of the one that begins in it; further ones are
            # lost to it
            early = dr.select(begins, border, _filled(dr, end)) - _filled(dr, start)
            late = dr.select(begins, _at_most_one(dr, _filled(dr, end) - border), 0)
            early = early * _at_most_one(dr, 1 - (begun - free))
            begun = dr.select(begins, kept + early, begun)
            added = early + late * _at_most_one(dr, 1 - (begun - free))
            passed = passed + added
            after += begun, kept + added
        return ahead, passed / PHASES, centre + (rise - fall), position + ahead * total, *after

    def walk(self, rows, part, now, centre, position, heading, begun):
        """One part forward; rows gain one. Returns kept counts and their place, and the state after it."""
        given = self.given(rows, part, now, centre, position, begun)
        ahead, passed, centre, position, *groups = self.step(heading, *given)
        for mine, value in zip(rows, groups[1::2], strict=True):
            mine[now + 1] = value
        return passed, self.place(part, ahead), centre, position, ahead, groups[::2]

    def place(self, part, ahead):
        """Row of the counts of a part that heads there: ON, then OFF."""
        return 2 * self.of_part(self.interval, part) + self.dr.select(ahead < 0, self.arr.UInt32(1), 0)

    def pull(self, seed, target, pulls, pull, rows, part, now, centre, position, heading, begun):
        """One part backward. pulls: gradients of the state after it, by name; pull: of the rows. Returns
        those of the state before it."""
        given = self.given(rows, part, now, centre, position, begun)
        ahead = self.dr.detach(self.step(heading, *given)[0])
        seeds = [self.gather(seed, self.place(part, ahead)), pulls["centre"], pulls["position"]]
        for mine, one in zip(pull, pulls["begun"], strict=True):
            seeds += one, mine[now + 1]
        level, theta_on, theta_off, blend, centre, position, *groups = pull_back(
            lambda *values: self.step(heading, *values)[1:], given, seeds
        )
        before = now - self.of_part(self.back_rows, part)
        for group, mine in enumerate(pull):
            for row, value in zip(
                (now, before, before + 1), groups[4 * group + 1 : 4 * group + 4], strict=True
            ):
                mine[row] = mine[row] + value
        interval, share = self.of_part(self.interval, part), self.of_part(self.share, part)
        self.add(target, (1 - share) * level, interval)
        self.add(target, share * level, interval + 1)
        return {
            "centre": centre,
            "position": position,
            "begun": groups[::4],
            "theta_on": pulls["theta_on"] + theta_on,
            "theta_off": pulls["theta_off"] + theta_off,
            "dead": pulls["dead"] - self.of_part(self.slope, part) * blend,
        }


def _filled(dr, place):
    """Mass of a group's events up to a place."""
    whole = dr.floor(dr.detach(place))
    return whole + _at_most_one(dr, (place - whole) * (1 / WIDTH))


def _at_most_one(dr, share):
    """No slope from 1 on: a phase that nothing blocks stays so."""
    return dr.select(share < 1, share, 1)


@exclusive
def forward(parts, level, theta_on, theta_off, centre, position, heading, begun, rows):
    """Kept counts [T, 2, ...] of levels [T + 1, ...]; the state after them; the stored states.

    Args: centre, position, heading: [...]. begun: [PHASES, ...]. rows: [reach, PHASES, ...], the last one
      now.
    """
    run = Run(parts, level, theta_on, theta_off)
    target = run.nothing(2 * (len(level) - 1))
    stored = run.fresh(run.blocks * run.stored * run.width)
    behind = run.fresh(run.reach * PHASES * run.width)
    local = run.fill(run.local(run.reach + run.size), run.load(rows), at=run.size)

    def walk_block(block, centre, position, heading, begun, local):
        first, size = run.ends(block)
        place = block * run.stored

        def shift(row, local):
            for mine in local:
                mine[row] = mine[run.size + row]
            return (local,)

        (local,) = run.repeat(run.reach, shift, local)
        local = run.keep(local, stored, place)
        for index, value in enumerate((*begun, centre, position, heading)):
            run.scatter(stored, value, place + run.reach * PHASES + index)

        def walk(index, centre, position, heading, begun, local):
            part = first + index
            kept, place, *after = run.walk(
                local, part, index + run.reach - 1, centre, position, heading, begun
            )
            run.add(target, kept, place)
            return *after, local

        return run.repeat(size, walk, centre, position, heading, begun, local)

    start = (*map(run.load, (centre, position, heading)), [run.load(one) for one in begun])
    centre, position, heading, begun, local = run.repeat(run.blocks, walk_block, *start, local)
    last = run.count - (run.blocks - 1) * run.size
    run.keep(local, behind, at=last)
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
    """Adjoint of ``forward``: gradients of level, theta_on, theta_off [...], dead time [...] and of the
    state.

    Args: stored: of ``forward``. grad_kept: [T, 2, ...]. grad_after: of the state after, in the order of
      ``forward``.
    """
    run = Run(parts, level, theta_on, theta_off)
    dr = run.dr
    seed = run.load(grad_kept)
    target = run.nothing(len(level))
    before = run.fresh(run.reach * PHASES * run.width)

    def back_block(done, pulls, pull, local, path):
        block = run.blocks - 1 - done
        first, size = run.ends(block)
        place = block * run.stored
        local = run.fill(local, stored, place)
        state = place + run.reach * PHASES
        *begun, centre, position, heading = (run.gather(stored, state + k) for k in range(PHASES + 3))

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

    pull = run.fill(run.local(run.reach + run.size), run.load(grad_after[4]))
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
    run.keep(pull, before)
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
