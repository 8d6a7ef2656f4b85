"""The memory layer as one drjit loop over time per pixel, forward and adjoint, front end included; nothing is
stored between the two.

Forward, with L the log level, r the memorised level and C the threshold on the side of L - r: n = floor(|L -
r|/C), r += C n.

Backward is the play of width w = (C_on + C_off)/2 and centre m that the mean of n follows over where in its
threshold a pixel happens to stand (exactly for C_on = C_off, see docs/events.md; ``turns_kernel`` is exact for
all). It moves only where L leaves it, by as much as L does: n_on = (L - m - w/2)/C_on, n_off = (m - w/2 - L)/C_off,
and the edge then stands at L. So an engaged step pulls at its own level, and pushes at the level of the step
engaged before: the loop forward in time writes both.
"""

from codesign.events.layers.pixel_loop import Loop
from codesign.exclusive import exclusive


@exclusive
def count(frames, start, theta_on, theta_off, front_end):
    """Counts [T, 2, ...] of frames [T, ...] from a start [2, ...] (memorised level, centre of the play); the
    state after them; whether a value may not enter."""
    loop = Loop(frames, theta_on, theta_off)
    target = loop.fresh(2 * frames.numel())

    def step(index, value, bad, reference, centre):
        bad |= ~front_end.accepts(loop.dr, value)
        level = front_end.traced(loop.dr, value)[0]
        moved = loop.fire(target, index, level - reference)
        return bad, reference + moved, loop.follow(level, centre)

    begun = loop.dr.zeros(loop.arr.Bool, loop.width), loop.load(start[0]), loop.load(start[1])
    bad, *after = loop(step, begun, target)
    return loop.result(target, after, bad)


@exclusive
def adjoint(frames, start, theta_on, theta_off, front_end, grad_counts, grad_end, *, first, wants_thetas):
    """Adjoint of ``count``: gradients of the frames [first + T, ...] (rows before ``first`` are left to the
    caller), start, theta_on, theta_off [...] (zero unless wanted).

    Args: grad_end: [...] of the memorised level and the play's centre together; the start's is theirs
      together, too.
    """
    loop = Loop(frames, theta_on, theta_off)
    dr = loop.dr
    arr = loop.arr
    seed = loop.load(grad_counts)
    offset = dr.opaque(arr.UInt32, first)
    target = dr.zeros(arr.Float, (first + len(frames)) * loop.width)  # steps inside the play keep 0
    dr.eval(target)
    never = 0xFFFFFFFF

    def step(index, value, centre, pull, slope, engaged, anchor, grad_start, grad_on, grad_off, grad_width):
        level, now_slope = front_end.traced(dr, value)
        rise, fall = loop.beyond(level, centre)
        is_on = rise > 0
        is_off = fall > 0
        moves = is_on | is_off
        place = 2 * index * loop.pixels + loop.lane
        seed_on = dr.gather(arr.Float, seed, place, is_on) / loop.theta_on
        seed_off = dr.gather(arr.Float, seed, place + loop.pixels, is_off) / loop.theta_off
        now_pull = seed_on - seed_off  # adjoint of this level through this step's count
        known = moves & (engaged != never)
        dr.scatter(
            target,
            (pull - now_pull) * slope,
            (engaged + offset) * loop.pixels + loop.lane,
            active=known,
            mode=dr.ReduceMode.NoConflicts,
        )
        grad_start = grad_start - dr.select(moves & ~known, now_pull, 0)
        if wants_thetas:
            grad_on = grad_on - seed_on * rise / loop.theta_on
            grad_off = grad_off - seed_off * fall / loop.theta_off
            # anchor: how the upper edge moves with the width: 0 where it stands at a level, 1 where the lower
            # one does, 1/2 at the start
            grad_width = (
                grad_width
                - dr.select(is_on, now_pull * anchor, 0)
                + dr.select(is_off, now_pull * (1 - anchor), 0)
            )
            anchor = dr.select(is_on, 0, dr.select(is_off, 1, anchor))
        pull = dr.select(moves, now_pull, pull)
        slope = dr.select(moves, now_slope(), slope)
        engaged = dr.select(moves, index, engaged)
        return centre + (rise - fall), pull, slope, engaged, anchor, grad_start, grad_on, grad_off, grad_width

    zero = dr.zeros(arr.Float, loop.width)
    begun = (
        loop.load(start[1]),
        zero,
        zero,
        dr.full(arr.UInt32, never, loop.width),
        zero + 0.5,
        zero,
        zero,
        zero,
        zero,
    )
    _, pull, slope, engaged, anchor, grad_start, grad_on, grad_off, grad_width = loop(step, begun, target)
    end = loop.load(grad_end)
    known = engaged != never
    dr.scatter(
        target,
        (pull + end) * slope,
        (engaged + offset) * loop.pixels + loop.lane,
        active=known,
        mode=dr.ReduceMode.NoConflicts,
    )
    grad_start = grad_start + dr.select(known, 0, end)
    grad_width = grad_width + end * (anchor - 0.5)
    dr.eval(target, grad_start, grad_on, grad_off, grad_width)
    dr.sync_thread()
    grad_frames = target.torch().reshape(first + len(frames), *frames.shape[1:])
    return grad_frames, *(
        loop.tensor(grad, start.shape[1:])
        for grad in (grad_start, grad_on + grad_width / 2, grad_off + grad_width / 2)
    )
