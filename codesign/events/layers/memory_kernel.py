"""The memory layer as one drjit loop over time per pixel, forward and adjoint, front end included;
nothing is stored between the two.

Forward, with L the log level, r the memorised level and C the threshold on the side of L - r: n =
floor(|L - r|/C), r += C n.

Backward is the play of width w = (C_on + C_off)/2 and centre m that the mean of n follows over
where in its threshold a pixel happens to stand (exactly for C_on = C_off, see docs/events.md;
``turns_adjoint`` is exact for all). It moves only where L leaves it, by as much as L does: n_on =
(L - m - w/2)/C_on, n_off = (m - w/2 - L)/C_off, and the edge then stands at L. So an engaged step
pulls at its own level, and pushes at the level of the step engaged before: the loop forward in time
writes both.

The exact gradient of the mean count for unequal thresholds, as one drjit loop over time per pixel.

The mean runs over all places that a pixel may begin at: its memorised level r evenly over a box. A
small move of one level L_s makes the pixels that then stand on the brink fire at s, or not, and
moves nothing else. So with f the density on the brink (ON: r = L_s - C_on before, r = L_s after;
OFF: r = L_s + C_off before, L_s after)

    d mean(loss) / d L_s = f (J(fired) - J(not fired)),  J(r): what a pixel at r adds to the loss
    from s on,

for ON, and the negative for OFF: a **pair** of pixels, ``plus`` and ``minus``, C apart, simulated
from s on by the rule of the hard sensor. In the inside of a monotone stretch they meet in the very
next step; a pair born at a turn lives until they meet. For equal thresholds they meet when the way
back has reached C, and what is left is the play of ``play_adjoint``; unequal ones may never meet.

The pairs are also the edges of the density: of all pixels above ``plus`` and ``minus``, weight f
lies between. Whatever passes the brink in a step changes the density there, f = -sum of weight
(n_plus - n_minus) in signed counts n, and the box begins as a pair of its own. A pixel keeps
``PAIRS`` pairs beside the youngest. Where a turn needs more, the pair with the least weight x
distance is spread evenly over the threshold in use: mass is kept.
"""

from typing import Any

import torch

from codesign.backend import frames_per_kernel
from codesign.events.kernels import Lanes, beyond
from codesign.exclusive import exclusive

PAIRS = 4
WIDTH = 6  # values of a pair
TIE = 1e-5  # thresholds: a pixel on the brink has not fired yet
MET = 1e-4  # thresholds: nearer pairs have met
# in place of a frame
START = 0xFFFFFFFE
NONE = 0xFFFFFFFF


class Loop(Lanes):
    """Frames, thresholds and the loop over time, in chunks."""

    def __init__(self, frames, theta_on, theta_off):
        super().__init__(frames, frames[0].numel())
        self.frames = frames
        self.theta_on, self.theta_off = (
            self.load(theta if theta.numel() == 1 else theta.expand(frames.shape[1:]))
            for theta in (theta_on, theta_off)
        )
        self.values = self.load(frames)

    def __call__(self, step, carried, target) -> Any:
        """Carry values through step(index, value, *carried) for every frame; ``target`` is what the
        steps write to."""
        size = frames_per_kernel(self.width)

        def body(index, *carried):
            return step(index, self.at(self.values, index), *carried)

        with self.dr.suspend_grad():
            for first in range(0, len(self.frames), size):
                end = min(first + size, len(self.frames))
                carried = self.loop(self.opaque(first), self.opaque(end), body, *carried)
                self.dr.eval(carried, target)
        return carried


@exclusive
def count(frames, start, theta_on, theta_off, front_end):
    """Counts [T, 2, ...] of frames [T, ...] from a start [2, ...] (memorised level, centre of the
    play); the state after them; whether a value may not enter."""
    loop = Loop(frames, theta_on, theta_off)
    dr = loop.dr
    target = loop.fresh(2 * len(frames))

    def step(index, value, bad, reference, centre):
        level = front_end.traced(dr, value)[0]
        difference = level - reference
        rose = difference > 0
        theta = dr.select(rose, loop.theta_on, loop.theta_off)
        total = exact_floor(dr, dr.abs(difference), theta)
        on = dr.select(rose, total, 0)
        off = dr.select(rose, 0, total)
        loop.put(target, on, 2 * index)
        loop.put(target, off, 2 * index + 1)
        rise, fall = beyond(dr, level, centre, loop.theta_on, loop.theta_off)
        bad = bad | ~front_end.accepts(dr, value)
        return bad, reference + (on - off) * theta, centre + (rise - fall)

    bad, *after = loop(step, (dr.zeros(loop.arr.Bool, loop.width), *loop.rows(start)), target)
    bad = bool(dr.any(bad)[0])
    dr.sync_thread()
    pixels = frames.shape[1:]
    counts = target.torch().reshape(len(frames), 2, *pixels)
    return counts, torch.stack([loop.tensor(value, pixels) for value in after]), bad


