"""The memory layer as one drjit loop over time per pixel, forward and adjoint, front end included; nothing is
stored between the two.

Forward, with L the log level, r the memorised level and C the threshold on the side of L - r: n = floor(|L -
r|/C), r += C n.

Backward follows the mean of n over where in its threshold a pixel happens to stand. After a turn of the
signal r lies anywhere within one C of the turning point, so on average nothing fires until the way back
exceeds C, and 1/C per unit of level from then on: a play (backlash) of width w = (C_on + C_off)/2, centre m.
It moves only where L leaves it, by as much as L does: n_on = (L - m - w/2)/C_on, n_off = (m - w/2 - L)/C_off,
and the edge then stands at L. So an engaged step pulls at its own level, and pushes at the level of the step
engaged before: the loop forward in time writes both.
"""

import torch

from codesign import backend


class _Run:
    """Frames, thresholds and the loop over time, in chunks."""

    def __init__(self, frames, theta_on, theta_off, front_end):
        import drjit as dr

        self.dr = dr
        self.arr = backend.arrays(frames.device.type, frames.dtype)
        self.frames = frames
        self.width = frames[0].numel()
        self.lane = dr.arange(self.arr.UInt32, self.width)
        self.pixels = dr.opaque(self.arr.UInt32, self.width)
        shape = frames.shape[1:]
        self.theta_on, self.theta_off = (
            self.load(theta if theta.numel() == 1 else theta.expand(shape)) for theta in (theta_on, theta_off)
        )
        self.values = self.load(frames)

    def load(self, tensor):
        return self.arr.Float(tensor.detach().contiguous().reshape(-1))

    def tensor(self, value, shape):
        return value.torch().reshape(shape).clone()

    def fresh(self, count):
        """Memory to be filled by kernels. It is drjit's, which hands the same pages out again and again: new
        pages from the system cost more than the kernel."""
        target = self.dr.empty(self.arr.Float, count)
        self.dr.eval(target)
        return target

    def compare(self, difference):
        """Counts ON, counts OFF, and what the memorised level moves by."""
        dr = self.dr
        rose = difference > 0
        theta = dr.select(rose, self.theta_on, self.theta_off)
        total = exact_floor(dr, dr.abs(difference), theta)
        on = dr.select(rose, total, 0)
        off = dr.select(rose, 0, total)
        return on, off, (on - off) * theta

    def beyond(self, level, centre):
        """How far the level lies above and below the play, >= 0 each."""
        half = (self.theta_on + self.theta_off) * 0.25
        return self.dr.maximum(level - centre - half, 0), self.dr.maximum(centre - half - level, 0)

    def __call__(self, step, carried, target):
        """Carry values through step(index, value, *carried) for every frame; ``target`` is what the steps
        write to."""
        dr = self.dr
        arr = self.arr
        size = backend.frames_per_kernel(self.width)
        with dr.suspend_grad():
            for first in range(0, len(self.frames), size):
                begin = dr.opaque(arr.UInt32, first, self.width)
                end = dr.opaque(arr.UInt32, min(first + size, len(self.frames)))

                def body(index, *carried):
                    value = dr.gather(arr.Float, self.values, index * self.pixels + self.lane)
                    return index + 1, *step(index, value, *carried)

                _, *carried = dr.while_loop(
                    (begin, *carried), lambda index, *_, end=end: index < end, body, mode="symbolic"
                )
                dr.eval(carried, target)
        return carried


def exact_floor(dr, value, divisor):
    """floor(value/divisor) of the two floats as they are, for value >= 0: a rounded quotient may reach the
    next whole number too early."""
    whole = dr.floor(value / divisor)
    rest = dr.fma(-whole, divisor, value)
    return dr.select(rest < 0, whole - 1, dr.select(rest >= divisor, whole + 1, whole))


