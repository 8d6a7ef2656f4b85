"""What dead time lets pass of mean counts: the expectation over where events stand in a pixel's
threshold, as a smooth function of the levels, the thresholds and the dead time.

A pixel has an event whenever its mean signed count I (ON less OFF) passes i + u, up or down, with a
phase u that is as good as random: on a way back those come first that came last. Event i is kept
unless one kept before lies less than T back, and no two kept ones do:

    kept_i = 1 - sum over j < i with t_i - t_j < T of kept_j,

a linear recursion, exact for every single phase. Here it runs for PHASES groups of neighbouring
phases, each WIDTH of a count wide and mixed within; S(t) is what a group has kept until t, and a
phase that has its event during a step is kept by 1 - (S(its event before) - S(t - T)). The first
event after a pause is never lost, and dead time reaches over frames, turns and polarities. What the
mixing costs is in docs/events.md.

It is a drjit loop over time per pixel. Intervals are cut into parts. A pixel carries the centre of
its play, its mean count so far (position), where it heads, and of every group of phases what it had
kept when its last event began, and what it had kept at the ends of the parts within a dead time
(rows). Rows lie in memory local to the pixel's thread: ``reach`` before a block of parts, then
those of the block. The forward loop stores the state at the beginning of every block; the adjoint
goes from block to block backward, walks each forward once more, and then back.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.backend import pull_back
from codesign.events.kernels import Lanes, beyond
from codesign.events.layers.dead_time_parts import cut_intervals, rows_wanted
from codesign.exclusive import exclusive

PHASES = 6
WIDTH = 2 / PHASES  # of a count: every phase belongs to two groups
BLOCK = 32  # parts between two stored states, at least
# its multiples spread evenly: neighbouring pixels stand at different phases
GOLDEN = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class DeadTimeState:
    """What ``mean_counts`` carries over chunks. position: [...] mean signed count so far, modulo 1.
    heading:
    [...] 1 where the last counts were ON, -1 where they were OFF. begun: [PHASES, ...] what a group
    had kept when its last event began. kept: [N, PHASES, ...] what it had kept at ago_s: [N]
    seconds before the end, the last one 0. All keep their graph."""

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
      level: [T + 1, ...] log levels. centre: [...] of the play at the first one. thetas: ON, OFF,
        0-dim or [...].
      interval_s: [T] float64 lengths. refractory_s: 0-dim, > 0. state: DeadTimeState of an earlier
        chunk.
    Returns: kept counts [T, 2, ...], ON first; the play's centre [...]; DeadTimeState.
    Gradient: level, centre, thetas, refractory_s, state; exact, of the recursion.
    Raises: DomainError for a dead time that reaches over more than MOST_ROWS intervals.
    Cost: one pass forward and two backward; beside counts and gradients some 15 numbers per part (a
      fifth of the dead time, or an interval) and pixel.
    """
    dead_s = torch.as_tensor(refractory_s, dtype=torch.float64)
    thetas = [torch.as_tensor(theta).to(level) for theta in thetas]
    if state is None:
        pixels = torch.arange(level[0].numel(), dtype=torch.float64)
        nothing = level.new_zeros(PHASES, *level.shape[1:])
        position = ((0.37 + GOLDEN * pixels) % 1).to(level).reshape(level.shape[1:])
        state = DeadTimeState(position, nothing[0], nothing, nothing[None], interval_s.new_zeros(1))
    cut, rows_s = cut_intervals(interval_s, float(dead_s.detach()), state.ago_s)
    missing = cut.reach - len(state.kept)
    rows = state.kept[-cut.reach :]
    if missing > 0:
        rows = torch.cat((rows.new_zeros(missing, *rows.shape[1:]), rows))
    passed, centre, position, heading, begun, rows = _Kept.apply(
        level, *thetas, dead_s, centre, state.position, state.heading, state.begun, rows, cut
    )
    ago_s = rows_s[-1] - rows_s
    kept = rows[-rows_wanted(ago_s, float(dead_s.detach())) :]
    base = kept[-1].detach()
    after = DeadTimeState(
        position - position.detach().floor(),
        heading,
        begun - base,
        kept - base,
        ago_s[-len(kept) :],
    )
    return passed, centre, after