def exact_floor(dr, value, divisor):
    """floor(value/divisor) of the two floats as they are, for value >= 0: a rounded quotient may
    reach the next whole number too early."""
    whole = dr.floor(value / divisor)
    rest = dr.fma(-whole, divisor, value)
    return dr.select(rest < 0, whole - 1, dr.select(rest >= divisor, whole + 1, whole))


@exclusive
def play_adjoint(
    frames, start, theta_on, theta_off, front_end, grad_counts, grad_end, *, first, wants_thetas
):
    """Adjoint of ``count``: gradients of the frames [first + T, ...] (rows before ``first`` are
    left to the caller), start, theta_on, theta_off [...] (zero unless wanted).

    Args:
      grad_end: [...] of the memorised level and the play's centre together; the start's is theirs
        together, too.
    """
    loop = Loop(frames, theta_on, theta_off)
    dr = loop.dr
    arr = loop.arr
    seed = loop.load(grad_counts)
    offset = loop.opaque(first)
    target = loop.zeros(first + len(frames))  # steps inside the play keep 0

    def step(
        index,
        value,
        centre,
        pull,
        slope,
        engaged,
        anchor,
        grad_start,
        grad_on,
        grad_off,
        grad_width,
    ):
        level, now_slope = front_end.traced(dr, value)
        rise, fall = beyond(dr, level, centre, loop.theta_on, loop.theta_off)
        is_on = rise > 0
        is_off = fall > 0
        moves = is_on | is_off
        seed_on = loop.at(seed, 2 * index, is_on) / loop.theta_on
        seed_off = loop.at(seed, 2 * index + 1, is_off) / loop.theta_off
        now_pull = seed_on - seed_off  # of this level through this step's count
        known = moves & (engaged != NONE)
        loop.put(target, (pull - now_pull) * slope, engaged + offset, known)
        grad_start = grad_start - dr.select(moves & ~known, now_pull, 0)
        moved_centre = centre + (rise - fall)
        if wants_thetas:
            # as it is rounded: what rounding leaves of ``rise`` would add up over many small steps
            moved = dr.abs(moved_centre - centre)
            grad_on = grad_on - seed_on * moved / loop.theta_on
            grad_off = grad_off - seed_off * moved / loop.theta_off
            # anchor: how the upper edge moves with the width: 0 where it stands at a level, 1 where
            # the lower one does, 1/2 at the start
            grad_width = (
                grad_width
                - dr.select(is_on, now_pull * anchor, 0)
                + dr.select(is_off, now_pull * (1 - anchor), 0)
            )
            anchor = dr.select(is_on, 0, dr.select(is_off, 1, anchor))
        pull = dr.select(moves, now_pull, pull)
        slope = dr.select(moves, now_slope(), slope)
        engaged = dr.select(moves, index, engaged)
        return (
            moved_centre,
            pull,
            slope,
            engaged,
            anchor,
            grad_start,
            grad_on,
            grad_off,
            grad_width,
        )

    zero = dr.zeros(arr.Float, loop.width)
    never = dr.full(arr.UInt32, NONE, loop.width)
    begun = (loop.load(start[1]), zero, zero, never, zero + 0.5, *[zero] * 4)
    _, pull, slope, engaged, anchor, grad_start, grad_on, grad_off, grad_width = loop(
        step, begun, target
    )
    end = loop.load(grad_end)
    known = engaged != NONE
    loop.put(target, (pull + end) * slope, engaged + offset, known)
    grad_start = grad_start + dr.select(known, 0, end)
    grad_width = grad_width + end * (anchor - 0.5)
    dr.eval(target, grad_start, grad_on, grad_off, grad_width)
    dr.sync_thread()
    grad_frames = target.torch().reshape(first + len(frames), *frames.shape[1:])
    return grad_frames, *(
        loop.tensor(grad, start.shape[1:])
        for grad in (grad_start, grad_on + grad_width / 2, grad_off + grad_width / 2)
    )