def count(frames, start, theta_on, theta_off, front_end):
    """Counts [T, 2, ...] of frames [T, ...] from a start [2, ...] (memorised level, centre of the play); the
    state after them; whether a value may not enter."""
    run = _Run(frames, theta_on, theta_off, front_end)
    dr = run.dr
    arr = run.arr
    target = run.fresh(2 * frames.numel())

    def step(index, value, reference, centre, bad):
        bad |= ~front_end.accepts(dr, value)
        level = front_end.traced(dr, value)[0]
        on, off, moved = run.compare(level - reference)
        rise, fall = run.beyond(level, centre)
        place = 2 * index * run.pixels + run.lane
        dr.scatter(target, on, place, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(target, off, place + run.pixels, mode=dr.ReduceMode.NoConflicts)
        return reference + moved, centre + (rise - fall), bad

    reference, centre, bad = run(
        step, (run.load(start[0]), run.load(start[1]), dr.zeros(arr.Bool, run.width)), target
    )
    bad = bool(dr.any(bad)[0])
    dr.sync_thread()
    return (
        target.torch().reshape(len(frames), 2, *frames.shape[1:]),
        torch.stack([run.tensor(value, start.shape[1:]) for value in (reference, centre)]),
        bad,
    )


def adjoint(frames, start, theta_on, theta_off, front_end, grad_counts, grad_end, *, first, wants_thetas):
    """Adjoint of ``count``: gradients of the frames [first + T, ...] (rows before ``first`` are left to the
    caller), start, theta_on, theta_off [...] (zero unless wanted).

    Args: grad_end: [...] of the memorised level and the play's centre together; the start's is theirs
      together, too.
    """
    run = _Run(frames, theta_on, theta_off, front_end)
    dr = run.dr
    arr = run.arr
    seed = run.load(grad_counts)
    offset = dr.opaque(arr.UInt32, first)
    target = dr.zeros(arr.Float, (first + len(frames)) * run.width)  # steps inside the play keep 0
    dr.eval(target)
    never = 0xFFFFFFFF

    def step(index, value, centre, pull, slope, engaged, anchor, grad_start, grad_on, grad_off, grad_width):
        level, now_slope = front_end.traced(dr, value)
        rise, fall = run.beyond(level, centre)
        is_on = rise > 0
        is_off = fall > 0
        moves = is_on | is_off
        place = 2 * index * run.pixels + run.lane
        seed_on = dr.gather(arr.Float, seed, place, is_on) / run.theta_on
        seed_off = dr.gather(arr.Float, seed, place + run.pixels, is_off) / run.theta_off
        now_pull = seed_on - seed_off  # adjoint of this level through this step's count
        known = moves & (engaged != never)
        dr.scatter(
            target,
            (pull - now_pull) * slope,
            (engaged + offset) * run.pixels + run.lane,
            active=known,
            mode=dr.ReduceMode.NoConflicts,
        )
        grad_start = grad_start - dr.select(moves & ~known, now_pull, 0)
        if wants_thetas:
            grad_on = grad_on - seed_on * rise / run.theta_on
            grad_off = grad_off - seed_off * fall / run.theta_off
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

    zero = dr.zeros(arr.Float, run.width)
    begun = (
        run.load(start[1]),
        zero,
        zero,
        dr.full(arr.UInt32, never, run.width),
        zero + 0.5,
        zero,
        zero,
        zero,
        zero,
    )
    _, pull, slope, engaged, anchor, grad_start, grad_on, grad_off, grad_width = run(step, begun, target)
    end = run.load(grad_end)
    known = engaged != never
    dr.scatter(
        target,
        (pull + end) * slope,
        (engaged + offset) * run.pixels + run.lane,
        active=known,
        mode=dr.ReduceMode.NoConflicts,
    )
    grad_start = grad_start + dr.select(known, 0, end)
    grad_width = grad_width + end * (anchor - 0.5)
    dr.eval(target, grad_start, grad_on, grad_off, grad_width)
    dr.sync_thread()
    grad_frames = target.torch().reshape(first + len(frames), *frames.shape[1:])
    return grad_frames, *(
        run.tensor(grad, start.shape[1:])
        for grad in (grad_start, grad_on + grad_width / 2, grad_off + grad_width / 2)
    )
