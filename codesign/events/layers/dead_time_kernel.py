"""The recursion of ``dead_time`` behind the play of the mean count, as a drjit loop over time per pixel: forward and
adjoint.

Intervals are cut into parts. A pixel carries the centre of its play, its mean count so far (position), and of every
group of phases what it had kept when its last event began, and what it had kept at the ends of the parts within a
dead time (rows). Rows lie in memory local to the pixel's thread: ``reach`` before a block of parts, then those of
the block. The forward loop stores the state at the beginning of every block; the adjoint goes from block to block
backward, walks each forward once more, and then back.
"""

import torch

from codesign.events.layers.dead_time_part import PHASES, Run
from codesign.exclusive import exclusive


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