@exclusive
def turns_adjoint(frames, start, theta_on, theta_off, front_end, grad_counts, grad_end, *, first):
    """Gradients of the frames [first + T, ...] (rows before ``first`` are left to the caller) and
    of the place of the box that the pixels begin in, [...].

    Args: as for ``play_adjoint``; the box lies from centre - theta_on/2 to centre +
      theta_off/2.
    """
    loop = Loop(frames, theta_on, theta_off)
    dr = loop.dr
    arr = loop.arr
    seed = loop.load(grad_counts)
    offset = loop.opaque(first)
    target = loop.zeros(first + len(frames))
    share = 2 / (loop.theta_on + loop.theta_off)  # of a pixel per level, in the box

    def emit(frame, grad, grad_start):
        loop.put(target, grad * share, frame + offset, frame < START)
        return dr.select(frame == START, grad * share, grad_start)

    def step(index, value, grad_start, before, *slots):
        level, slope = front_end.traced(dr, value)
        pairs = _Pairs(loop, level, before, slots)
        pairs.walk(loop.at(seed, 2 * index + dr.select(pairs.rises, loop.arr.UInt32(0), 1)))
        grad_start = emit(*pairs.renew(index, slope()), grad_start)
        return grad_start, level, *pairs.joined()

    reference, centre = loop.rows(start)
    zero = dr.zeros(arr.Float, loop.width)
    none = dr.full(arr.UInt32, NONE, loop.width)
    box = (centre + loop.theta_off / 2, centre - loop.theta_on / 2, zero + 1, zero, zero + 1)
    empty = (zero, zero, zero, zero, zero, none)
    grad_start, _, *slots = loop(step, (zero, reference, *box, none - 1, *empty * PAIRS), target)
    end = loop.load(grad_end)
    for k in range(0, len(slots), WIDTH):
        plus, minus, weight, grad, slope, frame = slots[k : k + WIDTH]
        grad_start = emit(frame, (grad + end * weight * (plus - minus)) * slope, grad_start)
    dr.eval(target, grad_start)
    dr.sync_thread()
    grad_frames = target.torch().reshape(first + len(frames), *frames.shape[1:])
    return grad_frames, loop.tensor(grad_start, start.shape[1:])


class _Pairs:
    """The pairs of one step, the youngest first. Each is six values: plus, minus, weight, gradient,
    slope of the front end at the frame that it belongs to, and that frame."""

    def __init__(self, loop, level, before, slots):
        dr = loop.dr
        self.dr = dr
        self.level = level
        self.slots = [list(slots[k : k + WIDTH]) for k in range(0, len(slots), WIDTH)]
        self.rises = level > before
        self.theta = dr.select(self.rises, loop.theta_on, loop.theta_off)
        self.direction = dr.select(self.rises, dr.full(loop.arr.Float, 1), -1)

    def walk(self, seed):
        """Every pixel fires by the rule of the sensor; each event adds ``seed``."""
        dr = self.dr
        jump = self.theta * self.direction
        per_theta = dr.rcp(jump)
        passed = []
        self.seed = seed
        for slot in self.slots:
            plus, minus, weight = slot[:3]
            by_plus, by_minus = (
                dr.maximum(dr.floor(dr.fma(self.level - place, per_theta, -TIE)), 0)
                for place in (plus, minus)
            )
            more = weight * (by_plus - by_minus)
            passed.append(more)
            slot[0] = dr.fma(by_plus, jump, plus)
            slot[1] = dr.fma(by_minus, jump, minus)
            slot[2] = dr.select(dr.abs(slot[0] - slot[1]) < MET * self.theta, 0, weight)
            slot[3] = dr.fma(more, seed, slot[3])
        self.flux = -self.direction * _sum(passed)

    def renew(self, frame, slope):
        """A new youngest pair where something fired; the one before is kept where its pixels have
        not met. Returns the frame whose gradient is complete (NONE where there is none), and the
        gradient."""
        dr = self.dr
        fired = dr.abs(self.flux) > TIE
        keeps = fired & (self.slots[0][2] != 0)
        least = self.slots[1]
        least_size = _size(dr, least)
        chosen = 1
        for k, slot in enumerate(self.slots[2:], 2):
            smaller = _size(dr, slot) < least_size
            least_size = dr.select(smaller, _size(dr, slot), least_size)
            least = [dr.select(smaller, a, b) for a, b in zip(slot, least, strict=True)]
            chosen = dr.select(smaller, k, chosen)
        spread = least[2] * (least[0] - least[1]) / self.theta
        flux = self.flux + dr.select(keeps, spread, 0)
        youngest = self.slots[0]
        for k, slot in enumerate(self.slots[1:], 1):
            here = keeps & (chosen == k)
            slot[:] = [dr.select(here, a, b) for a, b in zip(youngest, slot, strict=True)]
        upper = dr.select(self.rises, self.level, self.level + self.theta)
        new = [
            upper,
            upper - self.theta,
            flux,
            self.flux * self.direction * self.seed,
            slope,
            frame,
        ]
        grad, slope, frame = (
            dr.select(keeps, a, b) for a, b in zip(least[3:], youngest[3:], strict=True)
        )
        self.slots[0] = [dr.select(fired, a, b) for a, b in zip(new, youngest, strict=True)]
        return dr.select(fired, frame, NONE), grad * slope

    def joined(self):
        return [value for slot in self.slots for value in slot]


def _sum(values):
    """Sum by halves, which a processor adds side by side."""
    half = len(values) // 2
    return _sum(values[:half]) + _sum(values[half:]) if half else values[0]


def _size(dr, slot):
    return dr.abs(slot[2] * (slot[0] - slot[1]))