class _Kept(Function):
    @staticmethod
    @exclusive
    def forward(
        ctx, level, theta_on, theta_off, dead_s, centre, position, heading, begun, rows, cut
    ):
        run = _Run(cut, level, theta_on, theta_off)
        passed, after, stored = run.forward(centre, position, heading, begun, rows)
        ctx.mark_non_differentiable(after[2])
        ctx.cut = cut
        ctx.stored = stored
        ctx.save_for_backward(level, theta_on, theta_off)
        return passed, *after

    @staticmethod
    @once_differentiable
    @exclusive
    def backward(ctx, grad_passed, *grads):
        level, theta_on, theta_off = ctx.saved_tensors
        run = _Run(ctx.cut, level, theta_on, theta_off)
        of_level, (of_on, of_off, of_dead, *of_state), of_rows = run.backward(
            ctx.stored, grad_passed, *grads
        )
        of_thetas = of_on.sum_to_size(theta_on.shape), of_off.sum_to_size(theta_off.shape)
        of_dead = of_dead.sum(dtype=torch.float64)
        return (
            of_level,
            *of_thetas,
            of_dead,
            *of_state[:2],
            None,
            torch.stack(of_state[2:]),
            of_rows,
            None,
        )


class _Run(Lanes):
    """One call of a loop over parts, in either direction of time. A state is a list: the play's
    centre, position, heading, and of every group what it had kept when its last event began."""

    def __init__(self, cut, level, theta_on, theta_off):
        super().__init__(level, level[0].numel())
        UInt32, Float = self.arr.UInt32, self.arr.Float
        self.shape = level.shape
        self.values = self.load(level)
        self.thetas = [
            self.load(theta if theta.numel() == 1 else theta.expand(level.shape[1:]))
            for theta in (theta_on, theta_off)
        ]
        self.interval, self.back_rows = (UInt32(x.tolist()) for x in (cut.interval, cut.back))
        self.share, self.blend, self.slope = (
            Float(x.tolist()) for x in (cut.share, cut.blend, cut.slope)
        )
        self.reach = cut.reach
        # as many parts as rows of a state, so that both take the same memory
        self.size = max(BLOCK, cut.reach)
        self.blocks = -(-len(cut.interval) // self.size)
        self.count = self.opaque(len(cut.interval))
        self.stored = self.reach * PHASES + PHASES + 3  # numbers of a state and its rows

    def local(self, rows, several=PHASES):
        """Zeros in the memory of a thread: [rows] of every pixel, several times."""
        # one block each: numbers that are read at the same row share the work of finding it
        return [
            self.dr.alloc_local(self.arr.Float, rows, value=self.arr.Float(0))
            for _ in range(several)
        ]

    def add(self, flat, value, row):
        reduce = self.dr.ReduceOp.Add
        self.dr.scatter_reduce(
            reduce, flat, value, self.place(row), mode=self.dr.ReduceMode.NoConflicts
        )

    def fill(self, rows, source, place=0, at=0):
        """Rows in the memory of a thread, from ``at`` on, as they stand in a source from row
        ``place`` on."""

        def read(row, rows):
            for group, mine in enumerate(rows):
                mine[at + row] = self.at(source, place + row * PHASES + group)
            return (rows,)

        return self.loop(0, self.reach, read, rows)[0]

    def keep(self, rows, target, place=0, at=0):
        """The other way round."""

        def write(row, rows):
            for group, mine in enumerate(rows):
                self.put(target, mine[at + row], place + row * PHASES + group)
            return (rows,)

        return self.loop(0, self.reach, write, rows)[0]

    def of_part(self, source, part):
        return self.dr.gather(type(source), source, part)

    def ends(self, block):
        """First part of a block, how many parts it has, and where its state is stored."""
        first = block * self.size
        return first, self.dr.minimum(self.count - first, self.size), block * self.stored

    def given(self, rows, part, now, state):
        """What ``step`` takes: of the pixel, then of every group when its last event began, now,
        and at the rows around a dead time ago."""
        centre, position, _, *begun = state
        interval = self.of_part(self.interval, part)
        low = self.at(self.values, interval)
        high = self.at(self.values, interval + 1)
        level = self.dr.lerp(low, high, self.of_part(self.share, part))
        before = now - self.of_part(self.back_rows, part)
        groups = [
            value
            for mine, one in zip(rows, begun, strict=True)
            for value in (one, mine[now], mine[before], mine[before + 1])
        ]
        return [level, *self.thetas, self.of_part(self.blend, part), centre, position, *groups]

    def step(self, heading, level, theta_on, theta_off, blend, centre, position, *groups):
        """One part, as drjit differentiates it. Returns where the play heads now; kept counts,
        centre, position, and of every group what it had kept when its last event began, and what it
        has kept now."""
        dr = self.dr
        rise, fall = beyond(dr, level, centre, theta_on, theta_off)
        total = rise / theta_on + fall / theta_off
        ahead = dr.select(rise > 0, 1, dr.select(fall > 0, -1, heading))
        turned = ahead * heading < 0
        passed = 0
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
            # masses of the event begun before this part, and of the one that begins in it; further
            # ones are lost to it
            early = dr.select(begins, border, _filled(dr, end)) - _filled(dr, start)
            late = dr.select(begins, _at_most_one(dr, _filled(dr, end) - border), 0)
            early = early * _at_most_one(dr, 1 - (begun - free))
            begun = dr.select(begins, kept + early, begun)
            added = early + late * _at_most_one(dr, 1 - (begun - free))
            passed = passed + added
            after += begun, kept + added
        return ahead, passed / PHASES, centre + (rise - fall), position + ahead * total, *after

    def walk(self, rows, part, now, state):
        """One part forward; rows gain one. Returns kept counts and their row, and the state after
        it."""
        ahead, passed, centre, position, *groups = self.step(
            state[2], *self.given(rows, part, now, state)
        )
        for mine, value in zip(rows, groups[1::2], strict=True):
            mine[now + 1] = value
        return passed, self.row(part, ahead), [centre, position, ahead, *groups[::2]]

    def row(self, part, ahead):
        """Row of the counts of a part that heads there: ON, then OFF."""
        return 2 * self.of_part(self.interval, part) + self.dr.select(
            ahead < 0, self.arr.UInt32(1), 0
        )

    def forward(self, centre, position, heading, begun, rows):
        """Kept counts [T, 2, ...] of levels [T + 1, ...]; the state after them; the stored states.

        Args:
          centre, position, heading: [...].
          begun: [PHASES, ...].
          rows: [reach, PHASES, ...], the last one now.
        """
        steps, *pixels = self.shape
        target = self.zeros(2 * (steps - 1))
        stored = self.fresh(self.blocks * self.stored)
        behind = self.fresh(self.reach * PHASES)
        local = self.fill(self.local(self.reach + self.size), self.load(rows), at=self.size)

        def walk_block(block, state, local):
            first, size, place = self.ends(block)

            def shift(row, local):
                for mine in local:
                    mine[row] = mine[self.size + row]
                return (local,)

            (local,) = self.loop(0, self.reach, shift, local)
            local = self.keep(local, stored, place)
            for index, value in enumerate(state):
                self.put(stored, value, place + self.reach * PHASES + index)

            def walk(index, state, local):
                kept, row, state = self.walk(local, first + index, index + self.reach - 1, state)
                self.add(target, kept, row)
                return state, local

            return self.loop(0, size, walk, state, local)

        state = self.rows(torch.stack((centre, position, heading, *begun)))
        state, local = self.loop(0, self.blocks, walk_block, state, local)
        self.keep(local, behind, at=self.count - (self.blocks - 1) * self.size)
        self.dr.eval(target, stored, behind, state)
        self.dr.sync_thread()
        centre, position, heading, *begun = (self.tensor(one, pixels) for one in state)
        rows = self.tensor(behind, (self.reach, PHASES, *pixels))
        kept = self.tensor(target, (steps - 1, 2, *pixels))
        return kept, (centre, position, heading, torch.stack(begun), rows), stored

    def backward(self, stored, grad_kept, grad_centre, grad_position, _, grad_begun, grad_rows):
        """Adjoint of ``forward``: gradients of the level; of theta_on, theta_off, dead time and the
        state but its heading, a list of [...]; of the rows."""
        dr = self.dr
        seed = self.load(grad_kept)
        target = self.zeros(self.shape[0])
        before = self.fresh(self.reach * PHASES)

        def back_block(block, pulls, pull, local, path):
            first, size, place = self.ends(block)
            local = self.fill(local, stored, place)
            state = [self.at(stored, place + self.reach * PHASES + k) for k in range(PHASES + 3)]

            def walk(index, state, local, path):
                for mine, value in zip(path, state, strict=True):
                    mine[index] = value
                return (
                    self.walk(local, first + index, index + self.reach - 1, state)[2],
                    local,
                    path,
                )

            _, local, path = self.loop(0, size, walk, state, local, path)

            def shift(row, pull):  # what later blocks pull at lies behind this one
                old = row >= size
                for mine in pull:
                    value = mine[dr.select(old, row - size, 0)]
                    mine[row] = dr.select(old, value, 0)
                return (pull,)

            (pull,) = self.loop_back(0, self.reach + size, shift, pull)

            def back(index, pulls, pull, local, path):
                state = [mine[index] for mine in path]
                now = index + self.reach - 1
                pulls = self.pull(seed, target, pulls, pull, local, first + index, now, state)
                return pulls, pull, local, path

            return self.loop_back(0, size, back, pulls, pull, local, path)

        rows = self.reach + self.size
        pull = self.fill(self.local(rows), self.load(grad_rows))
        nothing = [dr.zeros(self.arr.Float, self.width) for _ in range(3)]
        pulls = [*nothing, *self.rows(torch.stack((grad_centre, grad_position, *grad_begun)))]
        path = self.local(self.size, PHASES + 3)
        pulls, pull, *_ = self.loop_back(
            0, self.blocks, back_block, pulls, pull, self.local(rows), path
        )
        self.keep(pull, before)
        dr.eval(target, before, pulls)
        dr.sync_thread()
        pixels = self.shape[1:]
        of_rows = self.tensor(before, (self.reach, PHASES, *pixels))
        return self.tensor(target, self.shape), [self.tensor(one, pixels) for one in pulls], of_rows

    def pull(self, seed, target, pulls, pull, rows, part, now, state):
        """One part backward. pulls: gradients gathered so far of thresholds and dead time, then
        those of the state after it; pull: of the rows. Returns those before it."""
        given = self.given(rows, part, now, state)
        ahead = self.dr.detach(self.step(state[2], *given)[0])
        seeds = [self.at(seed, self.row(part, ahead)), *pulls[3:5]]
        for mine, one in zip(pull, pulls[5:], strict=True):
            seeds += one, mine[now + 1]
        level, theta_on, theta_off, blend, *of_state = pull_back(
            lambda *values: self.step(state[2], *values)[1:], given, seeds
        )
        centre, position, *groups = of_state
        before = now - self.of_part(self.back_rows, part)
        for group, mine in enumerate(pull):
            for row, value in zip(
                (now, before, before + 1), groups[4 * group + 1 : 4 * group + 4], strict=True
            ):
                mine[row] = mine[row] + value
        interval, share = self.of_part(self.interval, part), self.of_part(self.share, part)
        self.add(target, (1 - share) * level, interval)
        self.add(target, share * level, interval + 1)
        moved = theta_on, theta_off, -self.of_part(self.slope, part) * blend
        gathered = [total + more for total, more in zip(pulls[:3], moved, strict=True)]
        return [*gathered, centre, position, *groups[::4]]


def _filled(dr, place):
    """Mass of a group's events up to a place."""
    whole = dr.floor(dr.detach(place))
    return whole + _at_most_one(dr, (place - whole) * (1 / WIDTH))


def _at_most_one(dr, share):
    """No slope from 1 on: a phase that nothing blocks stays so."""
    return dr.select(share < 1, share, 1)
